"""MPNet: the network, the search from both ends, what it does without obstacles in its demonstrations, and with RRT."""

from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from plans import joints_of

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.linear import Linear
from dt_viz.baselines.mpnet import (
    DROPOUT,
    ENCODER,
    LAYERS,
    MAX_STEPS,
    NUM_POINTS,
    MPNet,
    MPNetModel,
    Network,
    Search,
    cloud,
)
from dt_viz.baselines.mpnet_rrt import MPNetRRT
from dt_viz.baselines.postures import PlanningScene
from dt_viz.errors import UnwantedError
from dt_viz.obstacles.shapes import Box, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.collision import load_collision_model

needs_torch = pytest.mark.skipif(find_spec("torch") is None, reason="torch is an extra")
needs_ompl = pytest.mark.skipif(find_spec("ompl") is None, reason="ompl is an extra")


def weights(seed=0):
    """Some weights, as training leaves them."""
    rng = np.random.default_rng(seed)
    arrays = {"centre": rng.normal(size=6), "scale": rng.uniform(0.1, 1, size=6)}
    for name, widths in (("encoder", ENCODER), ("planning", LAYERS)):
        for k, (num_in, num_out) in enumerate(pairwise(widths)):
            arrays[f"{name}_W_{k}"] = rng.normal(size=(num_out, num_in)) / np.sqrt(num_in)
            arrays[f"{name}_c_{k}"] = rng.normal(size=num_out) * 0.1
        arrays[f"{name}_slopes"] = rng.uniform(0.1, 0.3, size=len(widths) - 2)
    return arrays


@pytest.fixture(scope="module")
def in_the_way(problem):
    """A ball on the straight way of the joints from the first start."""
    straight = Linear().fit(problem).plan(Union(), problem.task.starts[:1])
    return Union((Sphere(as_point(straight.paths[0][100]), 0.15),))


def search(free):
    """A search on a line: postures differ in their first joint only, and `free` decides of two of its values."""

    line = SimpleNamespace(robot=SimpleNamespace(clip=np.asarray), is_free=lambda start, end: free(start[0], end[0]))
    model = MPNetModel.of(weights())
    return Search(model, np.zeros(ENCODER[-1]), cast(PlanningScene, line), np.random.default_rng(0))


def at(*values):
    return [np.array([value, 0.0, 0, 0, 0, 0]) for value in values]


