"""The generator on the signed distance: a field that leads inwards, whose reverse flow clears motions."""

import numpy as np
import pytest

from dt_viz.baselines.registry import problem_of
from dt_viz.baselines.signed_distance import RANGE, SPEED, SignedDistance, SignedDistanceField
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, min_det_jacobian, round_trip_error
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


class WrongField(SignedDistanceField):
    """A field whose derivative is of another speed."""

    def with_jacobian(self, s):
        V, DV = super().with_jacobian(s)
        return V, 1.01 * DV


def derivative_error(field, s, h=1e-4):
    _, D = field.with_jacobian(s)
    columns = [(field(s + e) - field(s - e)) / (2 * h) for e in h * np.eye(3)]
    return np.abs(D - np.stack(columns, axis=-1)).max()


def test_its_derivative_is_that_of_finite_differences_and_its_flow_a_diffeomorphism():
    s = CENTRE + np.random.default_rng(0).normal(size=(60, 3)) * 0.06 + [0.1, 0, 0]
    field = SignedDistanceField(SPHERE)
    assert derivative_error(field, s) < 2e-3
    assert derivative_error(WrongField(SPHERE), s) > 5e-3
    outside = s[SPHERE.signed_distance(s) > 0.03]
    flow = AdaptiveFlow(field, 0.1, 1e-9)
    assert round_trip_error(flow, outside) < 1e-6
    assert min_det_jacobian(flow.jacobian, outside) > 0


@pytest.fixture(scope="module")
def problem(engine):
    return problem_of(engine.nominal(Scenario("lift_box")).learned, engine.follower)


@pytest.mark.parametrize("shape", [lambda p: Sphere(p, 0.15), lambda p: Box(p, (0.1, 0.1, 0.1))])
def test_motions_keep_the_margin_begin_at_their_starts_and_end_at_the_goal(problem, shape):
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


def test_without_an_obstacle_the_motions_are_the_imitation(problem):
    plan = SignedDistance().fit(problem).plan(Union(), problem.task.starts)
    assert all(np.array_equal(a, b) for a, b in zip(plan.paths, problem.learned.demonstrated.paths, strict=True))
