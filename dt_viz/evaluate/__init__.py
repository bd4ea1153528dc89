"""Measurements that a researcher repeats, `dt-viz evaluate NAME`: each prints tables and writes its data."""
