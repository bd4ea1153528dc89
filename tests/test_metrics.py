"""Measures of paths against slow, plain definitions, known values and the properties they must have."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dt_viz.metrics import (
    arc_length,
    discrete_frechet,
    dynamic_time_warping,
    frechet,
    maximum_collision_distance,
    resample_by_arc_length,
    rms_at_equal_times,
    rms_jerk,
    sharpest_turn,
)

COORDINATE = st.floats(-10, 10, allow_subnormal=False).map(lambda x: round(x, 3))


def paths(dimension, min_points=2, max_points=12):
    shapes = st.tuples(st.integers(min_points, max_points), st.just(dimension))
    return arrays(np.float64, shapes, elements=COORDINATE)


def frechet_by_recursion(a, b):
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)

    @cache
    def reach(i, j):
        before = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
        reached = [reach(*cell) for cell in before if min(cell) >= 0]
        return max(distance[i, j], min(reached, default=0.0))

    return reach(len(a) - 1, len(b) - 1)


def densely(path, spacing):
    """Points of a path, its own among them, and how far apart they are at most."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        num = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        pieces.append(a + (b - a) * np.linspace(0, 1, num + 1)[1:, None])
    dense = np.concatenate(pieces)
    return dense, float(np.linalg.norm(np.diff(dense, axis=0), axis=1).max(initial=0.0))


def half_circle(radius=1.0, n=400):
    angle = np.linspace(0, np.pi, n)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def sphere(center, radius):
    return lambda points: np.linalg.norm(points - center, axis=-1) - radius


class TestArcLength:
    def test_adds_up_the_segments(self):
        np.testing.assert_allclose(arc_length(np.array([[0.0, 0], [3, 4], [3, 4], [3, 5]])), [0, 5, 5, 6])

    def test_works_on_a_batch(self):
        batch = np.random.default_rng(0).normal(size=(2, 3, 5, 2))
        assert arc_length(batch).shape == (2, 3, 5)
        np.testing.assert_array_equal(arc_length(batch)[1, 2], arc_length(batch[1, 2]))

    @given(paths(3))
    def test_is_at_least_the_straight_distance(self, path):
        assert arc_length(path)[-1] >= np.linalg.norm(path[-1] - path[0]) - 1e-9


class TestResampling:
    @given(paths(2), st.integers(2, 50))
    def test_keeps_the_ends_and_the_number(self, path, n):
        resampled = resample_by_arc_length(path, n)
        assert resampled.shape == (n, 2)
        np.testing.assert_array_equal(resampled[[0, -1]], path[[0, -1]])

    @given(paths(3))
    def test_never_lengthens(self, path):
        assert arc_length(resample_by_arc_length(path, 30))[-1] <= arc_length(path)[-1] + 1e-9

    def test_spaces_points_equally_on_a_bent_line(self):
        path = np.array([[0.0, 0], [0.1, 0], [0.1, 0], [1, 0], [1, 1]])
        np.testing.assert_allclose(resample_by_arc_length(path, 5), [[0, 0], [0.5, 0], [1, 0], [1, 0.5], [1, 1]])

    def test_a_path_of_one_place_stays_there(self):
        np.testing.assert_array_equal(resample_by_arc_length(np.ones((4, 2)), 3), np.ones((3, 2)))


