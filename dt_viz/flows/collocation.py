"""Paths of single points along a flow, found as a whole: implicit Runge–Kutta methods solved by Newton's method.

The m stages Y_i = s + h·Σ_j A_ij·V(Y_j) of a method are one system of equations for the whole path. A field takes
hardly longer for a dozen points than for one, so a few iterations on that system are quicker than the steps of an
explicit method one after the other. The same linear system gives the derivative of the path's end by s.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from dt_viz.flows.fields import Array, VectorField

STAGES = 12
"""Number of stages of the Radau method."""
MAX_ITERATIONS = 8
"""Number of Newton's iterations after which a path counts as too long for one system."""
SLOW, QUADRATIC = 0.9, 0.003
"""Ratios of successive corrections of Newton's method. Above the first a path counts as too long, too. Below the second
the next correction, and the relative error of the derivative, is about the ratio squared."""
FIRST = 1e3
"""Value, in tolerances, that takes the place of the correction before the first one."""
UNRESOLVED = 100.0
"""Upper bound, in tolerances, of h·‖V‖·c², c the last Legendre coefficients of V along the path relative to ‖V‖. The
method's order 2m − 1 makes its error about as small as c², in stacks less than a hundredth of h·‖V‖·c². Where V is of
limited smoothness, as at the border of a bias point's region, that holds for tolerances down to 1e-7 m only."""
HALVINGS = 10
"""Number of times that a path is halved before its field counts as too steep."""

Mapped = tuple[Array, Array]
"""The end (d,) of a path and its derivative (d, d) by the start."""


class _Path(NamedTuple):
    """A path from one system."""

    mapped: Mapped
    rates: Array
    """(m, d) values of V at the stages."""


def collocated(
    field: VectorField, s: Array, duration: float, tolerance: float, halvings: int = HALVINGS
) -> Mapped | None:
    """Carry the point `s` (d,) along the flow of `field` by the Radau IIA method, in one step if that is exact enough.

    Args:
        field: V.
        s: start.
        duration: of the flow, of either sign.
        tolerance: largest error of a step, in the unit of `s`.
        halvings: number of times that the step may be halved.

    Returns:
        The end (d,) and its derivative by `s` (d, d); None where the field is too steep.
    """
    table, last = _radau(STAGES)
    path = _path(field, s, duration * table, tolerance)
    if path is not None and _resolved(path.rates, last, abs(duration), tolerance):
        return path.mapped
    if not halvings or (first := collocated(field, s, duration / 2, tolerance, halvings - 1)) is None:
        return None
    second = collocated(field, first[0], duration / 2, tolerance, halvings - 1)
    return None if second is None else (second[0], second[1] @ first[1])


def implicit_euler_path(field: VectorField, s: Array, duration: float, steps: int, tolerance: float) -> Mapped | None:
    """Carry the point `s` (d,) along the flow of `field` with implicit Euler in equal `steps`; see `collocated`."""
    path = _path(field, s, np.tri(steps) * (duration / steps), tolerance)
    return None if path is None else path.mapped


def _path(field: VectorField, s: Array, table: Array, tolerance: float) -> _Path | None:
    """Solve for the stages with the table h·A (m, m), the last of which is the end; None without convergence."""
    m, d = len(table), len(s)
    stages, before = np.tile(s, (m, 1)), FIRST * tolerance
    right = np.empty((m * d, 1 + d))
    right[:, 1:] = np.tile(np.eye(d), (m, 1))
    for iteration in range(MAX_ITERATIONS):
        rates, derivatives = field.with_jacobian(stages)
        right[:, 0] = (stages - s - table @ rates).reshape(-1)
        system = (-table[:, None, :, None] * derivatives.swapaxes(0, 1)).reshape(m * d, m * d)
        system.reshape(-1)[:: m * d + 1] += 1
        solved = np.linalg.solve(system, right)
        stages = stages - solved[:, 0].reshape(m, d)
        correction = float(np.abs(solved[:, 0]).max())
        ratio = correction / before
        if ratio <= QUADRATIC and ratio**2 * correction <= tolerance:
            return _Path((stages[-1], solved[-d:, 1:]), rates)
        if iteration and ratio > SLOW:
            return None
        before = correction
    return None


def _resolved(rates: Array, last: Array, h: float, tolerance: float) -> bool:
    """Whether a path with the velocities `rates` (m, d) at its stages has small last coefficients."""
    speed = np.abs(rates).max()
    return bool(h * np.abs(last @ rates).max(axis=1).sum() ** 2 <= UNRESOLVED * tolerance * speed)


@lru_cache
def _radau(stages: int) -> tuple[Array, Array]:
    """Table A (m, m) of Radau IIA, and the last two rows (2, m) of the map from values to Legendre coefficients."""
    nodes = np.sort(legendre.legroots([*np.zeros(stages - 1), -1.0, 1.0]).real)
    to_coefficients = np.linalg.inv(legendre.legvander(nodes, stages - 1))
    integrals = legendre.legval(nodes, legendre.legint(np.eye(stages), lbnd=-1)).T
    return integrals @ to_coefficients / 2, to_coefficients[-2:]
