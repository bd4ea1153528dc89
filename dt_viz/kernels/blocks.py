"""Kinematics of an arm and its distances from obstacles, for a block of `LANES` postures at once.

The innermost loops run over the lanes of a block, whose layout is known when they are compiled: so they become
instructions for four or eight numbers at a time. One posture alone takes as long as `LANES` of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dt_viz.kernels.arm import Array, BodyPoints, Joints, holds_others
from dt_viz.kernels.compiled import compiled, short_kernel, unrolled
from dt_viz.kernels.distances import GRID, KINDS, SPHERE, Record, Shapes, Values, from_surface, weight

LANES = 16  # number of postures in a block
MOST_JOINTS = 8  # largest number of joints of an arm
SPREAD = 2.0
"""Largest difference between a distance on a grid and its nearest node's, in cells, with room to spare."""


def block_of(*rows: tuple[str, tuple[int, ...]]) -> np.dtype:
    """Memory for a block: these arrays, by name and shape, each with one entry for every lane."""
    kinematics = (
        ("q", (MOST_JOINTS,)),  # angles, rad
        ("axes", (MOST_JOINTS, 3, 3)),  # of the joints' frames: [joint, column, component]
        ("origins", (MOST_JOINTS, 3)),  # of these frames, metres
        ("sine", ()),
        ("cosine", ()),
        ("place", (3,)),  # of a body point, metres
        ("away", ()),  # its distance from an obstacle, metres
        ("own", (3,)),  # and place in the frame of a grid, cells
        ("beyond", (3,)),  # how far that is beyond the grid, cells
        ("sums", ()),  # weighted sum of its nodes' distances
        ("corners", (3,)),  # and three of these
        ("node", ()),  # index of the nearest inner node's first neighbour
    )
    return np.dtype([(name, np.float64, (*shape, LANES)) for name, shape in (*kinematics, *rows)])


BLOCK = block_of(("floor", ()), ("bound", ()))  # memory for `clearance`
Blocks = NDArray[np.void]  # (1,) block of such a dtype


@compiled
def keep(memory: Blocks) -> None:
    """Keep the memory of a block up to here: numba frees it after its last use, and a record in it does not count."""


@compiled
def load(block: Record, q: Array, first: int) -> int:
    """Take the postures q[first:] (N, n) into the lanes, the last one into those left over; returns how many."""
    num, angles = min(len(q) - first, LANES), block.q
    for lane in range(LANES):
        for i in range(q.shape[1]):
            angles[i, lane] = q[first + min(lane, num - 1), i]
    return num


@compiled
def chain(joints: Joints, block: Record) -> None:
    """Find the frames of the joints: frame i is frame i − 1 times R_i, then a turn by q_i about its z axis."""
    axes, origins, sine, cosine = block.axes, block.origins, block.sine, block.cosine
    for i in range(len(joints)):
        R, shift = joints[i].rotation, joints[i].translation
        _sine_cosine(block, i)
        if i == 0:
            for k in range(3):
                for lane in range(LANES):
                    axes[0, 0, k, lane] = R[k, 0] * cosine[lane] + R[k, 1] * sine[lane]
                    axes[0, 1, k, lane] = R[k, 1] * cosine[lane] - R[k, 0] * sine[lane]
                    axes[0, 2, k, lane] = R[k, 2]
                    origins[0, k, lane] = shift[k]
            continue
        for k in range(3):
            for lane in range(LANES):
                a, b, c = axes[i - 1, 0, k, lane], axes[i - 1, 1, k, lane], axes[i - 1, 2, k, lane]
                x = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
                y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
                axes[i, 0, k, lane] = x * cosine[lane] + y * sine[lane]
                axes[i, 1, k, lane] = y * cosine[lane] - x * sine[lane]
                axes[i, 2, k, lane] = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
                origins[i, k, lane] = origins[i - 1, k, lane] + shift[0] * a + shift[1] * b + shift[2] * c


