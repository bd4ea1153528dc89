"""Shapes to avoid, what is believed of them, and the files they come from."""
