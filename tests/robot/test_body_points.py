"""Body points: their spheres cover the collision meshes, not by much more than needed, and move with them."""

import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from body_spheres import cover
from pinocchio_arm import random_configurations
from scipy.spatial import KDTree

from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.body_points import PROTRUSION, BodyPoints
from dt_viz.robot.collision import SELF_REACH
from dt_viz.robot.cover import bounding_sphere
from dt_viz.robot.link_distances import SELF_TOLERANCE
from dt_viz.robot.meshes import LinkMesh
from dt_viz.robot.models import load_jaco
from dt_viz.shipped import ASSETS

SCRIPT = Path(__file__).parents[2] / "assets" / "make_body_points.py"
JOINTS = range(-1, 6)
MEAN_PROTRUSION = 3.5e-3

each_link = pytest.mark.parametrize("mesh", load_jaco().meshes, ids=lambda mesh: mesh.name)
each_joint = pytest.mark.parametrize("joint", JOINTS)


@pytest.fixture(scope="module")
def body() -> BodyPoints:
    return load_jaco().body


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
        joint: KDTree(np.concatenate([on_surface(mesh) for mesh in load_jaco().meshes if mesh.joint == joint]))
        for joint in JOINTS
    }


def unit_sphere(num: int) -> np.ndarray:
    """Points spread evenly along a spiral from pole to pole."""
    height = (np.arange(num) + 0.5) / num * 2 - 1
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(num)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def beyond_spheres(points: np.ndarray, body: BodyPoints, joint: int) -> np.ndarray:
    """Signed distances (N, S) of points (N, 3) from each sphere of a joint, negative inside."""
    own = body.joint == joint
    return np.linalg.norm(points[:, None] - body.offset[own], axis=-1) - body.radius[own]


def uncovered(body: BodyPoints, mesh: LinkMesh, num: int = 10_000) -> float:
    """How far a link's surface is outside the spheres of its joint at most, metres."""
    return float(beyond_spheres(on_surface(mesh, num)[-num:], body, mesh.joint).min(axis=1).max())


def protrusions(body: BodyPoints, joint: int) -> np.ndarray:
    """How far the outside of a joint's spheres is off its links, metres, at points spread evenly over it."""
    own = np.flatnonzero(body.joint == joint)
    points = []
    for k in own:
        sphere = body.offset[k] + body.radius[k] * unit_sphere(int(4e5 * body.radius[k] ** 2) + 8)
        others = own[np.linalg.norm(body.offset[own] - body.offset[k], axis=1) < body.radius[own] + body.radius[k]]
        away = np.linalg.norm(sphere[:, None] - body.offset[others], axis=-1) - body.radius[others]
        points.append(sphere[away.min(axis=1) > -1e-9])
    return surface_of_joints()[joint].query(np.concatenate(points))[0]


def changed(body: BodyPoints, radius: float = 0.0, offset: float = 0.0) -> BodyPoints:
    """The same with larger spheres, metres, all farther along x in their joint's frame."""
    spheres = body.spheres.copy()
    spheres["radius"] += radius
    spheres["offset"] += [offset, 0.0, 0.0]
    return BodyPoints(spheres)


