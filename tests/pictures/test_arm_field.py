"""Velocities of the hand where the whole arm avoids."""

import numpy as np
import pytest
from scenes import changed, frame_at

from dt_viz.arm.arm_system import ArmSystem, Section
from dt_viz.engine.frame import Stage
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.union import Union
from dt_viz.pictures.arm_field import LiftedField
from dt_viz.pictures.slice_fields import FieldPicture


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
    some = FieldPicture(below.points[::37], below.velocities[::37])
    lifted = LiftedField.of(some, robot, reference)
    found = lifted.around(solved.arm.transform, robot, Union(()))
    system = ArmSystem(solved.stack.system, Section(robot, reference), solved.arm.transform)
    p = system.transform.inverse(lifted.postures[:, 0])
    step = 1e-5
    hand = [robot.end_effector(p + sign * step * system.velocity(p)) for sign in (1, -1)]
    expected = (hand[0] - hand[1]) / (2 * step)
    np.testing.assert_allclose(found.points, robot.end_effector(p), atol=1e-6)
    speed = np.linalg.norm(expected, axis=1)
    off = np.linalg.norm(found.velocities - expected, axis=1) / speed
    assert np.median(off) < 0.02 and off.max() < 0.2


def test_without_avoidance_the_field_is_the_one_below_where_the_arm_reaches(scene):
    engine, scenario, below, _ = scene
    robot, reference = engine.follower.robot, engine.follower.reference(engine.nominal(scenario))
    same = LiftedField.of(below, robot, reference).around(Identity(6), robot, Union(()))
    assert len(same.points) == len(below.points)
    np.testing.assert_allclose(same.points, below.points, atol=1e-4)
    np.testing.assert_allclose(same.velocities, below.velocities, atol=0.05 * np.abs(below.velocities).max())
    away = FieldPicture(np.array([[0.0, -0.5, 0.4], [0.0, -3.0, 0.4]]), np.array([[0.1, 0.0, 0.0]] * 2))
    assert len(LiftedField.of(away, robot, reference).seconds) == 1
    still = FieldPicture(below.points[:2], np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    assert len(LiftedField.of(still, robot, reference).seconds) == 1
