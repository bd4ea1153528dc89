"""Flows of the hand's fields, with tangents carried along.

A state (m,) is a point (d,) and, row by row, k tangents (d, k), m = d(1 + k). Tangents obey the variational equation
U̇ = DV·U, integrated by the same method, so they are the exact derivative of the numerical step. Inside, arrays hold up
to `LANES` states at once, the last axis; n of them are in use.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled, inlined, kernel
from dt_viz.kernels.dormand_prince import ERROR, STAGES, allowed_error, first_step, is_straight, next_step
from dt_viz.kernels.fields import FieldWork, Terms, at_rest, field_work, velocity
from dt_viz.kernels.gaussians import LANES, Array

Rows = NDArray[np.int64]

RATE, EULER, RK4, IMPLICIT_EULER, DORMAND_PRINCE = 0, 1, 2, 3, 4
"""What is done to states: they become their rates of change, or are carried along in steps, last adaptive ones."""
STAGES_OF = np.array((1, 1, 4))
"""Number of stages of a step of the first of these."""
TANGENT_TOLERANCE = 3e-4
"""Largest estimated error of a step's tangents, relative to their largest entry."""
MAX_ITERATIONS = 200
"""Largest number of Newton's iterations for a step of implicit Euler."""
TINY = 1e-300


@inlined
def _rate(field: Terms, states: Array, n: int, d: int, work: FieldWork, rate: Array) -> None:
    """Write V and DV·U at states (m, L)."""
    V, DV = velocity(field, states, n, int(len(states) > d), work)
    for i in range(d):
        _copy(V[i], n, rate[i])
    _multiply(DV, states, n, d, rate)


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
def _set(factor: float, row: Array, start: Array, n: int, into: Array) -> None:
    """Write start + factor·row."""
    for p in range(n):
        into[p] = start[p] + factor * row[p]


@compiled
def _copy(row: Array, n: int, into: Array) -> None:
    """Write a row."""
    for p in range(n):
        into[p] = row[p]


@compiled
def _load(states: Array, rows: Rows, n: int, block: Array) -> None:
    """Write n of the states (N, m), `rows` (L,), to lanes (m, L)."""
    for p in range(n):
        for i in range(len(block)):
            block[i, p] = states[rows[p], i]


@compiled
def _store(block: Array, rows: Rows, n: int, states: Array) -> None:
    """Write lanes (m, L) to n of the states (N, m), `rows` (L,)."""
    for p in range(n):
        for i in range(len(block)):
            states[rows[p], i] = block[i, p]


@compiled
def _largest(row: Array, begin: int, end: int) -> float:
    """Largest magnitude of some entries."""
    largest = 0.0
    for i in range(begin, end):
        largest = max(largest, abs(row[i]))
    return largest


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


@compiled
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
    y, tangents, inverse, change = memory[0], memory[1], memory[2:5], memory[8]
    scale, V = 1.0, work[4]
    if not begun:
        velocity(field, states, n, 0, work)
    for i in range(d):
        scale = max(scale, 1 + _largest(states[i], 0, n))
        if not begun:
            _set(h, V[i], states[i], n, y[i])
            continue
        _copy(states[i], n, y[i])
        for j in range(d):
            factor, source, into = inverse[i, j], change[j], y[i]
            for p in range(n):
                into[p] += factor[p] * source[p]
    memory[7, 0, :] = np.inf
    for _ in range(MAX_ITERATIONS):
        V, DV = velocity(field, y, n, 1, work)
        _invert(h, DV, n, inverse)
        if _newton(y, states, n, h, V, inverse, scale, memory[5:8]):
            break
    if len(states) > d:
        _invert(h, velocity(field, y, n, 1, work)[1], n, inverse)
        for i in range(d, len(states)):
            _copy(states[i], n, tangents[i])
        _multiply(inverse, tangents, n, d, states)
    for i in range(d):
        _set(-1.0, states[i], y[i], n, change[i])
        _copy(y[i], n, states[i])


@inlined
def _stepped(field: Terms, states: Array, d: int, method: int, duration: float, steps: int, work: FieldWork) -> None:
    """Carry states (N, m) along in equal steps, in place."""
    m, h = states.shape[1], duration / steps
    block, memory = np.empty((m, LANES)), np.empty((9, max(m, 3), LANES))
    rows, begin = np.empty(LANES, np.int64), 0
    while begin < len(states):
        n = 0
        while n < LANES and begin < len(states):
            if method == RATE or not at_rest(field, states[begin], d):
                rows[n] = begin
                n += 1
            begin += 1
        _load(states, rows, n, block)
        for step in range(steps):
            if method == IMPLICIT_EULER:
                _implicit_euler(field, block, n, d, h, step > 0, work, memory)
                continue
            rate, there, end = memory[0], memory[1], memory[2]
            for stage in range(STAGES_OF[method]):
                _rate(field, there if stage > 0 else block, n, d, work, rate)
                weight, ahead = (h / 6 if stage in (0, 3) else h / 3), (h if stage == 2 else h / 2)
                for i in range(m):
                    if method == RATE:
                        _copy(rate[i], n, end[i])
                    elif method == EULER:
                        _set(h, rate[i], block[i], n, end[i])
                    else:
                        _set(weight, rate[i], end[i] if stage > 0 else block[i], n, end[i])
                        _set(ahead, rate[i], block[i], n, there[i])
            for i in range(m):
                _copy(end[i], n, block[i])
        _store(block, rows, n, states)


