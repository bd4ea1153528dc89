"""The hand is held by the user: the arm follows, and goes on to the goal from wherever it is let go."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import used_fraction
from scenes import changed

from dt_viz.arm.arm_system import Section
from dt_viz.engine.frame import Stage
from dt_viz.motion.following import MAX_TRACKING_ERROR
from dt_viz.motion.stack import LIVE, build_stack

STEPS = 6
"""Events of a drag, two centimetres apart."""


@pytest.fixture(params=["draw_s", "push_box"], name="task")
def _task(request):
    return request.param


@pytest.fixture(params=["task", "cspace", "both"], name="space")
def _space(request):
    return request.param


def shown(engine, scenario):
    return next(frame for frame in engine.frames(scenario) if frame.stage is Stage.LIVE)


def drags(engine, scenario, robot, num=4):
    """The frame, and where the hand should be and what the arm does then, along random drags."""
    frame, rng = shown(engine, scenario), np.random.default_rng(5)
    for moment in np.linspace(0.1, 0.8, num):
        q = frame.arm.q[int(moment * len(frame.arm.q))]
        place, step = robot.end_effector(q), rng.normal(size=3) * (1, 1, 0.5)
        for _ in range(STEPS):
            place = place + 0.02 * step / np.linalg.norm(step)
            found = engine.held(scenario, q, place)
            yield frame, q, place, found
            q = found.motion.q[0]


def test_the_hand_is_where_it_is_held_and_goes_on_to_the_goal(engine, initial, robot, task, space):
    num_right = 0
    for frame, q, place, found in drags(engine, changed(initial(task), space=space), robot):
        motion, there = found.motion, robot.end_effector(found.motion.q)
        assert (motion.q >= robot.lower).all() and (motion.q <= robot.upper).all()
        assert np.abs(motion.q[0] - q).max() < 0.25 and np.abs(np.diff(motion.q, axis=0)).max() < 0.15
        assert used_fraction(motion.times, motion.q, robot.velocity_limits) < 1 + 1e-6
        np.testing.assert_allclose(there, found.path, atol=MAX_TRACKING_ERROR)
        np.testing.assert_allclose(there[-1], frame.goal, atol=1e-3)
        if not found.warning:
            num_right += 1
            np.testing.assert_allclose(there[0], place, atol=1e-3)
            assert frame.scenario.obstacle.signed_distance(there).min() > 0
    assert num_right > 12


def test_the_motion_from_there_is_one_of_the_system(engine, initial, robot, task):
    scenario = initial(task)
    system = build_stack(engine.nominal(scenario), scenario.active, LIVE).system
    for _, _, place, found in drags(engine, scenario, robot):
        np.testing.assert_allclose(found.path[0], place, atol=1e-3)
        z = system.transform.forward(found.path)
        to_goal = system.base.goal - z[0]
        aside = (z - z[0]) - np.outer((z - z[0]) @ to_goal, to_goal) / (to_goal @ to_goal)
        assert np.abs(aside).max() < 3e-3  # a straight ray in base space, where ψ stretches what LIVE rounds
        assert (np.diff(system.base.potential(z)) < 0).all()


def test_the_arm_gives_way_by_its_transform_while_it_is_held(engine, initial, robot):
    """Its postures are those of eq. (4): ψ_q leads each to the section that the undisturbed motion is lifted by."""
    scenario = changed(initial("push_box"), space="cspace")
    for _, _, _, found in drags(engine, scenario, robot):
        solved = engine.solved(scenario, LIVE)
        section = Section(robot, engine.follower.reference(solved.nominal))
        q = solved.arm.transform.forward(found.motion.q[::30])
        np.testing.assert_allclose(section.postures(robot.end_effector(q)[:, None])[:, 0], q, atol=5e-3)


def test_where_the_arm_cannot_reach_it_stretches_towards_the_pointer_and_says_so(engine, initial, robot):
    scenario = changed(initial("push_box"), obstacles=())
    frame = shown(engine, scenario)
    q = frame.arm.q[40]
    hand = robot.end_effector(q)
    away = np.array([0.6, -0.8, 0.2])
    distances, place = [], hand
    for step in np.arange(0.02, 1.4, 0.06):
        place = hand + step * away
        found = engine.held(scenario, q, place)
        q = found.motion.q[0]
        distances.append(np.linalg.norm(robot.end_effector(q) - place))
        assert (distances[-1] > MAX_TRACKING_ERROR) == (found.warning == "out of the arm's reach")
        np.testing.assert_allclose(robot.end_effector(found.motion.q[-1]), frame.goal, atol=1e-3)
    shoulder = robot.joint_translations[0] + robot.joint_rotations[0] @ robot.joint_translations[1]
    least = np.linalg.norm(place - shoulder) - robot.reach
    assert distances[0] < 1e-3 and least - 2e-3 < distances[-1] < least + 2e-3


def test_a_hand_that_is_held_in_the_obstacle_is_said_to_be(engine, initial, robot, space):
    scenario = changed(initial("push_box"), space=space)
    frame = shown(engine, scenario)
    inside = np.array(scenario.obstacles[0].position) + np.array([0.0, 0.0, 0.03])
    near = min(frame.arm.q, key=lambda q: np.linalg.norm(robot.end_effector(q) - inside))
    found = engine.held(scenario, near, inside)
    assert found.warning == "inside the obstacle"
    np.testing.assert_allclose(robot.end_effector(found.motion.q[-1]), frame.goal, atol=1e-3)


@pytest.mark.parametrize("direction", [(0.5, -0.6, 0.6), (0.0, -1.0, 0.0), (-0.7, -0.1, 0.7)])
def test_a_pointer_out_of_reach_is_said_to_be_and_no_other(engine, initial, robot, space, direction):
    """Wherever the search for the place of the motion below gives up."""
    scenario = changed(initial("draw_s"), space=space)
    frame = shown(engine, scenario)
    shoulder = robot.joint_translations[0] + robot.joint_rotations[0] @ robot.joint_translations[1]
    q = frame.arm.q[len(frame.arm.q) // 2]
    for distance in (4.0, 1.2 * robot.reach, 0.6 * robot.reach):
        place = shoulder + distance * np.array(direction) / np.linalg.norm(direction)
        warning = engine.held(scenario, q, place).warning
        assert (warning == "out of the arm's reach") == (distance > robot.reach)


@pytest.mark.parametrize("change", [{"warp": 0.0}, {"warp": 0.4}, {"avoids": False}])
def test_nothing_is_said_of_an_obstacle_that_is_not_avoided_or_not_yet(engine, initial, robot, space, change):
    """As of the motion itself."""
    scenario = changed(initial("draw_s"), space=space, **change)
    for q in shown(engine, scenario).arm.q[::50]:
        place = robot.end_effector(q)
        if scenario.obstacle.signed_distance(place) > 0:
            assert engine.held(scenario, q, place).warning == ""


def test_nothing_is_held_that_is_not_shown(new_engine, initial, robot):
    engine, scenario = new_engine(), initial("push_box")
    place = robot.end_effector(robot.home)
    assert engine.held(scenario, robot.home, place) is None
    shown(engine, scenario)
    assert engine.held(replace(scenario, arm_rollout=1), robot.home, place) is None
    assert engine.held(replace(scenario, view=replace(scenario.view, field=False)), robot.home, place) is not None
