"""What a strip should show of a target, and where."""
