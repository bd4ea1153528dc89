"""Equal Runge–Kutta steps along a field, for as many states at once as it has lanes.

A field comes with a compiled function `rate(field, states, n, d, work, into)`. It writes the rates of change of the
first n states (m, L), whose first d entries are a point, to `into` (m, L); `work` is its memory. Where a rate is zero,
the flow rests.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.compiled import compiled, inlined

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Field = Any  # what a rate is computed from
Rate = Any  # a compiled function as above
Work = Any


@compiled
def load(states: Array, rows: Rows, begin: int, n: int, block: Array) -> None:
    """Write the states (N, m) of the rows (K,) `begin` to `begin` + n to lanes (m, L)."""
    for p in range(n):
        for i in range(len(block)):
            block[i, p] = states[rows[begin + p], i]


@compiled
def store(block: Array, rows: Rows, begin: int, n: int, states: Array) -> None:
    """Write lanes (m, L) to the states (N, m) of such rows."""
    for p in range(n):
        for i in range(len(block)):
            states[rows[begin + p], i] = block[i, p]


@compiled
def add(factor: float, values: Array, start: Array, n: int, into: Array) -> None:
    """Write start + factor·values of n lanes (m, L)."""
    for i in range(len(into)):
        row, begin, end = values[i], start[i], into[i]
        for p in range(n):
            end[p] = begin[p] + factor * row[p]


@compiled
def copy(values: Array, n: int, into: Array) -> None:
    """Write n lanes (m, L), with less to compile than an assignment of slices, which compares shapes."""
    for i in range(len(into)):
        row, end = values[i], into[i]
        for p in range(n):
            end[p] = row[p]


@compiled
def any_moves(rates: Array, n: int) -> bool:
    """Return whether one of n lanes (m, L) is not zero."""
    for i in range(len(rates)):
        for p in range(n):
            if rates[i, p] != 0:
                return True
    return False


@compiled
def largest(row: Array, begin: int, end: int) -> float:
    """Largest magnitude of some entries."""
    found = 0.0
    for i in range(begin, end):
        found = max(found, abs(row[i]))
    return found


@compiled
def rates(rate: Rate, field: Field, states: Array, d: int, lanes: int, work: Work) -> Array:
    """Rates of change (N, m) of states (N, m)."""
    rows, found = np.arange(len(states)), np.empty_like(states)
    block, into = np.empty((states.shape[1], lanes)), np.empty((states.shape[1], lanes))
    for begin in range(0, len(states), lanes):
        n = min(lanes, len(states) - begin)
        load(states, rows, begin, n, block)
        rate(field, block, n, d, work, into)
        store(into, rows, begin, n, found)
    return found


@compiled
def moving(rates: Array) -> Rows:
    """Rows of rates (N, m) that are not zero."""
    rows, num = np.empty(len(rates), np.int64), 0
    for row in range(len(rates)):
        if rates[row].any():
            rows[num] = row
            num += 1
    return rows[:num]


@inlined
def carry_in_steps(
    rate: Rate,
    field: Field,
    states: Array,
    first: Array,
    d: int,
    stages: int,
    duration: float,
    steps: int,
    lanes: int,
    work: Work,
) -> None:
    """Carry states (N, m) with the rates `first` (N, m) along in equal steps, in place.

    They are explicit Euler's of one stage, or the classical method's of four.
    """
    m, h = states.shape[1], duration / steps
    rows = moving(first)
    start, there, k, total = np.empty((m, lanes)), np.empty((m, lanes)), np.empty((m, lanes)), np.empty((m, lanes))
    for begin in range(0, len(rows), lanes):
        n = min(lanes, len(rows) - begin)
        load(states, rows, begin, n, start)
        load(first, rows, begin, n, k)
        for step in range(steps):
            total[:] = 0
            for stage in range(stages):
                if step + stage > 0:
                    rate(field, there, n, d, work, k)
                weight = h if stages == 1 else (h / 6 if stage in (0, 3) else h / 3)
                ahead = h if stage == 2 else h / 2
                for i in range(m):
                    for p in range(n):
                        total[i, p] += weight * k[i, p]
                        there[i, p] = start[i, p] + ahead * k[i, p]
            add(1.0, total, start, n, start)
            copy(start, n, there)
            if not any_moves(k, n):
                break
        store(start, rows, begin, n, states)


STAGES = np.array(
    [
        (0, 0, 0, 0, 0, 0),
        (1 / 5, 0, 0, 0, 0, 0),
        (3 / 40, 9 / 40, 0, 0, 0, 0),
        (44 / 45, -56 / 15, 32 / 9, 0, 0, 0),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0),
        (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ]
)
"""Coefficients of the stages; the last is the result of order five, so that its velocity begins the next step."""
ERROR = np.array((71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40))
"""Coefficients of the estimated error."""
SHORT = 1 / 15
"""Motion of a step, in the unit of the points, from which on its error may be the whole tolerance. In the core of an
obstacle space is squeezed ten thousand times; the inverse magnifies errors as much, so the relative error counts."""
ROUNDING = 1e-15  # difference of coordinates, in their unit, below which rounding hides it
TANGENT_TOLERANCE = 3e-4
"""Largest estimated error of a step's tangents, relative to their largest entry."""
STRAIGHT = 0.1  # largest relative change of the velocity along a motion that counts as straight
LONGEST_TURN, TURN_ERROR = 0.8, 3e-4
"""Length of a first step, in units of the time in which the velocity changes by its own size, and the error of such a
step relative to its motion, about."""


