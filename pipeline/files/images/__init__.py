"""Image files: PNG, TIFF, FITS and others, opened in one way, whole or by window."""
