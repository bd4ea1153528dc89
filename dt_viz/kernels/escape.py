"""Escape of the whole arm from obstacles: the generator of `dt_viz.arm.cspace.WholeArmField` and its flow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dt_viz.kernels.arm import Array, BodyPoints, Joints, chain, placed
from dt_viz.kernels.compiled import compiled, kernel
from dt_viz.kernels.distances import Number, Shapes, Values, distance
from dt_viz.kernels.dormand_prince import ERROR, STAGES, allowed_error, first_step, is_straight, next_step


class Escape(NamedTuple):
    """The way in which an arm of n joints and P body points leaves K obstacles."""

    joints: Joints
    points: BodyPoints
    hand: Array
    """(3,) position of the end effector in the last joint, metres."""
    shapes: Shapes
    values: Values
    sources: Array
    """(K, 3) points from which the escape directions fan out, metres."""
    cores: Array
    """(K, P) distances from the surface at which the field has its full strength, metres."""
    reach: float
    """Distance from the surface at which the field ends, metres."""
    speed: float
    """v: distance that a contact at full strength escapes in a unit of flow time, metres."""
    damping: float
    """λ of the contact's pseudo-inverse, m/rad."""
    direction_weight: float
    """w_d of the hand's direction, rad²."""
    hand_weight: float
    """w_x of the end effector's motion, rad²/m²."""
    pins: Array
    """(M, n) postures that do not move, rad."""
    levers: Array
    """(n,) motion of the hand for each joint's turning, m/rad, about."""
    pin: float
    """Size of the region around a pin in which the field fades out, metres."""


@compiled
def _velocity(escape: Escape, q: Array, result: Array, work: tuple[Array, ...]) -> None:
    """Write V_q (n,) at the posture q (n,), with the memory of `_work`.

    With weights ŵ_b of the body points, J_c = Σ ŵ_b J_b and n_c = Σ ŵ_b n_b this is, for each obstacle,

        −V_q = v·m·χ (I + R Rᵀ)⁻¹ J_cᵀ n_c/λ²,   R = (√w_x Jᵀ, √w_d Dᵀ, J_cᵀ/λ), (n, 9).
    """
    n = len(q)
    axes, origins, R, A, lever, weight, pull = work
    moves = False
    for i in range(n):
        result[i] = 0
    chain(escape.joints, q, axes, origins)
    for k in range(len(escape.shapes)):
        total, x, y, z = _contact(escape, k, axes, origins, lever, weight, R)
        if total.real <= 0:
            continue
        if not moves:
            _holding(escape, axes, origins, R)
            moves = True
        strength = escape.speed * np.sqrt(total) / (total * escape.damping)
        for i in range(n):
            pull[i] = strength * (R[i, 6] * x + R[i, 7] * y + R[i, 8] * z)
            for j in range(i + 1):
                product = R[i, 0] * R[j, 0]
                for row in range(1, 9):
                    product += R[i, row] * R[j, row]
                A[i, j] = product
            A[i, i] += 1
        _solve(A, pull)
        for i in range(n):
            result[i] -= pull[i]
    if moves:
        freedom = _freedom(escape, q)
        for i in range(n):
            result[i] *= freedom


@compiled
def _contact(
    escape: Escape, k: int, axes: Array, origins: Array, lever: Array, weight: Array, R: Array
) -> tuple[Number, Number, Number, Number]:
    """Write J_cᵀ/λ of obstacle k to R[:, 6:], with memory for levers (n, 3) and weights (n,).

    Returns Σw_b² and n_c·Σw_b².
    """
    n, points, shape, values, reach = len(weight), escape.points, escape.shapes[k], escape.values, escape.reach
    total = 0 * axes[0, 0, 0]
    wanted_x, wanted_y, wanted_z = total, total, total
    for i in range(n):
        weight[i] = lever[i, 0] = lever[i, 1] = lever[i, 2] = 0
    for p in range(len(points)):
        offset, joint = points[p].offset, points[p].joint
        x, y = placed(offset, joint, axes, origins, 0), placed(offset, joint, axes, origins, 1)
        z = placed(offset, joint, axes, origins, 2)
        away = distance(shape, values, x, y, z) - points[p].radius
        if away.real >= reach:
            continue
        w = _fading((reach - away) / (reach - escape.cores[k, p])) ** 2
        total += w
        weight[joint] += w
        lever[joint, 0] += w * x
        lever[joint, 1] += w * y
        lever[joint, 2] += w * z
        x, y, z = x - escape.sources[k, 0], y - escape.sources[k, 1], z - escape.sources[k, 2]
        share = w / np.sqrt(x * x + y * y + z * z)
        wanted_x += share * x
        wanted_y += share * y
        wanted_z += share * z
    if total.real > 0:
        for i in range(n - 1, -1, -1):
            if i < n - 1:  # each joint moves the points beyond it, too
                weight[i] += weight[i + 1]
                for component in range(3):
                    lever[i, component] += lever[i + 1, component]
            x, y = lever[i, 0] - weight[i] * origins[i, 0], lever[i, 1] - weight[i] * origins[i, 1]
            _turn(axes, i, x, y, lever[i, 2] - weight[i] * origins[i, 2], 1 / (total * escape.damping), R, 6)
    return total, wanted_x, wanted_y, wanted_z


@compiled
def _freedom(escape: Escape, q: Array) -> Number:
    """χ: 0 at the pinned postures, 1 away from them."""
    freedom = 1 + 0 * q[0]
    for row in range(len(escape.pins)):
        squared = 0 * q[0]
        for i in range(len(q)):
            squared += (escape.levers[i] * (q[i] - escape.pins[row, i])) ** 2
        freedom *= 1 - np.exp(-squared / (2 * escape.pin**2))
    return freedom


