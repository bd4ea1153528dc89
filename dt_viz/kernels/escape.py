"""The whole arm's escape from obstacles: the formulas of `dt_viz.avoidance.arm_field.WholeArmField` and its flow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dt_viz.kernels.arm import Array, BodyPoints, Joints
from dt_viz.kernels.blocks import LANES, MOST_JOINTS, block_of, chain, keep, load, measure, put
from dt_viz.kernels.compiled import compiled, kernel
from dt_viz.kernels.distances import Record, Shapes, Values
from dt_viz.kernels.dormand_prince import ERROR, STAGES, allowed_error, first_step, is_straight, next_step

BLOCK = block_of(
    ("velocity", (MOST_JOINTS,)),  # V_q, rad per unit of flow time
    ("total", ()),  # Σ w_b²
    ("wanted", (3,)),  # n_c Σ w_b²
    ("weight", (MOST_JOINTS,)),  # Σ w_b² of the points that a joint moves
    ("lever", (MOST_JOINTS, 3)),  # Σ w_b² x_b of these
    ("tip", (3,)),  # place of the end effector, metres
    ("R", (MOST_JOINTS, 9)),
    ("A", (MOST_JOINTS, MOST_JOINTS)),
    ("pull", (MOST_JOINTS,)),
    ("squared", ()),  # distance from a pin, m²
    ("freedom", ()),  # χ
    ("scale", ()),
    ("start", (MOST_JOINTS,)),  # of a step, rad
    ("sum", (MOST_JOINTS,)),  # of the slopes of a Runge–Kutta step
    ("stages", (7, MOST_JOINTS)),
    ("h", ()),  # length of a step, with its sign
)
"""Memory for the field and the steps of its flow."""


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
def _find_velocity(escape: Escape, block: Record) -> bool:
    """Find V_q at the postures of the block; returns whether any of them moves.

    With weights ŵ_b of the body points, J_c = Σ ŵ_b J_b and n_c = Σ ŵ_b n_b this is, for each obstacle,

        −V_q = v·m·χ (I + R Rᵀ)⁻¹ J_cᵀ n_c/λ²,   R = (√w_x Jᵀ, √w_d Dᵀ, J_cᵀ/λ), (n, 9).
    """
    n, moves = len(escape.joints), False
    velocity, pull, freedom = block.velocity, block.pull, block.freedom
    for i in range(n):
        for lane in range(LANES):
            velocity[i, lane] = 0
    chain(escape.joints, block)
    for k in range(len(escape.shapes)):
        if not _touch(escape, k, block):
            continue
        if not moves:
            _hold(escape, block)
            moves = True
        _solve(escape, block)
        for i in range(n):
            for lane in range(LANES):
                velocity[i, lane] -= pull[i, lane]
    if moves:
        _free(escape, block)
        for i in range(n):
            for lane in range(LANES):
                velocity[i, lane] *= freedom[lane]
    return moves


@compiled
def _touch(escape: Escape, k: int, block: Record) -> bool:
    """Find the contact with obstacle k and J_cᵀ/λ, which is R[:, 6:]; returns whether there is one in any lane."""
    n, points, shape, reach = len(escape.joints), escape.points, escape.shapes[k], escape.reach
    place, away, total, wanted = block.place, block.away, block.total, block.wanted
    weight, lever, scale = block.weight, block.lever, block.scale
    X, Y, Z = escape.sources[k]
    touched = False
    for p in range(len(points)):
        joint = points[p].joint
        put(points[p].offset, joint, block)
        measure(shape, escape.values, points[p].radius, reach, block)
        num_near = 0
        for lane in range(LANES):
            num_near += away[lane] < reach
        if num_near == 0:
            continue
        if not touched:
            _clear(n, block)
            touched = True
        depth = reach - escape.cores[k, p]
        for lane in range(LANES):
            u = (reach - away[lane]) / depth
            u = 1.0 if u > 1 else u
            u = 0.0 if u < 0 else u
            w = u * u * u * (10 - 15 * u + 6 * u * u)  # a smooth step, with two derivatives of 0 at both ends
            scale[lane] = w * w
            total[lane] += scale[lane]
        for lane in range(LANES):
            w = scale[lane]
            x, y, z = place[0, lane], place[1, lane], place[2, lane]
            weight[joint, lane] += w
            lever[joint, 0, lane] += w * x
            lever[joint, 1, lane] += w * y
            lever[joint, 2, lane] += w * z
        for lane in range(LANES):
            x, y, z = place[0, lane] - X, place[1, lane] - Y, place[2, lane] - Z
            share = scale[lane] / np.sqrt(x * x + y * y + z * z)
            wanted[0, lane] += share * x
            wanted[1, lane] += share * y
            wanted[2, lane] += share * z
    if touched:
        origins = block.origins
        for lane in range(LANES):
            scale[lane] = 1 / ((total[lane] if total[lane] > 0 else 1.0) * escape.damping)
        for i in range(n - 1, -1, -1):
            if i < n - 1:  # each joint moves the points beyond it, too
                for lane in range(LANES):
                    weight[i, lane] += weight[i + 1, lane]
                    lever[i, 0, lane] += lever[i + 1, 0, lane]
                    lever[i, 1, lane] += lever[i + 1, 1, lane]
                    lever[i, 2, lane] += lever[i + 1, 2, lane]
            for c in range(3):
                for lane in range(LANES):
                    place[c, lane] = lever[i, c, lane] - weight[i, lane] * origins[i, c, lane]
            _turn(i, 6, block)
    return touched


@compiled
def _clear(n: int, block: Record) -> None:
    """Forget the contact before."""
    total, wanted, weight, lever = block.total, block.wanted, block.weight, block.lever
    for lane in range(LANES):
        total[lane] = 0
    for c in range(3):
        for lane in range(LANES):
            wanted[c, lane] = 0
    for i in range(n):
        for lane in range(LANES):
            weight[i, lane] = 0
        for c in range(3):
            for lane in range(LANES):
                lever[i, c, lane] = 0


@compiled
def _hold(escape: Escape, block: Record) -> None:
    """Find √w_x Jᵀ and √w_d Dᵀ, which are R[:, :3] and R[:, 3:6]."""
    n, hand, place, tip, origins, scale = (
        len(escape.joints),
        escape.hand,
        block.place,
        block.tip,
        block.origins,
        block.scale,
    )
    staying = np.sqrt(escape.hand_weight)
    upright = np.sqrt(escape.direction_weight / (hand[0] ** 2 + hand[1] ** 2 + hand[2] ** 2))
    put(hand, n - 1, block)
    for c in range(3):
        for lane in range(LANES):
            tip[c, lane] = place[c, lane]
    for column, weight in ((0, staying), (3, upright)):
        for lane in range(LANES):
            scale[lane] = weight
        for i in range(n):
            about = i if column == 0 else n - 1  # the direction is that from the last joint
            for c in range(3):
                for lane in range(LANES):
                    place[c, lane] = tip[c, lane] - origins[about, c, lane]
            _turn(i, column, block)


@compiled
def _turn(i: int, column: int, block: Record) -> None:
    """Find the velocity of what has the lever `place` from joint i, at its unit speed, times `scale`: R[i, column:]."""
    axes, place, scale, R = block.axes, block.place, block.scale, block.R
    for lane in range(LANES):
        a, b, c = axes[i, 2, 0, lane], axes[i, 2, 1, lane], axes[i, 2, 2, lane]
        x, y, z = place[0, lane], place[1, lane], place[2, lane]
        R[i, column, lane] = scale[lane] * (b * z - c * y)
        R[i, column + 1, lane] = scale[lane] * (c * x - a * z)
        R[i, column + 2, lane] = scale[lane] * (a * y - b * x)


@compiled
def _solve(escape: Escape, block: Record) -> None:
    """Find the escape of one contact, `pull`: (I + R Rᵀ) pull = v·m·J_cᵀ n_c/λ², by Cholesky's decomposition."""
    n, R, A, pull, scale = len(escape.joints), block.R, block.A, block.pull, block.scale
    total, wanted = block.total, block.wanted
    for lane in range(LANES):
        m = np.sqrt(total[lane])
        scale[lane] = escape.speed / ((m if m > 0 else 1.0) * escape.damping)
    for i in range(n):
        for lane in range(LANES):
            towards = (
                R[i, 6, lane] * wanted[0, lane] + R[i, 7, lane] * wanted[1, lane] + R[i, 8, lane] * wanted[2, lane]
            )
            pull[i, lane] = scale[lane] * towards
        for j in range(i + 1):
            one = 1.0 if i == j else 0.0
            for lane in range(LANES):
                A[i, j, lane] = (
                    one
                    + (R[i, 0, lane] * R[j, 0, lane] + R[i, 1, lane] * R[j, 1, lane] + R[i, 2, lane] * R[j, 2, lane])
                    + (R[i, 3, lane] * R[j, 3, lane] + R[i, 4, lane] * R[j, 4, lane] + R[i, 5, lane] * R[j, 5, lane])
                    + (R[i, 6, lane] * R[j, 6, lane] + R[i, 7, lane] * R[j, 7, lane] + R[i, 8, lane] * R[j, 8, lane])
                )
    for i in range(n):  # A = L Lᵀ, with 1/L_ii on the diagonal
        for j in range(i + 1):
            for k in range(j):
                for lane in range(LANES):
                    A[i, j, lane] -= A[i, k, lane] * A[j, k, lane]
            for lane in range(LANES):
                A[i, j, lane] = 1 / np.sqrt(A[i, i, lane]) if i == j else A[i, j, lane] * A[j, j, lane]
    for i in range(n):
        for k in range(i):
            for lane in range(LANES):
                pull[i, lane] -= A[i, k, lane] * pull[k, lane]
        for lane in range(LANES):
            pull[i, lane] *= A[i, i, lane]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for lane in range(LANES):
                pull[i, lane] -= A[k, i, lane] * pull[k, lane]
        for lane in range(LANES):
            pull[i, lane] *= A[i, i, lane]


