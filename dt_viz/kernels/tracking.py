"""Tracking of places with an arm's joints by Newton steps: the formulas of `dt_viz.robot.inverse_kinematics.track`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.arm import Array, Joints
from dt_viz.kernels.blocks import LANES, MOST_JOINTS, block_of, chain, keep, load, put, turning
from dt_viz.kernels.compiled import compiled, kernel
from dt_viz.kernels.distances import Record


@compiled
def times(matrix: Array, lane: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Multiply the symmetric matrix of a lane by a vector."""
    a, b, c = matrix[0, lane], matrix[1, lane], matrix[2, lane]
    f, g, h = matrix[3, lane], matrix[4, lane], matrix[5, lane]
    return a * x + h * y + g * z, h * x + b * y + f * z, g * x + f * y + c * z


@compiled
def product(n: int, A: Array, B: Array, block: Record) -> None:
    """Find the symmetric matrix AᵀB of arrays (n, 3, LANES)."""
    matrix = block.matrix
    matrix[:] = 0
    for i in range(n):
        for lane in range(LANES):
            matrix[0, lane] += A[i, 0, lane] * B[i, 0, lane]
            matrix[1, lane] += A[i, 1, lane] * B[i, 1, lane]
            matrix[2, lane] += A[i, 2, lane] * B[i, 2, lane]
            matrix[3, lane] += A[i, 1, lane] * B[i, 2, lane]
            matrix[4, lane] += A[i, 0, lane] * B[i, 2, lane]
            matrix[5, lane] += A[i, 0, lane] * B[i, 1, lane]


@compiled
def invert(block: Record) -> None:
    """Find the inverse of `matrix` + `damping`·I by cofactors."""
    matrix, inverse, damping = block.matrix, block.inverse, block.damping
    for lane in range(LANES):
        a, b, c = matrix[0, lane] + damping[lane], matrix[1, lane] + damping[lane], matrix[2, lane] + damping[lane]
        f, g, h = matrix[3, lane], matrix[4, lane], matrix[5, lane]
        x, y, z = b * c - f * f, f * g - h * c, h * f - g * b
        scale = 1 / (a * x + h * y + g * z)
        inverse[0, lane], inverse[1, lane], inverse[2, lane] = (
            x * scale,
            (a * c - g * g) * scale,
            (a * b - h * h) * scale,
        )
        inverse[3, lane], inverse[4, lane], inverse[5, lane] = (g * h - a * f) * scale, z * scale, y * scale


BLOCK = block_of(
    ("target", (3,)),  # metres
    ("turn", (3, 3)),  # orientation of the last joint that is wanted: [column, component]
    ("error", (3,)),  # metres
    ("reference", (MOST_JOINTS,)),
    ("soft_lower", (MOST_JOINTS,)),
    ("soft_upper", (MOST_JOINTS,)),
    ("wanted", (3,)),  # direction of the hand, or rotation vector to the orientation that is wanted
    ("flexibility", ()),  # 1/w_d
    ("direction", (3,)),  # of the hand, or zero
    ("J", (MOST_JOINTS, 3)),  # velocity of the end effector for each joint's
    ("D", (MOST_JOINTS, 3)),  # that of the hand's direction, or its angular velocity
    ("mobility", (MOST_JOINTS,)),  # diagonal of the inverse of H without its part of the direction
    ("G", (MOST_JOINTS, 3)),
    ("H_inv_J", (MOST_JOINTS, 3)),
    ("p", (MOST_JOINTS,)),  # −H⁻¹∇h
    ("matrix", (6,)),  # a symmetric matrix: entries 00, 11, 22, 12, 02, 01
    ("inverse", (6,)),
    ("damping", ()),
    ("mixed", (3, 3)),
    ("v", (3,)),
    ("multipliers", (3,)),
    ("caution", ()),
    ("largest", ()),
    ("moves", ()),  # 1 where the lane has not arrived
)
"""Memory for a step of a block of postures."""


