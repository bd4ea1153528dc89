"""Kinematics and link shapes against pinocchio and yourdfpy."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle
import pytest
import yourdfpy
from pinocchio_arm import placed_vertices, random_configurations

from dt_viz.robot.models import load_jaco, urdf_path


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

    @pytest.mark.parametrize(
        ("package", "words"),
        [("no-such-robot-data", "pip install no-such-robot-data"), ("numpy", r"numpy .* holds no .*kinova\.urdf")],
    )
    def test_what_is_missing_is_named(self, monkeypatch, package, words):
        monkeypatch.setattr("dt_viz.robot.models.DISTRIBUTION", package)
        with pytest.raises(FileNotFoundError, match=words):
            urdf_path()


class TestKinematics:
    def test_joint_frames_equal_the_viewers_scene_tree(self, robot):
        urdf = yourdfpy.URDF.load(str(robot.urdf), load_meshes=False, build_scene_graph=True)
        assert tuple(urdf.actuated_joint_names) == robot.joint_names
        for q in random_configurations(robot, 1, (10,)):
            urdf.update_cfg(q)
            np.testing.assert_allclose(np.linalg.norm(robot.joint_frames(q), axis=-1), 1, rtol=0, atol=1e-12)
            before = urdf.base_link
            for name, wxyz in zip(robot.joint_names, robot.joint_frames(q), strict=True):
                link = urdf.joint_map[name].child
                expected = urdf.get_transform(link, before)[:3, :3]
                before = link
                np.testing.assert_allclose(pin.Quaternion(*wxyz).matrix(), expected, atol=1e-9)


class TestLinkMeshes:
    def test_they_move_as_in_pinocchio(self, robot):
        for q in random_configurations(robot, 2, (5,)):
            rotations, origins = robot.forward_kinematics(q)
            for mesh, expected in zip(load_jaco().meshes, placed_vertices(q), strict=True):
                vertices = mesh.vertices
                if mesh.joint >= 0:
                    vertices = vertices @ rotations[mesh.joint].T + origins[mesh.joint]
                np.testing.assert_allclose(vertices, expected, atol=1e-12)

    def test_they_are_the_links_of_the_urdf(self):
        root = ElementTree.parse(load_jaco().urdf).getroot()
        with_shape = {
            link.get("name") for link in root.iter("link") if link.find("collision/geometry/mesh") is not None
        }
        assert {mesh.name for mesh in load_jaco().meshes} == with_shape
        assert [mesh.joint for mesh in load_jaco().meshes] == [-1, 0, 1, 2, 3, 4, 5, 5, 5, 5, 5]
