"""Measurements from the command line, `python -m dt_viz.evaluate`: each prints a table and writes its data."""