class TrackingArm(NamedTuple):
    """An arm of n joints."""

    joints: Joints
    hand: Array  # (3,) position of the end effector in the last joint, metres
    axis: Array  # (3,) direction of the hand there, of any length but 0
    lower: Array  # (n,) rad
    upper: Array  # (n,) rad
    limit_weight: float
    """This and what follows are fields of `dt_viz.robot.robot.TrackingSettings`."""
    damping_floor: float
    damping_per_error: float
    curvature: float
    step_limit: float


class Postures(NamedTuple):
    """B secondary objectives in the null space."""

    reference: Array  # (B, n) rad
    direction: Array  # (B, 3) unit vectors, base frame
    soft_lower: Array  # (B, n) rad, starts of the springs before the limits
    soft_upper: Array  # (B, n) rad
    direction_weight: Array
    """(B,) w_d, against 1 for the reference; of the orientation where one is wanted."""


@compiled
def _aim(postures: Postures, which: int, lane: int, block: Record) -> None:
    """Take an objective into a lane."""
    reference, soft_lower, soft_upper = block.reference, block.soft_lower, block.soft_upper
    wanted, flexibility = block.wanted, block.flexibility
    for i in range(postures.reference.shape[1]):
        reference[i, lane] = postures.reference[which, i]
        soft_lower[i, lane], soft_upper[i, lane] = postures.soft_lower[which, i], postures.soft_upper[which, i]
    for c in range(3):
        wanted[c, lane] = postures.direction[which, c]
    flexibility[lane] = 1 / postures.direction_weight[which]


