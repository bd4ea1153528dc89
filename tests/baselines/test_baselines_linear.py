"""Straight lines in configuration space, and what is free on them."""

import numpy as np
import pytest
from plans import joints_of

from dt_viz.baselines.postures import PlanningScene, Query, fit_straight, planned
from dt_viz.obstacles.shapes import Box, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.link_distances import Poses
from dt_viz.robot.models import load_jaco


def test_joints_go_straight_from_the_demonstrated_start_to_the_demonstrated_goal(problem):
    plan = fit_straight(problem)(Union(), problem.task.starts)
    for i, (q, t) in enumerate(zip(joints_of(plan), plan.times, strict=True)):
        start, goal = problem.postures[i][[0, -1]]
        np.testing.assert_allclose(q, start + np.linspace(0, 1, len(q))[:, None] * (goal - start), atol=1e-9)
        duration = np.ptp(problem.task.demonstrations[i].times)
        np.testing.assert_allclose(t, np.linspace(0, duration, len(q)), atol=1e-9)
        np.testing.assert_allclose(plan.paths[i], problem.robot.end_effector(q), atol=1e-12)


def test_another_start_is_reached_by_inverse_kinematics_near_the_nearest_demonstration(problem):
    start = problem.task.starts[2] + np.array([0.0005, 0.001, 0.001])
    plan = fit_straight(problem)(Union(), start[None])
    np.testing.assert_allclose(plan.paths[0][0], start, atol=1e-4)
    assert np.abs(joints_of(plan)[0][0] - problem.postures[2][0]).max() < 0.03
    np.testing.assert_array_equal(joints_of(plan)[0][-1], problem.postures[2][-1])


def test_a_start_out_of_reach_is_refused(problem):
    with pytest.raises(UnreachableError):
        fit_straight(problem)(Union(), np.array([[2.0, 0.0, 0.5]]))


def test_an_obstacle_changes_nothing(problem):
    planner, start = fit_straight(problem), problem.task.starts[:1]
    free = planner(Union(), start)
    ball = Union((Sphere(as_point(free.paths[0][100]), 0.15),))
    np.testing.assert_array_equal(joints_of(free)[0], joints_of(planner(ball, start))[0])


def test_corners_are_kept_and_joints_stay_within_their_velocity_limits(problem):
    robot = problem.robot
    a, b = problem.postures[0][[0, -1]]
    way = np.stack([a, a + np.array([3.0, 0, 0, 0, 0, 0]), b])
    plan = planned(problem, [Query(a, b, 1.0)], [way])
    for corner in way:
        assert (joints_of(plan)[0] == corner).all(axis=1).any()
    speed = np.abs(np.diff(joints_of(plan)[0], axis=0)) / np.diff(plan.times[0])[:, None]
    assert (speed <= robot.velocity_limits + 1e-9).all()
    assert plan.times[0][-1] > 1.0


@pytest.fixture(scope="module")
def lines(problem):
    """Random short and long lines near the task's postures."""
    rng, every = np.random.default_rng(4), np.concatenate(problem.postures)
    starts = every[rng.integers(len(every), size=60)] + rng.normal(scale=0.3, size=(60, 6))
    ends = starts + rng.normal(scale=0.5, size=(60, 6)) * rng.uniform(size=(60, 1))
    return list(zip(*(problem.robot.clip(q) for q in (starts, ends)), strict=True))


class TestSurroundings:
    @staticmethod
    def depth(robot, obstacle, start, end):
        """Smallest distance of some vertices of the meshes from the obstacle and the table, at some samples."""
        line = start + np.linspace(0, 1, 25)[:, None] * (end - start)
        poses, least = Poses.of(robot, line), np.inf
        for mesh in load_jaco().meshes:
            frame = mesh.joint + 1
            points = mesh.vertices[::7] @ poses.rotations[:, frame].transpose(0, 2, 1) + poses.origins[:, frame, None]
            least = min(least, obstacle.signed_distance(points).min())
            if mesh.joint >= 1:
                least = min(least, points[..., 2].min())
        return least

    @pytest.mark.long
    @pytest.mark.parametrize("shape", ["sphere", "box"])
    def test_a_line_is_free_only_where_no_vertex_of_the_meshes_enters_anything(self, problem, lines, shape):
        place = as_point(problem.task.mean_path[50])
        part = Sphere(place, 0.15) if shape == "sphere" else Box(place, (0.1, 0.2, 0.12))
        around = PlanningScene(problem.robot, Union((part,)))
        verdicts = []
        for line in lines[:30]:
            verdicts.append(around.is_free(*line))
            if verdicts[-1]:
                assert self.depth(problem.robot, around.obstacle, *line) > 0
        assert 3 < sum(verdicts) < 27

    @pytest.mark.long
    def test_nothing_between_two_samples_is_passed_through(self, problem, lines):
        free = [line for line in lines if PlanningScene(problem.robot, Union()).is_free(*line)]
        assert len(free) > 10
        rng, mesh = np.random.default_rng(2), load_jaco().meshes[-1]
        for start, end in free[:15]:
            poses = Poses.of(problem.robot, (start + rng.uniform() * (end - start))[None])
            vertex = mesh.vertices[rng.integers(len(mesh.vertices))]
            place = poses.rotations[0, mesh.joint + 1] @ vertex + poses.origins[0, mesh.joint + 1]
            speck = Union((Sphere(as_point(place), 0.0005),))
            assert not PlanningScene(problem.robot, speck).is_free(start, end)

    @pytest.mark.long
    def test_the_arm_may_not_pass_through_itself_or_the_table(self, problem):
        nothing, model, rng = PlanningScene(problem.robot, Union()), load_jaco().collision, np.random.default_rng(1)
        seen = set()
        for q in problem.robot.clip(rng.uniform(-np.pi, np.pi, size=(40, 6)) + problem.robot.home):
            report = model.report(q[None], Union())
            below, folded = report.table.distance <= 0, report.itself is not None and report.itself.distance <= 0
            seen.add((below, folded))
            assert nothing.is_free(q, q) != (below or folded)
        assert seen >= {(False, False), (True, False), (False, True)}
