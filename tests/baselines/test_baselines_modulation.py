"""Modulation: nothing flows into an obstacle, nothing changes far away, and motions are those of the velocity."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.baselines import modulation
from dt_viz.baselines.modulation import Modulation, modulated
from dt_viz.baselines.surface import distance_and_normal
from dt_viz.flows.systems import stepped
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere
from dt_viz.obstacles.union import Union

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
        distance, normal = distance_and_normal(obstacle, y)
        y = y - distance[:, None] * normal
    return y[np.abs(obstacle.signed_distance(y)) < 1e-9]


def inward(obstacle, velocities, y):
    """Largest speed into the obstacle, relative to the velocities."""
    _, normal = distance_and_normal(obstacle, y)
    return (-np.einsum("nd,nd->n", normal, velocities) / np.linalg.norm(velocities, axis=1)).max()


@pytest.mark.parametrize("obstacle", OBSTACLES)
def test_on_the_surface_nothing_flows_into_the_obstacle(obstacle):
    y = on_surface(obstacle)
    v = np.random.default_rng(1).normal(size=y.shape)
    assert len(y) > 100
    assert inward(obstacle, modulated(obstacle, y, v)[0], y) < 1e-6
    assert inward(obstacle, v, y) > 0.5  # as it was


@pytest.mark.parametrize("obstacle", OBSTACLES)
def test_far_away_the_velocity_is_the_nominal_one(obstacle):
    far = np.random.default_rng(2).normal(size=(50, 3))
    far *= 100 / np.linalg.norm(far, axis=1, keepdims=True)
    v = np.random.default_rng(3).normal(size=far.shape)
    assert np.abs(modulated(obstacle, far, v)[0] - v).max() < 1e-4 * np.abs(v).max()
    near = far / 400
    assert np.abs(modulated(obstacle, near, v)[0] - v).max() > 0.01


def test_where_it_leads_away_the_radial_velocity_stays():
    y = on_surface(SPHERE)
    _, normal = distance_and_normal(SPHERE, y)
    assert np.allclose(modulated(SPHERE, y, 0.1 * normal)[0], 0.1 * normal)


def test_without_an_obstacle_nothing_is_modulated():
    v = np.ones((3, 3))
    assert modulated(Union(), np.zeros((3, 3)), v)[0] is v


def departure(plan, places, times):
    """Largest distance, metres, of the first motion of a plan from places (T, 3) at times."""
    path, t = plan.paths[0], plan.times[0]
    return np.linalg.norm(places - np.stack([np.interp(times, t, axis) for axis in path.T], axis=1), axis=1).max()


def test_motions_are_those_of_the_modulated_velocity_reach_the_goal_and_stay_outside(problem):
    x, y, z = problem.task.mean_path[50]
    obstacle = Union((Sphere((x, y, z + 0.02), 0.15),))
    plan = Modulation(tolerance=1e-4).fit(problem).plan(obstacle, problem.task.starts[:1])
    system, start = problem.learned.system, problem.task.starts[:1]
    times = np.linspace(0, 0.6 * plan.times[0][-1], 16)
    oracle = stepped(lambda y: modulated(obstacle, y, system.velocity(y))[0], start, times, 5)[0]
    assert departure(plan, oracle, times) < 3e-3
    assert departure(plan, system.rollout(start[0], times), times) > 0.02  # another velocity would be found
    assert np.linalg.norm(plan.paths[0][-1] - problem.learned.goal) < 1e-6
    assert obstacle.signed_distance(plan.paths[0]).min() > 0
    assert (np.diff(plan.times[0]) > 0).all()


def test_without_an_obstacle_the_motions_are_the_imitation(problem):
    plan = Modulation(tolerance=1e-4).fit(problem).plan(Union(), problem.task.starts)
    system = problem.learned.system
    for path, times in zip(plan.paths, plan.times, strict=True):
        exact = system.rollout(path[0], times[:-1])
        assert np.linalg.norm(path[:-1] - exact, axis=1).max() < 5e-3


def test_on_the_page_it_stays_near_the_motion_that_is_exact(problem):
    x, y, z = problem.task.mean_path[50]
    obstacle = Union((Sphere((x, y, z + 0.02), 0.15),))
    quick, exact = (Modulation(t).fit(problem).plan(obstacle, problem.task.starts[:2]) for t in (1.5e-3, 1e-5))
    for a, b in zip(quick.paths, exact.paths, strict=True):
        assert np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1).max() < 0.01


def test_the_table_moves_motions_by_less_than_a_tenth_of_a_millimetre(problem):
    x, y, z = problem.task.mean_path[50]
    obstacle, starts = Union((Sphere((x, y, z + 0.02), 0.15),)), problem.task.starts
    planner = Modulation().fit(problem)
    assert isinstance(planner, modulation._Planner)
    exact = replace(planner, system=problem.learned.system).plan(obstacle, starts)
    apart = [np.abs(a - b).max() for a, b in zip(planner.plan(obstacle, starts).paths, exact.paths, strict=True)]
    assert 0 < max(apart) < 1e-4


def test_a_motion_straight_at_the_centre_stops_before_the_obstacle(problem):
    system, start = problem.learned.system, problem.task.starts[:1]
    direction = system.velocity(start)[0]
    direction /= np.linalg.norm(direction)
    x, y, z = start[0] + 0.09 * direction
    obstacle = Union((Sphere((x, y, z), 0.15),))
    plan = Modulation().fit(problem).plan(obstacle, start)
    assert obstacle.signed_distance(plan.paths[0]).min() > -1e-3
