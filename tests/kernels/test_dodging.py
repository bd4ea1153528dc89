"""The compiled look ahead: the same room as array operations, and no candidate that leaves more."""

from itertools import product

import numpy as np
import pytest
from body_spheres import cover

from dt_viz.kernels.dodging import ENOUGH, Forecast, LimitedArm, dodge
from dt_viz.obstacles.shapes import Box, Sphere, as_point, records
from dt_viz.robot.models import load_jaco

ROBOT = load_jaco()
LINKS = load_jaco().links
COVER = cover(LINKS)
FLOOR, DEPTH, KEPT = 0.05, 0.02, 0.01
UP = np.array([0.0, 0.0, 1.0])
ACCELERATION, TIMES = 4.0, np.linspace(0, 0.4, 9)[1:]
ARM = LimitedArm(ROBOT.records, LINKS.spheres, ROBOT.lower, ROBOT.upper, ROBOT.velocity_limits, ACCELERATION)


def room(parts, moved, deviation, q, velocity, wanted):
    """Smallest distance in deviations, at most `ENOUGH`, with joints that turn to `wanted` as fast as they may."""
    smallest = ENOUGH
    for t, places, unsure in zip(TIMES, moved, deviation, strict=True):
        steps = np.linspace(0, t, 4001)
        ramped = velocity + np.clip(wanted - velocity, -ACCELERATION * steps[:, None], ACCELERATION * steps[:, None])
        p = np.clip(q + t * (ramped[1:] + ramped[:-1]).mean(axis=0) / 2, ROBOT.lower, ROBOT.upper)
        points = COVER.positions(ROBOT, p)
        smallest = min(smallest, (points[:, 2] - COVER.radius - FLOOR).min() / DEPTH)
        for part, place, most in zip(parts, places, unsure, strict=True):
            away = part.signed_distance(points - place) - COVER.radius - KEPT
            smallest = min(smallest, away.min() / most)
    return smallest


def candidates(chosen):
    """Velocities with some joints, the first three or the last, at a standstill or their limits."""
    for first in (0, 3):
        for senses in product((-1, 0, 1), repeat=3):
            tried = chosen.copy()
            tried[first : first + 3] = senses * ROBOT.velocity_limits[first : first + 3]
            yield tried


@pytest.mark.parametrize("seed", range(6))
def test_what_is_chosen_leaves_most_room_of_what_is_tried(seed):
    rng = np.random.default_rng(seed)
    q = ROBOT.clip(ROBOT.home + rng.normal(0, 0.3, 6))
    velocity, wanted = rng.uniform(-0.5, 0.5, (2, 6))
    hand = ROBOT.end_effector(q)
    coming = rng.normal(size=3)
    coming /= np.linalg.norm(coming)
    parts = (Sphere(as_point(hand - 0.3 * coming), 0.15), Box(as_point(hand + 0.4 * UP), (0.2, 0.2, 0.2)))
    way = TIMES[:, None] * coming + np.outer(TIMES**2, rng.normal(scale=2.0, size=3))
    moved = np.stack([way, np.outer(TIMES, [0, 0, -0.5])], axis=1)
    deviation = np.stack([0.03 + 0.4 * TIMES, 0.02 + 0.2 * TIMES], axis=1)
    forecast = Forecast(*records(parts), TIMES, moved, deviation, KEPT, FLOOR, DEPTH)
    clear, chosen = dodge(ARM, forecast, q, velocity, wanted, wanted, 0.0)
    assert clear == (room(parts, moved, deviation, q, velocity, wanted) >= ENOUGH)
    if clear:
        np.testing.assert_array_equal(chosen, wanted)
        return
    best = room(parts, moved, deviation, q, velocity, chosen)
    assert best >= room(parts, moved, deviation, q, velocity, wanted) - 1e-6
    last = [tried for tried in candidates(chosen) if (tried[:3] == chosen[:3]).all()]
    assert best >= max(room(parts, moved, deviation, q, velocity, tried) for tried in last) - 1e-6


def test_what_is_far_away_changes_nothing():
    q, wanted = np.array(ROBOT.home), np.full(6, 0.3)
    moved, deviation = np.zeros((len(TIMES), 1, 3)), np.full((len(TIMES), 1), 0.2)
    forecast = Forecast(*records((Sphere((3.0, 3.0, 3.0), 0.15),)), TIMES, moved, deviation, KEPT, -1.0, DEPTH)
    clear, chosen = dodge(ARM, forecast, q, wanted, wanted, wanted, 0.0)
    assert clear
    np.testing.assert_array_equal(chosen, wanted)
