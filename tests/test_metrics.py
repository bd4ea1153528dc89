"""Measures of paths against slow, plain definitions, known values and the properties they must have."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dt_viz.metrics import (
    arc_length,
    discrete_frechet,
    dynamic_time_warping,
    maximum_collision_distance,
    resample_by_arc_length,
    rms_at_equal_times,
    rms_jerk,
    sharpest_turn,
)

COORDINATE = st.floats(-10, 10, allow_subnormal=False).map(lambda x: round(x, 3))
LINE = np.array([[0.0, 0], [1, 0]])


def paths(dimension, min_points=2, max_points=12):
    shapes = st.tuples(st.integers(min_points, max_points), st.just(dimension))
    return arrays(np.float64, shapes, elements=COORDINATE)


def walks(n, m):
    """Two long random walks in space, of so many points."""
    rng = np.random.default_rng(n)
    return rng.normal(size=(n, 3)).cumsum(axis=0), rng.normal(size=(m, 3)).cumsum(axis=0)


def least_over_all_ways(a, b, combine):
    """The least over all ways of stepping along both paths, by recursion; `combine` adds a distance to what is met."""
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)

    @cache
    def reach(i, j):
        before = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
        reached = [reach(*cell) for cell in before if min(cell) >= 0]
        return combine(distance[i, j], min(reached, default=0.0))

    return reach(len(a) - 1, len(b) - 1)


def with_middles(path):
    """The path with a point in the middle of each segment."""
    return np.insert(path, np.arange(1, len(path)), (path[1:] + path[:-1]) / 2, axis=0)


def half_circle(radius, n=400):
    angle = np.linspace(0, np.pi, n)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def sphere(center, radius):
    return lambda points: np.linalg.norm(points - center, axis=-1) - radius


def test_arc_length_adds_up_the_segments_of_each_path_of_a_batch():
    one = np.array([[0.0, 0], [3, 4], [3, 4], [3, 5]])
    batch = np.stack([[one, 2 * one], [3 * one, 0 * one]])
    expected = np.array([0.0, 5, 5, 6]) * np.array([[[1.0], [2]], [[3], [0]]])
    np.testing.assert_allclose(arc_length(batch), expected)


class TestResampling:
    @given(paths(2), st.integers(2, 50))
    def test_keeps_the_ends_and_the_number_and_never_lengthens(self, path, n):
        resampled = resample_by_arc_length(path, n)
        assert resampled.shape == (n, 2)
        np.testing.assert_array_equal(resampled[[0, -1]], path[[0, -1]])
        assert arc_length(resampled)[-1] <= arc_length(path)[-1] + 1e-9

    def test_spaces_points_equally_on_a_bent_line(self):
        path = np.array([[0.0, 0], [0.1, 0], [0.1, 0], [1, 0], [1, 1]])
        np.testing.assert_allclose(resample_by_arc_length(path, 5), [[0, 0], [0.5, 0], [1, 0], [1, 0.5], [1, 1]])
        np.testing.assert_array_equal(resample_by_arc_length(np.ones((4, 2)), 3), np.ones((3, 2)))  # stays there


class TestDiscreteFrechet:
    @given(st.integers(2, 3).flatmap(lambda d: st.tuples(paths(d, 1), paths(d, 1))))
    def test_equals_the_recursion(self, pair):
        assert float(discrete_frechet(*pair)) == pytest.approx(least_over_all_ways(pair[0], pair[1], max), rel=1e-12)

    @pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 90), (33, 200), (150, 150)])
    def test_equals_the_recursion_on_long_walks(self, n, m):
        pair = walks(n, m)
        assert float(discrete_frechet(*pair)) == pytest.approx(least_over_all_ways(pair[0], pair[1], max), rel=1e-12)

    @given(paths(3), paths(3), paths(3))
    def test_is_a_distance(self, a, b, c):
        assert discrete_frechet(a, a) == 0
        assert discrete_frechet(a, b) == discrete_frechet(b, a)
        assert discrete_frechet(a, c) <= discrete_frechet(a, b) + discrete_frechet(b, c) + 1e-9

    def test_takes_a_batch_and_broadcasts_it(self):
        rng = np.random.default_rng(3)
        a, b = rng.normal(size=(2, 4, 30, 2)), rng.normal(size=(4, 50, 2))
        batch = discrete_frechet(a, b)
        assert batch.shape == (2, 4)
        single = [[float(discrete_frechet(a[i, j], b[j])) for j in range(4)] for i in range(2)]
        np.testing.assert_array_equal(batch, single)
        np.testing.assert_array_equal(discrete_frechet(b[0], a)[1, 3], discrete_frechet(a[1, 3], b[0]))


@given(paths(2, 1, 8), paths(2, 1, 8))
def test_dynamic_time_warping_equals_the_recursion(a, b):
    expected = least_over_all_ways(a, b, lambda distance, before: distance + before)
    assert dynamic_time_warping(a, b) == pytest.approx(expected, abs=1e-9)


def test_the_jerk_is_the_third_derivative():
    t = np.linspace(0, 2, 401)
    assert rms_jerk(t, np.stack([t**3, 0 * t], axis=1), 0.05) == pytest.approx(6.0)
    assert rms_jerk(t, (t**2)[:, None], 0.05) == pytest.approx(0, abs=1e-9)
    assert rms_jerk(t, np.abs(t - 1)[:, None], 0.05) > 10  # a corner
    assert rms_jerk(np.array([0.0, 0.1]), np.eye(2), 0.05) == 0  # too short to tell


def test_the_rms_at_equal_times_does_not_depend_on_samples_and_what_ends_early_rests_at_its_end():
    times, fine = np.array([0.0, 1.0, 3.0]), np.linspace(0, 3, 31)
    path = np.array([[0.0, 0], [1, 0], [1, 2]])
    finer = np.stack([np.interp(fine, times, path[:, k]) for k in (0, 1)], axis=1)
    assert rms_at_equal_times(times, path, fine, finer + np.array([0.3, 0.4])) == pytest.approx(0.5)
    early = rms_at_equal_times(np.array([0.0, 1]), LINE, np.array([1.0, 2]), np.array([[1.0, 0], [3, 0]]))
    assert early == pytest.approx(np.sqrt((0 + 4) / 2))


class TestMaximumCollisionDistance:
    def test_ends_when_a_whole_segment_is_equally_deep(self):
        slab = maximum_collision_distance(LINE, lambda points: np.abs(points[:, 1]) - 0.05)
        assert slab == pytest.approx(0.05)

    @given(paths(3), paths(3, 1, 1), st.floats(0.1, 5))
    def test_equals_the_exact_depth_in_a_sphere_however_the_path_is_sampled(self, path, center, radius):
        start, step = path[:-1], np.diff(path, axis=0)
        square = (step**2).sum(axis=1)
        along = ((center - start) * step).sum(axis=1) / np.where(square > 0, square, 1)
        nearest = np.linalg.norm(start + np.clip(along, 0, 1)[:, None] * step - center, axis=1).min()
        for sampled in (path, with_middles(path)):
            depth = maximum_collision_distance(sampled, sphere(center, radius))
            assert depth == pytest.approx(max(0.0, radius - nearest), abs=1.1e-5)


class TestSharpestTurn:
    @given(st.floats(0, 179), st.floats(0.01, 3))
    def test_of_a_corner_is_its_angle_whatever_the_window(self, angle, window):
        after = [1 + np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))]
        assert sharpest_turn(np.array([*LINE, after]), window) == pytest.approx(angle, abs=1e-6)

    @pytest.mark.parametrize(
        ("path", "degrees"),
        [
            pytest.param([[0, 0, 0], [1, 1, 1], [1, 1, 1], [3, 3, 3]], 0, id="straight on, with a point twice"),
            pytest.param([[0, 0]], 0, id="a single point"),
            pytest.param(LINE, 0, id="a single segment"),
            pytest.param([[0, 0], [1, 0], [0, 0]], 180, id="back"),
        ],
    )
    def test_is_known_for_simple_paths(self, path, degrees):
        assert sharpest_turn(np.array(path, float), 0.1) == pytest.approx(degrees, abs=1e-6)

    @pytest.mark.parametrize("window", [0.2, 0.7, 1.5])
    def test_on_a_circle_is_the_window_over_the_radius(self, window):
        turn = sharpest_turn(half_circle(radius=2.0, n=5000), window)
        assert turn == pytest.approx(np.rad2deg(window / 2.0), rel=0.01)

    def test_adds_up_two_corners_only_when_both_lie_within_the_window(self):
        step = np.array([*LINE, [1, 0.1], [0.5, 0.1]])
        assert sharpest_turn(step, 0.09) == pytest.approx(90)
        assert sharpest_turn(step, 0.11) == pytest.approx(180)

    @given(paths(2), st.floats(0.05, 5))
    def test_does_not_change_when_points_are_added_on_the_path(self, path, window):
        # A window that ends within rounding of a corner may see it in one path and not in the other.
        low, high = (sharpest_turn(path, window * factor) for factor in (1 - 1e-9, 1 + 1e-9))
        assert low - 1e-6 <= sharpest_turn(with_middles(path), window) <= high + 1e-6
