"""From demonstrations to a stable motion."""
