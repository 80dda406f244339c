"""A self-contained HTML page about a result, drawn from what `calibrate` saved, and the pictures for it."""
