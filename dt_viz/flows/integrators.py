"""Flows of vector fields by a numerical method, with tangents carried along where asked for.

Tangents obey the variational equation U̇ = DV·U, so that they are the derivative of the flow.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import RK45

from dt_viz.flows.fields import Array, CompiledField, PointField, VectorField
from dt_viz.kernels.flows import IMPLICIT_EULER
from dt_viz.kernels.runge_kutta import DORMAND_PRINCE, EULER, RK4
from dt_viz.numerics import divisor

__all__ = ["DORMAND_PRINCE", "EULER", "IMPLICIT_EULER", "RK4", "carried"]

DIFFERENCE = 3e-4
"""Distance of the points by whose flows tangents are found, in their unit: next to what the core of a field measures,
their flows are straight, and errors of 1e-7 change a slope by some 3e-4."""


def carried(
    field: VectorField, s: Array, U: Array | None, method: int, duration: float, steps: int = 1, tolerance: float = 0.0
) -> tuple[Array, Array | None]:
    """Carry points `s` (N, d) and tangents `U` (N, d, k) along the flow of a field, for a duration of either sign.

    Compiled fields have loops of their own. Of others, tangents are carried by the central differences of points beside
    `s`.

    Args:
        field: V.
        s: points.
        U: tangents, or None.
        method: `EULER`, the paper's, of first order; `RK4`, of fourth; `IMPLICIT_EULER`, of first, the exact inverse of
            Euler's, for a `PointField` only; or `DORMAND_PRINCE`, adaptive steps of each point by itself.
        duration: of the flow.
        steps: number of equal steps, or largest number of adaptive ones; more raise ArithmeticError.
        tolerance: largest estimated error of an adaptive step, in the unit of `s`; smaller in proportion where the
            motion is short. That of tangents is `dt_viz.kernels.runge_kutta.TANGENT_TOLERANCE`.
    """
    if isinstance(field, PointField):
        return field.carried(s, U, method, duration, steps, tolerance)
    if U is not None:
        return _by_differences(lambda points: carried(field, points, None, method, duration, steps, tolerance)[0], s, U)
    if isinstance(field, CompiledField):
        return field.carried(s, method, duration, steps, tolerance), None
    if method == DORMAND_PRINCE:
        return _adaptively(field, s, duration, steps, tolerance), None
    return _stepped(field, s, method, duration, steps), None


def _by_differences(flow: Callable[[Array], Array], s: Array, U: Array) -> tuple[Array, Array]:
    """Images (N, d) of points `s` (N, d) and of tangents `U` (N, d, k) by the images of points beside them."""
    num, d, k = U.shape
    lengths = np.linalg.norm(U, axis=1, keepdims=True)
    steps = DIFFERENCE * np.swapaxes(U / divisor(lengths), 1, 2)
    shifted = s[:, None, None] + np.array([1, -1])[:, None, None] * steps[:, None]  # (N, 2, k, d)
    images = flow(np.concatenate([s, shifted.reshape(-1, d)]))
    beyond, before = np.moveaxis(images[num:].reshape(num, 2, k, d), 1, 0)
    slopes = (beyond - before) / (2 * DIFFERENCE)
    return images[:num], lengths * np.swapaxes(slopes, 1, 2)


def _stepped(field: VectorField, s: Array, method: int, duration: float, steps: int) -> Array:
    """Carry points (N, d) along in equal explicit steps."""
    h = duration / steps
    for _ in range(steps):
        k = field(s)
        if method == RK4:
            second = field(s + h / 2 * k)
            third = field(s + h / 2 * second)
            k = (k + 2 * second + 2 * third + field(s + h * third)) / 6
        s = s + h * k
    return s


def _adaptively(field: VectorField, s: Array, duration: float, max_steps: int, tolerance: float) -> Array:
    """Carry points (N, d) along in adaptive steps that are as long for all of them."""
    solver = RK45(
        lambda _time, state: field(state.reshape(s.shape)).reshape(-1),
        0.0,
        s.reshape(-1),
        duration,
        rtol=100 * np.finfo(float).eps,  # the smallest that is accepted
        atol=tolerance / np.sqrt(max(s.size, 1)),  # of the root mean square, so that none is more off
    )
    for _ in range(max_steps):
        solver.step()
        if solver.status == "finished":
            return solver.y.reshape(s.shape)
        if solver.status == "failed":
            break
    raise ArithmeticError(f"some of {len(s)} points need more than {max_steps} steps: the field is too steep for them")
