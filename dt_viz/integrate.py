"""One step of an integrator, for a state and, where asked for, for tangents carried along with it.

A step takes (field, s, U, h): points `s` (N, d), tangents `U` (N, d, k) or None, step length h of either sign. It
returns the new points and tangents. Tangents obey the variational equation U̇ = DV·U, integrated by the same method,
so they are the exact derivative of the numerical step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dt_viz.fields import Array, VectorField

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
    field: VectorField, s: Array, U: Array | None, h: float, *, max_iterations: int = 20
) -> tuple[Array, Array | None]:
    """Implicit Euler: the y with y − h·V(y) = s. First order, and the exact inverse of `euler` with −h.

    Newton's method with backtracking-free quadratic convergence while h·Lip(V) < 1, where the step is also known to be
    invertible.
    """
    identity = np.eye(field.dim)
    y = s
    scale = 1.0 + np.abs(s).max(initial=0.0)
    for _ in range(max_iterations):
        v, DV = field.with_jacobian(y)
        residual = y - h * v - s
        if np.abs(residual).max(initial=0.0) <= 1e-15 * scale:
            break
        update = np.linalg.solve(identity - h * DV, residual[..., None])[..., 0]
        y = y - update
        if np.abs(update).max(initial=0.0) <= 1e-9 * scale:
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


def _augment(field: VectorField, s: Array, U: Array | None) -> tuple[Array, Callable[[Array], Array]]:
    """The state (s, U) as one array (N, d·(1+k)) and its rate of change."""
    if U is None:
        return s, field
    num, d, k = U.shape

    def rate(state: Array) -> Array:
        v, DV = field.with_jacobian(state[:, :d])
        return np.concatenate([v, (DV @ state[:, d:].reshape(num, d, k)).reshape(num, -1)], axis=1)

    return np.concatenate([s, U.reshape(num, -1)], axis=1), rate


def _split(state: Array, s: Array, U: Array | None) -> tuple[Array, Array | None]:
    if U is None:
        return state, None
    d = s.shape[1]
    return state[:, :d], state[:, d:].reshape(U.shape)