RATE, EULER, RK4, DORMAND_PRINCE = 0, 1, 2, 3
"""What is done to states: they become their rates of change, or are carried along in steps, last adaptive ones."""


@compiled
def allowed_error(motion: float, tolerance: float) -> float:
    """Largest error allowed for a step of this motion."""
    return min(max(tolerance / SHORT * motion, ROUNDING), tolerance)


@compiled
def is_straight(speed: float, turning: float, total: float, tolerance: float) -> bool:
    """Return whether one Euler step over the whole time `total` is accurate enough.

    A weak field is not enough for that: it is weak beside a rest point, too, where motions grow from nothing.

    Args:
        speed: of the point.
        turning: relative rate at which it changes.
        total: time.
        tolerance: largest error.
    """
    return total * speed <= tolerance and turning * total <= STRAIGHT


@compiled
def first_step(speed: float, turning: float, total: float, tolerance: float) -> float:
    """Length of the first step at a speed that changes at the relative rate `turning`.

    The error grows as its fifth power.
    """
    motion = total * speed
    caution = (allowed_error(motion, tolerance) / max(TURN_ERROR * motion, ROUNDING)) ** 0.2
    return min(total, LONGEST_TURN * caution / max(turning, ROUNDING))


@compiled
def next_step(h: float, error: float) -> float:
    """Length of the step after one of length h with this error, relative to what is allowed."""
    return h * min(max(0.9 * max(error, 1e-10) ** -0.2, 0.1), 5.0)


@inlined
def carry_explicitly(
    rate: Rate,
    field: Field,
    states: Array,
    d: int,
    method: int,
    duration: float,
    steps: int,
    tolerance: float,
    lanes: int,
    work: Work,
) -> int:
    """Carry states (N, m) along, in place, by one of the methods above; see `dt_viz.kernels.flows.carry`."""
    first, num_failed = rates(rate, field, states, d, lanes, work), 0
    if method == RATE:
        copy(first, first.shape[1], states)
    elif method == DORMAND_PRINCE:
        num_failed = _carry_adaptively(rate, field, states, first, d, duration, tolerance, steps, lanes, work)
    else:
        stages = 4 if method == RK4 else 1
        carry_in_steps(rate, field, states, first, d, stages, duration, steps, lanes, work)
    return num_failed


