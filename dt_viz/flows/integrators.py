"""One step of an integrator, for a state and, where asked for, for tangents carried along with it.

A step takes (field, s, U, h): points `s` (N, d), tangents `U` (N, d, k) or None, step length h of either sign. It
returns the new points and tangents. Tangents obey the variational equation U̇ = DV·U, integrated by the same method,
so they are the exact derivative of the numerical step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dt_viz.flows.fields import Array, CompiledField, PointField, VectorField
from dt_viz.kernels.dormand_prince import (
    DORMAND_PRINCE,
    ERROR,
    EULER,
    RK4,
    ROUNDING,
    SHORT,
    STAGES,
    TANGENT_TOLERANCE,
    first_step,
)
from dt_viz.kernels.flows import IMPLICIT_EULER

Step = Callable[[VectorField, Array, "Array | None", float], "tuple[Array, Array | None]"]


def euler(field: VectorField, s: Array, U: Array | None, h: float) -> tuple[Array, Array | None]:
    """Explicit Euler, the paper's: s + h·V(s). First order."""
    state, rate = _augment(field, s, U)
    return _split(state + h * rate(state), s, U)


def rk4(field: VectorField, s: Array, U: Array | None, h: float) -> tuple[Array, Array | None]:
    """The classical Runge–Kutta step. Fourth order."""
    state, rate = _augment(field, s, U)
    k1 = rate(state)
    k2 = rate(state + h / 2 * k1)
    k3 = rate(state + h / 2 * k2)
    k4 = rate(state + h * k3)
    return _split(state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), s, U)


def implicit_euler(field: VectorField, s: Array, U: Array | None, h: float) -> tuple[Array, Array | None]:
    """Implicit Euler, of compiled fields: the y with y − h·V(y) = s. First order, and the exact inverse of `euler`.

    Newton's method, point by point going back half the way where the residual has grown. While I − h·DV is regular
    everywhere, which is also when the step is invertible, that leads to the one solution from everywhere.
    """
    assert isinstance(field, PointField)
    return field.carried(s, U, IMPLICIT_EULER, h)


def integrate(
    step: Step, field: VectorField, s: Array, U: Array | None, duration: float, steps: int
) -> tuple[Array, Array | None]:
    """Carry `s` (N, d) and `U` (N, d, k) along the flow of `field` for `duration` in equal `steps`.

    Compiled fields have loops of their own for the steps of this module.
    """
    if isinstance(field, PointField) and step in METHODS:
        return field.carried(s, U, METHODS[step], duration, steps)
    if U is None and step is rk4 and isinstance(field, CompiledField):
        return field.rk4(s, duration, steps), None
    h = duration / steps
    for _ in range(steps):
        s, U = step(field, s, U, h)
    return s, U


def integrate_adaptive(
    field: VectorField, s: Array, U: Array | None, duration: float, tolerance: float, *, max_rounds: int = 1000
) -> tuple[Array, Array | None]:
    """Carry `s` (N, d) and `U` (N, d, k) along the flow of `field` with the Dormand–Prince 5(4) pair.

    Every point has its own step length. The estimated error of a step is at most `tolerance` (in the unit of `s`) for
    the points, less in proportion where the motion is shorter than `SHORT`, and at most `TANGENT_TOLERANCE` for the
    tangents. The first step is short where the field changes quickly along it, because the estimated error of a step
    that is far too long may be small by chance.

    Raises:
        ArithmeticError: if some point needs more than `max_rounds` steps.
    """
    if duration == 0 or not len(s):
        return s, U
    if isinstance(field, PointField):
        return field.carried(s, U, DORMAND_PRINCE, duration, max_rounds, tolerance)
    if U is None and isinstance(field, CompiledField):
        return field.dormand_prince(s, duration, tolerance, max_rounds), None
    total, sign, d = abs(duration), np.sign(duration), s.shape[1]
    state, rate = _augment(field, s, U)
    result, first = state.copy(), rate(state)
    # of each point that has not arrived: its row, state, rate, time left, and length of the next step
    active = np.flatnonzero(first.any(axis=1))
    start, first, left = state[active], first[active], np.full(len(active), total)
    # how quickly velocities change is seen at the end of an Euler step, no longer than the tolerance
    speed = np.abs(first[:, :d]).max(axis=1, initial=0).clip(ROUNDING)
    ahead = np.minimum(total, tolerance / speed)
    there = field(start[:, :d] + sign * ahead[:, None] * first[:, :d])
    turning = np.abs(there - first[:, :d]).max(axis=1, initial=0) / (ahead * speed)
    h = np.array([first_step(v, w, total, tolerance) for v, w in zip(speed, turning, strict=True)])
    for _ in range(max_rounds):
        if not len(active):
            return _split(result, s, U)
        step, end = sign * h[:, None], start
        stages = np.empty((len(STAGES), *start.shape))
        stages[0] = first
        for i, row in enumerate(STAGES[1:], start=1):
            # the last stage point is the fifth-order result: first same as last
            end = start + step * _combined(row[:i], stages[:i])
            stages[i] = rate(end)
        defect = step * _combined(ERROR, stages)
        # beside a rest point a small error is large relative to the motion, and grows with it
        motion = np.abs(end - start)[:, :d].max(axis=1)
        error = np.abs(defect[:, :d]).max(axis=1) / (tolerance / SHORT * motion).clip(ROUNDING, tolerance)
        if U is not None:
            largest = np.maximum(np.abs(end[:, d:]).max(axis=1), np.finfo(float).tiny)
            error = np.maximum(error, np.abs(defect[:, d:]).max(axis=1) / (TANGENT_TOLERANCE * largest))
        accepted = error <= 1
        start = np.where(accepted[:, None], end, start)
        first = np.where(accepted[:, None], stages[-1], first)
        left = left - accepted * h
        h = np.minimum(h * np.clip(0.9 * np.maximum(error, 1e-10) ** -0.2, 0.1, 5.0), left)
        going = left > total * 1e-12
        result[active[~going]] = start[~going]
        active, start, first, left, h = (values[going] for values in (active, start, first, left, h))
    raise ArithmeticError(f"{len(active)} points need more than {max_rounds} steps: the field is too steep for them")


METHODS: dict[Step, int] = {euler: EULER, rk4: RK4, implicit_euler: IMPLICIT_EULER}
"""Steps of which compiled fields have loops."""


def _combined(coefficients: Array, stages: Array) -> Array:
    """Weighted sum (N, ·) of stages (S, N, ·), as one product."""
    return (coefficients @ stages.reshape(len(stages), -1)).reshape(stages.shape[1:])


def _augment(field: VectorField, s: Array, U: Array | None) -> tuple[Array, Callable[[Array], Array]]:
    """Join points and tangents to one state (N, d·(1+k)); also returns the function that gives its rate of change."""
    if U is None:
        return s, field
    _, d, k = U.shape

    def rate(state: Array) -> Array:
        v, DV = field.with_jacobian(state[:, :d])
        return np.concatenate([v, (DV @ state[:, d:].reshape(-1, d, k)).reshape(len(v), d * k)], axis=1)

    return np.concatenate([s, U.reshape(len(s), d * k)], axis=1), rate


def _split(state: Array, s: Array, U: Array | None) -> tuple[Array, Array | None]:
    if U is None:
        return state, None
    d = s.shape[1]
    return state[:, :d], state[:, d:].reshape(U.shape)
