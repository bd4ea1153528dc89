"""What is said of a motion: each thing by its own cause, whatever else is said."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.bias import Biasing, BiasPoint, vector
from dt_viz.doubts import MAX_GOAL_MISS
from dt_viz.engine import Stage
from dt_viz.obstacles import Sphere
from dt_viz.scenario import Layer, Scenario
from dt_viz.stacking import aware, plane_of


def stage(engine, scenario, wanted=Stage.ROLLOUTS):
    """The frame of one stage; what comes after it is not computed."""
    return next(frame for frame in engine.frames(scenario) if frame.stage is wanted)


def near(goal, obstacle_position, clearance, diameter=0.15):
    """A sphere so near the goal, on the side of where the task's obstacle stands."""
    away = np.array(obstacle_position) - goal
    return Sphere(vector(goal + (diameter / 2 + clearance) * away / np.linalg.norm(away)), diameter)


@pytest.fixture(name="middle")
def _middle(engine):
    return vector(engine.task("draw_s").mean_path[50])


def far_below(engine, middle):
    """A layer that says that it is misplaced, and does nothing."""
    point = BiasPoint((middle[0], middle[1], -0.02), strength=0.0, plane=plane_of(engine.task("draw_s")))
    return Layer(Biasing(point), name="Bias 1")


@pytest.mark.parametrize("objective", ["trajectory", "velocity"])
@pytest.mark.parametrize("misplaced", [False, True])
def test_a_motion_through_the_obstacle_is_said_whatever_else_is(engine, middle, objective, misplaced):
    layers = (far_below(engine, middle),) if misplaced else ()
    scenario = Scenario("draw_s", (Sphere(middle, 0.15),), duration=0.05, objective=objective, layers=layers)
    health = stage(engine, scenario).health
    assert health.clearance < -0.05
    assert health.says(f"a motion enters the obstacle by {-1e3 * health.clearance:.0f} mm")
    assert health.says("the learned motion strays") == (objective == "velocity")
    assert health.says("Bias 1: the point is below the table") == misplaced


@pytest.mark.parametrize("task", ["draw_s", "lift_box"])
def test_a_missed_goal_is_said_beside_a_covered_start_unless_it_is_covered_itself(engine, task):
    goal = stage(engine, Scenario(task, ())).goal
    start = Sphere(vector(engine.task(task).starts[0]), 0.05)
    beside = near(goal, engine.task(task).obstacle_position, 0.0005)
    frame = stage(engine, Scenario(task, (beside, start)))
    missed = np.linalg.norm(frame.reached - frame.goal)
    assert missed > MAX_GOAL_MISS
    assert frame.health.says("inside the obstacle")
    assert frame.health.says(f"no way to the goal: motions end {1e3 * missed:.0f} mm beside it")
    covering = stage(engine, Scenario(task, (replace(beside, position=vector(goal)), start))).health
    assert covering.says("the goal is inside the obstacle: motions end beside it")
    assert not covering.says("no way to the goal")


def test_each_bias_point_speaks_by_its_name(engine, middle):
    plane = plane_of(engine.task("draw_s"))
    below = BiasPoint((middle[0], middle[1], -0.02), strength=0.0, plane=plane)
    off_plane = BiasPoint((middle[0] + 0.04, middle[1] + 0.05, middle[2]), plane=plane)
    layers = aware((Layer(Biasing(below), name="Low"), Layer(Biasing(off_plane), name="Deep")))
    health = stage(engine, Scenario("draw_s", (Sphere(middle, 0.15),), layers=layers)).health
    assert health.says("Low: the point is below the table")
    assert health.says("Deep: the point lies 5 cm before or behind the plane")
    assert not any("bias" in doubt.lower() for doubt in health.doubts)


@pytest.mark.parametrize("seed", range(6))
def test_a_hopeless_bias_point_leaves_the_obstacle_avoided(engine, seed):
    rng, task = np.random.default_rng(seed), engine.task("draw_s")
    path = task.paths[seed % len(task.paths)]
    sphere = Sphere(vector(path[int(rng.integers(60, 140))] + rng.normal(0, 0.015, 3)), float(rng.uniform(0.1, 0.2)))
    target = BiasPoint(vector(path[path[:, 2].argmax()] + [0.0, 0.0, 0.10]), radius=0.05, plane=plane_of(task))
    layer = Layer(Biasing(target), name="Bias 1")
    without, with_it = (
        stage(engine, Scenario("draw_s", (sphere,), layers=(replace(layer, on=on),))).health for on in (False, True)
    )
    assert with_it.says("Bias 1: the region of 5 cm is too small")
    assert with_it.clearance > 0.85 * min(without.clearance, 0.01)