@compiled
def _free(escape: Escape, block: Record) -> None:
    """Find χ: 0 at the pinned postures, 1 away from them."""
    q, squared, freedom, pins, levers = block.q, block.squared, block.freedom, escape.pins, escape.levers
    width = 2 * escape.pin**2
    for lane in range(LANES):
        freedom[lane] = 1
    for row in range(len(pins)):
        for lane in range(LANES):
            squared[lane] = 0
        for i in range(len(levers)):
            lever, pin = levers[i], pins[row, i]
            for lane in range(LANES):
                squared[lane] += (lever * (q[i, lane] - pin)) ** 2
        num_near = 0
        for lane in range(LANES):
            num_near += squared[lane] < 40 * width  # beyond, the factor is 1 to rounding
        if num_near > 0:
            for lane in range(LANES):
                freedom[lane] *= 1 - np.exp(-squared[lane] / width)


@compiled
def _unload(values: Array, row: int, lane: int, result: Array) -> None:
    """Write the entries of one lane of `values` (n, LANES) to result[row] (n,)."""
    for i in range(result.shape[1]):
        result[row, i] = values[i, lane]


@kernel
def velocities(escape: Escape, q: Array) -> Array:
    """V_q (N, n) at postures q (N, n)."""
    rows, result, memory = np.arange(len(q)), np.zeros_like(q), np.empty(1, BLOCK)
    block = memory[0]
    for first in range(0, len(q), LANES):
        num = load(block, q, rows, first)
        if _find_velocity(escape, block):
            for lane in range(num):
                _unload(block.velocity, first + lane, lane, result)
    keep(memory)
    return result