@inlined
def _carry_adaptively(
    rate: Rate,
    field: Field,
    states: Array,
    first: Array,
    d: int,
    duration: float,
    tolerance: float,
    max_steps: int,
    lanes: int,
    work: Work,
) -> int:
    """Carry states (N, m) with the rates `first` (N, m) along, in place, each with steps of its own.

    Returns how many need more than `max_steps`. Where a state has arrived, another takes its lane.
    """
    m, total, sign = states.shape[1], abs(duration), 1.0 if duration > 0 else -1.0
    waiting = moving(first)
    steps = _first_steps(rate, field, states, first, waiting, d, duration, tolerance, lanes, work)
    k, start, end, defect = np.empty((7, m, lanes)), np.empty((m, lanes)), np.empty((m, lanes)), np.empty((m, lanes))
    rows, tried, h, left = np.empty(lanes, np.int64), np.empty(lanes, np.int64), np.empty(lanes), np.empty(lanes)
    n, upcoming, num_failed = 0, 0, 0
    while True:
        while n < lanes and upcoming < len(waiting):
            row, length = waiting[upcoming], steps[upcoming]
            if length > 0:
                rows[n], tried[n], h[n], left[n] = row, 0, sign * length, total
                for i in range(m):
                    start[i, n], k[0, i, n] = states[row, i], first[row, i]
                n += 1
            upcoming += 1
        if n == 0:
            return num_failed
        for stage in range(1, 7):
            _combine(STAGES[stage], stage, k, n, h, end)
            add(1.0, end, start, n, end)
            rate(field, end, n, d, work, k[stage])
        _combine(ERROR, 7, k, n, h, defect)
        for p in range(n - 1, -1, -1):
            error = _error(start, end, defect, p, d, tolerance)
            length = abs(h[p])
            tried[p] += 1
            if error <= 1:
                left[p] -= length
                for i in range(m):
                    start[i, p], k[0, i, p] = end[i, p], k[6, i, p]
            h[p] = sign * min(next_step(length, error), left[p])
            arrived = left[p] <= 1e-12 * total
            if not arrived and tried[p] < max_steps:
                continue
            num_failed += int(not arrived)
            n -= 1
            for i in range(m):
                states[rows[p], i] = start[i, p]
                start[i, p], k[0, i, p] = start[i, n], k[0, i, n]
            rows[p], tried[p], h[p], left[p] = rows[n], tried[n], h[n], left[n]


@inlined
def _first_steps(
    rate: Rate,
    field: Field,
    states: Array,
    first: Array,
    rows: Rows,
    d: int,
    duration: float,
    tolerance: float,
    lanes: int,
    work: Work,
) -> Array:
    """Lengths of the first steps from rows (K,) of states with the rates `first` (N, m).

    It is 0 for those that one Euler step carries accurately enough; they are carried along, in place.
    """
    m, total, lengths = states.shape[1], abs(duration), np.zeros(len(rows))
    ahead, there = np.zeros(len(rows)), states[rows, :d]
    for k in range(len(rows)):
        speed = largest(first[rows[k]], 0, d)
        ahead[k] = min(total, tolerance / speed) if speed > 0 else 0.0
        for i in range(d):
            there[k, i] += (ahead[k] if duration > 0 else -ahead[k]) * first[rows[k], i]
    there = rates(rate, field, there, d, lanes, work)
    for k in range(len(rows)):
        state, own = states[rows[k]], first[rows[k]]
        speed, turning = largest(own, 0, d), 0.0
        for i in range(d if speed > 0 else 0):
            turning = max(turning, abs(there[k, i] - own[i]) / (ahead[k] * speed))
        still = is_straight(speed, turning, total, tolerance)
        if m > d:
            changing = largest(own, d, m) * total
            still = speed * total <= tolerance and changing <= TANGENT_TOLERANCE * largest(state, d, m)
        if still:
            for i in range(m):
                state[i] += duration * own[i]
        else:
            lengths[k] = first_step(speed, turning, total, tolerance)
    return lengths


@compiled
def _combine(coefficients: Array, count: int, k: Array, n: int, h: Array, into: Array) -> None:
    """Write h (L,) times the weighted sum (m, L) of the first `count` stages k (7, m, L)."""
    for i in range(len(into)):
        row = into[i]
        for j in range(count):
            factor, stage = coefficients[j], k[j, i]
            for p in range(n):
                row[p] = factor * h[p] * stage[p] + (row[p] if j > 0 else 0.0)


@compiled
def _error(start: Array, end: Array, defect: Array, p: int, d: int, tolerance: float) -> float:
    """Estimated error of the step of lane p from `start` to its end (m, L), relative to what is allowed."""
    error, motion, bent, largest = 0.0, 0.0, 0.0, 0.0
    for i in range(d):
        error, motion = max(error, abs(defect[i, p])), max(motion, abs(end[i, p] - start[i, p]))
    for i in range(d, len(start)):
        bent, largest = max(bent, abs(defect[i, p])), max(largest, abs(end[i, p]))
    # beside a rest point a small error is large relative to the motion, and grows with it
    return max(error / allowed_error(motion, tolerance), bent / (TANGENT_TOLERANCE * max(largest, 1e-300)))
