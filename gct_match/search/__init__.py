"""Where in a strip a target may lie, to about a pixel."""
