"""Inverse kinematics and tracking by their properties."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from dt_viz.robot.inverse_kinematics import TrackedPath, UnreachableError, inverse_kinematics, track
from dt_viz.robot.models import load_jaco
from dt_viz.robot.robot import Robot

BOX = np.array([[-0.4, -0.65, 0.05], [0.4, -0.3, 0.75]])  # where the tasks live, metres
STEPS = 5 * load_jaco().tracking.step_tolerance  # rad, that a posture may be away from the best one
seeds = st.integers(0, 2**32 - 1)


def smooth_path(seed: int, num: int = 200) -> np.ndarray:
    """A curve of two bends that stays in the task box."""
    corners = np.random.default_rng(seed).uniform(*BOX, size=(4, 3))
    return np.clip(CubicSpline([0, 1, 2, 3], corners)(np.linspace(0, 3, num)), *BOX)


def inside_limits(robot: Robot, q: np.ndarray) -> bool:
    return bool(((q >= robot.lower) & (q <= robot.upper)).all())


class TestInverseKinematics:
    @settings(max_examples=30)
    @given(seed=seeds)
    def test_reaches_targets_with_a_natural_posture(self, seed):
        robot, target = load_jaco(), np.random.default_rng(seed).uniform(*BOX)
        q = inverse_kinematics(robot, target)
        _, origins = robot.forward_kinematics(q)
        np.testing.assert_allclose(robot.end_effector(q), target, atol=1e-5)
        assert inside_limits(robot, q)
        assert np.minimum(q - robot.lower, robot.upper - q).min() > 0.1
        assert origins[:, 2].min() > 0.1  # above the table
        assert origins[2, 2] > 0.4  # elbow up
        assert robot.hand_direction(q)[2] < 0.1  # not upwards

    @pytest.mark.parametrize("seed", range(4))
    def test_stays_near_a_seed_that_already_reaches(self, robot, seed):
        natural = inverse_kinematics(robot, np.random.default_rng(seed).uniform(*BOX))
        q = natural + np.array([2 * np.pi, 0.0, 0.0, -2 * np.pi, 0.0, 1.0])  # other turns of the continuous joints
        nudged = robot.end_effector(q) + np.array([0.0, 0.0, 0.01])
        np.testing.assert_allclose(inverse_kinematics(robot, nudged, seed=q), q, atol=0.15)

    @pytest.mark.parametrize("direction", [[0, -1, -1], [0.5, -1, 0], [0, 0, -2], [-1, -1, -1]])
    def test_points_the_hand_as_asked(self, robot, direction):
        q = inverse_kinematics(robot, [0.0, -0.45, 0.3], hand_direction=direction)
        cosine = robot.hand_direction(q) @ direction / np.linalg.norm(direction)
        assert np.degrees(np.arccos(cosine)) < 10.0
        np.testing.assert_allclose(robot.end_effector(q), [0.0, -0.45, 0.3], atol=1e-5)

    @pytest.mark.parametrize("target", [[0.0, -1.5, 0.3], [0.0, 0.0, 1.5], [2.0, 2.0, 2.0], [0.0, -0.3, -0.8]])
    def test_says_what_is_unreachable_and_by_how_much(self, robot, target):
        missed = np.linalg.norm(np.array(target) - [0.0, 0.0, 0.2755]) - robot.reach
        with pytest.raises(UnreachableError, match=r"no configuration reaches .* at most 0\.99 m") as raised:
            inverse_kinematics(robot, target)
        assert str(target) in str(raised.value)
        reported = float(str(raised.value).split("misses by ")[1].split(" m")[0])
        assert missed - 1e-3 < reported < missed + 0.15


class TestTracking:
    def follow(self, robot: Robot, path: np.ndarray) -> TrackedPath:
        return track(robot, path, inverse_kinematics(robot, path[0]))

    @settings(max_examples=30)
    @given(seed=seeds)
    def test_follows_smooth_paths_continuously(self, seed):
        robot, path = load_jaco(), smooth_path(seed)
        result = self.follow(robot, path)
        assert result.error.max() < 1e-4
        np.testing.assert_allclose(np.linalg.norm(robot.end_effector(result.q) - path, axis=1), result.error)
        assert inside_limits(robot, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    def test_walks_to_a_path_that_begins_elsewhere(self, robot):
        result = track(robot, smooth_path(3), inverse_kinematics(robot, [0.4, -0.6, 0.7]))
        assert result.error.max() < 1e-4
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    def test_a_single_waypoint_is_a_path(self, robot):
        result = track(robot, [[0.1, -0.5, 0.3]], robot.home)
        assert result.q.shape == (1, robot.num_joints)
        assert result.error[0] < 1e-4

    def test_keeps_the_hands_direction_better_than_the_plain_pseudo_inverse(self, robot):
        path = np.linspace([0.3, -0.45, 0.25], [-0.3, -0.45, 0.25], 200)
        start = inverse_kinematics(robot, path[0])
        q, plain = start, [start]
        for waypoint in path[1:]:
            q = q + np.linalg.pinv(robot.jacobian(q)) @ (waypoint - robot.end_effector(q))
            plain.append(q)
        aim = robot.hand_direction(start)
        kept = (robot.hand_direction(track(robot, path, start).q) @ aim).min()
        assert kept > (robot.hand_direction(np.array(plain)) @ aim).min()
        assert np.degrees(np.arccos(kept)) < 45.0

    def test_a_path_that_returns_brings_the_joints_back(self, robot):
        path = smooth_path(1)
        q = self.follow(robot, np.concatenate([path, path[::-1]])).q
        np.testing.assert_allclose(q, q[::-1], atol=5e-3)

    @pytest.mark.parametrize("seed", range(2))
    def test_bridges_jumps_and_repeated_samples(self, robot, seed):
        path = smooth_path(seed)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()
        sparse = path[np.unique(np.searchsorted(steps, np.arange(0.0, steps[-1], 0.03)))]
        result = self.follow(robot, np.repeat(sparse, 2, axis=0))
        assert result.error.max() < 1e-4
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    @pytest.mark.parametrize("seed", range(2))
    def test_a_warm_start_ends_where_a_cold_one_does_and_is_not_written_to(self, robot, seed):
        path, rng = smooth_path(seed), np.random.default_rng(seed)
        cold = self.follow(robot, path)
        np.testing.assert_allclose(cold.q[0], inverse_kinematics(robot, path[0]), atol=1e-3)
        bump = 0.02 * np.exp(-(np.linspace(-3, 3, len(path)) ** 2))[:, None]
        dragged, before = path + bump * rng.normal(size=3), cold.q.copy()
        warm = track(robot, dragged, cold.q[0], initial=cold.q)
        assert warm.error.max() < 1e-4
        np.testing.assert_allclose(warm.q, track(robot, dragged, cold.q[0]).q, atol=0.02)
        np.testing.assert_array_equal(cold.q, before)
        noise = robot.clip(rng.uniform(-np.pi, 2 * np.pi, cold.q.shape))
        np.testing.assert_allclose(track(robot, path, cold.q[0], initial=noise).q, cold.q, atol=0.01)

    @pytest.mark.parametrize("far", [[0.0, -1.4, 0.4], [0.9, -0.9, 0.9], [0.0, 0.0, 2.0], [0.5, 1.2, 0.3]])
    def test_out_of_reach_is_reported_and_stays_at_the_border(self, robot, far):
        near = np.array([0.0, -0.5, 0.4])
        path = near + np.sin(np.linspace(0, np.pi, 400))[:, None] * (np.array(far) - near)
        result = self.follow(robot, path)
        shoulder = np.array([0.0, 0.0, 0.2755])
        missing = np.linalg.norm(path - shoulder, axis=1) - robot.reach
        assert (missing > 0).any()
        assert inside_limits(robot, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3
        np.testing.assert_allclose(result.error[missing > 0], missing[missing > 0], atol=2e-3)
        assert result.error[missing < -0.01].max() < 1e-4

    def test_joint_limits_hold_and_are_reported(self, robot):
        near, low = np.array([0.0, -0.5, 0.4]), np.array([0.0, -0.5, -1.5])
        path = near + np.sin(np.linspace(0, np.pi, 400))[:, None] * (low - near)
        result = self.follow(robot, path)
        at_limit = ((result.q == robot.lower) | (result.q == robot.upper)).any(axis=1)
        assert at_limit.any()
        np.testing.assert_array_equal(result.limits_hit, at_limit)
        assert inside_limits(robot, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3
        assert result.error[[0, -1]].max() < 1e-4

    def test_singularities_are_reported(self, robot):
        stretched = np.linspace([0.0, -0.5, 0.4], [0.0, -1.3, 0.4], 100)
        result = self.follow(robot, stretched)
        assert result.damped[-1]
        assert not result.damped[0]

    @pytest.mark.parametrize("option", ["initial", "reference"])
    def test_shapes_are_checked(self, robot, option):
        with pytest.raises(ValueError, match="path must be"):
            track(robot, smooth_path(0)[:, :2], robot.home)
        with pytest.raises(ValueError, match=f"{option} must be"):
            track(robot, smooth_path(0), robot.home, **{option: np.zeros((10, 6))})


class TestSharedReference:
    """Paths with one reference are lifted to the joints by one section x → q(x)."""

    @settings(max_examples=15)
    @given(seed=seeds)
    def test_the_same_place_has_the_same_joints(self, seed):
        robot = load_jaco()
        paths = np.stack([smooth_path(seed), smooth_path(seed + 1)])
        crossing = paths.mean(axis=(0, 1))
        paths[0, 120], paths[1, 60] = crossing, crossing
        starts = np.stack([inverse_kinematics(robot, path[0]) for path in paths])
        q = track(robot, paths, starts, reference=robot.home).q
        np.testing.assert_allclose(q[0, 120], q[1, 60], atol=STEPS)

    def test_the_start_is_the_default(self, robot):
        path = smooth_path(0)
        start = inverse_kinematics(robot, path[0])
        np.testing.assert_array_equal(track(robot, path, start).q, track(robot, path, start, reference=start).q)
