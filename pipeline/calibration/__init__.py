"""The order of a calibration: rounds of matching, one dump, several dumps jointly."""
