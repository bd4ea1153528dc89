"""EFlow (repulsive): nothing beyond the range, away from the obstacle within, EFlow itself before and after."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import central_differences
from plans import eflow_weights as weights

from dt_viz.baselines.eflow import EFlowSystem
from dt_viz.baselines.repulsive import RepulsionSettings, RepulsivePlanner
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.tasks import TASKS

SETTINGS = RepulsionSettings()
SPHERE = Union((Sphere((0.1, -0.5, 0.3), 0.15),))


def at_distances(distances):
    """Points (N, 3) at these distances from the sphere, in the direction x."""
    return np.array(SPHERE.parts[0].position) + np.outer(0.075 + np.array(distances), [1.0, 0.0, 0.0])


def test_it_is_the_gradient_of_its_potential_up_to_a_bound_ends_at_its_range_and_leads_away_inside():
    def potential(y):
        return 0.5 * SETTINGS.gain * (1 / SPHERE.signed_distance(y) - 1 / SETTINGS.range) ** 2

    near = at_distances(np.array([0.9, 0.7, 0.5, 0.3]) * SETTINGS.range)
    expected = -central_differences(potential, near, 1e-5)
    np.testing.assert_allclose(SETTINGS.repulsion(SPHERE, near)[1], expected, rtol=1e-4, atol=1e-9)
    distance, velocity = SETTINGS.repulsion(SPHERE, at_distances([SETTINGS.range + 1e-9, 2 * SETTINGS.range, 1.0]))
    np.testing.assert_allclose(distance, [SETTINGS.range, 2 * SETTINGS.range, 1.0])
    assert not velocity.any()
    np.testing.assert_allclose(
        SETTINGS.repulsion(SPHERE, at_distances([-0.01, -0.05]))[1], [[SETTINGS.strongest, 0, 0]] * 2
    )


@pytest.fixture
def task():
    return TASKS["push_box"]()


@pytest.fixture
def planner(task):
    arrays = weights(task, amplitude=0.003)
    arrays["speed_2"][:, -1] -= 1.5  # as slow as a demonstration
    system = EFlowSystem.of(task, arrays)
    return RepulsivePlanner(system, SETTINGS)


def test_motions_that_stay_out_of_range_are_those_of_eflow(task, planner):
    far = Union((Sphere((0.0, 0.0, 3.0), 0.15),))
    paths, times = planner.system.rollouts(task.starts, LIVE.spacing)
    plan = planner(far, task.starts)
    assert all(np.array_equal(a, b) for a, b in zip((*plan.paths, *plan.times), (*paths, *times), strict=True))


@pytest.fixture
def beside(planner, task):
    """An obstacle beside the first motion."""
    (path,), _ = planner.system.rollouts(task.starts[:1], 0.012)
    return Union((Sphere(as_point(path[len(path) // 2] + [0.0, 0.03, 0.03]), 0.06),))


def test_steps_follow_the_sum_of_both_velocities_and_eflow_goes_on_after_them(task, planner, beside):
    plan = planner(beside, task.starts[:1])
    path, times = plan.paths[0], plan.times[0]
    assert (np.diff(times) > 0).all()
    stepped = np.flatnonzero(np.isclose(np.diff(times), 0.05, rtol=0, atol=1e-12))
    assert len(stepped) > 10
    alone, pushed = planner.system.velocity(path[stepped]), SETTINGS.repulsion(beside, path[stepped])[1]
    np.testing.assert_allclose(path[stepped + 1], path[stepped] + 0.05 * (alone + pushed), atol=1e-6)
    assert np.abs(0.05 * pushed).max() > 1e-4
    assert np.linalg.norm(path[-1] - planner.system.goal) < 1e-6


@pytest.mark.long
def test_finer_steps_converge(task, planner, beside):
    several = (RepulsionSettings(rate) for rate in (20.0, 200.0, 400.0, 800.0))
    *paths, finest = (replace(planner, settings=s)(beside, task.starts[:1]).paths[0] for s in several)
    off = [np.linalg.norm(path[:, None] - finest, axis=2).min(axis=1).max() for path in paths]
    assert off[0] > off[1] > off[2] > 0


def test_before_an_obstacle_on_the_goal_a_motion_stops(task, planner):
    plan = planner(Union((Sphere(as_point(planner.system.goal), 0.1),)), task.starts[:2])
    assert all(0.02 < np.linalg.norm(path[-1] - planner.system.goal) < 0.2 for path in plan.paths)
    assert max(t[-1] for t in plan.times) < SETTINGS.longest + 60