class TestDiscreteFrechet:
    @given(st.integers(2, 3).flatmap(lambda d: st.tuples(paths(d, 1), paths(d, 1))))
    def test_equals_the_recursion(self, pair):
        assert float(discrete_frechet(*pair)) == pytest.approx(frechet_by_recursion(*pair), rel=1e-12)

    @pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 90), (33, 200), (150, 150)])
    def test_equals_the_recursion_on_long_walks(self, n, m):
        rng = np.random.default_rng(n)
        a, b = rng.normal(size=(n, 3)).cumsum(axis=0), rng.normal(size=(m, 3)).cumsum(axis=0)
        assert float(discrete_frechet(a, b)) == pytest.approx(frechet_by_recursion(a, b), rel=1e-12)

    @given(paths(2))
    def test_of_a_path_with_itself_is_zero(self, path):
        assert discrete_frechet(path, path) == 0

    @given(paths(2), paths(2))
    def test_is_symmetric(self, a, b):
        assert discrete_frechet(a, b) == discrete_frechet(b, a)

    @given(paths(3), paths(3), paths(3))
    def test_obeys_the_triangle_inequality(self, a, b, c):
        assert discrete_frechet(a, c) <= discrete_frechet(a, b) + discrete_frechet(b, c) + 1e-9

    @given(paths(2), arrays(np.float64, 2, elements=COORDINATE))
    def test_of_a_shifted_path_is_at_most_the_shift(self, path, shift):
        assert discrete_frechet(path, path + shift) <= np.linalg.norm(shift) + 1e-9

    @given(paths(2), paths(2))
    def test_is_at_least_the_distance_of_the_ends(self, a, b):
        ends = np.linalg.norm(a[[0, -1]] - b[[0, -1]], axis=1).max()
        assert discrete_frechet(a, b) >= ends - 1e-9

    def test_of_parallel_lines_is_their_distance(self):
        line = np.stack([np.linspace(0, 1, 50), np.zeros(50)], axis=1)
        assert float(discrete_frechet(line, line + np.array([0, 0.25]))) == pytest.approx(0.25)

    def test_sees_the_direction_of_travel(self):
        line = np.array([[0.0, 0], [1, 0]])
        assert float(discrete_frechet(line, line[::-1])) == pytest.approx(1.0)

    def test_repeating_points_changes_nothing(self):
        a, b = half_circle(1.0, 30), half_circle(1.2, 40)
        assert discrete_frechet(np.repeat(a, 3, axis=0), b) == discrete_frechet(a, b)

    def test_tends_to_one_value_with_finer_resampling(self):
        a, b = half_circle(1.0, 100), half_circle(1.2, 70)
        values = [discrete_frechet(resample_by_arc_length(a, n), resample_by_arc_length(b, n)) for n in (100, 200, 400)]
        np.testing.assert_allclose(values, 0.2, atol=0.002)

    def test_takes_a_batch_and_broadcasts_it(self):
        rng = np.random.default_rng(3)
        a, b = rng.normal(size=(2, 4, 30, 2)), rng.normal(size=(4, 50, 2))
        batch = discrete_frechet(a, b)
        assert batch.shape == (2, 4)
        single = [[float(discrete_frechet(a[i, j], b[j])) for j in range(4)] for i in range(2)]
        np.testing.assert_array_equal(batch, single)
        np.testing.assert_array_equal(discrete_frechet(b[0], a)[1, 3], discrete_frechet(a[1, 3], b[0]))


class TestFrechet:
    @given(paths(2, 1, 6), paths(2, 1, 6))
    def test_lies_below_the_discrete_distance_of_many_points_by_at_most_their_spacing(self, a, b):
        dense, spacing = zip(*(densely(path, 0.25) for path in (a, b)), strict=True)
        discrete = float(discrete_frechet(*dense))
        assert discrete - max(spacing) - 1e-9 <= frechet(a, b) <= discrete + 1e-5

    @pytest.mark.parametrize(("n", "m"), [(2, 40), (30, 3), (60, 45)])
    def test_lies_there_on_long_walks_too(self, n, m):
        rng = np.random.default_rng(n)
        for _ in range(5):
            a, b = rng.normal(size=(n, 3)).cumsum(axis=0), rng.normal(size=(m, 3)).cumsum(axis=0)
            dense, spacing = zip(*(densely(path, 0.05) for path in (a, b)), strict=True)
            discrete = float(discrete_frechet(*dense))
            assert discrete - max(spacing) <= frechet(a, b) <= discrete + 1e-5

    def test_needs_no_points_where_the_paths_are_near(self):
        bent = np.array([[0.0, 0], [0.5, 0.1], [1, 0]])
        assert frechet(bent, bent[[0, -1]]) == pytest.approx(0.1, abs=1e-5)
        assert discrete_frechet(bent, bent[[0, -1]]) > 0.5

    def test_waits_where_a_path_goes_back(self):
        line, back = np.array([[0.0, 0], [4, 0]]), np.array([[0.0, 0], [3, 0], [1, 0], [4, 0]])
        assert frechet(line, back) == pytest.approx(1.0, abs=1e-5)  # halfway between 1 and 3

    def test_sees_the_direction_of_travel(self):
        line = np.array([[0.0, 0], [1, 0]])
        assert frechet(line, line[::-1]) == pytest.approx(1.0, abs=1e-5)

    def test_from_one_place_is_the_largest_distance(self):
        assert frechet(np.ones((4, 2)), np.array([[1.0, 1], [4, 5], [1, 2]])) == 5

    @given(paths(2, 1), paths(2, 1))
    def test_is_symmetric_and_sees_no_points_on_segments(self, a, b):
        halved = np.insert(a, np.arange(1, len(a)), (a[1:] + a[:-1]) / 2, axis=0)
        assert frechet(halved, b) == pytest.approx(frechet(b, a), abs=3e-6)

    @given(paths(2), arrays(np.float64, 2, elements=COORDINATE))
    def test_of_a_shifted_path_is_the_shift(self, path, shift):
        assert frechet(path, path + shift) == pytest.approx(np.linalg.norm(shift), abs=2e-6)


