"""Where units of work are computed, and how finished ones are kept; what a unit is, is defined elsewhere."""