@compiled
def _work(q: Array) -> tuple[Array, ...]:
    """Memory for `_velocity` at postures like q (N, n)."""
    n, like = q.shape[1], q.dtype
    frames = np.empty((n, 3, 3), like), np.empty((n, 3), like)
    system = np.empty((n, 9), like), np.empty((n, n), like)
    return (*frames, *system, np.empty((n, 3), like), np.empty(n, like), np.empty(n, like))


@compiled
def _holding(escape: Escape, axes: Array, origins: Array, R: Array) -> None:
    """Write √w_x Jᵀ and √w_d Dᵀ to R[:, :3] and R[:, 3:6]."""
    n, hand = len(origins), escape.hand
    tip = n - 1
    x, y = placed(hand, tip, axes, origins, 0), placed(hand, tip, axes, origins, 1)
    z = placed(hand, tip, axes, origins, 2)
    staying = np.sqrt(escape.hand_weight)
    upright = np.sqrt(escape.direction_weight / (hand[0] ** 2 + hand[1] ** 2 + hand[2] ** 2))
    for i in range(n):
        _turn(axes, i, x - origins[i, 0], y - origins[i, 1], z - origins[i, 2], staying, R, 0)
        _turn(axes, i, x - origins[tip, 0], y - origins[tip, 1], z - origins[tip, 2], upright, R, 3)


@compiled
def _turn(axes: Array, i: int, x: Number, y: Number, z: Number, scale: Number, R: Array, column: int) -> None:
    """Write the velocity, at unit speed of joint i, of what has this lever from it, times a scale, to R[i, column:]."""
    R[i, column] = scale * (axes[i, 2, 1] * z - axes[i, 2, 2] * y)
    R[i, column + 1] = scale * (axes[i, 2, 2] * x - axes[i, 2, 0] * z)
    R[i, column + 2] = scale * (axes[i, 2, 0] * y - axes[i, 2, 1] * x)


@compiled
def _fading(u: Number) -> Number:
    """Smooth step from 0 at u = 0 to 1 at u = 1, with two derivatives of 0 at both ends."""
    if u.real <= 0:
        return 0 * u
    if u.real >= 1:
        return 0 * u + 1
    return u * u * u * (10 - 15 * u + 6 * u * u)


@compiled
def _solve(A: Array, b: Array) -> None:
    """Solve A x = b in place, A (n, n) symmetric and positive definite, of which the lower half is given (Cholesky)."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            rest = A[i, j]
            for k in range(j):
                rest -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(rest) if i == j else rest / A[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@kernel
def velocities(escape: Escape, q: Array) -> Array:
    """V_q (N, n) at postures q (N, n), which may be a tiny complex step away from real ones."""
    result, work = np.empty_like(q), _work(q)
    for row in range(len(q)):
        _velocity(escape, q[row], result[row], work)
    return result


@compiled
def _moved(s: Array, h: float, v: Array, there: Array) -> None:
    """Write s + h·v (n,)."""
    for i in range(len(s)):
        there[i] = s[i] + h * v[i]


@kernel
def flow(escape: Escape, q: Array, duration: float, steps: int) -> Array:
    """Postures q (N, n) carried along by classical Runge–Kutta steps of equal length, (N, n)."""
    q, work = q.copy(), _work(q)
    n, h = q.shape[1], duration / steps
    k1, k2, k3, k4, there = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for row in range(len(q)):
        s = q[row]
        for _ in range(steps):
            _velocity(escape, s, k1, work)
            if not k1.any():
                break  # where the field vanishes its flow rests
            _moved(s, h / 2, k1, there)
            _velocity(escape, there, k2, work)
            _moved(s, h / 2, k2, there)
            _velocity(escape, there, k3, work)
            _moved(s, h, k3, there)
            _velocity(escape, there, k4, work)
            for i in range(n):
                s[i] += h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i])
    return q


@kernel
def adaptive_flow(escape: Escape, q: Array, duration: float, tolerance: float, max_steps: int) -> tuple[Array, int]:
    """Postures q (N, n) carried along by Dormand–Prince steps, and how many of them need more than `max_steps`.

    The estimated error of a step is at most `tolerance`, rad; see `dt_viz.flows.integrators.integrate_adaptive`.
    """
    q, work, num_failed = q.copy(), _work(q), 0
    n, total, sign = q.shape[1], abs(duration), np.sign(duration)
    k, end, defect = np.empty((7, n)), np.empty(n), np.empty(n)
    for row in range(len(q)):
        s = q[row]
        _velocity(escape, s, k[0], work)
        speed = np.abs(k[0]).max()
        if speed == 0:
            continue  # where the field vanishes its flow rests
        ahead = min(total, tolerance / speed)
        _moved(s, sign * ahead, k[0], end)
        _velocity(escape, end, k[1], work)
        turning = np.abs(k[1] - k[0]).max() / (ahead * speed)
        if is_straight(speed, turning, total, tolerance):
            s += duration * k[0]
            continue
        h, left = first_step(speed, turning, total, tolerance), total
        for _ in range(max_steps):
            for i in range(1, 7):
                for d in range(n):
                    end[d] = s[d]
                    for j in range(i):
                        end[d] += sign * h * STAGES[i, j] * k[j, d]
                _velocity(escape, end, k[i], work)
            for d in range(n):
                defect[d] = 0
                for i in range(7):
                    defect[d] += h * ERROR[i] * k[i, d]
            error = np.abs(defect).max() / allowed_error(np.abs(end - s).max(), tolerance)
            if error <= 1:
                s[:], k[0], left = end, k[6], left - h
            if left <= 1e-12 * total:
                break
            h = min(next_step(h, error), left)
        else:
            num_failed += 1
    return q, num_failed
