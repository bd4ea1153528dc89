"""Motions that begin where the user wants: rollouts of the same system, which disturb nothing."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scenes import biases, changed, frame_at, says, starts_at

from dt_viz.avoidance.arm_solver import MOVED
from dt_viz.avoidance.avoidance import StartStatus
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.motion.following import NEWEST
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.stack import FINE, LIVE, build_stack
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import WHOLE_ARM, plane_of
from dt_viz.scenario.starts import with_grid
from dt_viz.session.frame import Stage

NUM = 5


@pytest.fixture(params=["draw_s", "lift_box"], name="task")
def _task(request):
    return request.param


def random_starts(engine, scenario, num=NUM, seed=0, room=0.02):
    """Starts on the slice and up to 3 cm beside it, clear of the obstacle and above the table."""
    rng, area = np.random.default_rng(seed), engine.task(scenario.task).slice
    axes = np.column_stack([area.axes, np.cross(*area.axes.T)])
    found = []
    while len(found) < num:
        across = rng.uniform(-1, 1, 3) * (*area.half_size, 0.03)
        start = area.centre + axes @ across
        if start[2] > 0.05 and scenario.obstacle.signed_distance(start) > room:
            found.append(start)
    return starts_at(*found)


def test_added_rollouts_are_motions_of_the_system_that_avoid_the_obstacle_and_end_at_the_goal(engine, initial, task):
    scenario, num = replace(initial(task), view=View(field=False)), len(engine.task(task).demonstrations)
    scenario = replace(scenario, starts=random_starts(engine, scenario, seed=1))
    frame = frame_at(engine, scenario, Stage.FINE)
    system = build_stack(engine.nominal(scenario), scenario.active, FINE).system
    assert len(frame.rollouts) == num + NUM
    for start, path, times in zip(scenario.starts, frame.rollouts[num:], frame.times[num:], strict=True):
        np.testing.assert_allclose(path[0], start.place, atol=1e-6)
        np.testing.assert_allclose(path[-1], frame.goal, atol=1e-4)
        there = system.rollout(np.array([start.place]), times)[0]
        np.testing.assert_allclose(there[:-1], path[:-1], atol=1e-5)
        assert (np.diff(system.lyapunov(path)) < 0).all()
    without = frame_at(engine, changed(scenario, avoids=False), Stage.ROLLOUTS)
    before, after = (
        min(scenario.obstacle.signed_distance(path).min() for path in shown.rollouts[num:])
        for shown in (without, frame)
    )
    assert before < 0 < after


def test_a_bias_and_the_demonstrated_rollouts_are_those_without_added_starts(engine, initial, task):
    target = engine.task(task).mean_path[45] + np.array([0.0, 0.0, 0.06])
    x, y, z = (float(c) for c in target)
    layers = biases(BiasPoint((x, y, z), plane=plane_of(engine.task(task))))
    before = changed(initial(task), obstacles=(), layers=layers)
    after = replace(before, starts=random_starts(engine, before, seed=2))
    solutions = [build_stack(engine.nominal(scenario), scenario.active, FINE) for scenario in (before, after)]
    (a,), (b,) = ([applied.made for applied in solution.built] for solution in solutions)
    assert a.chosen == b.chosen and a.warnings == b.warnings == ()
    places = solutions[0].bundle.levels[:, 0]
    np.testing.assert_array_equal(a.transform.inverse(places), b.transform.inverse(places))
    for path, other in zip(solutions[0].bundle.paths, solutions[1].bundle.paths, strict=False):
        np.testing.assert_allclose(path[[0, -1]], other[[0, -1]], atol=1e-6)
        assert max(np.linalg.norm(other - point, axis=1).min() for point in path) < 0.006


def test_the_whole_arm_makes_way_for_the_task_and_names_the_added_starts_that_it_does_not_suit(engine, initial):
    scenario = changed(initial("draw_s"), space="cspace")
    area, reaches = engine.task("draw_s").slice, engine.follower.robot.reaches
    grid = with_grid(changed(scenario, space="task"), area, lambda places: np.zeros(len(places)), reaches)
    alone, frame = (frame_at(engine, replace(scenario, starts=starts), Stage.LIVE) for starts in ((), grid.starts))
    assert frame.durations[WHOLE_ARM] == pytest.approx(alone.durations[WHOLE_ARM], rel=1e-3)
    assert frame.certificates.clearance == pytest.approx(alone.certificates.clearance, abs=1e-4)
    for path, other in zip(alone.rollouts, frame.rollouts, strict=False):
        assert max(np.linalg.norm(other - point, axis=1).min() for point in path) < 5e-3
    assert not says(frame, "finds no way")
    named = " ".join(map(str, frame.certificates.warnings))
    solved = engine.solved(replace(scenario, starts=grid.starts), LIVE)
    nominal, arm = solved.nominal, solved.arm
    doubtful = arm.too_near | arm.moved
    assert doubtful.any()
    for added in np.flatnonzero(doubtful):
        assert re.search(rf"added starts? [\d, ]*\b{added - 6}\b", named)
    for added in np.flatnonzero(nominal.moving & nominal.added & ~doubtful):
        np.testing.assert_allclose(frame.rollouts[added][0], grid.starts[added - 7].place, atol=MOVED)
        assert engine.follower.whole_arm.clearance(arm.p[arm.index == added], scenario.obstacle).min() > 0


@pytest.mark.parametrize("space", ["task", "cspace"])
def test_the_arm_follows_an_added_rollout_clear_of_the_obstacle(engine, initial, robot, space):
    scenario = changed(initial("push_box"), space=space, view=View(field=False, health_plots=True))
    scenario = replace(scenario, starts=random_starts(engine, scenario, seed=3, room=0.12), arm_rollout=7 + 2)
    frame = frame_at(engine, scenario, Stage.FINE)
    assert len(frame.rollouts) == 7 + NUM and frame.certificates.clearance > 0
    for start, path in zip(scenario.starts, frame.rollouts[7:], strict=True):
        np.testing.assert_allclose(path[0], start.place, atol=2e-3)
        np.testing.assert_allclose(path[-1], frame.goal, atol=2e-3)
        assert scenario.obstacle.signed_distance(path).min() > 0
    assert frame.chosen == 9 and frame.arm is not None
    hand = robot.end_effector(frame.arm.q)
    np.testing.assert_allclose(hand[[0, -1]], [scenario.starts[2].place, frame.goal], atol=2e-3)
    assert frame.profiles is not None and frame.profiles.of_mean
    assert not frame_at(engine, replace(scenario, arm_rollout=3), Stage.FINE).profiles.of_mean


@pytest.mark.parametrize("space", ["task", "cspace"])
def test_a_start_out_of_reach_is_said_to_be_and_blocks_nothing(engine, initial, space):
    near, far = (0.2, -0.5, 0.3), (1.5, -0.5, 0.3)
    scenario = changed(
        initial("push_box"),
        space=space,
        view=View(field=False, arm=True),
        starts=starts_at(near, far, near),
        arm_rollout=7 + 1,
    )
    frame = frame_at(engine, scenario, Stage.FINE)
    assert not frame.blocked and frame.arm is None
    texts = [warning.text for warning in frame.certificates.warnings]
    assert texts.count("added start 2 is out of the arm's reach") == 1
    assert [len(path) > 0 for path in frame.rollouts[7:]] == [True, space == "task", True]
    other = frame_at(engine, replace(scenario, arm_rollout=9), Stage.FINE)
    assert other.arm is not None and other.chosen == len(other.rollouts) - 1
    np.testing.assert_allclose(other.rollouts[other.chosen][0], near, atol=2e-3)


@pytest.mark.parametrize("space", ["task", "cspace"])
def test_a_start_inside_the_obstacle_is_said_to_be(engine, initial, space):
    scenario = changed(initial("push_box"), space=space)
    frame = frame_at(engine, replace(scenario, starts=starts_at(scenario.obstacles[0].position)), Stage.ROLLOUTS)
    assert not frame.blocked and says(frame, "added start 1 is inside the obstacle")


def test_an_added_start_at_the_goal_stays_there(engine, initial):
    scenario = changed(initial("draw_s"), obstacles=())
    goal = engine.nominal(scenario).goal
    frame = frame_at(engine, replace(scenario, starts=starts_at(goal), arm_rollout=7), Stage.FINE)
    np.testing.assert_allclose(frame.rollouts[-1], np.broadcast_to(goal, frame.rollouts[-1].shape), atol=1e-6)
    assert frame.arm is not None and np.isfinite(frame.arm.q).all()


def test_dragging_a_start_keeps_only_the_newest_rollouts(new_engine, initial):
    engine, scenario = new_engine(), initial("draw_s")
    for x in np.linspace(-0.1, 0.1, 110):
        moved = replace(scenario, starts=starts_at((x, -0.5, 0.45)))
        assert isinstance(engine.nominal(moved), Nominal)
    assert engine.memo.count("Engine._added") == NEWEST < 110
    assert engine.memo.count("Engine._nominal") == 4


def test_starts_that_are_left_out_are_named_and_of_two_reasons_the_first_stays(engine, initial):
    nominal = engine.nominal(initial("lift_box"))
    some = nominal.without(np.isin(np.arange(len(nominal.starts)), [1, 2]), StartStatus.NO_WAY)
    (warning,) = some.warnings
    assert warning.text == "starts 2, 3 are without a way around the obstacle for the arm"
    none = some.without(np.ones(len(nominal.starts), bool), StartStatus.IN_COLLISION)
    assert none.status[1:4:2] == (StartStatus.NO_WAY, StartStatus.IN_COLLISION)


def test_a_motion_that_begins_inside_the_obstacle_needs_no_longer_flow_than_the_others(engine, initial):
    """It is not asked for the margin before it can have it."""
    scenario = initial("draw_s")
    (obstacle,) = scenario.obstacles
    inside = tuple(c + d for c, d in zip(obstacle.position, (0.0, 0.0, 0.07), strict=True))
    before, after = (
        build_stack(engine.nominal(s), s.active, LIVE) for s in (scenario, replace(scenario, starts=starts_at(inside)))
    )
    assert all(applied.satisfied for applied in (*before.built, *after.built))
    assert after.built[0].made.duration < 1.5 * before.built[0].made.duration
