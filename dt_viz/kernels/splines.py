"""Cubic splines through samples of several curves, each with knots of its own."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import short_kernel


@short_kernel
def cubics(knots: Array, values: Array) -> Array:
    """Coefficients of the cubic splines through samples, whose first and last two pieces are one cubic each.

    With the steps h_i and slopes σ_i of the pieces, continuous second derivatives ask of the derivatives s_i that

        h_i s_{i−1} + 2 (h_{i−1} + h_i) s_i + h_{i−1} s_{i+1} = 3 (h_i σ_{i−1} + h_{i−1} σ_i),

    a tridiagonal system, solved by elimination (de Boor, A Practical Guide to Splines, ch. IV).

    Args:
        knots: (R, T) increasing along each curve, T ≥ 4.
        values: (R, T, k) there.

    Returns:
        (4, R, T − 1, k) by falling powers of the distance from the begin of each piece.
    """
    num_curves, num, dim = values.shape
    found = np.empty((4, num_curves, num - 1, dim))
    h, upper, s = np.empty(num - 1), np.empty(num), np.empty((num, dim))
    for r in range(num_curves):
        x, y = knots[r], values[r]
        for i in range(num - 1):
            h[i] = x[i + 1] - x[i]
        begin, end = h[0] + h[1], h[-1] + h[-2]
        upper[0] = begin / h[1]
        for k in range(dim):
            first, second = (y[1, k] - y[0, k]) / h[0], (y[2, k] - y[1, k]) / h[1]
            s[0, k] = ((h[0] + 2 * begin) * h[1] * first + h[0] ** 2 * second) / begin / h[1]
        for i in range(1, num - 1):
            pivot = 2 * (h[i - 1] + h[i]) - h[i] * upper[i - 1]
            upper[i] = h[i - 1] / pivot
            for k in range(dim):
                before, after = (y[i, k] - y[i - 1, k]) / h[i - 1], (y[i + 1, k] - y[i, k]) / h[i]
                s[i, k] = (3 * (h[i] * before + h[i - 1] * after) - h[i] * s[i - 1, k]) / pivot
        pivot = h[-2] - end * upper[-2]
        for k in range(dim):
            before, last = (y[-2, k] - y[-3, k]) / h[-2], (y[-1, k] - y[-2, k]) / h[-1]
            right = (h[-1] ** 2 * before + (2 * end + h[-1]) * h[-2] * last) / end
            s[-1, k] = (right - end * s[-2, k]) / pivot
        for i in range(num - 2, -1, -1):
            for k in range(dim):
                s[i, k] -= upper[i] * s[i + 1, k]
                slope = (y[i + 1, k] - y[i, k]) / h[i]
                bend = (s[i, k] + s[i + 1, k] - 2 * slope) / h[i]
                found[0, r, i, k], found[1, r, i, k] = bend / h[i], (slope - s[i, k]) / h[i] - bend
                found[2, r, i, k], found[3, r, i, k] = s[i, k], y[i, k]
    return found
