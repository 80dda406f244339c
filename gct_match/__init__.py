"""Ground calibration targets found in raw strips and measured to a few thousandths of a pixel."""