@inlined
def _begun(
    field: Terms, states: Array, d: int, duration: float, tolerance: float, work: FieldWork
) -> tuple[Array, Array]:
    """Carry along states (N, m) that one Euler step carries accurately enough, in place.

    Returns the rates (N, m) of the others, and the lengths (N,) of their first steps; 0 for those carried along.
    """
    m, total = states.shape[1], abs(duration)
    rates, steps = np.empty_like(states), np.zeros(len(states))
    block, rate = np.empty((m, LANES)), np.empty((m, LANES))
    for begin in range(0, len(states), LANES):
        n = min(LANES, len(states) - begin)
        rows = np.arange(begin, begin + n)
        _load(states, rows, n, block)
        _rate(field, block, n, d, work, rate)
        _store(rate, rows, n, rates)
        for p in range(n):
            speed = _largest(rates[begin + p], 0, d)
            ahead = min(total, tolerance / speed) if speed > 0 else 0.0
            for i in range(d):
                block[i, p] += (ahead if duration > 0 else -ahead) * rate[i, p]
        V, _ = velocity(field, block, n, 0, work)
        for p in range(n):
            state, own, turning = states[begin + p], rates[begin + p], 0.0
            speed = _largest(own, 0, d)
            if speed > 0:
                for i in range(d):
                    turning = max(turning, abs(V[i, p] - own[i]) / (min(total, tolerance / speed) * speed))
            still = is_straight(speed, turning, total, tolerance)
            if m > d:
                changing = _largest(own, d, m) * total
                still = speed * total <= tolerance and changing <= TANGENT_TOLERANCE * _largest(state, d, m)
            if still:
                _set(duration, own, state, m, state)
            else:
                steps[begin + p] = first_step(speed, turning, total, tolerance)
    return rates, steps


@compiled
def _error(s: Array, end: Array, defect: Array, p: int, d: int, tolerance: float) -> float:
    """Estimated error of the step of lane p from s to its end (m, L), relative to what is allowed."""
    error, motion, bent, largest = 0.0, 0.0, 0.0, TINY
    for i in range(d):
        error, motion = max(error, abs(defect[i, p])), max(motion, abs(end[i, p] - s[i, p]))
    for i in range(d, len(s)):
        bent, largest = max(bent, abs(defect[i, p])), max(largest, abs(end[i, p]))
    # beside a rest point a small error is large relative to the motion, and grows with it
    return max(error / allowed_error(motion, tolerance), bent / (TANGENT_TOLERANCE * largest))


@compiled
def _combine(coefficients: Array, count: int, k: Array, n: int, h: Array, into: Array) -> None:
    """Write h (L,) times the weighted sum (m, L) of the first `count` stages k (7, m, L)."""
    for i in range(len(into)):
        row = into[i]
        for j in range(count):
            factor, stage = coefficients[j], k[j, i]
            for p in range(n):
                row[p] = factor * h[p] * stage[p] + (row[p] if j > 0 else 0.0)


@inlined
def _adaptive(
    field: Terms, states: Array, d: int, duration: float, tolerance: float, max_steps: int, work: FieldWork
) -> int:
    """Carry states (N, m) along by Dormand–Prince steps, in place; returns how many need more than `max_steps`.

    Every state has its own step length, see `dt_viz.flows.integrators.integrate_adaptive`. Where one has arrived,
    another takes its lane.
    """
    m, total, sign = states.shape[1], abs(duration), 1.0 if duration > 0 else -1.0
    rates, steps = _begun(field, states, d, duration, tolerance, work)
    k, s, end, defect = np.empty((7, m, LANES)), np.empty((m, LANES)), np.empty((m, LANES)), np.empty((m, LANES))
    rows, tried, h, left = np.empty(LANES, np.int64), np.empty(LANES, np.int64), np.empty(LANES), np.empty(LANES)
    n, row, num_failed = 0, 0, 0
    while True:
        while n < LANES and row < len(states):
            if steps[row] > 0:
                rows[n], tried[n], h[n], left[n] = row, 0, steps[row], total
                for i in range(m):
                    s[i, n], k[0, i, n] = states[row, i], rates[row, i]
                n += 1
            row += 1
        if n == 0:
            return num_failed
        for stage in range(1, 7):
            _combine(STAGES[stage], stage, k, n, h, end)
            for i in range(m):
                _set(sign, end[i], s[i], n, end[i])
            _rate(field, end, n, d, work, k[stage])
        _combine(ERROR, 7, k, n, h, defect)
        for p in range(n - 1, -1, -1):
            error = _error(s, end, defect, p, d, tolerance)
            tried[p] += 1
            if error <= 1:
                left[p] -= h[p]
                for i in range(m):
                    s[i, p], k[0, i, p] = end[i, p], k[6, i, p]
            h[p] = min(next_step(h[p], error), left[p])
            arrived = left[p] <= 1e-12 * total
            if not arrived and tried[p] < max_steps:
                continue
            num_failed += int(not arrived)
            n -= 1
            for i in range(m):
                states[rows[p], i] = s[i, p]
                s[i, p], k[0, i, p] = s[i, n], k[0, i, n]
            rows[p], tried[p], h[p], left[p] = rows[n], tried[n], h[n], left[n]


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
    if method == DORMAND_PRINCE:
        return _adaptive(field, states, d, duration, tolerance, steps, work)
    _stepped(field, states, d, method, duration, steps, work)
    return 0
