"""One step of an integrator, for a state and, where asked for, for tangents carried along with it.

A step takes (field, s, U, h): points `s` (N, d), tangents `U` (N, d, k) or None, step length h of either sign. It
returns the new points and tangents. Tangents obey the variational equation U̇ = DV·U, integrated by the same method,
so they are the exact derivative of the numerical step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dt_viz.flows.fields import Array, CompiledField, Mask, VectorField
from dt_viz.kernels.dormand_prince import ERROR, LONGEST_TURN, ROUNDING, SHORT, STAGES, STRAIGHT, TURN_ERROR

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


def implicit_euler(
    field: VectorField, s: Array, U: Array | None, h: float, *, max_iterations: int = 200
) -> tuple[Array, Array | None]:
    """Implicit Euler: the y with y − h·V(y) = s. First order, and the exact inverse of `euler` with −h.

    Newton's method, point by point going back half the way where the residual has grown. While I − h·DV is regular
    everywhere, which is also when the step is invertible, that leads to the one solution from everywhere.
    """
    identity = np.eye(field.dim)
    scale = 1.0 + np.abs(s).max(initial=0.0)
    y = best = s + h * field(s)
    direction = np.zeros_like(s)
    smallest = np.full(len(s), np.inf)  # residual at `best`
    length = np.ones((len(s), 1))
    for _ in range(max_iterations):
        v, DV = field.with_jacobian(y)
        residual = y - h * v - s
        size = np.abs(residual).max(axis=1)
        if size.max(initial=0.0) <= 1e-15 * scale:
            break
        update = np.linalg.solve(identity - h * DV, residual[..., None])[..., 0]
        worse = (size > smallest) & (size > 1e-13 * scale)
        length = np.where(worse[:, None], 0.5 * length, 1.0)
        best = np.where(worse[:, None], best, y)
        direction = np.where(worse[:, None], direction, update)
        smallest = np.where(worse, smallest, size)
        y = best - length * direction
        if not worse.any() and np.abs(update).max(initial=0.0) <= 1e-8 * scale:
            break  # quadratic convergence: the next correction would be far below rounding
    if U is None:
        return y, None
    return y, np.linalg.solve(identity - h * field.with_jacobian(y)[1], U)


def integrate(
    step: Step, field: VectorField, s: Array, U: Array | None, duration: float, steps: int
) -> tuple[Array, Array | None]:
    """Carry `s` (N, d) and `U` (N, d, k) along the flow of `field` for `duration` in equal `steps`."""
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

    Every point has its own step length: points that the field hardly moves take one step, only those in its stiff core
    take many. The estimated error of a step is at most `tolerance` (in the unit of `s`) for the points, less in
    proportion where the motion is shorter than `SHORT`, and at most `TANGENT_TOLERANCE` for the tangents. The first
    step is short where the field changes quickly along it, because the estimated error of a step that is far too long
    may be small by chance.

    Raises:
        ArithmeticError: if some point needs more than `max_rounds` steps.
    """
    total = np.abs(duration)
    if total == 0 or not len(s):
        return s, U
    if U is None and isinstance(field, CompiledField):
        return field.dormand_prince(s, duration, tolerance, max_rounds), None
    d = s.shape[1]
    state, rate = _augment(field, s, U)
    state = state.copy()
    first = rate(state)
    turning = _turning(field, state, first, duration, tolerance)
    still = _still(state, first, turning, d, total, tolerance)
    state[still] += duration * first[still]
    # for each point that has not arrived: its row, state, rate, time left, and length of the next step
    active = np.flatnonzero(~still)
    start, first, left = state[active], first[active], np.full(len(active), total)
    h = _first_step(first[:, :d], turning[active], total, tolerance)
    for _ in range(max_rounds):
        if not len(active):
            return _split(state, s, U)
        step = np.sign(duration) * h[:, None]
        stages = np.empty((len(STAGES), *start.shape))
        end, stages[0] = start, first
        for i, row in enumerate(STAGES[1:], start=1):
            # the last stage point is the fifth-order result: first same as last
            end = start + step * _combined(row[:i], stages[:i])
            stages[i] = rate(end)
        defect = step * _combined(ERROR, stages)
        # beside a rest point a small error is large relative to the motion, and grows with it
        allowed = _allowed(np.abs(end - start)[:, :d].max(axis=1), tolerance)
        error = np.abs(defect[:, :d]).max(axis=1) / allowed
        if U is not None:
            largest = np.maximum(np.abs(end[:, d:]).max(axis=1), np.finfo(float).tiny)
            error = np.maximum(error, np.abs(defect[:, d:]).max(axis=1) / (TANGENT_TOLERANCE * largest))
        accepted = error <= 1
        start = np.where(accepted[:, None], end, start)
        first = np.where(accepted[:, None], stages[-1], first)
        left = left - accepted * h
        h = np.minimum(h * np.clip(0.9 * np.maximum(error, 1e-10) ** -0.2, 0.1, 5.0), left)
        unfinished = left > total * 1e-12
        if not unfinished.all():
            state[active[~unfinished]] = start[~unfinished]
            active, start, first, left, h = (values[unfinished] for values in (active, start, first, left, h))
    raise ArithmeticError(f"{len(active)} points need more than {max_rounds} steps: the field is too steep for them")