class TestDynamicTimeWarping:
    @given(paths(2, 1, 8), paths(2, 1, 8))
    def test_equals_the_recursion(self, a, b):
        distance = np.linalg.norm(a[:, None] - b[None], axis=-1)

        @cache
        def reach(i, j):
            before = [(i - 1, j), (i, j - 1), (i - 1, j - 1)]
            reached = [reach(*cell) for cell in before if min(cell) >= 0]
            return distance[i, j] + min(reached, default=0.0)

        assert dynamic_time_warping(a, b) == pytest.approx(reach(len(a) - 1, len(b) - 1), abs=1e-9)

    def test_waiting_costs_nothing(self):
        a = half_circle(1.0, 20)
        assert dynamic_time_warping(a, np.repeat(a, 3, axis=0)) == 0


class TestRmsJerk:
    def test_of_a_cubic_is_its_third_derivative(self):
        t = np.linspace(0, 2, 401)
        assert rms_jerk(t, np.stack([t**3, 0 * t], axis=1), 0.05) == pytest.approx(6.0)

    def test_of_a_parabola_is_zero_and_of_a_corner_is_not(self):
        t = np.linspace(0, 2, 401)
        assert rms_jerk(t, (t**2)[:, None], 0.05) == pytest.approx(0, abs=1e-9)
        assert rms_jerk(t, np.abs(t - 1)[:, None], 0.05) > 10

    def test_of_a_motion_too_short_to_tell_is_zero(self):
        assert rms_jerk(np.array([0.0, 0.1]), np.eye(2), 0.05) == 0


class TestRmsAtEqualTimes:
    @given(paths(2))
    def test_of_a_motion_with_itself_is_zero(self, path):
        times = np.arange(float(len(path)))
        assert rms_at_equal_times(times, path, times, path) == 0

    def test_of_a_constant_offset_is_its_length(self):
        times = np.linspace(0, 1, 7)
        path = np.stack([times, times**2], axis=1)
        assert rms_at_equal_times(times, path, times, path + np.array([0.3, 0.4])) == pytest.approx(0.5)

    def test_does_not_depend_on_extra_samples_of_the_motion(self):
        times, fine = np.array([0.0, 1.0, 3.0]), np.linspace(0, 3, 31)
        path, reference = np.array([[0.0, 0], [1, 0], [1, 2]]), np.ones((31, 2))
        finer = np.stack([np.interp(fine, times, path[:, k]) for k in (0, 1)], axis=1)
        coarse_rms = rms_at_equal_times(times, path, fine, reference)
        assert coarse_rms == pytest.approx(rms_at_equal_times(fine, finer, fine, reference))

    def test_a_motion_that_ends_early_rests_at_its_end(self):
        early = rms_at_equal_times(
            np.array([0.0, 1]), np.array([[0.0, 0], [1, 0]]), np.array([1.0, 2]), np.array([[1.0, 0], [3, 0]])
        )
        assert early == pytest.approx(np.sqrt((0 + 4) / 2))


