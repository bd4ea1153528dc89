"""The controls and the status."""
