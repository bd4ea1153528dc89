"""Ways out of obstacles against brute force, and while these are dragged: carried over, kept, and turned gradually."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.avoidance.detour import DETOUR, NEARBY, Detour, DetourSettings, carried_over, escape_directions
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.sideways import Encounter, fixing_ends
from dt_viz.avoidance.transform import MotionBelow
from dt_viz.errors import FormatError
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.metrics import sharpest_turn
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere

NOWHERE = np.zeros((1, 3))  # tangents that make no direction dearer than another
SHIFTS = np.linspace(0, 0.8, 1601)
LATTICE = 10.0  # degrees that the tried directions may be off the best one
seeds = st.integers(0, 2**32 - 1)


def collision(seed, height=2.0):
    """Spheres (P, 3, M) with radii (P,) that all overlap an obstacle."""
    rng = np.random.default_rng(seed)
    num, samples = rng.integers(1, 6), rng.integers(1, 4)
    obstacle, radius = Sphere((0.1, -0.2, height), float(rng.uniform(0.04, 0.30))), rng.uniform(0.02, 0.06, num)
    middles = rng.normal(size=(num, 3, samples))
    middles *= rng.uniform(0, 1, (num, 1, samples)) / np.linalg.norm(middles, axis=1, keepdims=True)
    return middles * (obstacle.radius + radius[:, None, None]) + np.array(obstacle.position)[:, None], radius, obstacle


def detour(points, radius, obstacle, direction):
    """The last of `SHIFTS` at which a sphere that comes into the way soon enough is in the obstacle."""
    offset = (points - np.array(obstacle.position)[:, None]).transpose(0, 2, 1)
    moved = offset[..., None, :] + SHIFTS[:, None] * direction
    inside = np.linalg.norm(moved, axis=-1) < (obstacle.radius + radius)[:, None, None]
    inside &= inside[..., DETOUR.on_the_way > SHIFTS].any(axis=-1, keepdims=True)
    return SHIFTS[np.flatnonzero(inside.any(axis=(0, 1)))[-1]]


def some_directions(num=100, seed=0):
    u = np.random.default_rng(seed).normal(size=(num, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.long
@given(seeds)
def test_directions_are_unit_vectors_no_two_alike_the_least_detour_first(seed):
    points, radius, obstacle = collision(seed)
    found = np.array(escape_directions(points, radius, NOWHERE, obstacle, num=4))
    assert 2 <= len(found) <= 4
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=0, atol=1e-12)
    between = angle(found, found.T)[np.triu_indices(len(found), k=1)]
    assert between.min() > DETOUR.alike / 2  # each is a mean of what is alike
    detours = [detour(points, radius, obstacle, n) for n in found[:3]]
    assert (np.diff(detours) > -0.05 * detours[0] - 2e-3).all()
    assert detours[0] < 1.03 * min(detour(points, radius, obstacle, n) for n in some_directions()) + 2e-3
    for num in (1, 2):
        np.testing.assert_array_equal(escape_directions(points, radius, NOWHERE, obstacle, num=num), found[:num])


def test_no_way_leads_into_the_table_while_another_does_not():
    """An arm a little below the obstacle's middle: down were the least detour."""
    obstacle, radius = Sphere((0.0, 0.0, 0.09), 0.15), np.array([0.05])
    points = np.array([[0.0], [0.0], [0.075]])[None]
    raised = points + np.array([0, 0, 2.0])[:, None]
    into_table, *_ = escape_directions(raised, radius, NOWHERE, Sphere((0.0, 0.0, 2.09), 0.15))
    assert into_table[2] < -0.9
    for direction in escape_directions(points, radius, NOWHERE, obstacle):
        shifted = points[0, 2, 0] + detour(points, radius, obstacle, direction) * direction[2]
        assert shifted - radius[0] > -0.01


@given(seeds)
def test_what_is_beyond_the_obstacle_is_not_in_the_way(seed):
    """Spheres that no escape comes near change nothing."""
    points, radius, obstacle = collision(seed)
    far = np.array(obstacle.position) + 2.0 * some_directions(3)
    more = np.concatenate([points, np.repeat(far[:, :, None], points.shape[2], axis=2)])
    expected = escape_directions(points, radius, NOWHERE, obstacle)
    found = escape_directions(more, np.concatenate([radius, [0.05] * 3]), NOWHERE, obstacle)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@given(seeds)
def test_a_margin_is_left_as_around_an_obstacle_that_is_larger_by_it(seed):
    points, radius, obstacle = collision(seed)
    larger = Sphere(obstacle.position, obstacle.diameter + 0.06)
    expected = escape_directions(points, radius, NOWHERE, larger)
    np.testing.assert_allclose(escape_directions(points, radius, NOWHERE, obstacle, 0.03), expected, rtol=0, atol=1e-9)