@compiled
def _moving(v: Array) -> Array:
    """Rows of v (N, n) that are not zero."""
    rows, num = np.empty(len(v), np.int64), 0
    for row in range(len(v)):
        if v[row].any():
            rows[num] = row
            num += 1
    return rows[:num]


@kernel
def flow(escape: Escape, q: Array, duration: float, steps: int) -> Array:
    """Postures q (N, n) carried along by classical Runge–Kutta steps of equal length, (N, n)."""
    v = velocities(escape, q)
    rows, q, memory = _moving(v), q.copy(), np.empty(1, BLOCK)  # elsewhere the flow rests
    block = memory[0]
    n, h, at, start, slopes = q.shape[1], duration / steps, block.q, block.start, block.sum
    velocity = block.velocity
    for first in range(0, len(rows), LANES):
        num, moves = load(block, q, rows, first), True
        for step in range(steps):
            if not moves:
                break
            for i in range(n):
                for lane in range(LANES):
                    start[i, lane] = at[i, lane]
                    slopes[i, lane] = 0
            for stage, weight, ahead in ((0, h / 6, h / 2), (1, h / 3, h / 2), (2, h / 3, h), (3, h / 6, 0.0)):
                if step == 0 and stage == 0:
                    for lane in range(LANES):
                        for i in range(n):
                            velocity[i, lane] = v[rows[first + min(lane, num - 1)], i]
                else:
                    moves = _find_velocity(escape, block)
                for i in range(n):
                    for lane in range(LANES):
                        slopes[i, lane] += weight * velocity[i, lane]
                        at[i, lane] = start[i, lane] + ahead * velocity[i, lane]
            for i in range(n):
                for lane in range(LANES):
                    at[i, lane] = start[i, lane] + slopes[i, lane]
        for lane in range(num):
            _unload(at, rows[first + lane], lane, q)
    keep(memory)
    return q


