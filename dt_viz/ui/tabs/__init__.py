"""The tabs of the panel, one file for each, and what they share."""