@compiled
def _sine_cosine(block: Record, i: int) -> None:
    """Find sin q_i and cos q_i to 1e-16, for up to a thousand turns.

    The angle less the nearest multiple of π/2, which is known to 100 bits, goes into the polynomials of fdlibm.
    """
    q, sine, cosine = block.q, block.sine, block.cosine
    for lane in range(LANES):
        quarters = np.floor(q[i, lane] * 0.6366197723675814 + 0.5)
        x = q[i, lane] - quarters * 1.5707963267341256
        x = x - quarters * 6.077100506303966e-11
        x = x - quarters * 2.0222662487959506e-21
        z = x * x
        s = 2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        s = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * s)
        s = x + x * z * (-1.66666666666666324348e-01 + z * s)
        c = -2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)
        c = -1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 + z * c)
        c = 1 - 0.5 * z + z * z * (4.16666666666666019037e-02 + z * c)
        quadrant = quarters - 4 * np.floor(quarters * 0.25)
        odd = (quadrant == 1) | (quadrant == 3)
        turned_s, turned_c = c if odd else s, s if odd else c
        sine[lane] = -turned_s if quadrant >= 2 else turned_s
        cosine[lane] = -turned_c if (quadrant == 1) | (quadrant == 2) else turned_c


@compiled
def put(offset: Array, joint: int, block: Record) -> None:
    """Find the place of what is fixed to a joint, or to the base where that is −1, at an offset (3,), metres."""
    axes, origins, place = block.axes, block.origins, block.place
    u, v, w = offset[0], offset[1], offset[2]
    for k in range(3):
        if joint < 0:
            for lane in range(LANES):
                place[k, lane] = offset[k]
            continue
        for lane in range(LANES):
            turned = u * axes[joint, 0, k, lane] + v * axes[joint, 1, k, lane] + w * axes[joint, 2, k, lane]
            place[k, lane] = origins[joint, k, lane] + turned