def test_the_way_out_turns_smoothly_while_the_obstacle_is_dragged():
    """Though the directions that are tried are 18° apart."""
    radius, points = np.array([0.05]), np.array([[0.0], [0.0], [2.0]])[None]
    places = [Sphere((0.05 * np.cos(a), 0.05 * np.sin(a), 2.0), 0.15) for a in np.linspace(0, 2 * np.pi, 181)]
    ways = np.array([escape_directions(points, radius, NOWHERE, place)[0] for place in places])
    assert np.degrees(np.linalg.norm(np.diff(ways, axis=0), axis=1)).max() < 6  # for 2° each


def test_nobody_runs_away_along_the_way_of_a_moving_obstacle():
    """However fast it is, it is in the way of where it will be soon, and of nothing farther ahead."""
    obstacle, radius = Sphere((0.0, 0.0, 2.0), 0.15), np.array([0.05])
    points = np.array([[0.03], [0.005], [2.0]])[None]

    def way_out(*velocity, beyond=None):
        moving = np.array(velocity) if velocity else None
        all_points = points if beyond is None else np.concatenate([points, np.reshape(beyond, (1, 3, 1))])
        return escape_directions(all_points, radius.repeat(len(all_points)), NOWHERE, obstacle, velocity=moving)[0]

    assert way_out()[0] > 0.9
    np.testing.assert_array_equal(way_out(0.0, 0.0, 0.0), way_out())
    np.testing.assert_array_equal(way_out(-0.02, 0.0, 0.0), way_out())  # it stays within a stride
    ahead, fast = way_out(0.1, 0.0, 0.0), way_out(10.0, 0.0, 0.0)
    assert ahead[0] < 0.5 and fast[0] < 0.5
    assert fast[1] > 0.5
    far_ahead = [[0.4, -0.1, 2.0], [0.4, 0.1, 2.0]]
    for place in far_ahead:
        np.testing.assert_allclose(way_out(10.0, 0.0, 0.0, beyond=place), fast, rtol=0, atol=1e-12)


def test_settings_are_those_of_the_avoidance():
    """A detour along the motion costs what its avoidance says, and the previous one stays for as long as that says."""
    mean = np.linspace([-0.3, 0.02, 2.0], [0.3, -0.02, 2.0], 61)
    motion = MotionBelow(mean[:1], mean[-1], np.zeros(61, int), mean)
    oblique = Box((0.0, 0.0, 2.0), (0.05, 0.3, 0.3))

    def direction(**settings):
        (detour,) = HandAvoidance(oblique, detour=DetourSettings(**settings)).build(motion).detours
        assert detour is not None
        return detour.direction

    assert abs(direction(along=0.0)[0]) > 0.9 and abs(direction(along=50.0)[0]) < 0.4
    obstacle, radius, points = Sphere((0.0, 0.0, 2.0), 0.15), np.array([0.05]), np.array([[[0.0], [0.0], [2.02]]])
    for staying, up in ((1.0, True), (10.0, False)):
        settings = DetourSettings(staying=staying)
        first = escape_directions(points, radius, NOWHERE, obstacle, previous=-np.eye(3)[2], settings=settings)[0]
        assert (first[2] > 0) == up
    refused: list[dict[str, Any]] = [{"num_directions": 1}, {"stride": 0.0}, {"staying": np.nan}, {"along": -1.0}]
    for wrong in refused:
        with pytest.raises(FormatError, match=f"detour.{next(iter(wrong))}: found"):
            DetourSettings(**wrong)


# while obstacles are dragged


X, Y, Z = np.eye(3)
HAND = HandAvoidance().detour
TURNING = HAND.turning
RADIUS, HEIGHT = 0.08, 2.0  # far above the table


def ball(*place, diameter=2 * RADIUS):
    x, y, z = place or (0.0, 0.0, 0.0)
    return Sphere((x, y, z + HEIGHT), diameter)


def motion_past(*offsets, end=0.4):
    """Straight rollouts along x that pass the middle by these offsets (3,)."""
    s = np.linspace(-end, end, 81)
    paths = np.array([np.outer(s, X) + offset + HEIGHT * Z for offset in offsets])
    index = np.repeat(np.arange(len(offsets)), len(s))
    return MotionBelow(paths[:, 0], end * X + HEIGHT * Z, index, paths.reshape(-1, 3))


def carried(detour, obstacle, **how):
    """The detour as the next motion gets it, with its obstacle where it is now."""
    (found,) = carried_over([replace(detour, kept=True)], [obstacle], **how)
    assert found is not None
    return found


# --- turning ---


