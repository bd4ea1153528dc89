"""Alignment of two paths: the best way of stepping forward along both, from their first to their last points."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.compiled import kernel
from dt_viz.numerics import Array


@kernel
def aligned(a: Array, b: Array, adds: bool) -> Array:
    """Compute the least sum, or the least largest, of the distances between points that meet on such a way.

    D(i, j) is ‖a_i − b_j‖ and min(D(i−1, j), D(i, j−1), D(i−1, j−1)), added or the larger one.

    Args:
        a: (B, n, d) paths.
        b: (B, m, d) others.
        adds: whether distances add up.

    Returns:
        (B,) for each pair.
    """
    found = np.empty(len(a))
    for pair in range(len(a)):
        last = np.full(b.shape[1] + 1, np.inf)  # D(i − 1, j − 1) at j
        last[0] = 0.0
        for i in range(a.shape[1]):
            diagonal, last[0] = last[0], np.inf
            for j in range(b.shape[1]):
                squared = 0.0
                for k in range(a.shape[2]):
                    squared += (a[pair, i, k] - b[pair, j, k]) ** 2
                least, diagonal = min(last[j], last[j + 1], diagonal), last[j + 1]
                last[j + 1] = np.sqrt(squared) + least if adds else max(np.sqrt(squared), least)
        found[pair] = last[-1]
    return found
