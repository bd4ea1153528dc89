"""Disturbances: what crosses the motion by itself, and a goal that moves."""

from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest
from pages import wait_until
from scenes import changed

from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.scenario.roaming import (
    SETTINGS,
    Chase,
    MovingGoal,
    crossings,
)
from dt_viz.scenario.tasks import TASKS
from dt_viz.scheduler import Jobs
from dt_viz.session import player

SECONDS = np.arange(0, 60, 0.05)


@pytest.mark.parametrize("name", TASKS)
def test_it_crosses_the_motion_smoothly_beside_table_and_pedestal(engine, name):
    task = engine.task(name)
    ways = [crossings(task, 0.075, np.random.default_rng(seed)) for seed in (*range(5), 4)]
    np.testing.assert_array_equal(ways.pop(), ways[4])  # they differ by their seed only
    assert min(np.abs(one - other).max() for one, other in pairwise(ways)) > 0.05
    for way in ways:
        steps = np.diff(way, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        assert lengths.max() < 1.3 * lengths.min()
        assert np.linalg.norm(way[0] - way[-1]) < 2 * lengths.max()
        turns = (steps[1:] * steps[:-1]).sum(axis=1) / lengths[1:] / lengths[:-1]
        assert turns.min() > 0.8
        assert way[:, 2].min() >= 0.075 + SETTINGS.table_room - 1e-3
        assert np.linalg.norm(way[:, :2], axis=1).min() >= 0.075 + SETTINGS.pedestal_room - 5e-3
        near = np.linalg.norm(way[:, None] - task.mean_path, axis=2).min(axis=1) < 0.06
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) >= 3


class TestChase:
    def chase(self, engine, scenario, speed=0.1):
        return Chase(engine.task(scenario.task), scenario, speed, np.random.default_rng(0))

    def test_the_selected_obstacle_sets_out_from_where_it_is_at_the_speed_asked_for(self, engine, initial):
        begins = Box((0.1, -0.4, 0.2), (0.1, 0.12, 0.14))
        other = Sphere((0.3, -0.4, 0.5), 0.1)
        scenario = changed(initial("push_box"), obstacles=(other, begins))
        scenario = changed(scenario, view=scenario.view.__class__(selected=1))
        chase = self.chase(engine, scenario)
        np.testing.assert_allclose(chase.place(0.0), begins.position, atol=1e-9)
        stack = chase(scenario, 7.0)["stack"]
        kept, moved = changed(scenario, stack=stack).obstacles
        assert kept == other
        assert moved == begins.moved(tuple(chase.place(7.0)), begins.wxyz)
        places = np.array([chase.place(t) for t in SECONDS])
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.05
        assert np.percentile(speeds[100:], [5, 95]) == pytest.approx([0.1, 0.1], abs=0.03)

    def test_without_an_obstacle_a_sphere_comes(self, engine, initial):
        scenario = changed(initial("draw_s"), obstacles=())
        stack = self.chase(engine, scenario)(scenario, 1.0)["stack"]
        (sphere,) = changed(scenario, stack=stack).obstacles
        assert isinstance(sphere, Sphere)


def test_the_goal_moves_around_its_place_and_motions_end_there(engine, initial):
    scenario = changed(initial("push_box"), space="cspace", obstacles=())
    goal = engine.nominal(scenario).goal
    moving = MovingGoal(engine.task("push_box"), goal)
    stack, ends = scenario.stack, []
    for seconds in (0.0, 1.5, 4.0):
        stack = moving(changed(scenario, stack=stack), seconds)["stack"]
        assert len(stack) == len(scenario.stack) + 1
        frame = next(engine.frames(changed(scenario, stack=stack)))
        ends.append(frame.reached)
        assert np.linalg.norm(frame.reached - goal) <= 1.5 * SETTINGS.goal_sway
    np.testing.assert_allclose(ends[0], goal, atol=2e-3)
    assert np.linalg.norm(ends[1] - goal) > 0.5 * SETTINGS.goal_sway and np.linalg.norm(ends[2] - ends[1]) > 0.02


class Editable:
    """A session that computes nothing."""

    def __init__(self, scenario):
        self.scenario, self.edits, self.gestures = scenario, 0, []
        self.jobs = Jobs(lambda error: pytest.fail(str(error)))

    def edit(self, _gesture, **changes):
        self.scenario = changed(self.scenario, **changes)
        self.edits += 1

    def begin_gesture(self):
        self.gestures.append("begin")

    def end_gesture(self):
        self.gestures.append("end")


@pytest.mark.parametrize("taken", [False, True], ids=["stopped", "taken"])
def test_in_the_end_the_world_is_as_it_was_unless_somebody_else_has_changed_it(engine, initial, taken):
    before = initial("draw_s")
    session, told = Editable(before), []
    chase = Chase(engine.task("draw_s"), before, 0.3, np.random.default_rng(0))
    player.start(cast(Any, session), "Disturb", chase, told.append, returns=True)
    wait_until(lambda: session.edits > 5)
    assert session.scenario.obstacles[0].position != before.obstacles[0].position
    mine = changed(before, obstacles=(Sphere((0.0, -0.4, 0.6)),))
    if taken:
        session.scenario = mine
    else:
        player.stop(cast(Any, session))
    wait_until(lambda: told == [True, False])
    assert session.scenario == (mine if taken else before)
    assert session.gestures == (["begin"] if taken else ["begin", "end"])