@given(seeds, st.floats(0, 0.03))
def test_a_way_turns_by_an_angle_for_each_metre_and_arrives(seed, travel):
    start, side, *across = some_directions(5, seed)
    obstacle = ball(travel, 0.0, 0.0)
    before = carried(Detour(ball(), start, start), obstacle)
    way = Detour(obstacle, side, side, kept=True).turned_from(before, across, TURNING)
    assert np.linalg.norm(way.direction) == pytest.approx(1, abs=1e-12)
    assert angle(way.direction, start) <= np.degrees(TURNING * travel / RADIUS + 1e-6)
    assert way.kept and way.side is side
    for _ in range(200):
        if way.direction is side:
            break
        farther = ball(way.obstacle.position[0] + 0.005, 0.0, 0.0)
        turned = Detour(farther, side, side).turned_from(carried(way, farther), across, TURNING)
        assert angle(turned.direction, way.direction) <= np.degrees(TURNING * 0.005 / RADIUS + 1e-6)
        way = turned
    assert way.direction is side


def test_a_way_turns_to_the_opposite_over_what_is_across():
    obstacle = ball(0.0, 0.0, 0.005)
    turned = Detour(obstacle, -Z, -Z).turned_from(carried(Detour(ball(), Z, Z), obstacle), [Z, Y], TURNING)
    assert turned.direction @ Y == pytest.approx(np.sin(TURNING * 0.005 / RADIUS))


@pytest.mark.parametrize(
    ("now", "is_kept", "known"),
    [
        (ball(0.0, 0.0, 0.02), False, True),
        (ball(0.0, 0.0, NEARBY + 0.01), True, False),
        (ball(diameter=0.1), True, False),
        (Box((0.0, 0.0, HEIGHT)), True, False),
        (ball(), False, False),  # nothing has been dragged
        (ball(), True, True),
    ],
)
@pytest.mark.parametrize("turn", [True, False])
def test_what_is_dragged_is_carried_over(now, is_kept, known, turn):
    way = Detour(ball(), Z, Z, kept=is_kept)
    found, none = carried_over([way, None], [now, now], turn=turn)
    assert none is None and (found is not None) == known
    if found is not None:
        assert (found.obstacle, found.side is Z, found.direction is Z) == (ball(), True, True)
        assert found.travelled == (now.position[2] - HEIGHT if turn else None)
    assert carried_over([way], [now, now], turn=turn) == (None, None)


# --- sides ---


def passes_of(motion, obstacle=None, margin=0.01, **changes):
    everywhere = np.ones(len(motion.positions), dtype=bool)
    found = Encounter.of(motion, everywhere, ball() if obstacle is None else obstacle, margin, **changes)
    assert found is not None
    return found


def blocks(seed):
    """A ball, a box and a cylinder, turned somehow, around the middle."""
    rng = np.random.default_rng(seed)
    wxyz = tuple(rng.normal(size=4).tolist())
    sizes = rng.uniform(0.08, 0.2, 5).tolist()
    nowhere = (0.0, 0.0, HEIGHT)
    yield Sphere(nowhere, sizes[0])
    yield Box(nowhere, tuple(sizes[:3]), wxyz)
    yield Cylinder(nowhere, sizes[3], sizes[4], wxyz)


def test_without_a_way_before_it_is_the_nearest_one_across_the_motions_and_in_their_plane():
    way = passes_of(motion_past(0.02 * Z, 0.01 * Z)).detour(None, HAND)
    assert not way.kept
    assert way.direction @ Z > 0.9 and abs(way.direction @ X) < 0.1
    in_plane = passes_of(motion_past(0.001 * Z), plane=np.stack([X, Y], axis=1))
    assert abs(in_plane.detour(None, HAND).direction @ Y) > 0.99


@pytest.mark.parametrize("corner", [False, True])
def test_a_single_sample_is_led_out_however_far_out_it_is(corner):
    cube = Box((0.0, 0.0, HEIGHT), (0.1, 0.1, 0.1))
    motion = motion_past((0.0499 if corner else 0.02) * (Y + Z))
    counts = np.zeros(len(motion.positions), dtype=bool)
    counts[np.abs(motion.positions[:, 0] - (0.045 if corner else 0.0)).argmin()] = True
    passes = Encounter.of(motion, counts, cube, 0.01)
    assert passes is not None
    assert np.linalg.norm(passes.detour(None, HAND).direction) == pytest.approx(1)


def test_what_does_not_count_or_is_clear_does_not_pass():
    near, clear = (motion_past((RADIUS + by) * Y) for by in (0.009, 0.011))
    everywhere = np.ones(len(near.positions), dtype=bool)
    assert Encounter.of(near, everywhere, ball(), 0.01) is not None
    assert Encounter.of(near, ~everywhere, ball(), 0.01) is None
    assert Encounter.of(clear, everywhere, ball(), 0.01) is None


