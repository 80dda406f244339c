"""Every further job than calibrating: one folder each, which can be taken out."""
