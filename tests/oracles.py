"""Independent measures that several test modules judge results by."""

from collections.abc import Callable

import numpy as np

from dt_viz.flows.integrators import RK4


def used_fraction(times: np.ndarray, q: np.ndarray, limits: np.ndarray) -> float:
    """The largest fraction of a velocity limit that any joint uses in any segment; infinite where the motion jumps.

    Args:
        times: (T,) seconds, not decreasing.
        q: (T, 6) joint angles, rad.
        limits: (6,) rad/s.
    """
    intervals, least = np.diff(times), (np.abs(np.diff(q, axis=0)) / limits).max(axis=1)
    used = np.where(least > 0, np.inf, 0.0)
    np.divide(least, intervals, out=used, where=intervals > 0)
    return float(used.max(initial=0.0))


def central_differences(function: Callable[[np.ndarray], np.ndarray], s: np.ndarray, h: float) -> np.ndarray:
    """Derivative of `function` (*B, d) → (*B, …) by the coordinates of `s`, in a new last axis; its error is O(h⁴)."""
    columns = []
    for e in h * np.eye(s.shape[-1]):
        far, near = function(s + 2 * e) - function(s - 2 * e), function(s + e) - function(s - e)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)


def stepped(velocity: Callable[[np.ndarray], np.ndarray], y0: np.ndarray, times: np.ndarray, substeps: int):
    """Integrate ẏ = velocity(y) with RK4.

    Args:
        velocity: takes states (*B, d).
        y0: (*B, d) starts.
        times: (T,) increasing, seconds; the first is the start's.
        substeps: number of RK4 steps between neighbouring times.

    Returns:
        (*B, T, d) states.
    """
    y, motion = y0, [y0]
    for h in np.diff(times) / substeps:
        for _ in range(substeps):
            k1 = velocity(y)
            k2 = velocity(y + h / 2 * k1)
            k3 = velocity(y + h / 2 * k2)
            k4 = velocity(y + h * k3)
            y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        motion.append(y)
    return np.stack(motion, axis=-2)


def carried_by_arrays(field, s: np.ndarray, U: np.ndarray | None, method: int, duration: float, steps: int):
    """Carry points (N, d) and tangents (N, d, k) or None along in equal steps of Euler's method or RK4.

    Tangents obey U̇ = DV·U, integrated by the same method.
    """
    state = s if U is None else np.concatenate([s[..., None], U], axis=2)

    def rate(state: np.ndarray) -> np.ndarray:
        if state.ndim == 2:
            return field(state)
        V, DV = field.with_jacobian(state[..., 0])
        return np.concatenate([V[..., None], DV @ state[..., 1:]], axis=2)

    h = duration / steps
    for _ in range(steps):
        k = rate(state)
        if method == RK4:
            second = rate(state + h / 2 * k)
            third = rate(state + h / 2 * second)
            k = (k + 2 * second + 2 * third + rate(state + h * third)) / 6
        state = state + h * k
    return (state, None) if U is None else (state[..., 0], state[..., 1:])
