"""Compiled inner loops: pure functions of arrays for what a drag repeats, free of the interpreter (numba)."""
