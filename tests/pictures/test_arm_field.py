"""Velocities of the hand where the whole arm avoids."""

import numpy as np
import pytest
from scenes import avoiding, biases, changed, frame_at

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import Avoidance
from dt_viz.control.courses import Section
from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.pictures.slice_fields import Lattice
from dt_viz.scenario.scenario import Layer
from dt_viz.session.drawing import lattice, rest, system_of, velocities
from dt_viz.session.frame import Stage


@pytest.fixture(scope="module", name="scene", params=["draw_s", "lift_box"])
def _scene(request, engine, initial):
    scenario = changed(initial(request.param), space="cspace")
    below, above = (frame_at(engine, s, Stage.FINE).pictures.field for s in (changed(scenario, obstacles=()), scenario))
    return engine, scenario, below, above


def test_arrows_leave_the_obstacle_and_stay_elsewhere(scene):
    _, scenario, below, above = scene
    assert scenario.obstacle.signed_distance(below.points).min() < -0.05
    assert scenario.obstacle.signed_distance(above.points).min() > 0
    distance = scenario.obstacle.signed_distance(above.points)
    far = distance > np.percentile(distance, 90)
    nearest = np.linalg.norm(above.points[far][:, None] - below.points, axis=2).min(axis=1)
    assert np.median(nearest) < 2e-3


def test_arrows_are_the_hand_s_velocities_of_the_pulled_back_system(scene):
    engine, scenario, below, _ = scene
    solved, robot = engine.solved(scenario, FINE), engine.follower.robot
    reference = engine.follower.reference(solved.nominal)
    lattice = Lattice.of(below.points[::37], robot, reference)
    found = lattice.carried(below.velocities[::37], solved.arm.transform, robot, Union(()))
    p, step = solved.arm.transform.inverse(lattice.postures), 1e-5
    x = robot.end_effector(lattice.postures)
    ways = step * np.array([1, -1])[:, None, None] * solved.stack.system.velocity(x)
    hand = robot.end_effector(solved.arm.transform.inverse(Section(robot, reference).postures(x + ways)))
    expected = (hand[0] - hand[1]) / (2 * step)
    np.testing.assert_allclose(found.points, robot.end_effector(p), atol=1e-6)
    speed = np.linalg.norm(expected, axis=1)
    off = np.linalg.norm(found.velocities - expected, axis=1) / speed
    assert np.median(off) < 0.02 and off.max() < 0.2


def test_there_is_an_arrow_where_the_hand_moves_and_the_arm_reaches(scene):
    engine, scenario, below, _ = scene
    robot, reference = engine.follower.robot, engine.follower.reference(engine.nominal(scenario))
    places = np.array([[0.0, -0.5, 0.4], [0.0, -3.0, 0.4], *below.points[:3]])
    lattice = Lattice.of(places, robot, reference)
    assert lattice.reached.tolist() == [True, False, True, True, True]
    velocities = np.array([[0.1, 0, 0], [0.1, 0, 0], [0, 0, 0], [np.nan] * 3, [0, 0, 0.1]])
    carried = lattice.carried(velocities, Identity(6), robot, Union(()))
    np.testing.assert_allclose(carried.points, places[[0, 4]], atol=1e-3)
    np.testing.assert_allclose(carried.velocities, velocities[[0, 4]], atol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("moves_goal", [False, True])
@pytest.mark.parametrize("task", ["draw_s", "lift_box"])
def test_velocities_are_those_of_the_whole_stack_whether_it_moves_a_place_or_not(engine, task, moves_goal):
    path = engine.task(task).mean_path
    ball, beside = Avoidance((Sphere(as_point(path[30]), 0.1),)), path[-1] + np.array([0.03, 0.0, 0.04])
    layers = (Layer(ball, name="Hand"), *biases(BiasPoint(as_point(beside), moves_goal=moves_goal)))
    frame = frame_at(engine, avoiding(task, layers=layers), Stage.FINE)
    places = lattice(frame)
    alone = system_of(frame, 0).velocity(places)
    found = velocities(frame, alone)
    free, expected = np.isfinite(found[:, 0]), np.full_like(found, np.nan)
    expected[free] = frozen(frame.motion.stack.system, rest(frame)).velocity(places[free])
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8)
    assert 0.02 < (np.abs(found - alone)[free].max(axis=1) > 1e-4).mean() < 0.98
