"""Finds ground calibration targets in raw strips and places them to a few thousandths of a pixel."""
