"""Ground calibration targets and dumps before a calibration: choose, match, begin, check."""
