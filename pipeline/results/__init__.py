"""A finished result: its folder, and everything that is computed from it."""
