"""The warp from straight rays to the whole stack: a diffeomorphism with its goal all the way, full at the end."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import avoiding, biases, changed, frame_at

from dt_viz.avoidance.registry import bias_beside
from dt_viz.metrics import distance_from_path, maximum_collision_distance
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import surroundings
from dt_viz.session.frame import Stage

WARPS = (0.0, 0.15, 0.5, 0.85)


def beside(task, scenario):
    return bias_beside(surroundings(task, scenario))


def stacked(engine, task, **changes):
    """An obstacle on the path and a bias point beside it."""
    task = engine.task(task)
    plain = avoiding(task.name, Sphere(task.obstacle_position))
    return changed(plain, layers=biases(beside(task, plain)), **changes)


def aside(path):
    """Distances (T,) of a path from the straight line between its ends."""
    return distance_from_path(path, path[[0, -1]])


def turned(segments, axes):
    """How far segments (K, 2, 3) of lines along two axes (3, 2) are turned away from these at most, rad."""
    along = np.diff(segments, axis=1)[:, 0]
    length = np.linalg.norm(along, axis=1)
    cosine = np.abs(along[length > 1e-6] @ axes).max(axis=1) / length[length > 1e-6]
    return np.arccos(np.minimum(cosine, 1)).max()


CASES = [("draw_s", "task", 0.15), ("lift_box", "task", 0.0), ("push_box", "cspace", 0.5)]


@pytest.mark.parametrize(
    ("task", "space", "warp"),
    [
        pytest.param(*case, warp, marks=() if (*case, warp) in CASES else pytest.mark.slow)
        for case in (("draw_s", "task"), ("lift_box", "task"), ("push_box", "cspace"))
        for warp in WARPS
    ],
)
def test_motions_begin_and_end_where_they_should_and_certificates_hold_at_every_warp(engine, task, space, warp):
    scenario = stacked(engine, task, space=space, warp=warp)
    frames = list(engine.frames(scenario))
    for frame in frames:
        tolerance = 1e-5 if frame.stage >= Stage.FINE else 5e-4
        for path, start in zip(frame.rollouts, frame.task.starts, strict=True):
            np.testing.assert_allclose(path[0], start, rtol=0, atol=tolerance)
            np.testing.assert_allclose(path[-1], frame.goal, rtol=0, atol=tolerance)
        for times in frame.times:
            assert (np.diff(times) > 0).all()
    certificates = frames[-1].certificates
    assert certificates.min_det_jacobian > 0
    assert certificates.round_trip_error < 1e-6
    assert certificates.lyapunov_falls


@pytest.mark.parametrize("task", ["draw_s", "lift_box"])
def test_without_any_warp_motions_are_straight_and_so_is_space(engine, task):
    frame = frame_at(engine, stacked(engine, task, warp=0.0, view=View(grid=True)), Stage.FINE)
    grid, field = frame.pictures.grid, frame.pictures.field
    assert grid is not None and len(grid) > 10
    assert max(aside(path).max() for path in frame.rollouts) < 1e-9
    assert turned(grid, frame.slice.axes) < 1e-3
    to_goal = frame.goal - field.points
    cosine = (to_goal * field.velocities).sum(axis=1)
    cosine /= np.linalg.norm(to_goal, axis=1) * np.linalg.norm(field.velocities, axis=1)
    assert cosine.min() > 1 - 1e-9


def test_motions_bend_more_and_more_and_the_grid_with_them(engine):
    bends = []
    for warp in (*WARPS, 1.0):
        frame = frame_at(engine, replace(stacked(engine, "draw_s"), warp=warp, view=View(grid=True)), Stage.LIVE)
        bends.append([max(aside(path).max() for path in frame.rollouts), turned(frame.pictures.grid, frame.slice.axes)])
    rollouts, lines = np.transpose(bends)
    assert (np.diff(rollouts) > 0).all()
    assert (np.diff(lines[:-1]) > 0).all()  # at last they leave the picture, and are cut shorter


@pytest.mark.long
@pytest.mark.parametrize("space", ["task", "cspace"])
def test_a_nearly_full_warp_is_nearly_the_stack_and_a_full_one_is_the_stack(engine, new_engine, space):
    scenario = stacked(engine, "push_box", space=space, view=View(field=False))
    fresh, used = frame_at(new_engine(), scenario, Stage.FINE), new_engine()
    for warp in (1.0, 1 - 1e-9):
        frame = frame_at(used, replace(scenario, warp=warp), Stage.FINE)
    for path, full in zip(frame.rollouts, fresh.rollouts, strict=True):
        assert max(distance_from_path(path, full).max(), distance_from_path(full, path).max()) < 1e-3
    again = frame_at(used, scenario, Stage.FINE)
    for path, full in zip(again.rollouts, fresh.rollouts, strict=True):
        np.testing.assert_array_equal(path, full)


def test_what_auto_chose_for_the_full_stack_stays(new_engine, engine):
    fresh, scenario = new_engine(), stacked(engine, "draw_s", view=View(field=False))
    full = frame_at(fresh, scenario, Stage.FINE)
    for warp in (0.4, 0.0, 1.0):
        frame = frame_at(fresh, replace(scenario, warp=warp), Stage.FINE)
        assert len(frame.durations) == 2 and frame.durations == full.durations
        assert frame.chosen_values == full.chosen_values


def test_a_warp_through_the_obstacle_is_told_and_not_warned_of(engine):
    for space in ("task", "cspace"):
        scenario = changed(stacked(engine, "draw_s", space=space, warp=0.1), layers=())
        *_, frame = engine.frames(scenario)
        depth = max(maximum_collision_distance(path, scenario.obstacle.signed_distance) for path in frame.rollouts)
        assert depth > 0.02 and frame.certificates.clearance < -0.02
        assert frame.certificates.warnings == ()


def test_a_goal_that_the_stack_moves_moves_along(engine):
    scene = SCENES["left_pot"]
    full = replace(scene.scenario(engine.task(scene.task)), view=View(field=False))
    goal = frame_at(engine, replace(full, warp=0.0), Stage.FINE).reached
    there = frame_at(engine, full, Stage.FINE).reached
    frame = frame_at(engine, replace(full, warp=0.25), Stage.FINE)
    np.testing.assert_allclose(frame.reached, goal + 0.25 * (there - goal), rtol=0, atol=1e-6)
    for path in frame.rollouts:
        np.testing.assert_allclose(path[-1], frame.reached, rtol=0, atol=1e-6)


def test_the_undeformed_rollouts_and_their_joints_stay_those_of_the_demonstrations(engine):
    scenario = replace(stacked(engine, "draw_s"), view=View(field=False, replay=True))
    full, half = (frame_at(engine, replace(scenario, warp=warp), Stage.LIVE) for warp in (1.0, 0.5))
    for a, b in zip(full.ghost, half.ghost, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(half.arm.without[[0, -1]], full.arm.without[[0, -1]], rtol=0, atol=1e-6)