@compiled
def _want(begin: Array, end: Array, part: float, lane: int, block: Record) -> None:
    """Take what is between two targets into a lane: places (3,), or these and orientations (12,), by columns."""
    target, turn = block.target, block.turn
    for c in range(3):
        target[c, lane] = begin[c] + part * (end[c] - begin[c])
    for c in range(3, len(begin)):
        turn[c // 3 - 1, c % 3, lane] = begin[c] + part * (end[c] - begin[c])


@compiled
def _newton(arm: TrackingArm, gain: float, turns: bool, block: Record) -> None:
    """Make one damped resolved-rate step towards the targets and improve the posture in the null space.

    With e = target − x(q), H ≈ ∇²h (Gauss–Newton) and p = −H⁻¹∇h:

        δq = J#(λ) e + c·(I − J#(λ₀) J) p,   J#(λ) = H⁻¹Jᵀ(J H⁻¹ Jᵀ + λ²I)⁻¹.

    λ² grows with ‖e‖, which keeps steps moderate far from the target and out of reach, and falls with it to the small
    λ₀² of the projector, so that the posture does not pull the hand off its target. μ = (J H⁻¹ Jᵀ + λ₀²I)⁻¹ J p are the
    multipliers of x(q) = target, and c = 1/(1 + κ‖μ‖) stands in for the curvature μ·∇²x that they add to H in the
    null space; without it the posture overshoots again and again near singularities.

    `gain` is a factor of the null-space part; 0 leaves the plain pseudo-inverse. Postures end inside the limits;
    `largest` is the largest joint motion, rad. Where the hand `turns` to an orientation that is wanted, h counts the
    rotation vector to it instead of the difference of directions.
    """
    n, error, J, p, H_inv_J = len(arm.joints), block.error, block.J, block.p, block.H_inv_J
    damping, inverse, v, multipliers, caution = block.damping, block.inverse, block.v, block.multipliers, block.caution
    _linearise(arm, block)
    if turns:
        _turn(len(arm.joints), block)
    _improve(n, arm.limit_weight, block)
    for lane in range(LANES):
        squared = error[0, lane] ** 2 + error[1, lane] ** 2 + error[2, lane] ** 2
        caution[lane] = np.sqrt(squared)
    damping[:] = arm.damping_floor
    multipliers[:] = 0
    for i in range(n):
        for lane in range(LANES):
            multipliers[0, lane] += J[i, 0, lane] * p[i, lane]
            multipliers[1, lane] += J[i, 1, lane] * p[i, lane]
            multipliers[2, lane] += J[i, 2, lane] * p[i, lane]
    invert(block)
    for lane in range(LANES):
        x, y, z = multipliers[0, lane], multipliers[1, lane], multipliers[2, lane]
        multipliers[0, lane], multipliers[1, lane], multipliers[2, lane] = times(inverse, lane, x, y, z)
        damping[lane] = arm.damping_floor + arm.damping_per_error * caution[lane]
    invert(block)
    for lane in range(LANES):
        a, b, c = multipliers[0, lane], multipliers[1, lane], multipliers[2, lane]
        care = gain / (1 + arm.curvature * np.sqrt(a * a + b * b + c * c))
        x, y, z = times(inverse, lane, error[0, lane], error[1, lane], error[2, lane])
        v[0, lane], v[1, lane], v[2, lane] = x - care * a, y - care * b, z - care * c
        caution[lane] = care
    for i in range(n):
        for lane in range(LANES):
            along = (
                H_inv_J[i, 0, lane] * v[0, lane] + H_inv_J[i, 1, lane] * v[1, lane] + H_inv_J[i, 2, lane] * v[2, lane]
            )
            p[i, lane] = caution[lane] * p[i, lane] + along
    _move(arm, block)


@compiled
def _linearise(arm: TrackingArm, block: Record) -> None:
    """Find the error, and the derivatives J and D of the hand's place and direction."""
    n, axis, axes, origins, place = len(arm.joints), arm.axis, block.axes, block.origins, block.place
    target, error, direction, J, D = block.target, block.error, block.direction, block.J, block.D
    length = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    chain(arm.joints, block)
    put(axis, n - 1, block)
    for c in range(3):
        for lane in range(LANES):
            direction[c, lane] = (place[c, lane] - origins[n - 1, c, lane]) / length
    put(arm.hand, n - 1, block)
    for c in range(3):
        for lane in range(LANES):
            error[c, lane] = target[c, lane] - place[c, lane]
    for i in range(n):
        for lane in range(LANES):
            x, y = place[0, lane] - origins[i, 0, lane], place[1, lane] - origins[i, 1, lane]
            z = place[2, lane] - origins[i, 2, lane]
            J[i, 0, lane], J[i, 1, lane], J[i, 2, lane] = turning(axes, i, lane, x, y, z)
            x, y, z = direction[0, lane], direction[1, lane], direction[2, lane]
            D[i, 0, lane], D[i, 1, lane], D[i, 2, lane] = turning(axes, i, lane, x, y, z)


@compiled
def _turn(n: int, block: Record) -> None:
    """Find the rotation vector from the last joint's orientation to the one that is wanted, and its derivative D."""
    axes, turn, wanted, direction, D = block.axes, block.turn, block.wanted, block.direction, block.D
    for lane in range(LANES):
        x, y, z, alike = 0.0, 0.0, 0.0, -1.0
        for c in range(3):  # of R and W, the sum of the columns' cross products is 2 sin θ times the axis
            a, b, d = axes[n - 1, c, 0, lane], axes[n - 1, c, 1, lane], axes[n - 1, c, 2, lane]
            p, q, r = turn[c, 0, lane], turn[c, 1, lane], turn[c, 2, lane]
            x, y, z = x + b * r - d * q, y + d * p - a * r, z + a * q - b * p
            alike += a * p + b * q + d * r  # and that of their products 1 + 2 cos θ
        sine = np.sqrt(x * x + y * y + z * z)
        factor = np.arctan2(sine, alike) / sine if sine > 1e-12 else 0.5
        wanted[0, lane], wanted[1, lane], wanted[2, lane] = factor * x, factor * y, factor * z
    direction[:] = 0
    for i in range(n):
        for c in range(3):
            for lane in range(LANES):
                D[i, c, lane] = axes[i, 2, c, lane]


@compiled
def _improve(n: int, limit_weight: float, block: Record) -> None:
    """Find p = −H⁻¹∇h, H⁻¹Jᵀ and J H⁻¹ Jᵀ, which is `matrix`.

    H = diag(1/mobility) + w_d DᵀD is inverted by Woodbury's formula: only 3 × 3 systems are solved.
    """
    q, J, D, G, H_inv_J, p, mobility = block.q, block.J, block.D, block.G, block.H_inv_J, block.p, block.mobility
    direction, wanted, mixed, v, damping = block.direction, block.wanted, block.mixed, block.v, block.damping
    reference, soft_lower, soft_upper, inverse = block.reference, block.soft_lower, block.soft_upper, block.inverse
    flexibility = block.flexibility
    for i in range(n):
        for lane in range(LANES):
            angle = q[i, lane]
            inside = soft_lower[i, lane] if angle < soft_lower[i, lane] else angle
            inside = soft_upper[i, lane] if inside > soft_upper[i, lane] else inside
            excess = angle - inside
            mobility[i, lane] = 1 / (1 + limit_weight) if excess != 0 else 1.0
            p[i, lane] = mobility[i, lane] * (reference[i, lane] - angle - limit_weight * excess)
            H_inv_J[i, 0, lane] = mobility[i, lane] * D[i, 0, lane]
            H_inv_J[i, 1, lane] = mobility[i, lane] * D[i, 1, lane]
            H_inv_J[i, 2, lane] = mobility[i, lane] * D[i, 2, lane]
    product(n, D, H_inv_J, block)
    damping[:] = flexibility
    invert(block)
    mixed[:] = 0
    for c in range(3):
        for lane in range(LANES):
            v[c, lane] = wanted[c, lane] - direction[c, lane]
    for i in range(n):
        for lane in range(LANES):
            x, y, z = H_inv_J[i, 0, lane], H_inv_J[i, 1, lane], H_inv_J[i, 2, lane]
            G[i, 0, lane], G[i, 1, lane], G[i, 2, lane] = times(inverse, lane, x, y, z)
        for c in range(3):
            for lane in range(LANES):
                v[c, lane] -= D[i, c, lane] * p[i, lane]
                mixed[c, 0, lane] += H_inv_J[i, c, lane] * J[i, 0, lane]
                mixed[c, 1, lane] += H_inv_J[i, c, lane] * J[i, 1, lane]
                mixed[c, 2, lane] += H_inv_J[i, c, lane] * J[i, 2, lane]
    for i in range(n):
        for lane in range(LANES):
            x, y, z = G[i, 0, lane], G[i, 1, lane], G[i, 2, lane]
            p[i, lane] += x * v[0, lane] + y * v[1, lane] + z * v[2, lane]
        for c in range(3):
            for lane in range(LANES):
                turned = G[i, 0, lane] * mixed[0, c, lane] + G[i, 1, lane] * mixed[1, c, lane]
                turned += G[i, 2, lane] * mixed[2, c, lane]
                H_inv_J[i, c, lane] = mobility[i, lane] * J[i, c, lane] - turned
    product(n, J, H_inv_J, block)


@compiled
def _move(arm: TrackingArm, block: Record) -> None:
    """Move the joints by p, at most by the step's limit and up to their own, in the lanes that move."""
    q, p, largest, moves, caution = block.q, block.p, block.largest, block.moves, block.caution
    longest = arm.step_limit
    largest[:] = 0
    for i in range(len(arm.joints)):
        for lane in range(LANES):
            size = abs(p[i, lane])
            largest[lane] = size if size > largest[lane] else largest[lane]
    for lane in range(LANES):
        caution[lane] = longest / largest[lane] if largest[lane] > longest else 1.0
        largest[lane] = 0
    for i in range(len(arm.joints)):
        lower, upper = arm.lower[i], arm.upper[i]
        for lane in range(LANES):
            moved = q[i, lane] + p[i, lane] * caution[lane]
            moved = lower if moved < lower else moved
            moved = upper if moved > upper else moved
            size = abs(moved - q[i, lane])
            largest[lane] = size if size > largest[lane] else largest[lane]
            q[i, lane] = moved if moves[lane] > 0 else q[i, lane]


@kernel
def settle(
    arm: TrackingArm,
    postures: Postures,
    q: Array,
    targets: Array,
    which: NDArray[np.int64],
    num_improving: int,
    num_final: int,
    tolerance: float,
) -> Array:
    """Step each posture until it moves less than a tolerance.

    Args:
        arm: the arm.
        postures: B secondary objectives.
        q: (N, n) where to begin, rad.
        targets: (N, 3) places for the end effector, metres; or (N, 12), and orientations for the last joint, column by
            column.
        which: (N,) objective of each.
        num_improving: largest number of steps that improve the posture, too.
        num_final: largest number of steps after them that only correct the place.
        tolerance: step, rad, after which a posture is left as it is.

    Returns:
        The postures (N, n), rad, inside the limits.
    """
    q, memory = q.copy(), np.empty(1, BLOCK)
    block = memory[0]
    at, moves, largest, turns = block.q, block.moves, block.largest, targets.shape[1] > 3
    for first in range(0, len(q), LANES):
        num = load(block, q, first)
        for lane in range(LANES):
            row = first + min(lane, num - 1)
            _aim(postures, which[row], lane, block)
            moves[lane] = 1
            _want(targets[row], targets[row], 0.0, lane, block)
        for step in range(num_improving + num_final):
            _newton(arm, 1.0 if step < num_improving else 0.0, turns, block)
            num_moving = 0
            for lane in range(LANES):
                moves[lane] = moves[lane] if largest[lane] > tolerance else 0.0
                num_moving += moves[lane] > 0
            if num_moving == 0:
                break
        for lane in range(num):
            for i in range(q.shape[1]):
                q[first + lane, i] = at[i, lane]
    keep(memory)
    return q


@kernel
def walk(arm: TrackingArm, postures: Postures, lines: Array, lengths: Array, starts: Array, num_strides: int) -> Array:
    """Walk along lines, one step a stride.

    Args:
        arm: the arm.
        postures: B secondary objectives, one for each line.
        lines: (B, T + 1, 3) places of the end effector, metres, the first one that of the start; or (B, T + 1, 12), as
            the targets of `settle`.
        lengths: (B, T + 1) distance travelled up to there, metres.
        starts: (B, n) where to begin, rad.
        num_strides: number of strides of equal length along each line.

    Returns:
        Rough postures (B, T, n), rad, at the places after the start: linear in the distance between strides.
    """
    num, n, last = len(lines), starts.shape[1], lines.shape[1] - 1
    result, memory = np.empty((num, last, n)), np.empty(1, BLOCK)
    block = memory[0]
    q = np.empty((LANES, num_strides + 1, n))
    at, moves, passed, turns = block.q, block.moves, np.zeros(LANES, np.int64), lines.shape[2] > 3
    for first in range(0, num, LANES):
        here = load(block, starts, first)
        for lane in range(LANES):
            _aim(postures, first + min(lane, here - 1), lane, block)
            moves[lane], passed[lane] = 1, 0
        for stride in range(num_strides + 1):
            if stride > 0:
                for lane in range(LANES):
                    row = first + min(lane, here - 1)
                    travelled, piece = stride / num_strides * lengths[row, last], passed[lane]
                    while piece < last - 1 and lengths[row, piece + 1] < travelled:
                        piece += 1
                    passed[lane], begins = piece, lengths[row, piece]
                    part = (travelled - begins) / max(lengths[row, piece + 1] - begins, 1e-300)
                    _want(lines[row, piece], lines[row, piece + 1], part, lane, block)
                _newton(arm, 1.0, turns, block)
            for lane in range(LANES):
                for i in range(n):
                    q[lane, stride, i] = at[i, lane]
        for lane in range(here):
            row = first + lane
            for waypoint in range(last):
                place = lengths[row, waypoint + 1] / max(lengths[row, last], 1e-12) * num_strides
                left = min(int(place), num_strides - 1)
                for i in range(n):
                    begin, end = q[lane, left, i], q[lane, left + 1, i]
                    result[row, waypoint, i] = begin + (place - left) * (end - begin)
    keep(memory)
    return result
