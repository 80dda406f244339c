"""Whether the mounting moved between several results."""
