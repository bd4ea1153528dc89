"""Measurements from the command line, `python -m dt_viz.evaluate`: each prints a table and writes its data."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that limit the threads of linear algebra; numerical libraries read them when they are first imported."""
