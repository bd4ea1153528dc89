"""Paths of single points along a flow, found as a whole: implicit Runge–Kutta methods solved by Newton's method.

The m stages Y_i = s + h·Σ_j A_ij·V(Y_j) of a method are one system of equations for the whole path. A field takes hardly
longer for a dozen points than for one, so a few iterations on it are quicker than the steps of an explicit method one
after the other. The same linear system gives the derivative of the path's end by s.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from dt_viz.flows.fields import Array, VectorField

STAGES = 12
"""Number of stages of the Radau method."""
MAX_ITERATIONS = 6
"""Number of Newton's iterations after which a path counts as too long for one system."""
CONTRACTION = 0.9
"""Largest ratio of successive corrections; above it a path counts as too long, too."""
LAST_CORRECTION = 10.0
"""Largest final correction of Newton's method, in tolerances. Convergence is quadratic: the error is far smaller."""
LAST_COEFFICIENTS = 100.0
"""Factor on the tolerance for h·‖V‖·c², c the last Legendre coefficients of V along the path relative to ‖V‖. The order
2m − 1 of the method makes its error about as small as c²; in stacks it is below a hundredth of that."""
SHORTEST = 1e-3
"""Shortest part of the duration that is tried."""


class Path(NamedTuple):
    """The end of a path, with its derivative."""

    end: Array
    """(d,)."""
    jacobian: Array
    """(d, d) derivative of the end by the start."""
    rates: Array
    """(m, d) values of V at the stages."""
    iterations: int


def collocated(field: VectorField, s: Array, duration: float, tolerance: float) -> tuple[Array, Array] | None:
    """Carry the point `s` (d,) along the flow of `field` with the Radau IIA method.

    The step length adapts: a step that is not resolved or does not converge is halved, quick convergence doubles the
    next one.

    Args:
        field: V, of d dimensions.
        s: start.
        duration: of the flow, of either sign.
        tolerance: largest error of a step, in the unit of `s`.

    Returns:
        The end (d,) and its derivative by `s` (d, d); None where the field is too steep.
    """
    table, last = _radau(STAGES)
    jacobian, done, part = np.eye(len(s)), 0.0, 1.0
    while done < 1:
        part = min(part, 1 - done)
        h = part * duration
        path = _path(field, s, h * table, tolerance)
        if path is None or not _resolved(path.rates, last, abs(h), tolerance):
            part /= 2
            if part < SHORTEST:
                return None
            continue
        s, jacobian, done = path.end, path.jacobian @ jacobian, done + part
        if 2 * path.iterations <= MAX_ITERATIONS:
            part *= 2
    return s, jacobian


def implicit_euler_path(
    field: VectorField, s: Array, duration: float, steps: int, tolerance: float
) -> tuple[Array, Array] | None:
    """Carry the point `s` (d,) along the flow of `field` with implicit Euler in `steps` equal steps; see `collocated`."""
    path = _path(field, s, np.tri(steps) * (duration / steps), tolerance)
    return None if path is None else (path.end, path.jacobian)


def _path(field: VectorField, s: Array, table: Array, tolerance: float) -> Path | None:
    """Solve for the stages with the table h·A (m, m), whose last stage is the end; None without convergence."""
    m, d = len(table), len(s)
    stages, before = np.tile(s, (m, 1)), np.inf
    right = np.empty((m * d, 1 + d))
    right[:, 1:] = np.tile(np.eye(d), (m, 1))
    for iteration in range(1, MAX_ITERATIONS + 1):
        rates, derivatives = field.with_jacobian(stages)
        right[:, 0] = (stages - s - table @ rates).reshape(-1)
        system = (-table[:, None, :, None] * derivatives.swapaxes(0, 1)).reshape(m * d, m * d)
        system.reshape(-1)[:: m * d + 1] += 1
        solved = np.linalg.solve(system, right)
        stages = stages - solved[:, 0].reshape(m, d)
        correction = np.abs(solved[:, 0]).max()
        if correction <= LAST_CORRECTION * tolerance:
            return Path(stages[-1], solved[-d:, 1:], rates, iteration)
        if correction > CONTRACTION * before:
            return None
        before = correction
    return None


def _resolved(rates: Array, last: Array, h: float, tolerance: float) -> bool:
    """Whether a path with the velocities `rates` (m, d) at its stages has small last coefficients."""
    speed = np.abs(rates).max()
    return bool(h * (np.abs(last @ rates).max(axis=1).sum()) ** 2 <= LAST_COEFFICIENTS * tolerance * speed)


@lru_cache
def _radau(stages: int) -> tuple[Array, Array]:
    """Table A (m, m) of Radau IIA, and the last two rows (2, m) of the map from values to Legendre coefficients."""
    nodes = np.sort(legendre.legroots([*np.zeros(stages - 1), -1.0, 1.0]).real)
    to_coefficients = np.linalg.inv(legendre.legvander(nodes, stages - 1))
    integrals = legendre.legval(nodes, legendre.legint(np.eye(stages), lbnd=-1)).T
    return integrals @ to_coefficients / 2, to_coefficients[-2:]