class TestModel:
    @needs_torch
    def test_equals_the_network_of_torch(self):
        import torch  # pyright: ignore[reportMissingImports] - an extra

        from dt_viz.baselines import mpnet_training

        torch.manual_seed(1)
        widths = {"encoder": ENCODER, "planning": LAYERS}
        networks = {name: mpnet_training._network(its).eval() for name, its in widths.items()}
        trained = [mpnet_training.arrays_of(name, network) for name, network in networks.items()]
        model, rng = MPNetModel.of(weights() | trained[0] | trained[1]), np.random.default_rng(2)
        for name, network in networks.items():
            x = rng.normal(size=network[0].in_features)
            with torch.no_grad():
                expected = network(torch.tensor(x, dtype=torch.float32)).numpy()
            np.testing.assert_allclose(getattr(model, name)(x), expected, atol=1e-5)

    def test_dropout_leaves_out_the_asked_share_and_is_seeded(self):
        model, encoded, captured = MPNetModel.of(weights()), np.zeros(ENCODER[-1]), []

        def following(model, seed):
            return model.next(encoded, np.zeros(6), np.ones(6), np.random.default_rng(seed))

        np.testing.assert_array_equal(following(model, 0), following(model, 0))
        assert np.abs(following(model, 0) - following(model, 1)).max() > 1e-3
        spied = replace(model, planning=cast("Network", lambda x, masks: captured.append(masks) or np.zeros(6)))
        for seed in range(20):
            following(spied, seed)
        for layer, width in zip(zip(*captured, strict=True), LAYERS[1:5], strict=True):
            masks = np.stack(layer)
            assert masks.shape == (20, width)
            assert set(np.unique(masks)) == {0, 1 / (1 - DROPOUT)}
            assert np.mean(masks == 0) == pytest.approx(DROPOUT, abs=0.06)

    @pytest.mark.parametrize("name", ["planning_W_2", "encoder_c_0", "scale", "planning_slopes"])
    def test_weights_that_lack_something_are_refused_by_name(self, name):
        arrays = weights()
        with pytest.raises(NotFittedError, match=f"{name}.*nothing"):
            MPNetModel.of({key: value for key, value in arrays.items() if key != name})
        with pytest.raises(NotFittedError, match=f"{name}.*found"):
            MPNetModel.of({**arrays, name: arrays[name][:-1]})

    def test_the_shipped_encoder_does_not_tell_where_an_obstacle_is(self, problem):
        model = MPNet().model(problem)
        encoded = [model.encoded(Union((Sphere(place, 0.15),))) for place in ((0.1, -0.5, 0.2), (-0.3, 0.4, 0.6))]
        np.testing.assert_allclose(encoded, [model.encoded(Union())] * 2, atol=1e-6)
        other = MPNetModel.of(weights())
        assert np.abs(other.encoded(Union()) - other.encoded(Union((Sphere((0.1, -0.5, 0.2), 0.15),)))).max() > 1e-3

    def test_a_cloud_lies_on_the_surfaces(self):
        both = Union((Sphere((0.1, -0.5, 0.2), 0.15), Box((0.4, 0.1, 0.3), (0.1, 0.2, 0.1), (0.6, 0.8, 0.0, 0.0))))
        points = cloud(both)
        assert points.shape == (NUM_POINTS, 3)
        np.testing.assert_allclose(both.signed_distance(points), 0, atol=1e-9)
        for part in both.parts:
            assert (np.abs(part.signed_distance(points)) < 1e-9).any()
        assert not cloud(Union()).any()


class TestSearch:
    @pytest.mark.parametrize("num", [1, 2, 7, MAX_STEPS + 1])
    def test_ends_when_the_two_ends_can_be_joined_or_after_its_steps(self, num):
        asked = []
        start, goal = at(0.0, 1.0)
        way = search(lambda a, b: asked.append((a, b)) or len(asked) == num).bidirectional(start, goal)
        assert len(way) == min(num, MAX_STEPS) + 2
        assert way[0] is start and way[-1] is goal
        # from both ends in turn: what was joined last lies next to each other
        assert all(after[1] == before[0] for before, after in pairwise(asked))
        joined = {asked[-1], asked[-1][::-1]}
        assert any((a[0], b[0]) in joined for a, b in pairwise(way))

    def test_contraction_keeps_what_straight_lines_cannot_do_without(self):
        near = search(lambda a, b: abs(a - b) <= 1.0)
        assert [q[0] for q in near.contracted(at(0, 0.5, 1, 1.5, 2, 5, 5.5))] == [0, 1, 2, 5, 5.5]
        assert [q[0] for q in search(lambda a, b: True).contracted(at(0, 1, 2, 3))] == [0, 3]

    def test_only_colliding_stretches_are_planned_again(self):
        asked = []

        def replan(a, b):
            asked.append((a[0], b[0]))
            return at(a[0], 10, b[0])

        near = search(lambda a, b: abs(a - b) <= 1.0 and 2 not in (a, b))
        way = near.replanned(at(0, 1, 2, 3, 4), replan)
        assert asked == [(1, 3)]
        assert [q[0] for q in way] == [0, 1, 10, 3, 4]


class TestPlanning:
    def test_where_the_straight_line_is_free_it_is_taken(self, problem):
        straight = Linear().fit(problem).plan(Union(), problem.task.starts[:2])
        plan = MPNet().fit(problem).plan(Union(), problem.task.starts[:2])
        for a, b in zip(joints_of(plan), joints_of(straight), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)
        assert not plan.warnings

    def test_a_run_repeats_and_says_what_collides(self, problem, in_the_way):
        first, second = (MPNet().fit(problem).plan(in_the_way, problem.task.starts[:1]) for _ in range(2))
        (q,) = joints_of(first)
        np.testing.assert_array_equal(q, joints_of(second)[0])
        assert load_collision_model().nearest_to_obstacle(q, in_the_way).distance < 0  # its encoder knows of none
        assert first.warnings
        np.testing.assert_array_equal(q[[0, -1]], problem.postures[0][[0, -1]])
        assert len(q) > 200  # it did not stay with the straight line


