"""Obstacles: their shapes, the occupancy learned from them, and the files they come from."""
