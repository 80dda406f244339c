"""On-orbit calibration of the installation matrix between star camera and remote-sensing camera."""
