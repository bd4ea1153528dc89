"""Independent measures that several test modules judge results by."""

from collections.abc import Callable

import numpy as np


def used_fraction(times: np.ndarray, q: np.ndarray, limits: np.ndarray) -> float:
    """The largest fraction of a velocity limit that any joint uses in any segment; infinite where the motion jumps.

    Args:
        times: (T,) seconds, not decreasing.
        q: (T, 6) joint angles, rad.
        limits: (6,) rad/s.
    """
    intervals, least = np.diff(times), (np.abs(np.diff(q, axis=0)) / limits).max(axis=1)
    used = np.where(least > 0, np.inf, 0.0)
    np.divide(least, intervals, out=used, where=intervals > 0)
    return float(used.max(initial=0.0))


def central_differences(function: Callable[[np.ndarray], np.ndarray], s: np.ndarray, h: float) -> np.ndarray:
    """Derivative of `function` (*B, d) → (*B, …) by the coordinates of `s`, in a new last axis; its error is O(h⁴)."""
    columns = []
    for e in h * np.eye(s.shape[-1]):
        far, near = function(s + 2 * e) - function(s - 2 * e), function(s + e) - function(s - e)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)
