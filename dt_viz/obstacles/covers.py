"""Few balls that cover a box, a cylinder or the cells of a grid."""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.spatial import KDTree

from dt_viz.flows.fields import Array

MAX_BALLS = 12
"""Largest number of balls of a cover: each costs time in the search of an escape."""


def box_cover(half: Array) -> tuple[Array, Array]:
    """Cover a box of half sizes (3,) by the balls of its equal parts: centres (K, 3) and radii (K,)."""
    cuts = itertools.product(range(1, MAX_BALLS + 1), repeat=3)
    counts = np.array([cut for cut in cuts if math.prod(cut) <= MAX_BALLS])
    radius = np.linalg.norm(half / counts, axis=1)
    good = np.flatnonzero(radius <= 1.15 * radius.min())  # the fewest parts that are nearly as small as can be
    best = good[np.prod(counts[good], axis=1).argmin()]
    sides = [size * ((2 * np.arange(num) + 1) / num - 1) for size, num in zip(half, counts[best], strict=True)]
    centres = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    return centres, np.full(len(centres), radius[best])


def cylinder_cover(R: float, half: float) -> tuple[Array, Array]:
    """Cover a cylinder of radius R along z by balls of its slices, or by seven side by side, whichever is tighter."""
    slices = np.arange(1, MAX_BALLS + 1)
    stacked = np.hypot(R, half / slices)
    num = int(slices[stacked <= 1.02 * stacked[-1]][0])  # the fewest that are nearly as tight
    centres = np.zeros((num, 3))
    centres[:, 2] = half * ((2 * np.arange(num) + 1) / num - 1)
    radius = stacked[num - 1]
    if (beside := np.hypot(R / 2, half)) < radius:  # seven discs of half the radius cover a disc
        turn = np.arange(6) * np.pi / 3
        ring = R * np.sqrt(3) / 2 * np.stack([np.cos(turn), np.sin(turn), np.zeros(6)], axis=1)
        centres, radius = np.concatenate([np.zeros((1, 3)), ring]), beside
    return centres, np.full(len(centres), radius)


def cells_cover(nodes: Array, cell: float, num: int = 10) -> tuple[Array, Array]:
    """Cover the cells around nodes (N, 3) of a grid by at most `num` balls of clusters: centres (K, 3), radii (K,)."""
    some = nodes[:: max(1, len(nodes) // 4000)]
    centres = [some[np.linalg.norm(some - some.mean(axis=0), axis=1).argmax()]]
    apart = np.linalg.norm(some - centres[0], axis=1)
    while len(centres) < num:  # farthest-point initialisation
        centres.append(some[apart.argmax()])
        apart = np.minimum(apart, np.linalg.norm(some - centres[-1], axis=1))
    centres = np.array(centres)
    for _ in range(15):
        member = KDTree(centres).query(some)[1]
        for k in range(num):
            if len(mine := some[member == k]):
                centres[k] = _middle(mine)
    distance, member = KDTree(centres).query(nodes)
    radii = np.array([distance[member == k].max(initial=-1.0) for k in range(num)])
    return centres[radii >= 0], radii[radii >= 0] + cell * np.sqrt(3) / 2


def _middle(points: Array) -> Array:
    """Find the centre (3,) of a small ball around points (N, 3) by steps to the farthest (Bădoiu and Clarkson)."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    for k in range(1, 20):
        farthest = points[((points - centre) ** 2).sum(axis=1).argmax()]
        centre = centre + (farthest - centre) / (k + 4)
    return centre