@given(seeds)
def test_all_motions_are_carried_clear_on_one_side(seed):
    offsets = np.random.default_rng(seed).uniform(-0.03, 0.03, (4, 3)) * [0, 1, 1]
    motion = motion_past(*offsets)
    least = (0.009, -1e-3, 0.006)  # beside a box's corners, samples lack
    for obstacle, clearance in zip(blocks(seed), least, strict=True):
        passes = passes_of(motion, obstacle)
        direction = passes.detour(None, HAND).direction
        flow = passes.flow(direction, 1e-9)
        moved = flow.inverse(motion.positions)
        assert obstacle.signed_distance(moved).min() > clearance
        across = (moved - motion.positions) @ direction
        np.testing.assert_allclose(moved - motion.positions, across[:, None] * direction, atol=1e-9)
        assert (across > -1e-9).all()


@given(seeds)
def test_no_motion_is_turned_sharply_however_near_to_the_middle_it_passes(seed):
    rng = np.random.default_rng(seed)
    motion = motion_past(*rng.uniform(-0.002, 0.002, (3, 3)) * [0, 1, 1])
    s = np.linspace(-0.4, 0.4, 801)
    for obstacle in blocks(seed):
        passes = passes_of(motion, obstacle)
        flow = passes.flow(passes.detour(None, HAND).direction, 1e-9)
        assert sharpest_turn(flow.inverse(np.outer(s, X) + motion.starts[0] * [0, 1, 1]), 0.015) < 25


@given(seeds)
def test_starts_and_goal_stay_where_they_are(seed):
    motion = motion_past(0.01 * Y, -0.01 * Z, end=RADIUS + 0.02)
    passes = passes_of(motion)
    flow = passes.flow(some_directions(1, seed)[0], 1e-9)
    ends = np.concatenate([motion.starts, motion.goal[None]])
    np.testing.assert_allclose(flow.inverse(ends), ends, atol=1e-9)


def test_the_way_out_does_not_end_in_an_obstacle_that_is_passed_already():
    beside = ball(0.0, 0.0, 0.1)
    motion = motion_past(0.02 * Z)
    assert passes_of(motion).detour(None, HAND).direction @ Z > 0.9
    passes = passes_of(motion, others=(beside,))
    direction = passes.detour(None, HAND).direction
    assert direction @ Z < 0.5
    assert beside.signed_distance(passes.flow(Z, 1e-9).inverse(motion.positions)).min() > 0.007


def test_motions_keep_their_side_until_another_costs_much_less_then_turn_together():
    way, heights = Detour(ball(), Z, Z, kept=True), np.arange(0.02, -0.0495, -0.001)
    directions, durations = [], []
    for k, height in enumerate(heights):
        obstacle = ball(0.0, 0.0, 0.001 * k)  # moved as a drag moves it; the motions are told relative to it
        passes = passes_of(motion_past((height + 0.002) * Z, (height - 0.002) * Z))
        moved = replace(passes, obstacle=obstacle, points=passes.points + 0.001 * k * Z)
        way = moved.detour(carried(way, obstacle), HAND)
        directions.append(way.direction)
        durations.append(passes.flow(way.direction, 1e-9).duration)
    beyond = np.array([direction @ Z for direction in directions])
    assert (beyond[heights > -0.0155] > 0.8).all()  # there the other side is nearer, by less than it must be
    assert beyond[-1] < 0
    assert max(angle(a, b) for a, b in pairwise(directions)) <= np.degrees(TURNING * 1e-3 / RADIUS + 1e-6)
    assert np.abs(np.diff(durations)).max() < 0.2


def test_a_turn_that_would_lead_far_around_is_made_at_once():
    """What has come near on the other side makes the way before a long one."""
    before = Detour(ball(), Y, Y, kept=True, length=0.001)
    passes = passes_of(motion_past((RADIUS + 0.009) * Y, -(RADIUS + 0.009) * Y), ball(0.001, 0.0, 0.0))
    way = passes.detour(carried(before, passes.obstacle), HAND)
    assert abs(way.direction @ Z) > 0.8 and way.length < 0.03


def test_a_side_is_held_where_what_is_stacked_on_it_moves_the_ends():
    motion = motion_past(0.01 * Y, end=RADIUS + 0.02)
    flow = passes_of(motion).flow(Z, 1e-9)
    outer = Flow.adaptive(ball().field("free-space", 6.0), 0.1, 1e-9)
    ends = np.concatenate([motion.starts, motion.goal[None]])
    moved = outer.forward(ends)
    assert np.linalg.norm(moved - ends, axis=1).min() > 1e-3
    assert np.linalg.norm(flow.forward(moved) - moved, axis=1).max() > 1e-3
    np.testing.assert_allclose(fixing_ends(flow, outer).forward(moved), moved, atol=1e-9)
