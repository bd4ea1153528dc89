"""Tubes around paths, ring by ring."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.arm import Array
from dt_viz.kernels.compiled import compiled, short_kernel

NUM_BALL_RINGS = 6  # number of rings of a ball
BEND = 0.03  # length of a path that needs as many rings as a turn by one radian, metres


@compiled
def dot(a: Array, b: Array) -> float:
    """Return the product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def add(times: float, other: Array, vector: Array) -> None:
    """Add a multiple of another vector (3,) to a vector (3,), in place."""
    for k in range(3):
        vector[k] += times * other[k]


@compiled
def shorten(vector: Array) -> None:
    """Give a vector (3,) length one, in place; without a direction it stays short."""
    size = max(np.sqrt(dot(vector, vector)), 1e-12)
    for k in range(3):
        vector[k] /= size


@compiled
def reflect(vector: Array, across: Array) -> None:
    """Reflect a vector (3,) in the plane across another one, in place."""
    add(-2 * dot(across, vector) / max(dot(across, across), 1e-18), across, vector)


@compiled
def write_ring(middle: Array, radius: float, height: float, frame: Array, turns: Array, ring: Array) -> None:
    """Write the corners (S, 3) of a ring.

    Args:
        middle: (3,) of which the ring lies ahead by `height`, along its axis, metres.
        radius: metres.
        height: metres.
        frame: (3, 3) axis, normal and the direction across both.
        turns: (S, 2) cosines and sines of the corners' angles from the normal.
        ring: (S, 3) the corners, metres.
    """
    for side in range(len(ring)):
        for k in range(3):
            outward = turns[side, 0] * frame[1, k] + turns[side, 1] * frame[2, k]
            ring[side, k] = middle[k] + height * frame[0, k] + radius * outward


@short_kernel
def tubes(paths: Array, radius: float, ball: float, num_sides: int) -> Array:
    """Return the vertices (R, K, S, 3), single precision, of tubes around paths (R, T, 3), metres, in K rings.

    The rings do not twist: their frames go along by double reflection (Wang et al., "Computation of Rotation Minimizing
    Frames", 2008). A ball at the beginning has a radius `ball`, metres; 0 is none.
    """
    num, length, _ = paths.shape
    num_first = NUM_BALL_RINGS if ball > 0 else 1
    vertices = np.empty((num, num_first + length + 1, num_sides, 3), np.float32)
    angles = 2 * np.pi * np.arange(num_sides) / num_sides
    turns = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    frame, before, step = np.zeros((3, 3)), np.empty(3), np.empty(3)
    axis, normal, across = frame
    for r in range(num):
        path, tube = paths[r], vertices[r]
        for place in range(length):
            before[:] = axis
            for k in range(3):
                axis[k] = path[min(place + 1, length - 1), k] - path[max(place - 1, 0), k]
                step[k] = path[place, k] - path[max(place - 1, 0), k]
            shorten(axis)
            if place == 0:
                normal[:] = 0.0
                normal[np.abs(axis).argmin()] = 1.0
            else:
                reflect(normal, step)
                reflect(before, step)
                add(-1.0, axis, before)
                reflect(normal, before)
            add(-dot(normal, axis), axis, normal)  # where a path stands still, or numbers are rounded
            shorten(normal)
            for k in range(3):
                across[k] = axis[k - 2] * normal[k - 1] - axis[k - 1] * normal[k - 2]
            write_ring(path[place], radius, 0.0, frame, turns, tube[num_first + place])
            for k in range(num_first if place == 0 else 0):
                angle = np.pi * (1 - k / (NUM_BALL_RINGS - 1))
                write_ring(path[0], ball * np.sin(angle), ball * np.cos(angle), frame, turns, tube[k])
        for side in range(num_sides):
            tube[-1, side] = path[-1]
    return vertices


@short_kernel
def evenly_bent(path: Array, num: int) -> Array:
    """Return (num, 3) points of a path (T, 3), metres: the denser the more it bends."""
    length, result = len(path), np.empty((num, 3))
    measure, ahead, before = np.zeros(length), np.zeros(3), np.zeros(3)
    for place in range(1, length):
        for k in range(3):
            ahead[k] = path[place, k] - path[place - 1, k]
        piece = np.sqrt(dot(ahead, ahead))
        shorten(ahead)
        for k in range(3):
            before[k] -= ahead[k]
        turn = np.sqrt(dot(before, before)) if place > 1 else 0.0
        measure[place] = measure[place - 1] + max(piece + BEND * turn, 1e-12)
        before[:] = ahead
    for k in range(3):
        result[:, k] = np.interp(np.linspace(0, measure[-1], num), measure, path[:, k])
    return result
