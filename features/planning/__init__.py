"""Before any data: what a campaign will reach, and which scans of the sky to take."""
