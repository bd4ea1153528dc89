"""No decision between demonstrations and arm hangs on rounding: fits that differ by 1e-12 lead to the same frame."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import avoiding, frame_at

from dt_viz.learning.store import FitStore
from dt_viz.metrics import resample_by_arc_length
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere
from dt_viz.scenario.tasks import TASKS, TaskEntry
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

PERTURBATION = 1e-12
"""Change of the demonstrations' positions, metres, as another processor's rounding makes it."""
TOLERANCE = 1e-5
"""Accepted change of motions (1e-4 of their extent would be 1e-4 m at most) and postures, metres and radians."""


def perturbed_tasks(seed):
    """The tasks, their demonstrations changed by rounding."""

    def entry(name):
        def load():
            rng, task = np.random.default_rng(seed), TASKS[name]()
            moved = [
                replace(d, positions=d.positions + PERTURBATION * rng.normal(size=d.positions.shape))
                for d in task.demonstrations
            ]
            return replace(task, demonstrations=tuple(moved))

        return TaskEntry(TASKS[name].title, load)

    return {name: entry(name) for name in TASKS}


def random_scenario(seed):
    """An obstacle on a demonstration, centred exactly there or anywhere near, that the hand or the whole arm avoids."""
    rng = np.random.default_rng(seed)
    name = list(TASKS)[rng.integers(len(TASKS))]
    paths = TASKS[name]().paths
    path = paths[rng.integers(len(paths))]
    centre = path[rng.integers(len(path) // 5, 4 * len(path) // 5)] + rng.choice([0.0, 0.03]) * rng.normal(size=3)
    x, y, z = map(float, centre)
    size = float(rng.uniform(0.05, 0.18))
    obstacle = (Sphere((x, y, z), size), Box((x, y, z), (size, 0.7 * size, size)), Cylinder((x, y, z), size, 2 * size))
    return avoiding(
        name, (obstacle[rng.integers(3)],), space=("task", "cspace")[rng.integers(2)], imitation=bool(rng.integers(4))
    )


def assert_repeats(scenario, robot):
    """The frame does not change by more than `TOLERANCE`."""
    one, other = (
        frame_at(Engine(tasks, FitStore(None), robot), scenario, Stage.FINE) for tasks in (TASKS, perturbed_tasks(0))
    )
    assert one.blocked == other.blocked
    for a, b in zip(one.rollouts, other.rollouts, strict=True):
        np.testing.assert_allclose(
            resample_by_arc_length(a, 200), resample_by_arc_length(b, 200), rtol=0, atol=TOLERANCE
        )
    for a, b in zip(one.times, other.times, strict=True):
        np.testing.assert_allclose(a[-1], b[-1], rtol=1e-5)
    if one.arm is not None and other.arm is not None:
        np.testing.assert_allclose(one.arm.q[[0, -1]], other.arm.q[[0, -1]], rtol=0, atol=TOLERANCE)


def test_a_sphere_on_the_motion_is_passed_alike(robot):
    scenario = avoiding("draw_z", (Sphere(TASKS["draw_z"]().obstacle_position),))
    assert_repeats(scenario, robot)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_obstacles_anywhere_are_passed_alike(robot, seed):
    assert_repeats(random_scenario(seed), robot)
