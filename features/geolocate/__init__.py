"""Pixels of a calibrated strip to places on the ground, and one virtual CCD of several."""
