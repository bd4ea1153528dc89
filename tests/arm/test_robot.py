"""Kinematics and link shapes against pinocchio and yourdfpy."""

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

from dt_viz.arm.robot import (
    END_EFFECTOR_FRAME,
    NUM_JOINTS,
    Robot,
    collision_meshes,
    load_jaco,
    package_folder,
    urdf_path,
)

angles = arrays(np.float64, (NUM_JOINTS,), elements=st.floats(-2 * np.pi, 2 * np.pi))


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


class TestModel:
    def test_limits_are_those_of_the_urdf(self, robot):
        np.testing.assert_array_equal(np.isinf(robot.lower), [True, False, False, True, False, True])
        np.testing.assert_allclose(robot.lower[[1, 2, 4]], [0.820, 0.332, 0.524], atol=1e-3)
        np.testing.assert_allclose(robot.upper[[1, 2, 4]], [5.463, 5.952, 5.760], atol=1e-3)
        np.testing.assert_allclose(robot.velocity_limits, [0.628] * 3 + [0.838] * 3, atol=1e-3)

    def test_home_is_a_ready_pose(self, robot):
        _, origins = robot.forward_kinematics(robot.home)
        assert ((robot.home > robot.lower) & (robot.home < robot.upper)).all()
        assert origins[2, 2] == origins[:, 2].max()  # elbow up
        assert robot.end_effector(robot.home)[1] < -0.3  # ahead of the base
        assert robot.hand_direction(robot.home)[2] < 0.0

    def test_arrays_cannot_be_changed(self, robot):
        with pytest.raises(ValueError, match="read-only"):
            robot.lower[1] = 0.0

    def test_meshes_resolve_in_the_package_folder(self):
        meshes = [mesh.get("filename", "") for mesh in ElementTree.parse(urdf_path()).iter("mesh")]
        assert len(meshes) > 10
        for mesh in meshes:
            assert (package_folder() / mesh.removeprefix("package://")).is_file()

    def test_missing_package_is_named(self, monkeypatch):
        monkeypatch.setattr("dt_viz.arm.robot.DISTRIBUTION", "no-such-robot-data")
        with pytest.raises(FileNotFoundError, match="pip install no-such-robot-data"):
            urdf_path()

    def test_package_without_the_urdf_is_named(self, monkeypatch):
        monkeypatch.setattr("dt_viz.arm.robot.DISTRIBUTION", "numpy")
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

    def test_batch_axes_lead(self, robot):
        q = random_configurations(robot, 0, 6).reshape(2, 3, NUM_JOINTS)
        rotations, origins = robot.forward_kinematics(q)
        assert rotations.shape == (2, 3, 6, 3, 3)
        for index in np.ndindex(2, 3):
            np.testing.assert_allclose(rotations[index], robot.forward_kinematics(q[index])[0], atol=1e-13)
            np.testing.assert_allclose(origins[index], robot.forward_kinematics(q[index])[1], atol=1e-13)
            np.testing.assert_allclose(robot.end_effector(q)[index], robot.end_effector(q[index]), atol=1e-13)
            np.testing.assert_allclose(robot.hand_direction(q)[index], robot.hand_direction(q[index]), atol=1e-13)
            np.testing.assert_allclose(robot.jacobian(q)[index], robot.jacobian(q[index]), atol=1e-13)
            np.testing.assert_allclose(robot.joint_frames(q)[index], robot.joint_frames(q[index]), atol=1e-13)

    def test_joint_frames_equal_the_viewers_scene_tree(self, robot):
        urdf = yourdfpy.URDF.load(str(urdf_path()), load_meshes=False, build_scene_graph=True)
        assert tuple(urdf.actuated_joint_names) == robot.joint_names
        for q in random_configurations(robot, 1, 10):
            urdf.update_cfg(q)
            for name, wxyz in zip(robot.joint_names, robot.joint_frames(q), strict=True):
                joint = urdf.joint_map[name]
                expected = urdf.get_transform(joint.child, joint.parent)[:3, :3]
                np.testing.assert_allclose(pin.Quaternion(*wxyz).matrix(), expected, atol=1e-9)


class TestLinkMeshes:
    def test_they_move_as_in_pinocchio(self, robot):
        model, data = pinocchio_model()
        shapes = pin.buildGeomFromUrdf(
            model, str(urdf_path()), pin.GeometryType.COLLISION, package_dirs=[str(package_folder())]
        )
        placed = shapes.createData()
        for q in random_configurations(robot, 2, 5):
            pin.updateGeometryPlacements(model, data, shapes, placed, pinocchio_configuration(q))
            rotations, origins = robot.forward_kinematics(q)
            for mesh, shape, world in zip(collision_meshes(), shapes.geometryObjects, placed.oMg, strict=True):
                expected = shape.geometry.vertices() @ world.rotation.T + world.translation
                vertices = mesh.vertices
                if mesh.joint >= 0:
                    vertices = vertices @ rotations[mesh.joint].T + origins[mesh.joint]
                np.testing.assert_allclose(vertices, expected, atol=1e-12)

    def test_they_are_the_links_of_the_urdf(self):
        root = ElementTree.parse(urdf_path()).getroot()
        with_shape = {
            link.get("name") for link in root.iter("link") if link.find("collision/geometry/mesh") is not None
        }
        assert {mesh.name for mesh in collision_meshes()} == with_shape
        assert [mesh.joint for mesh in collision_meshes()] == [-1, 0, 1, 2, 3, 4, 5, 5, 5, 5, 5]

    def test_faces_join_vertices_that_each_occur_once(self):
        for mesh in collision_meshes():
            assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
            np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)))