@kernel
def adaptive_flow(escape: Escape, q: Array, duration: float, tolerance: float, max_steps: int) -> tuple[Array, int]:  # noqa: PLR0915
    """Postures q (N, n) carried along by Dormand–Prince steps, and how many of them need more than `max_steps`.

    The estimated error of a step is at most `tolerance`, rad; see `dt_viz.flows.integrators.integrate_adaptive`. Each
    lane takes steps of its own length, and the next posture when it has arrived.
    """
    v = velocities(escape, q)
    rows, q, total, sign = _moving(v), q.copy(), abs(duration), np.sign(duration)
    first_steps, num_failed, n = _first_steps(escape, q, v, rows, total, sign, tolerance), 0, q.shape[1]
    memory = np.empty(1, BLOCK)
    block = memory[0]
    at, start, stages, h, velocity, defect = block.q, block.start, block.stages, block.h, block.velocity, block.sum
    row_of, num_steps, left = np.full(LANES, -1), np.zeros(LANES, np.int64), np.zeros(LANES)
    for i in range(n):
        for lane in range(LANES):
            start[i, lane] = q[rows[0], i] if len(rows) else 0.0
            stages[0, i, lane] = 0
    for lane in range(LANES):
        h[lane] = 0
    upcoming, num_busy = 0, 0
    while True:
        for lane in range(LANES):
            if row_of[lane] < 0 and upcoming < len(rows):
                row = rows[upcoming]
                if first_steps[upcoming] == 0:  # one Euler step is exact enough
                    q[row] += duration * v[row]
                    upcoming += 1
                    continue
                row_of[lane], left[lane], num_steps[lane], h[lane] = row, total, 0, sign * first_steps[upcoming]
                upcoming, num_busy = upcoming + 1, num_busy + 1
                for i in range(n):
                    start[i, lane], stages[0, i, lane] = q[row, i], v[row, i]
        if num_busy == 0:
            if upcoming < len(rows):
                continue
            keep(memory)
            return q, num_failed
        for stage in range(1, 7):
            for i in range(n):
                for lane in range(LANES):
                    defect[i, lane] = 0
                for before in range(stage):
                    weight = STAGES[stage, before]
                    for lane in range(LANES):
                        defect[i, lane] += weight * stages[before, i, lane]
                for lane in range(LANES):
                    at[i, lane] = start[i, lane] + h[lane] * defect[i, lane]
            _find_velocity(escape, block)
            for i in range(n):
                for lane in range(LANES):
                    stages[stage, i, lane] = velocity[i, lane]
        for i in range(n):
            for lane in range(LANES):
                defect[i, lane] = 0
            for stage in range(7):
                weight = ERROR[stage]
                for lane in range(LANES):
                    defect[i, lane] += weight * stages[stage, i, lane]
        for lane in range(LANES):
            if row_of[lane] < 0:
                continue
            motion = error = 0.0
            for i in range(n):
                motion = max(motion, abs(at[i, lane] - start[i, lane]))
                error = max(error, abs(h[lane] * defect[i, lane]))
            error, length = error / allowed_error(motion, tolerance), abs(h[lane])
            num_steps[lane] += 1
            if error <= 1:
                left[lane] -= length
                for i in range(n):
                    start[i, lane], stages[0, i, lane] = at[i, lane], stages[6, i, lane]
            arrived = left[lane] <= 1e-12 * total
            if arrived or num_steps[lane] == max_steps:
                _unload(start, row_of[lane], lane, q)
                num_failed += not arrived
                row_of[lane], h[lane], num_busy = -1, 0.0, num_busy - 1
            else:
                h[lane] = sign * min(next_step(length, error), left[lane])


@compiled
def _first_steps(escape: Escape, q: Array, v: Array, rows: Array, total: float, sign: float, tolerance: float) -> Array:
    """Lengths of the first steps from postures q[rows] with velocities v[rows]; 0 where one Euler step does."""
    there, speeds, ahead = np.empty((len(rows), q.shape[1])), np.empty(len(rows)), np.empty(len(rows))
    for k in range(len(rows)):
        speeds[k] = np.abs(v[rows[k]]).max()
        ahead[k] = min(total, tolerance / speeds[k])
        there[k] = q[rows[k]] + sign * ahead[k] * v[rows[k]]
    there = velocities(escape, there)
    for k in range(len(rows)):
        turning = np.abs(there[k] - v[rows[k]]).max() / (ahead[k] * speeds[k])
        straight = is_straight(speeds[k], turning, total, tolerance)
        ahead[k] = 0.0 if straight else first_step(speeds[k], turning, total, tolerance)
    return ahead
