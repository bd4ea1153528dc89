"""Ways out of obstacles while these are dragged: remembered, kept for all motions at once, and turned gradually."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.flows.diffeomorphisms import AdaptiveFlow
from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.obstacles.ways import NEARBY, TURNING, Way, remembered
from dt_viz.transforms.base import MotionBelow
from dt_viz.transforms.sides import CORE, INNER, KEPT, ROOM, Passes

seeds = st.integers(0, 2**32 - 1)
X, Y, Z = np.eye(3)
RADIUS = 0.08


def ball(*place, diameter=2 * RADIUS):
    x, y, z = place or (0.0, 0.0, 0.0)
    return Sphere((x, y, z), diameter)


def some_directions(seed, num):
    u = np.random.default_rng(seed).normal(size=(num, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def angle(a, b):
    return float(np.arccos(np.clip(a @ b, -1, 1)))


def motion_past(*offsets, end=0.4):
    """Straight rollouts along x that pass the origin by these offsets (3,)."""
    s = np.linspace(-end, end, 81)
    paths = np.array([np.outer(s, X) + offset for offset in offsets])
    index = np.repeat(np.arange(len(offsets)), len(s))
    return MotionBelow(paths[:, 0], end * X, index, paths.reshape(-1, 3))


# --- turning ---


@given(seeds, st.floats(0, 0.03))
def test_a_way_turns_by_an_angle_for_each_metre_and_arrives(seed, travel):
    start, side, *across = some_directions(seed, 5)
    before = Way(ball(), start, start)
    way = Way(ball(travel, 0.0, 0.0), side, side, kept=True).turned_from(before, across)
    assert np.linalg.norm(way.direction) == pytest.approx(1, abs=1e-12)
    assert angle(way.direction, start) <= TURNING * travel / RADIUS + 1e-6
    assert way.kept and way.side is side
    for _ in range(200):
        if way.direction is side:
            break
        farther = ball(way.obstacle.position[0] + 0.005, 0.0, 0.0)
        turned = Way(farther, side, side).turned_from(way, across)
        assert angle(turned.direction, way.direction) <= TURNING * 0.005 / RADIUS + 1e-6
        way = turned
    assert way.direction is side


def test_a_way_turns_to_the_opposite_over_what_is_across():
    before, way = Way(ball(), Z, Z), Way(ball(0.0, 0.0, 0.005), -Z, -Z)
    turned = way.turned_from(before, [Z, Y])
    assert turned.direction @ Y == pytest.approx(np.sin(TURNING * 0.005 / RADIUS))


@pytest.mark.parametrize(
    ("now", "is_kept", "known"),
    [
        (ball(0.0, 0.0, 0.02), False, True),
        (ball(0.0, 0.0, NEARBY + 0.01), True, False),
        (ball(diameter=0.1), True, False),
        (Box((0.0, 0.0, 0.01)), True, False),
        (ball(), False, False),  # nothing has been dragged
        (ball(), True, True),
    ],
)
def test_what_is_dragged_is_remembered(now, is_kept, known):
    way = Way(ball(), Z, Z, kept=is_kept)
    assert remembered([way, None], [now, now]) == (way if known else None, None)
    assert remembered([way], [now, now]) == (None, None)


# --- sides ---


def test_without_a_way_before_the_motions_are_left_as_they_are():
    passes = Passes.of(motion_past(0.02 * Z, -0.005 * Z), ball())
    assert passes is not None
    way = passes.way(None, gradually=True)
    assert not way.kept
    np.testing.assert_allclose(way.direction, Z, atol=1e-9)
    assert Passes.of(motion_past(1.01 * CORE * RADIUS * Y), ball()) is None


@given(seeds)
def test_all_motions_are_carried_to_one_side_of_the_middle(seed):
    rng = np.random.default_rng(seed)
    angles, sizes = rng.uniform(0, 2 * np.pi, 4), rng.uniform(0, INNER * RADIUS, 4)
    motion = motion_past(*(size * (np.cos(a) * Y + np.sin(a) * Z) for a, size in zip(angles, sizes, strict=True)))
    passes = Passes.of(motion, ball())
    assert passes is not None
    duration = passes.duration(Z)
    moved = AdaptiveFlow(passes.field(Z), duration, 1e-9).inverse(motion.positions).reshape(4, -1, 3)
    least = moved[:, 40, 2].min()  # where they pass the middle
    assert least == pytest.approx(ROOM * RADIUS, abs=1e-6) if duration else least >= ROOM * RADIUS
    np.testing.assert_allclose(moved[:, [0, -1]], motion.positions.reshape(4, -1, 3)[:, [0, -1]], atol=1e-6)


def test_motions_keep_their_side_until_they_are_far_beyond_the_middle_then_turn_together():
    way, heights = Way(ball(), Z, Z, kept=True), np.arange(0.02, -0.0495, -0.001)
    directions, durations = [], []
    for k, height in enumerate(heights):
        obstacle = ball(0.0, 0.0, 0.001 * k)  # moved as a drag moves it; the motions are told relative to it
        passes = Passes.of(motion_past((height + 0.002) * Z, (height - 0.002) * Z), ball())
        assert passes is not None
        way = replace(passes, obstacle=obstacle).way(way, gradually=True)
        directions.append(way.direction)
        durations.append(passes.duration(way.direction))
    beyond = np.array([direction @ Z for direction in directions])
    assert (beyond[heights > -KEPT * RADIUS + 2e-3] == 1).all()
    assert (beyond[heights < -KEPT * RADIUS - 2e-3] < 1).all()
    assert beyond[-1] < 0
    between = [angle(a, b) for a, b in pairwise(directions)]
    assert max(between) <= TURNING * 1e-3 / RADIUS + 1e-6
    assert np.abs(np.diff(durations)).max() < 5e-3
    assert durations[0] == 0


def test_at_rest_the_way_is_on_its_side_at_once():
    passes = Passes.of(motion_past(-0.03 * Z), ball())
    assert passes is not None
    way = passes.way(Way(ball(), Z, Z, kept=True), gradually=False)
    assert way.direction @ Z == pytest.approx(-1)


def test_motions_are_carried_less_the_nearer_one_of_their_ends_is():
    durations = []
    for end in (3 * RADIUS, 1.4 * RADIUS, 1.2 * RADIUS, RADIUS):
        passes = Passes.of(motion_past(-0.01 * Z, end=end), ball())
        assert passes is not None
        durations.append(passes.duration(Z))
    assert durations[0] > durations[1] > durations[2] > 0.0
    assert durations[3] == pytest.approx(0, abs=1e-3)
