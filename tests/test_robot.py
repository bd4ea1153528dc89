"""Kinematics against pinocchio and yourdfpy; inverse kinematics and tracking by their properties."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from functools import lru_cache
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import CubicSpline

from dt_viz.robot import (
    END_EFFECTOR_FRAME,
    NUM_JOINTS,
    JointPath,
    Robot,
    UnreachableError,
    load_jaco,
    package_folder,
    urdf_path,
)

BOX = np.array([[-0.4, -0.65, 0.05], [0.4, -0.3, 0.75]])  # where the tasks live, metres
angles = arrays(np.float64, (NUM_JOINTS,), elements=st.floats(-2 * np.pi, 2 * np.pi))
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def jaco() -> Robot:
    return load_jaco()


@lru_cache(maxsize=1)
def pinocchio_model() -> tuple[pin.Model, pin.Data]:
    model = pin.buildModelFromUrdf(str(urdf_path()))
    return model, model.createData()


def pinocchio_configuration(q: np.ndarray) -> np.ndarray:
    model, _ = pinocchio_model()
    parts = [[np.cos(angle), np.sin(angle)] if model.joints[i + 1].nq == 2 else [angle] for i, angle in enumerate(q)]
    return np.concatenate(parts)


def random_configurations(robot: Robot, seed: int, num: int) -> np.ndarray:
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, 2 * np.pi)
    return np.random.default_rng(seed).uniform(lower, upper, (num, NUM_JOINTS))


def smooth_path(seed: int, num: int = 200) -> np.ndarray:
    """A curve of two bends that stays in the task box."""
    corners = np.random.default_rng(seed).uniform(*BOX, size=(4, 3))
    return np.clip(CubicSpline([0, 1, 2, 3], corners)(np.linspace(0, 3, num)), *BOX)


def inside_limits(robot: Robot, q: np.ndarray) -> bool:
    return bool(((q >= robot.lower) & (q <= robot.upper)).all())


class TestModel:
    def test_limits_are_those_of_the_urdf(self, jaco):
        np.testing.assert_array_equal(np.isinf(jaco.lower), [True, False, False, True, False, True])
        np.testing.assert_allclose(jaco.lower[[1, 2, 4]], [0.820, 0.332, 0.524], atol=1e-3)
        np.testing.assert_allclose(jaco.upper[[1, 2, 4]], [5.463, 5.952, 5.760], atol=1e-3)
        np.testing.assert_allclose(jaco.velocity_limits, [0.628] * 3 + [0.838] * 3, atol=1e-3)

    def test_home_is_a_ready_pose(self, jaco):
        _, origins = jaco.forward_kinematics(jaco.home)
        assert inside_limits(jaco, jaco.home)
        assert origins[2, 2] == origins[:, 2].max()  # elbow up
        assert jaco.end_effector(jaco.home)[1] < -0.3  # ahead of the base
        assert jaco.hand_direction(jaco.home)[2] < 0.0

    def test_arrays_cannot_be_changed(self, jaco):
        with pytest.raises(ValueError, match="read-only"):
            jaco.lower[1] = 0.0

    def test_meshes_resolve_in_the_package_folder(self):
        meshes = [mesh.get("filename", "") for mesh in ElementTree.parse(urdf_path()).iter("mesh")]
        assert len(meshes) > 10
        for mesh in meshes:
            assert (package_folder() / mesh.removeprefix("package://")).is_file()

    def test_missing_package_is_named(self, monkeypatch):
        monkeypatch.setattr("dt_viz.robot.DISTRIBUTION", "no-such-robot-data")
        with pytest.raises(FileNotFoundError, match="pip install no-such-robot-data"):
            urdf_path()

    def test_package_without_the_urdf_is_named(self, monkeypatch):
        monkeypatch.setattr("dt_viz.robot.DISTRIBUTION", "numpy")
        with pytest.raises(FileNotFoundError, match=r"numpy .* holds no .*kinova\.urdf"):
            urdf_path()


class TestKinematics:
    @settings(deadline=None)
    @given(q=angles)
    def test_forward_kinematics_equals_pinocchio(self, q):
        robot, (model, data) = load_jaco(), pinocchio_model()
        pin.framesForwardKinematics(model, data, pinocchio_configuration(q))
        rotations, origins = robot.forward_kinematics(q)
        for i in range(NUM_JOINTS):
            np.testing.assert_allclose(rotations[i], data.oMi[i + 1].rotation, atol=1e-12)
            np.testing.assert_allclose(origins[i], data.oMi[i + 1].translation, atol=1e-12)
        hand = data.oMf[model.getFrameId(END_EFFECTOR_FRAME)]
        rotation, position = robot.end_effector_pose(q)
        np.testing.assert_allclose(rotation, hand.rotation, atol=1e-12)
        np.testing.assert_allclose(position, hand.translation, atol=1e-12)
        np.testing.assert_allclose(robot.end_effector(q), hand.translation, atol=1e-12)

    @settings(deadline=None)
    @given(q=angles)
    def test_jacobian_equals_pinocchio(self, q):
        model, data = pinocchio_model()
        expected = pin.computeFrameJacobian(
            model,
            data,
            pinocchio_configuration(q),
            model.getFrameId(END_EFFECTOR_FRAME),
            pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
        )[:3]
        np.testing.assert_allclose(load_jaco().jacobian(q), expected, atol=1e-12)

    @settings(deadline=None)
    @given(q=angles)
    def test_jacobian_equals_finite_differences(self, q):
        robot, h = load_jaco(), 1e-6
        steps = h * np.eye(NUM_JOINTS)
        expected = (robot.end_effector(q + steps) - robot.end_effector(q - steps)).T / (2 * h)
        np.testing.assert_allclose(robot.jacobian(q), expected, atol=1e-8)

    def test_batch_axes_lead(self, jaco):
        q = random_configurations(jaco, 0, 6).reshape(2, 3, NUM_JOINTS)
        rotations, origins = jaco.forward_kinematics(q)
        assert rotations.shape == (2, 3, 6, 3, 3)
        for index in np.ndindex(2, 3):
            np.testing.assert_allclose(rotations[index], jaco.forward_kinematics(q[index])[0], atol=1e-15)
            np.testing.assert_allclose(origins[index], jaco.forward_kinematics(q[index])[1], atol=1e-15)
            np.testing.assert_allclose(jaco.end_effector(q)[index], jaco.end_effector(q[index]), atol=1e-15)
            np.testing.assert_allclose(jaco.hand_direction(q)[index], jaco.hand_direction(q[index]), atol=1e-15)
            np.testing.assert_allclose(jaco.jacobian(q)[index], jaco.jacobian(q[index]), atol=1e-15)
            np.testing.assert_allclose(jaco.joint_frames(q)[index], jaco.joint_frames(q[index]), atol=1e-15)

    def test_joint_frames_equal_the_viewers_scene_tree(self, jaco):
        urdf = yourdfpy.URDF.load(str(urdf_path()), load_meshes=False, build_scene_graph=True)
        assert tuple(urdf.actuated_joint_names) == jaco.joint_names
        for q in random_configurations(jaco, 1, 10):
            urdf.update_cfg(q)
            for name, wxyz in zip(jaco.joint_names, jaco.joint_frames(q), strict=True):
                joint = urdf.joint_map[name]
                expected = urdf.get_transform(joint.child, joint.parent)[:3, :3]
                np.testing.assert_allclose(pin.Quaternion(*wxyz).matrix(), expected, atol=1e-9)


class TestInverseKinematics:
    @pytest.mark.parametrize("seed", range(100))
    def test_reaches_targets_with_a_natural_posture(self, jaco, seed):
        target = np.random.default_rng(seed).uniform(*BOX)
        q = jaco.inverse_kinematics(target)
        _, origins = jaco.forward_kinematics(q)
        np.testing.assert_allclose(jaco.end_effector(q), target, atol=1e-5)
        assert inside_limits(jaco, q)
        assert np.minimum(q - jaco.lower, jaco.upper - q).min() > 0.1
        assert origins[:, 2].min() > 0.1  # above the table
        assert origins[2, 2] > 0.4  # elbow up
        assert jaco.hand_direction(q)[2] < 0.1  # not upwards

    @pytest.mark.parametrize("seed", range(10))
    def test_stays_near_a_seed_that_already_reaches(self, jaco, seed):
        natural = jaco.inverse_kinematics(np.random.default_rng(seed).uniform(*BOX))
        q = natural + np.array([2 * np.pi, 0.0, 0.0, -2 * np.pi, 0.0, 1.0])  # other turns of the continuous joints
        nudged = jaco.end_effector(q) + np.array([0.0, 0.0, 0.01])
        np.testing.assert_allclose(jaco.inverse_kinematics(nudged, seed=q), q, atol=0.15)

    @pytest.mark.parametrize("direction", [[0, -1, -1], [0.5, -1, 0], [0, 0, -2], [-1, -1, -1]])
    def test_points_the_hand_as_asked(self, jaco, direction):
        q = jaco.inverse_kinematics([0.0, -0.45, 0.3], hand_direction=direction)
        cosine = jaco.hand_direction(q) @ direction / np.linalg.norm(direction)
        assert np.degrees(np.arccos(cosine)) < 10.0
        np.testing.assert_allclose(jaco.end_effector(q), [0.0, -0.45, 0.3], atol=1e-5)

    @pytest.mark.parametrize("target", [[0.0, -1.5, 0.3], [0.0, 0.0, 1.5], [2.0, 2.0, 2.0], [0.0, -0.3, -0.8]])
    def test_says_what_is_unreachable_and_by_how_much(self, jaco, target):
        missed = np.linalg.norm(np.array(target) - [0.0, 0.0, 0.2755]) - jaco.reach
        with pytest.raises(UnreachableError, match=r"no configuration reaches .* at most 0\.99 m") as raised:
            jaco.inverse_kinematics(target)
        assert str(target) in str(raised.value)
        reported = float(str(raised.value).split("misses by ")[1].split(" m")[0])
        assert missed - 1e-3 < reported < missed + 0.15


class TestTracking:
    def follow(self, robot: Robot, path: np.ndarray) -> JointPath:
        return robot.track(path, robot.inverse_kinematics(path[0]))

    @settings(max_examples=30, deadline=None)
    @given(seed=seeds)
    def test_follows_smooth_paths_continuously(self, seed):
        robot, path = load_jaco(), smooth_path(seed)
        result = self.follow(robot, path)
        assert result.error.max() < 1e-4
        np.testing.assert_allclose(np.linalg.norm(robot.end_effector(result.q) - path, axis=1), result.error)
        assert inside_limits(robot, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    def test_starts_at_the_start(self, jaco):
        path = smooth_path(0)
        start = jaco.inverse_kinematics(path[0])
        np.testing.assert_allclose(jaco.track(path, start).q[0], start, atol=1e-3)

    def test_walks_to_a_path_that_begins_elsewhere(self, jaco):
        result = jaco.track(smooth_path(3), jaco.inverse_kinematics([0.4, -0.6, 0.7]))
        assert result.error.max() < 1e-4
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    def test_a_single_waypoint_is_a_path(self, jaco):
        result = jaco.track([[0.1, -0.5, 0.3]], jaco.home)
        assert result.q.shape == (1, NUM_JOINTS)
        assert result.error[0] < 1e-4

    def test_keeps_the_hands_direction_better_than_the_plain_pseudo_inverse(self, jaco):
        path = np.linspace([0.3, -0.45, 0.25], [-0.3, -0.45, 0.25], 200)
        start = jaco.inverse_kinematics(path[0])
        q, plain = start, [start]
        for waypoint in path[1:]:
            q = q + np.linalg.pinv(jaco.jacobian(q)) @ (waypoint - jaco.end_effector(q))
            plain.append(q)
        aim = jaco.hand_direction(start)
        kept = (jaco.hand_direction(jaco.track(path, start).q) @ aim).min()
        assert kept > (jaco.hand_direction(np.array(plain)) @ aim).min()
        assert np.degrees(np.arccos(kept)) < 45.0

    def test_a_path_that_returns_brings_the_joints_back(self, jaco):
        path = smooth_path(1)
        q = self.follow(jaco, np.concatenate([path, path[::-1]])).q
        np.testing.assert_allclose(q, q[::-1], atol=5e-3)

    @pytest.mark.parametrize("seed", range(5))
    def test_bridges_jumps_and_repeated_samples(self, jaco, seed):
        path = smooth_path(seed)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()
        sparse = path[np.unique(np.searchsorted(steps, np.arange(0.0, steps[-1], 0.03)))]
        result = self.follow(jaco, np.repeat(sparse, 2, axis=0))
        assert result.error.max() < 1e-4
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3

    @pytest.mark.parametrize("seed", range(5))
    def test_a_warm_start_ends_where_a_cold_one_does(self, jaco, seed):
        path = smooth_path(seed)
        cold = self.follow(jaco, path)
        bump = 0.02 * np.exp(-(np.linspace(-3, 3, len(path)) ** 2))[:, None]
        dragged = path + bump * np.random.default_rng(seed).normal(size=3)
        warm = jaco.track(dragged, cold.q[0], initial=cold.q)
        assert warm.error.max() < 1e-4
        np.testing.assert_allclose(warm.q, jaco.track(dragged, cold.q[0]).q, atol=0.02)

    def test_a_warm_start_is_not_written_to(self, jaco):
        path = smooth_path(0)
        initial = self.follow(jaco, path).q
        before = initial.copy()
        jaco.track(path + 0.01, initial[0], initial=initial)
        np.testing.assert_array_equal(initial, before)

    def test_dragging_out_and_back_leaves_no_trace(self, jaco):
        path = np.linspace([0.3, -0.45, 0.25], [-0.3, -0.45, 0.25], 100)
        bump = np.exp(-(np.linspace(-2.5, 2.5, 100) ** 2))[:, None] * np.array([0.0, -1.0, 0.3])
        first = previous = self.follow(jaco, path)
        for pull in np.concatenate([np.linspace(0.0, 0.8, 30), np.linspace(0.8, 0.0, 30)]):
            previous = jaco.track(path + pull * bump, first.q[0], initial=previous.q)
            assert inside_limits(jaco, previous.q)
        np.testing.assert_allclose(previous.q, first.q, atol=0.01)

    def test_a_bad_warm_start_does_no_harm(self, jaco):
        path = smooth_path(2)
        cold = self.follow(jaco, path)
        noise = random_configurations(jaco, 0, len(path))
        np.testing.assert_allclose(jaco.track(path, cold.q[0], initial=noise).q, cold.q, atol=0.01)

    @pytest.mark.parametrize("far", [[0.0, -1.4, 0.4], [0.9, -0.9, 0.9], [0.0, 0.0, 2.0], [0.5, 1.2, 0.3]])
    def test_out_of_reach_is_reported_and_stays_at_the_border(self, jaco, far):
        near = np.array([0.0, -0.5, 0.4])
        path = near + np.sin(np.linspace(0, np.pi, 400))[:, None] * (np.array(far) - near)
        result = self.follow(jaco, path)
        shoulder = np.array([0.0, 0.0, 0.2755])
        missing = np.linalg.norm(path - shoulder, axis=1) - jaco.reach
        assert (missing > 0).any()
        assert inside_limits(jaco, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3
        np.testing.assert_allclose(result.error[missing > 0], missing[missing > 0], atol=2e-3)
        assert result.error[missing < -0.01].max() < 1e-4

    def test_joint_limits_hold_and_are_reported(self, jaco):
        near, low = np.array([0.0, -0.5, 0.4]), np.array([0.0, -0.5, -1.5])
        path = near + np.sin(np.linspace(0, np.pi, 400))[:, None] * (low - near)
        result = self.follow(jaco, path)
        at_limit = ((result.q == jaco.lower) | (result.q == jaco.upper)).any(axis=1)
        assert at_limit.any()
        np.testing.assert_array_equal(result.limits_hit, at_limit)
        assert inside_limits(jaco, result.q)
        assert np.abs(np.diff(result.q, axis=0)).max() < 0.3
        assert result.error[[0, -1]].max() < 1e-4

    def test_singularities_are_reported(self, jaco):
        stretched = np.linspace([0.0, -0.5, 0.4], [0.0, -1.3, 0.4], 100)
        result = self.follow(jaco, stretched)
        assert result.damped[-1]
        assert not result.damped[0]
        assert result.min_manipulability == result.manipulability.min()

    def test_several_paths_at_once_equal_one_by_one(self, jaco):
        paths = np.stack([smooth_path(seed) for seed in range(4)])
        starts = np.stack([jaco.inverse_kinematics(path[0]) for path in paths])
        together = jaco.track(paths, starts)
        assert together.q.shape == (4, 200, NUM_JOINTS)
        assert together.error.shape == (4, 200)
        for path, start, q in zip(paths, starts, together.q, strict=True):
            np.testing.assert_allclose(q, jaco.track(path, start).q, atol=0.01)

    def test_shapes_are_checked(self, jaco):
        path = smooth_path(0)
        with pytest.raises(ValueError, match="path must be"):
            jaco.track(path[:, :2], jaco.home)
        with pytest.raises(ValueError, match="initial must be"):
            jaco.track(path, jaco.home, initial=np.zeros((10, 6)))
