"""Surfaces that are drawn, and directions spread over a sphere."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from dt_viz.flows.fields import Array, Indices


def box_surface(half: Array) -> tuple[Array, Indices]:
    """Return vertices (8, 3) and faces (12, 3), outward, of a box of half sizes (3,), metres."""
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))  # x slowest
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners * half, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def lathe(profile: Sequence[tuple[float, float]], num: int = 48) -> tuple[Array, Indices]:
    """Return the closed surface, vertices (V, 3), metres, and faces (F, 3), outward, of a profile turned around z.

    The profile has distances from the axis and heights, metres, from the axis up along the outside and back to it; the
    surface has `num` sides.
    """
    (_, bottom), *rings, (_, top) = profile
    turn, here = 2 * np.pi * np.arange(num) / num, np.arange(num)
    circle, there = np.stack([np.cos(turn), np.sin(turn)], axis=1), (here + 1) % num
    vertices = [np.column_stack([radius * circle, np.full(num, height)]) for radius, height in rings]
    last, below = (len(rings) - 1) * num, len(rings) * num
    faces = [np.stack([np.full(num, below), there, here], axis=1)]
    for first in range(0, last, num):
        a, b, c, d = here + first, there + first, there + first + num, here + first + num
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    faces.append(np.stack([np.full(num, below + 1), here + last, there + last], axis=1))
    return np.concatenate([*vertices, [[0, 0, bottom], [0, 0, top]]]), np.concatenate(faces)


@lru_cache(maxsize=4)
def golden_spiral(num: int, offset: float = 0.0) -> Array:
    """Return evenly spread unit vectors (num, 3): a spiral in golden angles, turned by `offset` of them."""
    k = np.arange(num)
    z, turn = 1 - (2 * k + 1) / num, np.pi * (1 + np.sqrt(5)) * (k + offset)
    r = np.sqrt(1 - z * z)
    vectors = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    vectors.flags.writeable = False
    return vectors
