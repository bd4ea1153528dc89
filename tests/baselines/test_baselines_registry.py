"""The methods by name, ours among them, the problems that they are fitted to, and modulation, which lets nothing in."""

import numpy as np
import pytest
from oracles import stepped

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.modulation import fit, modulated
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.errors import UnwantedError
from dt_viz.metrics import distance_from_path
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Scenario


@pytest.fixture(scope="module")
def in_the_way(problem):
    """A ball on the motions, a little above their middle."""
    return Union((Sphere(as_point(problem.task.mean_path[50] + [0.0, 0.0, 0.02]), 0.15),))


def test_methods_are_known_by_their_name_and_promise_stability_unless_they_plan_a_path_once():
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


# modulation


SPHERE = Union((Sphere((0.1, -0.5, 0.3), 0.15),))
OBSTACLES = (
    SPHERE,
    Union((Box((0.1, -0.5, 0.3), (0.1, 0.12, 0.2)),)),
    Union((Cylinder((0.1, -0.5, 0.3), 0.1, 0.2),)),
    Union((Sphere((0.1, -0.5, 0.3), 0.1), Sphere((0.0, -0.4, 0.3), 0.08))),
)


def on_surface(obstacle, count=200):
    """Points (N, 3) on the surface of a union, by steps along the normals."""
    y = np.array(obstacle.parts[0].position) + np.random.default_rng(0).normal(size=(count, 3)) * 0.15
    for _ in range(100):
        distance, normal = obstacle.distance_and_normal(y)
        y = y - distance[:, None] * normal
    return y[np.abs(obstacle.signed_distance(y)) < 1e-9]


@pytest.mark.parametrize("obstacle", OBSTACLES)
def test_on_the_surface_nothing_flows_into_the_obstacle_and_far_away_the_velocity_is_the_nominal_one(obstacle):
    y, rng = on_surface(obstacle), np.random.default_rng(1)
    v, normal = rng.normal(size=y.shape), obstacle.distance_and_normal(y)[1]
    assert len(y) > 100
    inward, before = (-np.einsum("nd,nd->n", normal, u) for u in (modulated(obstacle, y, v), v))
    assert inward.max() < 1e-6 and before.max() > 0.5
    assert np.abs(modulated(obstacle, 1000 * y, v) - v).max() < 1e-4 * np.abs(v).max()


def test_where_it_leads_away_the_radial_velocity_stays_and_without_an_obstacle_all_of_it():
    y = on_surface(SPHERE)
    away = 0.1 * SPHERE.distance_and_normal(y)[1]
    np.testing.assert_allclose(modulated(SPHERE, y, away), away, rtol=1e-5)
    assert modulated(Union(), y, away) is away


def test_motions_are_those_of_the_modulated_velocity_reach_the_goal_and_stay_outside(problem, in_the_way, monkeypatch):
    monkeypatch.setattr("dt_viz.baselines.modulation.TOLERANCE", 1e-4)
    start, system = problem.task.starts[:1], problem.learned.system
    plan = fit(problem)(in_the_way, start)
    (path,), (times,) = plan.paths, plan.times
    some = np.linspace(0, 0.6 * times[-1], 16)
    at = np.stack([np.interp(some, times, axis) for axis in path.T], axis=1)
    oracle = stepped(lambda y: modulated(in_the_way, y, system.velocity(y)), start, some, 5)[0]
    assert np.linalg.norm(at - oracle, axis=1).max() < 3e-3
    assert np.linalg.norm(at - system.rollout(start[0], some), axis=1).max() > 0.02  # it is not the imitation
    assert np.linalg.norm(path[-1] - problem.learned.goal) < 1e-6
    assert in_the_way.signed_distance(path).min() > 0
    assert (np.diff(times) > 0).all()


def test_on_the_page_it_stays_near_the_motion_that_is_exact(problem, in_the_way, monkeypatch):
    planner, start = fit(problem), problem.task.starts[:1]
    (quick,) = planner(in_the_way, start).paths
    monkeypatch.setattr("dt_viz.baselines.modulation.TOLERANCE", 1e-5)
    (exact,) = planner(in_the_way, start).paths
    assert distance_from_path(quick, exact).max() < 0.01


def test_a_task_in_augmented_states_is_refused_by_one_line(engine):
    drawn = problem_of(engine.nominal(Scenario("draw_8")).learned, engine.follower)
    with pytest.raises(NotFittedError, match="augmented"):
        fit(drawn)


def test_a_motion_straight_at_the_centre_stops_before_the_obstacle(problem):
    start = problem.task.starts[:1]
    direction = problem.learned.system.velocity(start)[0]
    obstacle = Union((Sphere(as_point(start[0] + 0.09 * direction / np.linalg.norm(direction)), 0.15),))
    (path,) = fit(problem)(obstacle, start).paths
    assert obstacle.signed_distance(path).min() > -1e-3