class TestMaximumCollisionDistance:
    def test_is_zero_when_clear(self):
        assert maximum_collision_distance(half_circle(), sphere([0.0, 0], 0.9)) == 0

    def test_finds_the_penetration_between_two_samples(self):
        ends = np.array([[-1.0, 0.03], [1.37, 0.03]])
        assert maximum_collision_distance(ends, sphere([0.0, 0], 0.1)) == pytest.approx(0.07, abs=1e-5)

    def test_is_zero_when_a_segment_passes_just_outside(self):
        assert maximum_collision_distance(np.array([[-1.0, 0.101], [1.0, 0.101]]), sphere([0.0, 0], 0.1)) == 0

    def test_takes_a_single_point(self):
        assert maximum_collision_distance(np.zeros((1, 3)), sphere(np.zeros(3), 0.2)) == pytest.approx(0.2)

    def test_ends_when_a_whole_segment_is_equally_deep(self):
        slab = maximum_collision_distance(np.array([[0.0, 0], [1, 0]]), lambda points: np.abs(points[:, 1]) - 0.05)
        assert slab == pytest.approx(0.05)

    @given(paths(3), paths(3, 1, 1), st.floats(0.1, 5))
    def test_equals_the_exact_depth_in_a_sphere(self, path, center, radius):
        start, step = path[:-1], np.diff(path, axis=0)
        square = (step**2).sum(axis=1)
        along = ((center - start) * step).sum(axis=1) / np.where(square > 0, square, 1)
        nearest = np.linalg.norm(start + np.clip(along, 0, 1)[:, None] * step - center, axis=1).min()
        depth = maximum_collision_distance(path, sphere(center, radius))
        assert depth == pytest.approx(max(0.0, radius - nearest), abs=1.1e-5)

    def test_does_not_depend_on_resampling_a_straight_path(self):
        ends = np.array([[-1.0, 0.2, 0], [1.0, -0.1, 0.1]])
        obstacle = sphere(np.zeros(3), 0.3)
        depths = [maximum_collision_distance(resample_by_arc_length(ends, n), obstacle) for n in (2, 3, 10, 301)]
        np.testing.assert_allclose(depths, depths[0], atol=1e-5)


class TestSharpestTurn:
    @given(st.floats(0, 179), st.floats(0.01, 3))
    def test_of_a_corner_is_its_angle_whatever_the_window(self, angle, window):
        after = [1 + np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))]
        assert sharpest_turn(np.array([[0.0, 0], [1, 0], after]), window) == pytest.approx(angle, abs=1e-6)

    def test_of_a_straight_path_is_zero(self):
        assert sharpest_turn(np.array([[0.0, 0, 0], [1, 1, 1], [1, 1, 1], [3, 3, 3]]), 0.1) == pytest.approx(
            0, abs=1e-6
        )

    def test_of_a_single_point_or_segment_is_zero(self):
        assert sharpest_turn(np.zeros((1, 2)), 1.0) == 0
        assert sharpest_turn(np.array([[0.0, 0], [1, 0]]), 1.0) == 0

    def test_of_turning_back_is_180(self):
        assert sharpest_turn(np.array([[0.0, 0], [1, 0], [0, 0]]), 0.1) == pytest.approx(180)

    @pytest.mark.parametrize("window", [0.2, 0.7, 1.5])
    def test_on_a_circle_is_the_window_over_the_radius(self, window):
        turn = sharpest_turn(half_circle(radius=2.0, n=5000), window)
        assert turn == pytest.approx(np.rad2deg(window / 2.0), rel=0.01)

    def test_adds_up_two_corners_only_when_both_lie_within_the_window(self):
        step = np.array([[0.0, 0], [1, 0], [1, 0.1], [0.5, 0.1]])
        assert sharpest_turn(step, 0.09) == pytest.approx(90)
        assert sharpest_turn(step, 0.11) == pytest.approx(180)

    @given(paths(2), st.floats(0.05, 5))
    def test_does_not_change_when_points_are_added_on_the_path(self, path, window):
        middles = (path[:-1] + path[1:]) / 2
        finer = np.insert(path, np.arange(1, len(path)), middles, axis=0)
        # A window that ends within rounding of a corner may see it in one path and not in the other.
        low, high = (sharpest_turn(path, window * factor) for factor in (1 - 1e-9, 1 + 1e-9))
        assert low - 1e-6 <= sharpest_turn(finer, window) <= high + 1e-6

    @given(paths(3), st.floats(0.05, 5), st.floats(1, 3))
    def test_grows_with_the_window(self, path, window, factor):
        assert sharpest_turn(path, window) <= sharpest_turn(path, window * factor)
