"""MPNet: the network, the search from both ends, what it does without obstacles in its demonstrations, and with RRT."""

from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from other_arms import OTHER_ARMS
from plans import joints_of

from assets.mpnet_training import initial, loss_and_gradient, train
from dt_viz.baselines import mpnet
from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.mpnet import Network, Search
from dt_viz.baselines.postures import PlanningScene, fit_straight
from dt_viz.errors import UnwantedError
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco

needs_ompl = pytest.mark.skipif(find_spec("ompl") is None, reason="ompl is an extra")


def weights(seed=0):
    """Some weights, as training leaves them."""
    rng = np.random.default_rng(seed)
    return {**initial(6, rng), "centre": rng.normal(size=6), "scale": rng.uniform(0.1, 1, size=6)}


@pytest.fixture(scope="module")
def in_the_way(problem):
    """A ball on the straight way of the joints from the first start."""
    straight = fit_straight(problem)(Union(), problem.task.starts[:1])
    return Union((Sphere(as_point(straight.paths[0][100]), 0.15),))


def search(free):
    """A search on a line: postures differ in their first joint only, and `free` decides of two of its values."""

    line = SimpleNamespace(robot=SimpleNamespace(clip=np.asarray), is_free=lambda start, end: free(start[0], end[0]))
    model = Network.of(weights())
    return Search(model, cast(PlanningScene, line), np.random.default_rng(0))


def at(*values):
    return [np.array([value, 0.0, 0, 0, 0, 0]) for value in values]


class TestModel:
    @pytest.mark.parametrize("fit", [mpnet.fit, mpnet.fit_rrt])
    @pytest.mark.parametrize("arm", OTHER_ARMS)
    def test_for_another_arm_it_says_whose_weights_they_are(self, problem, fit, arm):
        with pytest.raises(NotFittedError, match=r"^trained for the JACO only$"):
            fit(replace(problem, robot=OTHER_ARMS[arm]()))


class TestSearch:
    def test_contraction_keeps_what_straight_lines_cannot_do_without(self):
        near = search(lambda a, b: abs(a - b) <= 1.0)
        assert [q[0] for q in near.contracted(at(0, 0.5, 1, 1.5, 2, 5, 5.5))] == [0, 1, 2, 5, 5.5]
        assert [q[0] for q in search(lambda a, b: True).contracted(at(0, 1, 2, 3))] == [0, 3]

    def test_only_colliding_stretches_are_planned_again(self):
        asked = []

        def replan(_, a, b):
            asked.append((a[0], b[0]))
            return at(a[0], 10, b[0])

        near = search(lambda a, b: abs(a - b) <= 1.0 and 2 not in (a, b))
        way = near.replanned(at(0, 1, 2, 3, 4), replan)
        assert asked == [(1, 3)]
        assert [q[0] for q in way] == [0, 1, 10, 3, 4]


class TestPlanning:
    def test_where_the_straight_line_is_free_it_is_taken(self, problem):
        straight = fit_straight(problem)(Union(), problem.task.starts[:2])
        plan = mpnet.fit(problem)(Union(), problem.task.starts[:2])
        for a, b in zip(joints_of(plan), joints_of(straight), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
        assert not plan.warnings

    @pytest.mark.long
    def test_a_run_repeats_and_says_what_collides(self, problem, in_the_way):
        first, second = (mpnet.fit(problem)(in_the_way, problem.task.starts[:1]) for _ in range(2))
        (q,) = joints_of(first)
        np.testing.assert_array_equal(q, joints_of(second)[0])
        assert load_jaco().collision.nearest_to_obstacle(q, in_the_way).distance < 0  # its encoder knows of none
        assert first.warnings
        np.testing.assert_array_equal(q[[0, -1]], problem.postures[0][[0, -1]])
        assert len(q) > 200  # it did not stay with the straight line


class TestRRT:
    @needs_ompl
    def test_its_motions_are_free_and_repeat(self, problem, in_the_way):
        planner = mpnet.fit_rrt(problem)
        first, second = (planner(in_the_way, problem.task.starts[:1]) for _ in range(2))
        (q,) = joints_of(first)
        np.testing.assert_array_equal(q, joints_of(second)[0])
        report = load_jaco().collision.report(q, in_the_way)
        assert report.obstacle.distance > 0 and report.table.distance > 0
        assert report.itself is None or report.itself.distance > 0
        assert not first.warnings
        np.testing.assert_array_equal(q[[0, -1]], problem.postures[0][[0, -1]])
        assert (q >= problem.robot.lower).all() and (q <= problem.robot.upper).all()

    @needs_ompl
    def test_what_there_is_no_time_for_stays_in_collision_and_says_so(self, problem, in_the_way):
        plan = mpnet.fit_rrt(problem, seconds=0.0)(in_the_way, problem.task.starts[:1])
        assert load_jaco().collision.nearest_to_obstacle(joints_of(plan)[0], in_the_way).distance < 0
        assert "from 1 of 1 starts collide" in plan.warnings[0]

    @needs_ompl
    def test_an_exception_within_ompl_ends_it(self, problem, in_the_way):
        alone, calls = [], []
        mpnet.fit(problem)(in_the_way, problem.task.starts[:1], lambda: alone.append(0) is not None)

        def cancelled():
            calls.append(0)
            return len(calls) == len(alone) + 20

        planner = mpnet.fit_rrt(problem)
        with pytest.raises(UnwantedError):
            planner(in_the_way, problem.task.starts[:1], cancelled)
        assert len(calls) == len(alone) + 20


class TestTraining:
    def test_the_gradient_is_that_of_finite_differences(self):
        arrays, rng = weights(), np.random.default_rng(1)
        x, y, h = rng.normal(size=(5, 12)), rng.normal(size=(5, 6)), 1e-6
        slopes = loss_and_gradient(arrays, x, y, np.random.default_rng(2))[1]
        for name, slope in slopes.items():
            along = rng.normal(size=slope.shape)
            beside = ({**arrays, name: arrays[name] + side * h * along} for side in (1, -1))
            ahead, behind = (loss_and_gradient(moved, x, y, np.random.default_rng(2))[0] for moved in beside)
            assert (slope * along).sum() == pytest.approx((ahead - behind) / (2 * h), rel=1e-4, abs=1e-9)

    @pytest.mark.long
    def test_what_training_returns_can_be_planned_with(self, problem):
        lines = []
        model = Network.of(train(problem, 100, lines.append))
        assert len(lines) == 1
        q, goal = problem.postures[0][[0, -1]]
        rng = np.random.default_rng(0)
        ahead = np.mean([model.next(q, goal, rng) for _ in range(200)], axis=0)
        assert np.linalg.norm(ahead - q) < np.linalg.norm(goal - q) / 2  # a step, not the goal
