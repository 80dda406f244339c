"""Calibration of the interior orientation of the remote-sensing camera."""
