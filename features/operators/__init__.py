"""Operators' own files to a dump: what a mission has published or downlinked, without images."""
