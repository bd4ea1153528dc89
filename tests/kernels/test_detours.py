"""The compiled detours: the same numbers as array operations, for random arms, balls and directions."""

import numpy as np
import pytest

from dt_viz.kernels.detours import detours

LENGTH = 0.1


def plain(directions, points, radius, centres, radii, margin):
    offset = points - centres[:, None, :, None]  # (B, P, 3, M)
    squared, apart = (offset**2).sum(axis=2), (radii[:, None] + margin + radius)[:, :, None]
    ball, point, sample = np.nonzero(squared < (apart + 2 * LENGTH) ** 2)
    along = directions @ offset[ball, point, :, sample].T  # (D, pairs)
    under_root = along**2 - (squared - apart**2)[ball, point, sample]
    root = np.sqrt(np.maximum(under_root, 0))
    hit = (under_root > 0) & (root - along > 0) & (-along - root < LENGTH)
    shift = np.where(hit, root - along, 0)
    lowest = (points[:, 2] - radius[:, None])[point, sample]
    return shift.max(axis=1), np.maximum(-(lowest + shift * directions[:, 2:]), 0).max(axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_they_are_those_of_array_operations(seed):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = rng.normal(0, 0.15, (12, 3, 7)) + np.array([0, 0, rng.uniform(-0.1, 0.3)])[:, None]
    radius, centres = rng.uniform(0.02, 0.05, 12), rng.normal(0, 0.1, (5, 3))
    given = directions, points, radius, centres, rng.uniform(0.01, 0.07, 5), rng.uniform(0, 0.05)
    for found, expected in zip(detours(*given, LENGTH), plain(*given), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert (detours(*given, LENGTH)[0] > 0).any()


def test_balls_far_away_are_no_reason_to_move():
    up = np.array([[0.0, 0.0, 1.0]])
    shifts, depths = detours(up, np.zeros((1, 3, 1)), np.full(1, 0.1), np.array([[3.0, 0, 0]]), np.ones(1), 0.0, LENGTH)
    assert shifts[0] == depths[0] == 0
