"""Body points: their spheres cover the collision meshes, not by much more than needed, and move with them."""

import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pinocchio_arm import random_configurations
from scipy.spatial import KDTree

from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.body_points import BodyPoints, load_body_points
from dt_viz.robot.collision import load_collision_model
from dt_viz.robot.robot import LinkMesh, Robot, collision_meshes
from dt_viz.shipped import ASSETS

SCRIPT = Path(__file__).parents[2] / "assets" / "make_body_points.py"
OVERSHOOT = {-1: 0.0375, 0: 0.0295, 1: 0.0455, 2: 0.043, 3: 0.031, 4: 0.031, 5: 0.0255}
"""How far the spheres of each joint may stick out of its links, metres: about a millimetre more than they do."""

each_link = pytest.mark.parametrize("mesh", collision_meshes(), ids=lambda mesh: mesh.name)
each_joint = pytest.mark.parametrize("joint", OVERSHOOT)


@pytest.fixture(scope="module")
def body() -> BodyPoints:
    return load_body_points()


def on_surface(mesh: LinkMesh, num: int = 50_000) -> np.ndarray:
    """All vertices, and points spread evenly over the triangles."""
    rng = np.random.default_rng(0)
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(areas), num, p=areas / areas.sum())]
    points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), num), chosen)
    return np.concatenate([mesh.vertices, points])


@lru_cache(maxsize=1)
def surface_of_joints() -> dict[int, KDTree]:
    """Points less than a millimetre apart on all the links that move with a joint."""
    return {
        joint: KDTree(np.concatenate([on_surface(mesh) for mesh in collision_meshes() if mesh.joint == joint]))
        for joint in OVERSHOOT
    }


def unit_sphere(num: int) -> np.ndarray:
    """Points spread evenly along a spiral from pole to pole."""
    height = (np.arange(num) + 0.5) / num * 2 - 1
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(num)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def beyond_spheres(points: np.ndarray, body: BodyPoints, joint: int) -> np.ndarray:
    """Signed distances (N, S) of points (N, 3) from each of a joint's spheres, negative inside."""
    own = body.joint == joint
    return np.linalg.norm(points[:, None] - body.offset[own], axis=-1) - body.radius[own]


def clearance(body: BodyPoints, robot: Robot, q: np.ndarray, obstacle: Sphere) -> float:
    """Of all spheres from the obstacle at one configuration, metres."""
    return float((obstacle.signed_distance(body.positions(robot, q)) - body.radius).min())


