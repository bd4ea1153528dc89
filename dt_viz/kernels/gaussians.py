"""Sums of Gaussians on an equally spaced grid, Σ_i w_i exp(−ℓ‖u − ŝ_i‖²), and their partial derivatives.

A Gaussian is a product of 1-D Gaussians, so a sum is contracted axis by axis. Arrays hold up to `LANES` points at once,
the last axis, so that the innermost loops become vector instructions. A grid in the plane has no nodes along a first
axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled
from dt_viz.kernels.distances import Record

Array = NDArray[np.float64]
GaussianWork = tuple[Array, Array, Array, Array]
"""Memory for 1-D Gaussians (3, 3, n, L), partial sums (3, m, L) and (3, 3, m, L), and sums (3, 3, 3, num, L)."""

LANES = 64
"""L, the largest number of points at once."""
LOG2_E, LN2_HIGH, LN2_LOW = 1 / np.log(2), 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""1/ln 2, and ln 2 as a sum whose first part has zeros at its end."""
WHOLE = 1.5 * 2.0**52
"""Number to which others are added in order to round them: the last bits of the sum are a whole number then."""
SMALLEST = -700.0
"""Exponent below which an exponential is 0."""


@compiled
def exponential(x: float) -> float:
    """exp(x) for x ≤ 0 to rounding, without branches: x = k·ln 2 + r, and a polynomial in r."""
    shifted = max(x, SMALLEST) * LOG2_E + WHOLE
    k = shifted - WHOLE
    r = max(x, SMALLEST) - k * LN2_HIGH - k * LN2_LOW
    p = 1 / 6227020800 * r + 1 / 479001600
    p = ((p * r + 1 / 39916800) * r + 1 / 3628800) * r + 1 / 362880
    p = ((p * r + 1 / 40320) * r + 1 / 5040) * r + 1 / 720
    p = ((p * r + 1 / 120) * r + 1 / 24) * r + 1 / 6
    p = ((p * r + 0.5) * r + 1) * r + 1
    # k is added to the exponent of the floating-point number p
    bits = np.float64(p).view(np.int64) + (np.float64(shifted).view(np.int64) << 52)
    return np.int64(bits).view(np.float64) if x > SMALLEST else 0.0


@compiled
def gaussian_work(counts: NDArray[np.int64], num: int) -> GaussianWork:
    """Memory for grids of at most `counts` (3,) nodes and sums with at most `num` components."""
    length = counts[2] * num
    rows = np.empty((3, counts[1] * length if counts[0] > 0 else 0, LANES))
    planes = np.empty((3, 3, length, LANES))
    return np.empty((3, 3, counts.max(), LANES)), rows, planes, np.zeros((3, 3, 3, num, LANES))


@compiled
def _along(u: Array, first: float, spacing: float, ell: float, order: int, num_nodes: int, n: int, g: Array) -> None:
    """Write exp(−ℓ(u − ŝ_j)²), ŝ_j = first + j·spacing, and its derivatives up to `order` to g (3, nodes, L)."""
    for j in range(num_nodes):
        node, value, slope, bend = first + j * spacing, g[0, j], g[1, j], g[2, j]
        for p in range(n):
            offset = u[p] - node
            value[p] = exponential(-ell * offset * offset)
        if order > 0:
            for p in range(n):
                factor = -2 * ell * (u[p] - node)
                slope[p] = factor * value[p]
                bend[p] = (factor * factor - 2 * ell) * value[p]


@compiled
def _weighted(g: Array, count: int, values: Array, begin: int, stride: int, n: int, into: Array) -> None:
    """Write Σ_j g_j·values[begin + j·stride] of `count` rows g (nodes, L), four at a time."""
    for p in range(n):
        into[p] = 0
    for j in range(0, count - 3, 4):
        at = begin + j * stride
        a, b, c, d = values[at], values[at + stride], values[at + 2 * stride], values[at + 3 * stride]
        g_a, g_b, g_c, g_d = g[j], g[j + 1], g[j + 2], g[j + 3]
        for p in range(n):
            into[p] += (g_a[p] * a + g_b[p] * b) + (g_c[p] * c + g_d[p] * d)
    for j in range(count // 4 * 4, count):
        a, g_a = values[begin + j * stride], g[j]
        for p in range(n):
            into[p] += g_a[p] * a


@compiled
def _contracted(g: Array, count: int, rows: Array, begin: int, stride: int, n: int, into: Array) -> None:
    """Write Σ_j g_j·rows[begin + j·stride] of `count` rows g (nodes, L), four at a time."""
    for p in range(n):
        into[p] = 0
    for j in range(0, count - 3, 4):
        at = begin + j * stride
        a, b, c, d = rows[at], rows[at + stride], rows[at + 2 * stride], rows[at + 3 * stride]
        g_a, g_b, g_c, g_d = g[j], g[j + 1], g[j + 2], g[j + 3]
        for p in range(n):
            into[p] += (g_a[p] * a[p] + g_b[p] * b[p]) + (g_c[p] * c[p] + g_d[p] * d[p])
    for j in range(count // 4 * 4, count):
        a, g_a = rows[begin + j * stride], g[j]
        for p in range(n):
            into[p] += g_a[p] * a[p]


@compiled
def gaussian_sums(grid: Record, values: Array, u: Array, n: int, order: int, work: GaussianWork) -> Array:
    """Sums with the `grid.num` components of its weights, and partial derivatives up to `order`, at n points u (3, L).

    Returns:
        (3, 3, 3, num, L): [1, 0, 1] is ∂²/∂u_1∂u_3. What is of a higher order is undefined.
    """
    along, rows, planes, sums = work
    counts, num, length = grid.counts, grid.num, grid.counts[2] * grid.num
    in_space = counts[0] > 0
    for axis in range(3):
        _along(u[axis], grid.first[axis], grid.spacing[axis], grid.ell, order, counts[axis], n, along[axis])
    highest = order if in_space else 0  # nothing depends on the first coordinate in the plane
    for i in range(highest + 1):
        if in_space:
            for m in range(counts[1] * length):
                _weighted(along[0, i], counts[0], values, grid.begin + m, counts[1] * length, n, rows[i, m])
        for j in range(order + 1 - i):
            for m in range(length):
                if in_space:
                    _contracted(along[1, j], counts[1], rows[i], m, length, n, planes[i, j, m])
                else:
                    _weighted(along[1, j], counts[1], values, grid.begin + m, length, n, planes[i, j, m])
            for k in range(order + 1 - i - j):
                for m in range(num):
                    _contracted(along[2, k], counts[2], planes[i, j], m, num, n, sums[i, j, k, m])
    return sums