@compiled
def turning(axes: Array, i: int, lane: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Velocity of what has the lever (x, y, z) from joint i, at its unit speed; axes (n, 3, 3, LANES)."""
    a, b, c = axes[i, 2, 0, lane], axes[i, 2, 1, lane], axes[i, 2, 2, lane]
    return b * z - c * y, c * x - a * z, a * y - b * x


@compiled
def measure(shape: Record, values: Values, radius: float, enough: float, block: Record) -> None:
    """Find the distance of a sphere about the place from an obstacle; from `enough` on, any not larger one will do."""
    place, away, axes, kind = block.place, block.away, shape.axes, shape.kind
    X, Y, Z = shape.position
    half_u, half_v, half_w = shape.half
    if kind == GRID:
        _measure_on_grid(shape, values, radius, enough, block)
        return
    a, b, c, d, e, f = axes[0, 0], axes[1, 0], axes[2, 0], axes[0, 1], axes[1, 1], axes[2, 1]
    g, h, i = axes[0, 2], axes[1, 2], axes[2, 2]
    for known in unrolled(KINDS):  # a loop over the lanes for each, without branches
        if kind == known:
            for lane in range(LANES):
                u, v, w = place[0, lane] - X, place[1, lane] - Y, place[2, lane] - Z
                if known != SPHERE:  # which needs no turn
                    u, v, w = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
                away[lane] = from_surface(known, half_u, half_v, half_w, u, v, w) - radius


@compiled
def _measure_on_grid(shape: Record, values: Values, radius: float, enough: float, block: Record) -> None:
    """Do the same for a distance grid; see `dt_viz.kernels.distances`.

    A weighted mean of 27 nodes is read only where neither the ball around the grid's content nor the nearest node tells
    that the distance is `enough`: distances of nodes change by at most their distance.
    """
    place, away, own, beyond, nodes = block.place, block.away, block.own, block.beyond, block.node
    sums, corners = block.sums, block.corners
    scale, cell, margin, ball, counts = shape.scale, shape.cell, shape.margin, shape.radius, shape.counts
    limit, stride = (enough + radius) / scale, counts[2]
    X, Y, Z = shape.position
    for k in range(3):
        a, b, c = shape.axes[0, k] / scale, shape.axes[1, k] / scale, shape.axes[2, k] / scale
        for lane in range(LANES):
            own[k, lane] = a * (place[0, lane] - X) + b * (place[1, lane] - Y) + c * (place[2, lane] - Z)
    X, Y, Z = shape.centre
    for lane in range(LANES):  # from the ball
        x, y, z = own[0, lane] - X, own[1, lane] - Y, own[2, lane] - Z
        away[lane] = np.sqrt(x * x + y * y + z * z) - ball
    if _least(away) < limit:
        nodes[:] = shape.begin
        for k in range(3):
            step = stride if k == 1 else (counts[1] * stride if k == 0 else 1)
            first, last = shape.first[k], counts[k] - 1.5
            for lane in range(LANES):
                t = (own[k, lane] - first) / cell
                clipped = min(max(t, 0.5), last)
                node = min(np.floor(clipped + 0.5), last - 0.5)
                own[k, lane], beyond[k, lane] = clipped - node, t - clipped
                nodes[lane] += (node - 1) * step
        middle = (counts[1] + 1) * stride + 1
        for lane in range(LANES):
            sums[lane] = values[np.int64(nodes[lane]) + middle]
        for lane in range(LANES):
            away[lane] = max(away[lane], sums[lane] - SPREAD * cell)
    if _least(away) < limit:
        sums[:] = 0
        for p in range(3):
            for q in range(3):
                at = (p * counts[1] + q) * stride
                for lane in range(LANES):
                    node = np.int64(nodes[lane]) + at
                    corners[0, lane], corners[1, lane], corners[2, lane] = (
                        values[node],
                        values[node + 1],
                        values[node + 2],
                    )
                for lane in range(LANES):
                    c = own[2, lane]
                    row = 0.5 * (0.5 - c) ** 2 * corners[0, lane] + (0.75 - c * c) * corners[1, lane]
                    row += 0.5 * (0.5 + c) ** 2 * corners[2, lane]
                    sums[lane] += weight(own[0, lane], p) * weight(own[1, lane], q) * row
        for lane in range(LANES):
            value = sums[lane]
            x, y, z = cell * abs(beyond[0, lane]), cell * abs(beyond[1, lane]), cell * abs(beyond[2, lane])
            outside, far = x + y + z, max(value, margin)
            far = np.sqrt(far * far + x * x + y * y + z * z + 2 * margin * outside)
            away[lane] = max(away[lane], far if outside > 0 else value)
    for lane in range(LANES):
        away[lane] = scale * away[lane] - radius


@compiled
def _largest(values: Array) -> float:
    most = values[0]
    for lane in range(LANES):
        most = values[lane] if values[lane] > most else most
    return most


@compiled
def _least(values: Array) -> float:
    least = values[0]
    for lane in range(LANES):
        least = values[lane] if values[lane] < least else least
    return least


@short_kernel
def room_asked(q: Array, pins: Array, room: Array, levers: Array, slope: float, margin: float) -> Array:
    """Clearance (N,), metres, asked for at postures q (N, n): a margin, less beside pins (K, n) that have less `room`.

    From its room (K,) at a pin it grows by `slope` for each metre of distance, with `levers` (n,), m/rad.
    """
    asked = np.full(len(q), margin)
    for row in range(len(q)):
        for k in range(len(pins)):
            if room[k] < asked[row]:
                squared = 0.0
                for i in range(q.shape[1]):
                    squared += (levers[i] * (q[row, i] - pins[k, i])) ** 2
                asked[row] = min(asked[row], room[k] + slope * np.sqrt(squared))
    return asked


@short_kernel
def clearance(
    joints: Joints, points: BodyPoints, shapes: Shapes, values: Values, q: Array, lowest: Array, highest: Array
) -> Array:
    """Smallest distance (N,), metres, of body points' spheres from any of the obstacles, at angles q (N, n), rad.

    It is cut off at `lowest` (N,) and `highest` (N,): what is beyond takes less time.
    """
    result, memory = highest.copy(), np.empty(1, BLOCK)
    likely = np.full(len(shapes), len(points) - 1)  # what was nearest just before: most bounds are beyond it
    block = memory[0]
    away, floor, bound = block.away, block.floor, block.bound
    for first in range(0, len(q), LANES):
        num = load(block, q, first)
        chain(joints, block)
        for lane in range(LANES):
            row = first + min(lane, num - 1)
            floor[lane], bound[lane] = lowest[row], highest[row]
        for k in range(len(shapes)):
            tried, p = False, 0
            while p < len(points):
                at = p if tried else likely[k]
                most = _largest(bound)
                put(points[at].offset, points[at].joint, block)
                measure(shapes[k], values, points[at].radius, most, block)
                nearer = 0
                for lane in range(LANES):
                    nearer += away[lane] < bound[lane]
                if not holds_others(points, at):
                    if away[0] < bound[0]:
                        likely[k] = at
                    for lane in range(LANES):
                        closer = away[lane] if away[lane] < bound[lane] else bound[lane]
                        bound[lane] = closer if closer > floor[lane] else -np.inf
                if tried:
                    p = p + 1 if nearer > 0 else points[p].end
                tried = True
        for lane in range(num):
            result[first + lane] = max(bound[lane], lowest[first + lane])
    keep(memory)
    return result