TANGENT_TOLERANCE = 3e-4
"""Largest estimated error of a step's tangents, relative to their largest entry."""


def _combined(coefficients: Array, stages: Array) -> Array:
    """Weighted sum (N, ·) of stages (S, N, ·), as one product."""
    return (coefficients @ stages.reshape(len(stages), -1)).reshape(stages.shape[1:])


def _turning(field: VectorField, state: Array, rate: Array, duration: float, tolerance: float) -> Array:
    """Relative change per unit of time (N,) of the velocities of states (N, ·) that change at `rate` (N, ·).

    The second velocity is that at the end of an Euler step over the whole duration, or at the distance `tolerance` in
    the same direction if that is nearer.
    """
    d = field.dim
    turning = np.zeros(len(state))
    speed = np.abs(rate[:, :d]).max(axis=1, initial=0.0)
    moving = np.flatnonzero(speed)
    if not len(moving):
        return turning
    speed, velocity = speed[moving], rate[moving, :d]
    ahead = np.minimum(np.abs(duration), tolerance / speed)
    there = field(state[moving, :d] + (np.sign(duration) * ahead)[:, None] * velocity)
    turning[moving] = np.abs(there - velocity).max(axis=1) / (ahead * speed)
    return turning


def _still(state: Array, rate: Array, turning: Array, d: int, total: float, tolerance: float) -> Mask:
    """Mask (N,) of the states (N, ·) that one Euler step carries accurately enough: those that hardly move or turn.

    A weak field is not enough. It is weak beside a rest point, too, where motions grow from nothing and tangents are
    stretched most.
    """
    still = np.abs(rate[:, :d]).max(axis=1, initial=0.0) * total <= tolerance
    if rate.shape[1] == d:
        return still & (turning * total <= STRAIGHT)
    changing = np.abs(rate[:, d:]).max(axis=1)
    return still & (changing * total <= TANGENT_TOLERANCE * np.abs(state[:, d:]).max(axis=1))


def _first_step(velocity: Array, turning: Array, total: float, tolerance: float) -> Array:
    """Length (N,) of the first step of points with a `velocity` (N, d) that changes at the rate `turning` (N,).

    The error of a step h grows as its fifth power.
    """
    motion = total * np.abs(velocity).max(axis=1, initial=0.0)
    caution = (_allowed(motion, tolerance) / np.maximum(TURN_ERROR * motion, ROUNDING)) ** 0.2
    return np.minimum(total, LONGEST_TURN * caution / np.maximum(turning, ROUNDING))


def _allowed(motion: Array, tolerance: float) -> Array:
    """Largest error (N,) allowed for a step of this `motion` (N,)."""
    return np.clip(tolerance / SHORT * motion, ROUNDING, tolerance)


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
