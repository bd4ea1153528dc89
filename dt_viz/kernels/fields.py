"""Vector fields of the hand, V(s) = Σ B·v(A(s − o)) over terms of a few kinds, and their derivatives.

Arrays hold up to `LANES` points at once, the last axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled
from dt_viz.kernels.distances import Record

Array = NDArray[np.float64]
GaussianWork = tuple[Array, Array, Array, Array]
"""Memory for 1-D Gaussians (3, 3, n, L), partial sums (3, m, L) and (3, 3, m, L), and sums (3, 3, 3, num, L)."""

LANES = 64  # L, the largest number of points at once
LOG2_E, LN2_HIGH, LN2_LOW = 1 / np.log(2), 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""1/ln 2, and ln 2 as a sum whose first part has zeros at its end."""
WHOLE = 1.5 * 2.0**52
"""Number to which others are added in order to round them: the last bits of the sum are a whole number then."""
SMALLEST = -700.0  # exponent below which an exponential is 0


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


GRID, OCCUPANCY, REGION, ASIDE, SHIFT = 0, 1, 2, 3, 4
"""Kinds of terms; the first three have weights on a grid of Gaussians."""

TERM = np.dtype(
    [
        ("kind", np.int64),
        ("origin", np.float64, 3),  # o, of its own frame
        ("inward", np.float64, (3, 3)),  # A, to its own frame; the plane's coordinates are the last two there
        ("outward", np.float64, (3, 3)),  # B, from the components of v
        ("first", np.float64, 3),  # first node of the grid
        ("spacing", np.float64, 3),  # distance between neighbouring nodes
        ("counts", np.int64, 3),  # number of nodes along each axis
        ("ell", np.float64),  # ℓ of the Gaussians
        ("num", np.int64),  # number of components of a weight
        ("begin", np.int64),  # index of its first value
        ("size", np.int64),  # number of its values
        ("bias", np.float64),  # of an occupancy map: the logit far away
        ("temperature", np.float64),  # T, 0 for the paper's generator
    ]
)
"""A term; what a kind does not have is zero."""


class Terms(NamedTuple):
    """A field as compiled loops take it."""

    terms: NDArray[np.void]  # (T,) of dtype `TERM`
    values: Array
    """Values of all terms: weights, the last axis of the grid fastest, or what `_aside` says."""


FieldWork = tuple[GaussianWork, Array, Array, Array, Array, Array]
"""Memory for points in R^d: that of Gaussians; u (3, L), v (3, L), Dv (3, 3, L); V (d, L) and DV (d, d, L)."""


@compiled
def field_work(field: Terms, d: int) -> FieldWork:
    """Memory for points of a field in R^d."""
    counts, num = np.zeros(3, np.int64), 1
    for t in range(len(field.terms)):
        counts, num = np.maximum(counts, field.terms[t].counts), max(num, field.terms[t].num)
    own = np.empty((3, LANES)), np.empty((3, LANES)), np.empty((3, 3, LANES))
    return gaussian_work(counts, num), *own, np.empty((d, LANES)), np.empty((d, d, LANES))


@compiled
def velocity(field: Terms, s: Array, n: int, order: int, work: FieldWork) -> tuple[Array, Array]:
    """V (d, L) and, for the order 1, DV (d, d, L) at n points s, of which the first d coordinates are taken."""
    gaussians, u, v, Dv, V, DV = work
    d = len(V)
    _clear(V, n)
    for i in range(d):
        _clear(DV[i], n)
    for t in range(len(field.terms)):
        term = field.terms[t]
        A, B = term.inward, term.outward
        _clear(u, n)
        for i in range(3):
            for j in range(d):
                factor, origin, source, into = A[i, j], term.origin[j], s[j], u[i]
                for p in range(n):
                    into[p] += factor * (source[p] - origin)
        if not _own(term, field.values, u, n, order, gaussians, v, Dv):
            continue
        for k in range(3):
            for i in range(d):
                factor, source, into = B[i, k], v[k], V[i]
                for p in range(n):
                    into[p] += factor * source[p]
                for j in range(d if order else 0):
                    a, b, c, into = factor * A[0, j], factor * A[1, j], factor * A[2, j], DV[i, j]
                    x, y, z = Dv[k, 0], Dv[k, 1], Dv[k, 2]
                    for p in range(n):
                        into[p] += a * x[p] + b * y[p] + c * z[p]
    return V, DV


@compiled
def _own(
    term: Record, values: Array, u: Array, n: int, order: int, gaussians: GaussianWork, v: Array, Dv: Array
) -> bool:
    """Write v and Dv of a term at n points u of its own frame; False where they are 0."""
    if term.kind == ASIDE:
        _aside(term, values, u, n, v, Dv)
        return True
    if term.kind in (REGION, SHIFT) and not _any_inside(u, n):
        return False
    if term.kind == SHIFT:
        _first(n, v, Dv)
        _fade(u, n, v, Dv)
        return True
    sums = gaussian_sums(term, values, u, n, order + int(term.kind == OCCUPANCY), gaussians)
    if term.kind == OCCUPANCY:
        _occupancy(term, sums, n, v, Dv)
        return True
    _grid(term, sums, n, v, Dv)
    if term.kind == REGION:
        _fade(u, n, v, Dv)
    return True


@compiled
def _clear(rows: Array, n: int) -> None:
    for row in range(len(rows)):
        for p in range(n):
            rows[row, p] = 0


