"""Pictures as arrays: masked, normalised, read between their pixels, and their spectra."""
