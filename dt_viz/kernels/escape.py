"""The whole arm's escape from obstacles: the formulas of `dt_viz.avoidance.arm_field.WholeArmField` and its flow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dt_viz.kernels.arm import Array, BodyPoints, Joints
from dt_viz.kernels.blocks import LANES, MOST_JOINTS, Blocks, block_of, chain, keep, measure, put, turning
from dt_viz.kernels.compiled import compiled, kernel, short_kernel
from dt_viz.kernels.distances import Record, Shapes, Values
from dt_viz.kernels.runge_kutta import carry_explicitly

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
)
"""Memory for the field."""


class Escape(NamedTuple):
    """The way in which an arm of n joints and P body points leaves K obstacles."""

    joints: Joints
    points: BodyPoints
    hand: Array  # (3,) position of the end effector in the last joint, metres
    axis: Array  # (3,) direction of the hand there, of any length but 0
    shapes: Shapes
    values: Values
    sources: Array  # (K, 3) points from which the escape directions fan out, metres
    cores: Array
    """(K, P) distances from the surface at which the field has its full strength, metres."""
    reach: float  # distance from the surface at which the field ends, metres
    speed: float
    """v: distance that a contact at full strength escapes in a unit of flow time, metres."""
    damping: float  # λ of the contact's pseudo-inverse, m/rad
    direction_weight: float  # w_d of the hand's direction, rad²
    hand_weight: float  # w_x of the end effector's motion, rad²/m²
    pins: Array  # (M, n) postures that do not move, rad
    levers: Array  # (n,) motion of the hand for each joint's turning, m/rad, about
    pin: float  # size of the region around a pin in which the field fades out, metres


@compiled
def _find_velocity(escape: Escape, block: Record) -> bool:
    """Find V_q at the postures of the block; returns whether any of them moves.

    With weights ŵ_b of the body points, J_c = Σ ŵ_b J_b and n_c = Σ ŵ_b n_b this is, for each obstacle,

        −V_q = v·m·χ (I + R Rᵀ)⁻¹ J_cᵀ n_c/λ²,   R = (√w_x Jᵀ, √w_d Dᵀ, J_cᵀ/λ), (n, 9).
    """
    n, moves = len(escape.joints), False
    velocity, pull, freedom = block.velocity, block.pull, block.freedom
    velocity[:] = 0
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
            total[:], wanted[:], weight[:], lever[:], touched = 0, 0, 0, 0, True
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
def _hold(escape: Escape, block: Record) -> None:
    """Find √w_x Jᵀ and √w_d Dᵀ, which are R[:, :3] and R[:, 3:6]."""
    n, hand, axis = len(escape.joints), escape.hand, escape.axis
    place, tip, origins, scale = block.place, block.tip, block.origins, block.scale
    staying = np.sqrt(escape.hand_weight)
    upright = np.sqrt(escape.direction_weight / (axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2))
    for column, weight, offset in ((0, staying, hand), (3, upright, axis)):
        put(offset, n - 1, block)
        scale[:] = weight
        for c in range(3):
            for lane in range(LANES):
                tip[c, lane] = place[c, lane]
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
        x, y, z = turning(axes, i, lane, place[0, lane], place[1, lane], place[2, lane])
        R[i, column, lane], R[i, column + 1, lane] = scale[lane] * x, scale[lane] * y
        R[i, column + 2, lane] = scale[lane] * z


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
    freedom[:] = 1
    for row in range(len(pins)):
        squared[:] = 0
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
def _rate(escape: Escape, states: Array, n: int, d: int, work: Blocks, into: Array) -> None:
    """Write V_q at postures (d, L); see `dt_viz.kernels.runge_kutta`."""
    block = work[0]
    q, velocity = block.q, block.velocity
    for i in range(d):
        for lane in range(LANES):
            q[i, lane] = states[i, lane]
        for lane in range(n, LANES):
            q[i, lane] = states[i, n - 1]
    _find_velocity(escape, block)
    for i in range(d):
        for lane in range(LANES):
            into[i, lane] = velocity[i, lane]


@kernel
def carry(escape: Escape, q: Array, method: int, duration: float, steps: int, tolerance: float) -> int:
    """Carry postures q (N, n) along the flow, in place; see `dt_viz.kernels.flows.carry`."""
    memory = np.empty(1, BLOCK)
    num_failed = carry_explicitly(_rate, escape, q, q.shape[1], method, duration, steps, tolerance, LANES, memory)
    keep(memory)
    return num_failed


@kernel
def detours(
    directions: Array, points: Array, radius: Array, centres: Array, radii: Array, margin: float, length: float
) -> tuple[Array, Array]:
    """Find how far the arm has to be shifted until none of its spheres is nearer than a margin to a ball.

    A ball that a sphere would meet only after more than `length` metres of the shift is not in the way.

    Args:
        directions: (D, 3) unit vectors.
        points: (P, 3, M) centres of the arm's spheres at M samples, metres.
        radius: (P,) their radii, metres.
        centres: (B, 3) centres of the balls that cover the obstacle, metres.
        radii: (B,) their radii, metres.
        margin: required distance, metres.
        length: see above.

    Returns:
        For each direction the shift (D,), and the greatest depth (D,) below the plane z = 0 of the spheres that are
        near a ball, each shifted as far as it needs itself, metres.
    """
    shifts, depths = np.zeros(len(directions)), np.zeros(len(directions))
    u, v, w = directions[:, 0].copy(), directions[:, 1].copy(), directions[:, 2].copy()
    for b in range(len(centres)):
        for p in range(len(points)):
            apart = radii[b] + margin + radius[p]
            for m in range(points.shape[2]):
                x, y = points[p, 0, m] - centres[b, 0], points[p, 1, m] - centres[b, 1]
                z = points[p, 2, m] - centres[b, 2]
                room = x * x + y * y + z * z - apart * apart
                if room >= 4 * length * (apart + length):
                    continue
                lowest = points[p, 2, m] - radius[p]
                for d in range(len(u)):
                    # along the direction it meets the ball, grown by `apart`, at −along ± root
                    along = u[d] * x + v[d] * y + w[d] * z
                    root = np.sqrt(max(along * along - room, 0.0))
                    in_the_way = (root > along) & (along + root > -length) & (along * along > room)
                    shift = root - along if in_the_way else 0.0
                    shifts[d] = max(shifts[d], shift)
                    depths[d] = max(depths[d], -lowest - shift * w[d])
    return shifts, depths


@short_kernel
def distinct(directions: Array, cost: Array, alike: float, selectivity: float, num: int) -> tuple[Array, Array]:
    """Gather directions that are alike, those about the cheapest first.

    Args:
        directions: (D, 3) unit vectors.
        cost: (D,) their costs; infinite where they are out of the question.
        alike: cosine of the largest angle from the cheapest direction of a group.
        selectivity: relative difference in cost over which a direction's share in its group's mean falls by e.
        num: largest number of groups.

    Returns:
        For F groups the means (F, 3), unit vectors, and the least costs (F,).
    """
    num = min(num, len(cost))
    left, means, costs, found = cost.copy(), np.zeros((num, 3)), np.empty(num), 0
    while found < num and left.min() < np.inf:
        best, mean = left.argmin(), means[found]
        costs[found] = least = left[best]
        for d in range(len(directions)):
            if directions[d] @ directions[best] > alike and left[d] < np.inf:
                mean += (
                    np.exp((least - left[d]) / (selectivity * least)) * directions[d] if least > 0 else directions[d]
                )
                left[d] = np.inf
        mean /= np.sqrt(mean @ mean)
        found += 1
    return means[:found], costs[:found]
