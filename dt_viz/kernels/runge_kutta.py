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
Field = Any
"""What a rate is computed from."""
Rate = Any
"""A compiled function as above."""
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
