"""Types of arrays, numerical zeros, and divisions by lengths that may be zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]
Mask = NDArray[np.bool_]

ZERO = 1e-12
"""Length below which a vector counts as zero, and least divisor, in the unit of its coordinates (m, s, rad)."""


def divisor(lengths: np.ndarray) -> np.ndarray:
    """Return lengths (*B,) as divisors: not negative, and at least `ZERO`."""
    return np.maximum(lengths, ZERO)


def unit(vectors: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return v/‖v‖ for vectors along an axis, (*B, d); those of length zero stay zero."""
    return vectors / divisor(np.linalg.norm(vectors, axis=axis, keepdims=True))
