"""One step of an integrator, for a state and, where asked for, for tangents carried along with it.

A step takes (field, s, U, h): points `s` (N, d), tangents `U` (N, d, k) or None, step length h of either sign. It
returns the new points and tangents. Tangents obey the variational equation U̇ = DV·U, integrated by the same method,
so they are the exact derivative of the numerical step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dt_viz.fields import Array, Mask, VectorField

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
    h = duration / steps
    for _ in range(steps):
        s, U = step(field, s, U, h)
    return s, U


def integrate_adaptive(
    field: VectorField, s: Array, U: Array | None, duration: float, tolerance: float, *, max_rounds: int = 1000
) -> tuple[Array, Array | None]:
    """Carry `s` (N, d) and `U` (N, d, k) along the flow of `field` with the Dormand–Prince 5(4) pair.

    Every point has its own step length, chosen so that the estimated error of each step is below `tolerance` (in the
    unit of `s`) and, for motions as small as that and for tangents, below `RELATIVE_TOLERANCE` of them: points that the
    field hardly moves take one step, only those in its stiff core take many.

    Raises:
        ArithmeticError: if some point needs more than `max_rounds` steps.
    """
    total = np.abs(duration)
    if total == 0 or not len(s):
        return s, U
    d = s.shape[1]
    state, rate = _augment(field, s, U)
    state = state.copy()
    first = rate(state)
    still = _still(field, state, first, U is None, duration, tolerance)
    state[still] += duration * first[still]
    active, first = np.flatnonzero(~still), first[~still]
    done, h = np.zeros(len(s)), np.full(len(s), total)
    for _ in range(max_rounds):
        if not len(active):
            return _split(state, s, U)
        start, step = state[active], np.sign(duration) * h[active, None]
        stages = [first]
        for row in _DP_STAGES:
            stages.append(rate(start + step * sum(a * k for a, k in zip(row, stages, strict=True) if a)))
        # the last stage point is the fifth-order result: first same as last
        end = start + step * sum(a * k for a, k in zip(_DP_STAGES[-1], stages[:-1], strict=True) if a)
        defect = step * sum(e * k for e, k in zip(_DP_ERROR, stages, strict=True) if e)
        # beside a rest point a small error is a large part of the motion, which grows with the motion
        allowed = np.clip(RELATIVE_TOLERANCE * np.abs(end - start)[:, :d].max(axis=1), ROUNDING, tolerance)
        error = np.abs(defect[:, :d]).max(axis=1) / allowed
        if U is not None:
            largest = np.maximum(np.abs(end[:, d:]).max(axis=1), np.finfo(float).tiny)
            error = np.maximum(error, np.abs(defect[:, d:]).max(axis=1) / (RELATIVE_TOLERANCE * largest))
        accepted = error <= 1
        state[active[accepted]] = end[accepted]
        done[active] += np.where(accepted, h[active], 0)
        growth = 0.9 * np.maximum(error, 1e-10) ** -0.2
        h[active] = np.minimum(h[active] * np.clip(growth, 0.1, 5.0), total - done[active])
        first = np.where(accepted[:, None], stages[-1], first)
        unfinished = done[active] < total * (1 - 1e-12)
        active, first = active[unfinished], first[unfinished]
    raise ArithmeticError(f"{len(active)} points need more than {max_rounds} steps: the field is too steep for them")


_DP_STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_DP_ERROR = (71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


RELATIVE_TOLERANCE = 3e-4
"""Of the motion of a step, and of a tangent."""
ROUNDING = 1e-15
"""Below which differences of coordinates mean nothing, in their unit."""


def _still(field: VectorField, state: Array, rate: Array, alone: bool, duration: float, tolerance: float) -> Mask:
    """Which states (N, ·) with that `rate` one Euler step carries well enough: those that hardly move or turn.

    That the field is weak is not enough: it is so, too, beside a rest point, where motions grow from nothing and
    tangents are stretched most.
    """
    d, total = field.dim, np.abs(duration)
    still = np.abs(rate[:, :d]).max(axis=1, initial=0.0) * total <= tolerance
    if not alone:
        return still & (
            np.abs(rate[:, d:]).max(axis=1) * total <= RELATIVE_TOLERANCE * np.abs(state[:, d:]).max(axis=1)
        )
    slow = np.flatnonzero(still & rate.any(axis=1))
    if not len(slow):
        return still
    velocity = rate[slow]
    change = field(state[slow] + duration * velocity) - velocity
    still[slow] = np.abs(change).max(axis=1, initial=0.0) <= 0.1 * np.abs(velocity).max(axis=1, initial=0.0)
    return still


def _augment(field: VectorField, s: Array, U: Array | None) -> tuple[Array, Callable[[Array], Array]]:
    """The state (s, U) as one array (N, d·(1+k)) and its rate of change."""
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
