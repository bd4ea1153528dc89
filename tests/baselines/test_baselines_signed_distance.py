"""The generator on the signed distance beside the laws of its field (tests/laws): it leads in, its reverse out."""

import numpy as np
import pytest

from dt_viz.baselines.registry import problem_of
from dt_viz.baselines.signed_distance import RANGE, SPEED, SignedDistance, SignedDistanceField
from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Scenario

SPHERE = Union((Sphere((0.1, -0.5, 0.3), 0.15),))
CENTRE = np.array(SPHERE.parts[0].position)


def test_the_field_leads_straight_in_at_full_speed_inside_and_ends_at_its_range():
    along = np.array([-0.02, 0.0, 0.5 * RANGE, RANGE, 2 * RANGE]) + 0.075
    field = SignedDistanceField(SPHERE)(CENTRE + np.outer(along, [0, 1, 0]))
    assert np.allclose(field[:, [0, 2]], 0)
    assert np.allclose(field[:, 1], -SPEED * np.array([1, 1, 0.75**2, 0, 0]))


@pytest.fixture(scope="module")
def problem(engine):
    return problem_of(engine.nominal(Scenario("lift_box")).learned, engine.follower)


@pytest.mark.parametrize("shape", [lambda p: Sphere(p, 0.15), lambda p: Box(p, (0.1, 0.1, 0.1))])
def test_motions_keep_the_margin_their_starts_and_the_goal_and_are_the_imitation_where_nothing_is(problem, shape):
    x, y, z = problem.task.mean_path[50] + [0.0, 0.01, 0.02]
    obstacle = Union((shape((x, y, z)),))
    without = problem.learned.demonstrated.paths
    assert min(obstacle.signed_distance(path).min() for path in without) < -0.02
    starts = np.concatenate([problem.task.starts, problem.task.starts[:1] + 0.01])
    plan = SignedDistance().fit(problem).plan(obstacle, starts)
    assert min(obstacle.signed_distance(path).min() for path in plan.paths[:-1]) > 0.008
    for path, times, start in zip(plan.paths, plan.times, starts, strict=True):
        assert np.linalg.norm(path[0] - start) < 5e-4
        assert np.linalg.norm(path[-1] - problem.learned.goal) < 5e-4
        assert (np.diff(times) > 0).all()
    plan = SignedDistance().fit(problem).plan(Union(), problem.task.starts)
    assert all(np.array_equal(a, b) for a, b in zip(plan.paths, problem.learned.demonstrated.paths, strict=True))
