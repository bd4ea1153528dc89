"""The methods by name, ours among them, and the problems that they are fitted to."""

import numpy as np
import pytest

from dt_viz.baselines.registry import METHODS, TRAINED
from dt_viz.errors import UnwantedError
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union


@pytest.fixture(scope="module")
def in_the_way(problem):
    return Union((Sphere(problem.task.obstacle_position, 0.15),))


def test_methods_are_known_by_their_name_and_promise_stability_unless_they_plan_a_path_once():
    assert TRAINED.keys() <= METHODS.keys()
    assert [method.name for method in METHODS.values()] == list(METHODS)
    assert all(method.promise.startswith("Stable") == method.stable for method in METHODS.values())
    stable = {name for name, method in METHODS.items() if method.stable}
    assert stable == {"ours", "ours-no-avoidance", "eflow"}


def test_the_arm_follows_each_demonstration(problem, robot):
    for posture, path in zip(problem.postures, problem.task.paths, strict=True):
        assert np.linalg.norm(robot.end_effector(posture) - path, axis=1).max() < 1e-4


def test_our_whole_arm_clears_the_obstacle_and_says_its_joints(problem, in_the_way, robot):
    starts = np.concatenate([problem.task.starts[2:3], problem.task.starts[:2], problem.task.starts[:1] + 0.01])
    plan = METHODS["ours"].fit(problem)(in_the_way, starts)
    assert plan.joints is not None
    for path, q, times, start in zip(plan.paths, plan.joints, plan.times, starts, strict=True):
        assert np.array_equal(robot.end_effector(q), path)
        assert len(q) == len(times) and (np.diff(times) > 0).all()
        assert (np.abs(np.diff(q, axis=0)) <= 1.001 * np.outer(np.diff(times), robot.velocity_limits)).all()
        assert np.linalg.norm(path[0] - start) < 5e-3
        assert np.linalg.norm(path[-1] - problem.learned.goal) < 1e-4
        assert in_the_way.signed_distance(path).min() > 0
    alone = METHODS["ours-no-avoidance"].fit(problem)(in_the_way, starts)
    assert min(in_the_way.signed_distance(path).min() for path in alone.paths) < -0.02
    assert all(path[0] == pytest.approx(start) for path, start in zip(alone.paths, starts, strict=True))


def test_where_nothing_can_move_the_arm_stays_at_its_starts(problem, robot):
    x, y, z = problem.learned.goal
    plan = METHODS["ours"].fit(problem)(Union((Sphere((x, y, z), 0.15),)), problem.task.starts[:2])
    assert [len(path) for path in plan.paths] == [1, 1]
    assert np.linalg.norm(np.concatenate(plan.paths) - problem.task.starts[:2], axis=1).max() < 1e-4


@pytest.mark.parametrize("name", ["eflow-repulsive", "mpnet"])
def test_a_plan_that_is_cancelled_ends(problem, in_the_way, name):
    planner, calls = METHODS[name].fit(problem), []

    def cancelled():
        calls.append(0)
        return len(calls) == 5

    with pytest.raises(UnwantedError):
        planner(in_the_way, problem.task.starts[:2], cancelled)
    assert len(calls) == 5
