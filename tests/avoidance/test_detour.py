"""Ways out of an obstacle against brute force: shift the spheres and look."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.avoidance.detour import DETOUR, DetourSettings, escape_directions
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.transform import MotionBelow
from dt_viz.errors import FormatError
from dt_viz.obstacles.shapes import Box, Sphere

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


def some_directions(num=100):
    u = np.random.default_rng(0).normal(size=(num, 3))
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


@given(seeds)
def test_the_shift_along_the_first_direction_is_what_clears_a_single_sphere(seed):
    rng = np.random.default_rng(seed)
    outward = some_directions(1)[0] if seed == 0 else rng.normal(size=3)
    outward /= np.linalg.norm(outward)
    obstacle, radius = Sphere((0.1, -0.2, 2.0), 0.15), np.array([0.05])
    points = (np.array(obstacle.position) + rng.uniform(0.03, 0.12) * outward)[None, :, None]
    first = escape_directions(points, radius, NOWHERE, obstacle)[0]
    assert angle(first, outward) < LATTICE


def test_across_the_motion_is_preferred_to_along_it():
    obstacle, radius = Sphere((0.0, 0.0, 2.0), 0.15), np.array([0.05])
    points = np.array([[0.03], [0.02], [2.0]])[None]  # the least detour is along x, nearly
    tangent = np.array([[1.0, 0.0, 0.0]])
    along, across = (escape_directions(points, radius, t, obstacle)[0] for t in (NOWHERE, tangent))
    assert abs(along[0]) > 0.7 and abs(across[0]) < 0.5


def test_no_way_leads_into_the_table_while_another_does_not():
    """An arm a little below the obstacle's middle: down were the least detour."""
    obstacle, radius = Sphere((0.0, 0.0, 0.09), 0.15), np.array([0.05])
    points = np.array([[0.0], [0.0], [0.075]])[None]
    into_table, *_ = escape_directions(points + np.array([0, 0, 2.0])[:, None], radius, NOWHERE, raised(obstacle, 2.0))
    assert into_table[2] < -0.9
    for direction in escape_directions(points, radius, NOWHERE, obstacle):
        shifted = points[0, 2, 0] + detour(points, radius, obstacle, direction) * direction[2]
        assert shifted - radius[0] > -0.01


def raised(obstacle, height):
    x, y, z = obstacle.position
    return Sphere((x, y, z + height), obstacle.diameter)


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