class TestCover:
    @each_link
    def test_no_point_of_a_link_sticks_out_of_its_joints_spheres_and_each_triangle_lies_in_one(self, body, mesh):
        assert beyond_spheres(on_surface(mesh), body, mesh.joint).min(axis=1).max() <= 1e-6
        of_corners = beyond_spheres(mesh.vertices, body, mesh.joint)[mesh.faces]
        assert of_corners.max(axis=1).min(axis=1).max() <= 1e-6

    @each_joint
    def test_no_sphere_sticks_out_of_the_links_by_more_than_it_must(self, body, joint):
        own = body.joint == joint
        spheres = body.offset[own, None] + body.radius[own, None, None] * unit_sphere(2000)
        farthest = surface_of_joints()[joint].query(spheres)[0].max()
        assert OVERSHOOT[joint] - 0.002 < farthest < OVERSHOOT[joint]

    def test_no_sphere_could_be_left_out(self, body):
        for leave_out, joint in enumerate(body.joint):
            keep = np.arange(len(body.joint)) != leave_out
            rest = BodyPoints(body.joint[keep], body.offset[keep], body.radius[keep])
            sticks_out = [
                beyond_spheres(mesh.vertices, rest, joint).min(axis=1).max()
                for mesh in collision_meshes()
                if mesh.joint == joint
            ]
            assert max(sticks_out) > 0.002

    @pytest.mark.slow
    def test_the_script_makes_the_file_that_ships(self):
        made = script().body_points()
        with np.load(ASSETS / "body_points.npz", allow_pickle=False) as shipped:
            assert set(made) == set(shipped.files)
            np.testing.assert_array_equal(made["joint"], shipped["joint"])
            # Another platform's mathematics may round the last digit differently.
            np.testing.assert_allclose(made["offset"], shipped["offset"], rtol=0, atol=2.1e-5)
            np.testing.assert_allclose(made["radius"], shipped["radius"], rtol=0, atol=1.1e-4)

    def test_the_scripts_balls_are_the_smallest(self):
        """Around a ball's own points the ball itself, whatever lies within; around two points the one between them."""
        rng = np.random.default_rng(0)
        smallest_ball = script()._smallest_ball
        for num in (4, 20, 300):
            directions = unit_sphere(num)
            directions[: num // 2] = -directions[num // 2 :]  # in opposite pairs: no smaller ball holds them
            inside = 0.9 * rng.uniform(size=(200, 1)) * unit_sphere(200)
            points = np.array([0.3, -0.2, 0.1]) + 0.05 * np.concatenate([inside, directions])
            centre, radius = smallest_ball(rng.permutation(points))
            np.testing.assert_allclose(centre, [0.3, -0.2, 0.1], atol=1e-6)
            assert radius == pytest.approx(0.05, abs=1e-8)
        for points in rng.normal(size=(20, 2, 3)):
            centre, radius = smallest_ball(points)
            np.testing.assert_allclose(centre, points.mean(axis=0), atol=1e-9)
            assert radius == pytest.approx(np.linalg.norm(points[1] - points[0]) / 2)
        assert smallest_ball(np.ones((5, 3)))[1] == 0.0


class TestPositions:
    @pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3), (0,), (3, 1, 2)])
    def test_they_move_with_the_joint_frames(self, body, robot, shape):
        q = random_configurations(robot, 0, shape)
        positions = body.positions(robot, q)
        assert positions.shape == (*shape, len(body.joint), 3)
        rotations, origins = robot.forward_kinematics(q)
        for i, (joint, offset) in enumerate(zip(body.joint, body.offset, strict=True)):
            expected = offset
            if joint >= 0:
                expected = rotations[..., joint, :, :] @ offset + origins[..., joint, :]
            np.testing.assert_allclose(positions[..., i, :], np.broadcast_to(expected, (*shape, 3)), atol=1e-14)

    def test_pedestal_and_moving_links_are_all_there_is_and_the_end_effector_is_one_more(self, body, robot):
        q, more = random_configurations(robot, 1, (3,)), body.with_end_effector(robot, 0.01)
        positions, parts = more.positions(robot, q), [body.on_pedestal, body.on_moving_links]
        together = np.concatenate([part.positions(robot, q) for part in parts], axis=1)
        np.testing.assert_array_equal(together, body.positions(robot, q))
        np.testing.assert_array_equal(together, positions[:, :-1])
        np.testing.assert_allclose(positions[:, -1], robot.end_effector(q), atol=1e-12)
        assert (parts[0].joint.max(), parts[1].joint.min(), more.radius[-1]) == (0, 1, 0.01)
        for part in (body, more, *parts):
            covered = np.concatenate([np.arange(len(part.joint))[points] for _, points in part.by_joint])
            np.testing.assert_array_equal(covered, np.arange(len(part.joint)))
            assert all((part.joint[points] == joint).all() for joint, points in part.by_joint)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("diameter", [0.02, 0.15, 0.4])
def test_where_the_spheres_clear_an_obstacle_the_meshes_clear_it_by_at_least_as_much(body, robot, seed, diameter):
    model, rng = load_collision_model(), np.random.default_rng(seed)
    checked = 0
    for q in random_configurations(robot, seed, (40,)):
        # An obstacle near some sphere, though perhaps in the way of another.
        beside = rng.integers(len(body.joint))
        direction = rng.normal(size=3)
        away = body.radius[beside] + diameter / 2 + rng.uniform(0.0, 0.1)
        centre = body.positions(robot, q)[beside] + away * direction / np.linalg.norm(direction)
        obstacle = Sphere((float(centre[0]), float(centre[1]), float(centre[2])), diameter)
        promised = clearance(body, robot, q, obstacle)
        if promised > 0:
            true = model.obstacle_distance(q[None], obstacle)[0][0]
            assert promised - 1e-6 <= true <= promised + max(OVERSHOOT.values())
            checked += 1
    assert checked >= 10


@lru_cache(maxsize=1)
def script() -> Any:
    spec = importlib.util.spec_from_file_location("make_body_points", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