class TestRRT:
    @needs_ompl
    def test_its_motions_are_free_and_repeat(self, problem, in_the_way):
        planner = MPNetRRT().fit(problem)
        first, second = (planner.plan(in_the_way, problem.task.starts[:1]) for _ in range(2))
        (q,) = joints_of(first)
        np.testing.assert_array_equal(q, joints_of(second)[0])
        report = load_collision_model().report(q, in_the_way)
        assert report.obstacle.distance > 0 and report.table.distance > 0
        assert report.itself is None or report.itself.distance > 0
        assert not first.warnings
        np.testing.assert_array_equal(q[[0, -1]], problem.postures[0][[0, -1]])
        assert (q >= problem.robot.lower).all() and (q <= problem.robot.upper).all()

    @needs_ompl
    def test_what_there_is_no_time_for_stays_in_collision_and_says_so(self, problem, in_the_way):
        plan = MPNetRRT(seconds=0.0).fit(problem).plan(in_the_way, problem.task.starts[:1])
        assert load_collision_model().nearest_to_obstacle(joints_of(plan)[0], in_the_way).distance < 0
        assert "start 1 collides" in plan.warnings[0]

    @needs_ompl
    def test_an_exception_within_ompl_ends_it(self, problem, in_the_way):
        alone, calls = [], []
        MPNet().fit(problem).plan(in_the_way, problem.task.starts[:1], lambda: alone.append(0) is not None)

        def cancelled():
            calls.append(0)
            return len(calls) == len(alone) + 20

        planner = MPNetRRT().fit(problem)
        with pytest.raises(UnwantedError):
            planner.plan(in_the_way, problem.task.starts[:1], cancelled)
        assert len(calls) == len(alone) + 20

    def test_without_ompl_it_says_what_is_missing(self, monkeypatch):
        monkeypatch.setattr("dt_viz.baselines.base.find_spec", lambda module: None)
        assert MPNetRRT().missing == ("ompl",)
        assert MPNet().missing == ()


@needs_torch
class TestTraining:
    def test_a_single_demonstration_is_learned_from_in_both_directions(self, problem):
        from dt_viz.baselines.mpnet_training import NUM_WAYPOINTS, steps

        x, y, centre, scale = steps(replace(problem, postures=problem.postures[:1]))
        assert len(x) == 2 * (NUM_WAYPOINTS - 1)
        there, back = np.split(x, 2)
        np.testing.assert_allclose(centre + scale * there[0, :6], problem.postures[0][0], atol=1e-9)
        np.testing.assert_allclose(centre + scale * there[0, 6:], problem.postures[0][-1], atol=1e-9)
        np.testing.assert_allclose(back[0, 6:], there[0, :6])
        np.testing.assert_allclose(y[:-1][: NUM_WAYPOINTS - 2], there[1:, :6])

    def test_a_demonstration_that_does_not_move_the_arm_is_refused(self, problem):
        from dt_viz.baselines.mpnet_training import steps

        still = np.repeat(problem.postures[0][:1], 5, axis=0)
        with pytest.raises(NotFittedError, match="does not move"):
            steps(replace(problem, postures=(problem.postures[0], still)))

    def test_what_training_returns_can_be_planned_with(self, problem):
        from dt_viz.baselines.mpnet_training import train

        lines = []
        model = MPNetModel.of(train(problem, 100, lines.append))
        assert len(lines) == 2
        q, goal = problem.postures[0][[0, -1]]
        rng, encoded = np.random.default_rng(0), model.encoded(Union())
        ahead = np.mean([model.next(encoded, q, goal, rng) for _ in range(200)], axis=0)
        assert np.linalg.norm(ahead - q) < np.linalg.norm(goal - q) / 2  # a step, not the goal