class TestCover:
    @each_link
    def test_the_smallest_spheres_of_a_joint_cover_its_links(self, body, mesh):
        smallest = cover(body)
        assert uncovered(smallest, mesh) <= 1e-6
        # which would be seen otherwise
        assert uncovered(changed(smallest, radius=-2e-3), mesh) > 5e-4
        assert uncovered(changed(smallest, offset=5e-3), mesh) > 5e-4

    @each_joint
    def test_they_stick_out_as_little_as_is_said(self, body, joint):
        off = protrusions(cover(body), joint)
        assert 0.8 * PROTRUSION < off.max() < PROTRUSION + 4e-4 and off.mean() < MEAN_PROTRUSION
        assert protrusions(changed(cover(body), radius=2e-3), joint).mean() > MEAN_PROTRUSION

    def test_they_are_inside_all_spheres_that_hold_them(self, body):
        spheres, smallest, holds = body.spheres, body.spheres["end"] == np.arange(len(body.spheres)) + 1, 0
        for k, (joint, offset, radius, end) in enumerate(spheres):
            assert (spheres["joint"][k:end] == joint).all() and (spheres["end"][k:end] <= end).all()
            inside = spheres[k:end][smallest[k:end]]
            holds += len(inside)
            assert (np.linalg.norm(inside["offset"] - offset, axis=1) + inside["radius"] <= radius + 3e-5).all()
        assert holds > 3 * len(spheres) and len(body.joint) == 29

    @pytest.mark.slow
    def test_the_script_makes_the_file_that_ships(self):
        made = script().body_points()
        with np.load(ASSETS / "body_points.npz", allow_pickle=False) as shipped:
            assert set(made) == set(shipped.files)
            np.testing.assert_array_equal(made["joint"], shipped["joint"])
            # Another platform's mathematics may round the last digit differently.
            np.testing.assert_array_equal(made["end"], shipped["end"])
            np.testing.assert_allclose(made["offset"], shipped["offset"], rtol=0, atol=2.1e-5)
            np.testing.assert_allclose(made["radius"], shipped["radius"], rtol=0, atol=2.1e-5)

    def test_balls_around_others_are_hardly_larger_than_they_must_be(self):
        """Around spheres inside a ball, some of which touch it from within, it is that ball, or 2 % larger."""
        rng = np.random.default_rng(0)
        for num in (4, 20, 300):
            directions, radii = unit_sphere(num), rng.uniform(0.0, 0.02, num)
            directions[: num // 2] = -directions[num // 2 :]  # in opposite pairs: no smaller ball holds them
            spheres = np.column_stack([[0.3, -0.2, 0.1] + (0.05 - radii)[:, None] * directions, radii])
            ball = bounding_sphere(np.concatenate([spheres, [[0.31, -0.2, 0.1, 0.02]]]))
            assert 0.05 - 1e-9 <= ball[3] < 0.051
            assert (np.linalg.norm(spheres[:, :3] - ball[:3], axis=1) + spheres[:, 3]).max() <= ball[3]


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
        q, more = random_configurations(robot, 1, (3,)), body.with_end_effector(robot)
        positions, parts = more.positions(robot, q), [robot.pedestal, robot.links]
        together = np.concatenate([part.positions(robot, q) for part in parts], axis=1)
        np.testing.assert_array_equal(together, body.positions(robot, q))
        np.testing.assert_array_equal(together, positions[:, :-1])
        np.testing.assert_allclose(positions[:, -1], robot.end_effector(q), atol=1e-12)
        assert (parts[0].joint.max(), parts[1].joint.min(), more.radius[-1]) == (0, 1, 0.0)
        for part in (body, more, *parts):
            covered = np.concatenate([np.arange(len(part.joint))[points] for _, points in part.by_joint])
            np.testing.assert_array_equal(covered, np.arange(len(part.joint)))
            assert all((part.joint[points] == joint).all() for joint, points in part.by_joint)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("diameter", [0.02, 0.15, 0.4])
def test_where_the_spheres_clear_an_obstacle_the_meshes_clear_it_by_at_least_as_much(body, robot, seed, diameter):
    """And by no more than they stick out. What is smaller or elsewhere is found out, by coal's distances of meshes."""
    model, rng, checked, found_out = load_jaco().collision, np.random.default_rng(seed), 0, np.zeros(3, int)
    for q in random_configurations(robot, seed, (40,)):
        # An obstacle near some sphere, though perhaps in the way of another.
        beside = rng.integers(len(body.joint))
        direction = rng.normal(size=3)
        away = body.radius[beside] + diameter / 2 + rng.uniform(-0.02, 0.1)
        centre = body.positions(robot, q)[beside] + away * direction / np.linalg.norm(direction)
        obstacle = Sphere((float(centre[0]), float(centre[1]), float(centre[2])), diameter)
        true = model.obstacle_distance(q[None], obstacle)[0][0]

        def wrong(body, q=q, obstacle=obstacle, true=true):
            promised = body.clearance(robot, q[None], obstacle)[0]
            return not promised - 1e-6 <= true <= promised + PROTRUSION + 4e-4

        if true > 0:
            assert not wrong(body)
            checked += 1
            found_out += [wrong(changed(body, radius=-6e-3)), wrong(changed(body, offset=0.01)), wrong(body.outermost)]
    assert checked >= 10 and (found_out > checked / 4).all()


def test_links_keep_at_least_as_far_from_each_other_as_their_spheres_and_hardly_farther(body, robot):
    """By coal's distances of meshes."""
    model, paths = load_jaco().collision, random_configurations(robot, 1, (300, 1))
    found = [(model.nearest_to_itself(q), robot.self_clearance(q, SELF_REACH)) for q in paths]
    near = [(nearest.distance, asked) for nearest, asked in found if nearest is not None]
    apart = [true - asked for true, asked in near if true > 0]
    assert len(apart) > 20
    assert -SELF_TOLERANCE < min(apart) <= max(apart) < 2 * PROTRUSION + SELF_TOLERANCE


def test_distances_are_cut_off_at_their_bounds(body, robot):
    q, ball = random_configurations(robot, 0, (50,)), Sphere((0.2, -0.3, 0.3), 0.1)
    exact, highest = body.clearance(robot, q, ball), np.linspace(-0.05, 0.3, 50)
    for lowest in (-np.inf, np.random.default_rng(0).permutation(highest) - 0.05, highest, 0.1):
        bounded = np.maximum(highest, lowest)
        found = body.clearance(robot, q, ball, bounded, lowest)
        np.testing.assert_allclose(found, np.clip(exact, lowest, bounded), rtol=0, atol=1e-12)
    points = cover(body)
    expected = (ball.signed_distance(points.positions(robot, q)) - points.radius).min(axis=1)
    np.testing.assert_allclose(exact, expected, rtol=0, atol=1e-12)


@lru_cache(maxsize=1)
def script() -> Any:
    spec = importlib.util.spec_from_file_location("make_body_points", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
