"""Body points: their spheres cover the collision meshes, not by much more than needed, and move with them."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from body_spheres import cover
from pinocchio_arm import random_configurations

from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.body_points import PROTRUSION, BodyPoints
from dt_viz.robot.collision import SELF_REACH
from dt_viz.robot.link_distances import SHAPE_TOLERANCE
from dt_viz.robot.models import load_jaco
from dt_viz.shipped import ASSETS

SCRIPT = Path(__file__).parents[2] / "assets" / "make_body_points.py"


@pytest.fixture(scope="module")
def body() -> BodyPoints:
    return load_jaco().body


def changed(body: BodyPoints, radius: float = 0.0, offset: float = 0.0) -> BodyPoints:
    """The same with larger spheres, metres, all farther along x in their joint's frame."""
    spheres = body.spheres.copy()
    spheres["radius"] += radius
    spheres["offset"] += [offset, 0.0, 0.0]
    return BodyPoints(spheres)


class TestCover:
    @pytest.mark.slow
    def test_the_script_makes_the_file_that_ships(self):
        made = runpy.run_path(str(SCRIPT))["body_points"]()
        with np.load(ASSETS / "body_points.npz", allow_pickle=False) as shipped:
            assert set(made) == set(shipped.files)
            np.testing.assert_array_equal(made["joint"], shipped["joint"])
            # Another platform's mathematics may round the last digit differently.
            np.testing.assert_array_equal(made["end"], shipped["end"])
            np.testing.assert_allclose(made["offset"], shipped["offset"], rtol=0, atol=2.1e-5)
            np.testing.assert_allclose(made["radius"], shipped["radius"], rtol=0, atol=2.1e-5)


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


@pytest.mark.long
def test_links_keep_at_least_as_far_from_each_other_as_their_spheres_and_hardly_farther(body, robot):
    """By coal's distances of meshes."""
    model, paths = load_jaco().collision, random_configurations(robot, 1, (300, 1))
    found = [(model.nearest_to_itself(q), robot.self_clearance(q, SELF_REACH)) for q in paths]
    near = [(nearest.distance, asked) for nearest, asked in found if nearest is not None]
    apart = [true - asked for true, asked in near if true > 0]
    assert len(apart) > 20
    assert -SHAPE_TOLERANCE < min(apart) <= max(apart) < 2 * PROTRUSION + SHAPE_TOLERANCE


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
