"""From places on a detector to names in the catalogue."""