@compiled
def _grid(term: Record, sums: Array, n: int, v: Array, Dv: Array) -> None:
    """Write Wᵀk(u, ŝ)."""
    for k in range(3):
        for p in range(n):
            v[k, p] = sums[0, 0, 0, k, p] if k < term.num else 0.0
            Dv[k, 0, p] = sums[1, 0, 0, k, p] if k < term.num else 0.0
            Dv[k, 1, p] = sums[0, 1, 0, k, p] if k < term.num else 0.0
            Dv[k, 2, p] = sums[0, 0, 1, k, p] if k < term.num else 0.0


@compiled
def _first(n: int, v: Array, Dv: Array) -> None:
    for k in range(3):
        for p in range(n):
            v[k, p] = 1.0 if k == 0 else 0.0
        _clear(Dv[k], n)


@compiled
def _any_inside(u: Array, n: int) -> bool:
    nearest = np.inf
    for p in range(n):
        nearest = min(nearest, u[0, p] * u[0, p] + u[1, p] * u[1, p] + u[2, p] * u[2, p])
    return nearest < 1


@compiled
def _fade(u: Array, n: int, v: Array, Dv: Array) -> None:
    """Multiply v by (1 − ‖u‖²)³, up to the border ‖u‖ = 1, and by 0 beyond it."""
    for p in range(n):
        room = max(1 - (u[0, p] * u[0, p] + u[1, p] * u[1, p] + u[2, p] * u[2, p]), 0.0)
        window, slope = room * room * room, -6 * room * room
        for k in range(3):
            for j in range(3):
                Dv[k, j, p] = window * Dv[k, j, p] + v[k, p] * slope * u[j, p]
            v[k, p] *= window


@compiled
def _occupancy(term: Record, sums: Array, n: int, v: Array, Dv: Array) -> None:
    """Write ∇U of an occupancy map: U′(logit)·∇logit, with U′ as `dt_viz.obstacles.occupancy.AvoidanceField` says."""
    T, bias = term.temperature, term.bias
    far = 1 / (1 + np.exp(-bias / T)) if T > 0 else 0.0
    for p in range(n):
        logit = sums[0, 0, 0, 0, p] + bias
        if T > 0:
            share = 1 / (1 + np.exp(-logit / T))
            weight = max(share - far, 0.0)
            slope = share * (1 - share) / T if weight > 0 else 0.0
        else:
            share = 1 / (1 + np.exp(-logit))
            weight = share * (1 - share)
            slope = weight * (1 - 2 * share)
        x, y, z = sums[1, 0, 0, 0, p], sums[0, 1, 0, 0, p], sums[0, 0, 1, 0, p]
        v[0, p], v[1, p], v[2, p] = weight * x, weight * y, weight * z
        Dv[0, 0, p] = weight * sums[2, 0, 0, 0, p] + slope * x * x
        Dv[1, 1, p] = weight * sums[0, 2, 0, 0, p] + slope * y * y
        Dv[2, 2, p] = weight * sums[0, 0, 2, 0, p] + slope * z * z
        Dv[0, 1, p] = Dv[1, 0, p] = weight * sums[1, 1, 0, 0, p] + slope * x * y
        Dv[0, 2, p] = Dv[2, 0, p] = weight * sums[1, 0, 1, 0, p] + slope * x * z
        Dv[1, 2, p] = Dv[2, 1, p] = weight * sums[0, 1, 1, 0, p] + slope * y * z


@compiled
def _aside(term: Record, values: Array, u: Array, n: int, v: Array, Dv: Array) -> None:
    """Write (exp(−½‖A(u − c)‖²) Π_e (1 − exp(−½‖u − e‖²/ρ_e²)), 0, 0); values are c, A, then e, ρ_e of each end."""
    at = values[term.begin : term.begin + term.size]
    _clear(v, n)
    for k in range(3):
        _clear(Dv[k], n)
    weight, along_x, along_y, along_z = v[0], Dv[0, 0], Dv[0, 1], Dv[0, 2]
    u_x, u_y, u_z = u[0], u[1], u[2]
    for i in range(3):
        a, b, c = at[3 + 3 * i], at[4 + 3 * i], at[5 + 3 * i]
        for p in range(n):
            part = a * (u_x[p] - at[0]) + b * (u_y[p] - at[1]) + c * (u_z[p] - at[2])
            weight[p] -= 0.5 * part * part
            along_x[p] -= part * a
            along_y[p] -= part * b
            along_z[p] -= part * c
    for p in range(n):
        weight[p] = exponential(weight[p])
        along_x[p] *= weight[p]
        along_y[p] *= weight[p]
        along_z[p] *= weight[p]
    for e in range(12, len(at), 4):
        scale, end_x, end_y, end_z = 1 / (at[e + 3] * at[e + 3]), at[e], at[e + 1], at[e + 2]
        for p in range(n):
            x, y, z = u_x[p] - end_x, u_y[p] - end_y, u_z[p] - end_z
            half = 0.5 * scale * (x * x + y * y + z * z)
            lost = exponential(-half)
            kept = 1 - lost if half > 1e-3 else half * (1 - half / 2 * (1 - half / 3 * (1 - half / 4)))
            share = weight[p] * lost * scale
            along_x[p] = kept * along_x[p] + share * x
            along_y[p] = kept * along_y[p] + share * y
            along_z[p] = kept * along_z[p] + share * z
            weight[p] *= kept
