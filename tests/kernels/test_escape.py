"""Compiled loops of the whole arm: the same numbers as array operations, for random arms, obstacles and postures."""

import numpy as np
import plain_escape
import pytest
from body_spheres import cover
from laws.registry import OBSTACLES, SIMILAR, TILTED

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.arm_field import WholeArmField
from dt_viz.flows.integrators import DORMAND_PRINCE, RK4, carried
from dt_viz.kernels.escape import detours
from dt_viz.obstacles.shapes import as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco

ROBOT = load_jaco()
ARM = WholeArm(ROBOT)
NUM = 60


class Plain:
    """A field that is no `CompiledField`, so that flows take its array operations step by step."""

    dim = 6

    def __init__(self, field):
        self.field = field

    def __call__(self, q):
        return plain_escape.velocities(self.field, q)


SEVERAL = ("torus", "sphere", "scan", "plate")


@pytest.fixture(scope="module", params=["sphere", "box 3:1", "larger cloud", "several"])
def field(request):
    """The escape from one obstacle, or four, somewhere about the hand of the arm that is ready."""
    rng = np.random.default_rng(3)
    names = SEVERAL if request.param == "several" else (request.param,)
    places = ROBOT.end_effector(ROBOT.home) + rng.uniform(-0.15, 0.15, (len(names), 3))
    parts = tuple(OBSTACLES[name].moved(as_point(at), TILTED) for name, at in zip(names, places, strict=True))
    directions = rng.normal(size=(len(parts), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pins = ROBOT.home + rng.normal(0, 0.5, (2, 6))
    return WholeArmField(ROBOT, ARM.body, parts, directions, pins, 0.1)


@pytest.fixture(scope="module")
def postures():
    return ROBOT.home + np.random.default_rng(4).normal(0, 0.4, (NUM, 6))


def test_velocities_are_those_of_array_operations(field, postures):
    expected = plain_escape.velocities(field, postures)
    assert (np.abs(expected).max(axis=1) > 0.01).sum() > NUM / 8  # so many are in the way
    np.testing.assert_allclose(field(postures), expected, rtol=0, atol=1e-12)


def test_clearance_is_that_of_array_operations(field, postures):
    body = cover(ARM.body)
    points = body.of_chain(ROBOT.chain(postures.T)).transpose(0, 2, 1)
    expected = (Union(field.obstacles).signed_distance(points) - body.radius[:, None]).min(axis=0)
    np.testing.assert_allclose(ARM.clearance(postures, Union(field.obstacles)), expected, rtol=0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("name", OBSTACLES.keys() - SIMILAR)
def test_far_away_and_beyond_a_grid_distances_are_those_of_array_operations(name):
    q, body = ROBOT.home + np.random.default_rng(6).normal(0, 1.0, (50, 6)), cover(ARM.body)
    for away in (0.2, 0.5, 2.0):
        part = OBSTACLES[name].moved((away, -0.4, 0.3), (0.3, 0.2, 0.9, 0.1))
        points = body.of_chain(ROBOT.chain(q.T)).transpose(0, 2, 1)
        expected = (part.signed_distance(points) - body.radius[:, None]).min(axis=0)
        np.testing.assert_allclose(ARM.clearance(q, part), expected, rtol=0, atol=1e-12)
    assert (ARM.clearance(q, Union(())) == np.inf).all()


@pytest.mark.long
@pytest.mark.parametrize("duration", [-0.7, 0.4])
def test_runge_kutta_steps_are_those_of_array_operations(field, postures, duration):
    expected, _ = carried(Plain(field), postures, None, RK4, duration, 5)
    found, _ = carried(field, postures, None, RK4, duration, 5)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)


@pytest.mark.long
def test_adaptive_steps_are_as_exact_as_fine_runge_kutta_steps(field, postures):
    postures = postures[:20]
    before = postures.copy()
    exact, _ = carried(field, postures, None, RK4, -0.7, 2000)
    found, _ = carried(field, postures, None, DORMAND_PRINCE, -0.7, 1000, 1e-8)
    np.testing.assert_allclose(found, exact, rtol=0, atol=5e-6)
    np.testing.assert_array_equal(postures, before)


def test_too_many_steps_are_an_error(field, postures):
    with pytest.raises(ArithmeticError, match="more than 2 steps"):
        carried(field, postures, None, DORMAND_PRINCE, -0.7, 2, 1e-9)


# ways out


LENGTH = 0.1


def plain(directions, points, radius, centres, radii, margin):
    offset = points - centres[:, None, :, None]  # (B, P, 3, M)
    squared, apart = (offset**2).sum(axis=2), (radii[:, None] + margin + radius)[:, :, None]
    ball, point, sample = np.nonzero(squared < (apart + 2 * LENGTH) ** 2)
    along = directions @ offset[ball, point, :, sample].T  # (D, pairs)
    under_root = along**2 - (squared - apart**2)[ball, point, sample]
    root = np.sqrt(np.maximum(under_root, 0))
    hit = (under_root > 0) & (root - along > 0) & (-along - root < LENGTH)
    shift = np.where(hit, root - along, 0)
    lowest = (points[:, 2] - radius[:, None])[point, sample]
    return shift.max(axis=1), np.maximum(-(lowest + shift * directions[:, 2:]), 0).max(axis=1)


@pytest.mark.parametrize("seed", range(6))
def test_they_are_those_of_array_operations(seed):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = rng.normal(0, 0.15, (12, 3, 7)) + np.array([0, 0, rng.uniform(-0.1, 0.3)])[:, None]
    radius, centres = rng.uniform(0.02, 0.05, 12), rng.normal(0, 0.1, (5, 3))
    given = directions, points, radius, centres, rng.uniform(0.01, 0.07, 5), rng.uniform(0, 0.05)
    for found, expected in zip(detours(*given, LENGTH), plain(*given), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert (detours(*given, LENGTH)[0] > 0).any()


def test_balls_far_away_are_no_reason_to_move():
    up = np.array([[0.0, 0.0, 1.0]])
    shifts, depths = detours(up, np.zeros((1, 3, 1)), np.full(1, 0.1), np.array([[3.0, 0, 0]]), np.ones(1), 0.0, LENGTH)
    assert shifts[0] == depths[0] == 0
