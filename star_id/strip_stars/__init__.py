"""Stars in strips of a pushbroom camera that scans the sky: found, measured, identified."""
