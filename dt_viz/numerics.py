"""Numerical zeros, and divisions by lengths that may be zero."""

import numpy as np

ZERO = 1e-12
"""Length below which a vector counts as zero, and least divisor, in the unit of its coordinates (m, s, rad)."""


def divisor(lengths: np.ndarray) -> np.ndarray:
    """Return lengths (*B,) as divisors: not negative, and at least `ZERO`."""
    return np.maximum(lengths, ZERO)


def unit(vectors: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return v/‖v‖ for vectors along an axis, (*B, d); those of length zero stay zero."""
    return vectors / divisor(np.linalg.norm(vectors, axis=axis, keepdims=True))
