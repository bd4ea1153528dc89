"""Flows of the hand's fields, with tangents carried along.

A state (m,) is a point (d,) and, row by row, k tangents (d, k), m = d(1 + k). Tangents obey the variational equation
U̇ = DV·U, integrated by the same method, so they are the exact derivative of the numerical step. Inside, arrays hold up
to `LANES` states at once, the last axis; n of them are in use.
"""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.compiled import compiled, inlined, kernel
from dt_viz.kernels.fields import LANES, Array, FieldWork, Terms, field_work, velocity
from dt_viz.kernels.runge_kutta import add, carry_explicitly, copy, load, moving, rates, store

IMPLICIT_EULER = 4  # a method beside those of `dt_viz.kernels.runge_kutta`
MAX_ITERATIONS = 200  # largest number of Newton's iterations for a step of implicit Euler


@compiled
def _rate(field: Terms, states: Array, n: int, d: int, work: FieldWork, into: Array) -> None:
    """Write V and DV·U at states (m, L)."""
    V, DV = velocity(field, states, n, int(len(states) > d), work)
    into[:d] = V
    _multiply(DV, states, n, d, into)


@compiled
def _multiply(M: Array, states: Array, n: int, d: int, into: Array) -> None:
    """Write M·U of matrices M (d, d, L) and the tangents U of states (m, L)."""
    k = len(states) // d - 1
    for i in range(d):
        for c in range(k):
            row = into[d + i * k + c]
            for j in range(d):
                factor, tangent = M[i, j], states[d + j * k + c]
                for p in range(n):
                    row[p] = factor[p] * tangent[p] + (row[p] if j > 0 else 0.0)


@compiled
def _invert(h: float, DV: Array, n: int, inverse: Array) -> None:
    """Write (I − h·DV)⁻¹ (d, d, L) for d = 2 or 3, by cofactors."""
    for p in range(n):
        a, b, c, e = 1 - h * DV[0, 0, p], -h * DV[0, 1, p], -h * DV[1, 0, p], 1 - h * DV[1, 1, p]
        if len(DV) == 2:
            scale = 1 / (a * e - b * c)
            inverse[0, 0, p], inverse[0, 1, p] = e * scale, -b * scale
            inverse[1, 0, p], inverse[1, 1, p] = -c * scale, a * scale
            continue
        f, g, i, j, k = -h * DV[0, 2, p], -h * DV[1, 2, p], -h * DV[2, 0, p], -h * DV[2, 1, p], 1 - h * DV[2, 2, p]
        x, y, z = e * k - g * j, g * i - c * k, c * j - e * i
        scale = 1 / (a * x + b * y + f * z)
        inverse[0, 0, p], inverse[1, 0, p], inverse[2, 0, p] = x * scale, y * scale, z * scale
        inverse[0, 1, p], inverse[0, 2, p] = (f * j - b * k) * scale, (b * g - f * e) * scale
        inverse[1, 1, p], inverse[1, 2, p] = (a * k - f * i) * scale, (f * c - a * g) * scale
        inverse[2, 1, p], inverse[2, 2, p] = (b * i - a * j) * scale, (a * e - b * c) * scale


@inlined
def _newton(y: Array, states: Array, n: int, h: float, V: Array, inverse: Array, scale: float, memory: Array) -> bool:
    """Correct y (d, L) by Newton's method for y − h·V(y) = s; where the residual has grown, go back half the way.

    Returns whether that was the last correction: quadratic convergence makes the next one far below rounding.
    """
    best, direction, smallest, length = memory[0], memory[1], memory[2, 0], memory[2, 1]
    largest, correction, worse = 0.0, 0.0, False
    for p in range(n):
        size = 0.0
        for i in range(len(V)):
            V[i, p] = y[i, p] - h * V[i, p] - states[i, p]  # the residual
            size = max(size, abs(V[i, p]))
        largest = max(largest, size)
        if size > smallest[p] and size > 1e-13 * scale:
            length[p] *= 0.5
            worse = True
            continue
        smallest[p], length[p] = size, 1.0
        for i in range(len(V)):
            direction[i, p], best[i, p] = 0.0, y[i, p]
            for j in range(len(V)):
                direction[i, p] += inverse[i, j, p] * V[j, p]
            correction = max(correction, abs(direction[i, p]))
    if largest <= 1e-15 * scale:
        return True
    for i in range(len(V)):
        for p in range(n):
            y[i, p] = best[i, p] - length[p] * direction[i, p]
    return not worse and correction <= 1e-8 * scale


@inlined
def _implicit_euler(
    field: Terms, states: Array, n: int, d: int, h: float, begun: bool, work: FieldWork, memory: Array
) -> None:
    """Carry states (m, L) to the y with y − h·V(y) = s, tangents by (I − h·DV(y))⁻¹.

    See `dt_viz.flows.integrators.implicit_euler`. From the last step, if that is begun, h·V(s) and (I − h·DV(s))⁻¹ are
    known, so that Newton's method begins with its step from s.
    """
    s, y, inverse, change = states[:d], memory[0, :d], memory[2:5], memory[8, :d]
    scale = 1 + np.abs(s[:, :n]).max()
    if begun:
        copy(s, n, y)
        for i in range(d):
            for j in range(d):
                factor, source, into = inverse[i, j], change[j], y[i]
                for p in range(n):
                    into[p] += factor[p] * source[p]
    else:
        add(h, velocity(field, s, n, int(d < 0), work)[0], s, n, y)
    memory[7, 0, :] = np.inf
    both = int(d > 0)  # not the constant 1, of which numba would compile the fields once more
    for _ in range(MAX_ITERATIONS):
        V, DV = velocity(field, y, n, both, work)
        _invert(h, DV, n, inverse)
        if _newton(y, states, n, h, V, inverse, scale, memory[5:8]):
            break
    if len(states) > d:
        _invert(h, velocity(field, y, n, both, work)[1], n, inverse)
        tangents = memory[1, : len(states)]
        copy(states, n, tangents)
        _multiply(inverse, tangents, n, d, states)
    add(-1.0, s, y, n, change)
    copy(y, n, s)


@inlined
def _carry_implicitly(field: Terms, states: Array, d: int, duration: float, steps: int, work: FieldWork) -> None:
    """Carry states (N, m) along in equal steps of implicit Euler, in place."""
    m, rows = states.shape[1], moving(rates(_rate, field, states, d, LANES, work))
    block, memory = np.empty((m, LANES)), np.empty((9, max(m, 3), LANES))
    for begin in range(0, len(rows), LANES):
        n = min(LANES, len(rows) - begin)
        load(states, rows, begin, n, block)
        for step in range(steps):
            _implicit_euler(field, block, n, d, duration / steps, step > 0, work, memory)
        store(block, rows, begin, n, states)


@kernel
def carry(field: Terms, states: Array, d: int, method: int, duration: float, steps: int, tolerance: float) -> int:
    """Carry states (N, m) along the flow of a field in R^d, in place: one kernel, since compiling takes long.

    Args:
        field: V.
        states: see above.
        d: 2 or 3.
        method: one of those above.
        duration: of the flow, of either sign.
        steps: number of equal steps, or largest number of adaptive ones.
        tolerance: of an adaptive step, in the unit of the points.

    Returns:
        Number of states that need more adaptive steps.
    """
    work = field_work(field, d)
    if method == IMPLICIT_EULER:
        _carry_implicitly(field, states, d, duration, steps, work)
        return 0
    return carry_explicitly(_rate, field, states, d, method, duration, steps, tolerance, LANES, work)
