"""What is said of a motion: each thing by its own cause, whatever else is said."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.arm.collision import Nearest, load_collision_model
from dt_viz.engine.frame import Stage
from dt_viz.motion.diagnostics import MARGIN_TOLERANCE, MAX_GOAL_MISS, margin_doubts
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import aware, plane_of
from dt_viz.transforms.avoidance import BESIDE
from dt_viz.transforms.bias import Biasing, BiasPoint


def stage(engine, scenario, wanted=Stage.ROLLOUTS):
    """The frame of one stage; what comes after it is not computed."""
    return next(frame for frame in engine.frames(scenario) if frame.stage is wanted)


def near(goal, obstacle_position, clearance, diameter=0.15):
    """A sphere so near the goal, on the side of where the task's obstacle stands."""
    away = np.array(obstacle_position) - goal
    return Sphere(as_point(goal + (diameter / 2 + clearance) * away / np.linalg.norm(away)), diameter)


@pytest.fixture(name="middle")
def _middle(engine):
    return as_point(engine.task("draw_s").mean_path[50])


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
    start = Sphere(as_point(engine.task(task).starts[0]), 0.05)
    beside = near(goal, engine.task(task).obstacle_position, 0.0005)
    frame = stage(engine, Scenario(task, (beside, start)))
    missed = np.linalg.norm(frame.reached - frame.goal)
    assert missed > MAX_GOAL_MISS
    assert frame.health.says("inside the obstacle")
    assert frame.health.says(f"no way to the goal: motions end {1e3 * missed:.0f} mm beside it")
    covering = stage(engine, Scenario(task, (replace(beside, position=as_point(goal)), start))).health
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
    sphere = Sphere(as_point(path[int(rng.integers(60, 140))] + rng.normal(0, 0.015, 3)), float(rng.uniform(0.1, 0.2)))
    target = BiasPoint(as_point(path[path[:, 2].argmax()] + [0.0, 0.0, 0.10]), radius=0.05, plane=plane_of(task))
    layer = Layer(Biasing(target), name="Bias 1")
    without, with_it = (
        stage(engine, Scenario("draw_s", (sphere,), layers=(replace(layer, on=on),))).health for on in (False, True)
    )
    assert with_it.says("Bias 1: the region of 5 cm is too small")
    assert with_it.clearance > 0.85 * min(without.clearance, 0.01)


@pytest.mark.parametrize(("temperature", "diameter"), [(1.0, 0.04), (1.0, 0.10), (2.0, 0.06)])
def test_a_margin_out_of_reach_is_said_with_what_is_kept_and_what_helps(engine, middle, temperature, diameter):
    sphere = Sphere(as_point(np.add(middle, (0.01, 0.005, 0.0))), diameter)
    scenario = Scenario("draw_s", (sphere,), temperature=temperature, margin=0.05)
    health = stage(engine, scenario).health
    assert 0 < health.clearance < 0.05
    (doubt,) = health.doubts
    assert doubt.startswith(
        f"a motion keeps only {1e3 * health.clearance:.1f} mm from the obstacle: the field does not"
    )
    assert stage(engine, replace(scenario, temperature=2 * temperature)).health.clearance > 1.2 * health.clearance
    assert stage(engine, replace(scenario, margin=0.8 * health.clearance)).health.doubts == ()


def test_a_motion_that_stays_inside_is_said_once(engine, middle):
    health = stage(engine, Scenario("draw_s", (Sphere(middle, 0.15),), generator="probability")).health
    assert health.clearance < 0
    assert health.doubts == ("a motion does not leave the obstacle: ∇p is flat inside it",)


@pytest.mark.parametrize("seed", [5, 25, 27])
@pytest.mark.parametrize("wanted", [Stage.ROLLOUTS, Stage.FINE])
def test_motions_to_a_goal_that_two_obstacles_cover_end_beside_both(engine, seed, wanted):
    goal, rng = stage(engine, Scenario("draw_s", ())).goal, np.random.default_rng(seed)
    scenario = Scenario("draw_s", tuple(Sphere(as_point(goal + rng.normal(0, 0.04, 3)), 0.15) for _ in range(2)))
    assert scenario.obstacle.signed_distance(goal) < 0
    frame = stage(engine, scenario, wanted)
    assert frame.health.clearance > -BESIDE
    assert frame.health.doubts == ("the goal is inside the obstacle: motions end beside it",)


def test_equal_layers_are_told_apart(engine, middle):
    point = BiasPoint(as_point(np.add(middle, (0.05, 0.0, 0.0))), plane=plane_of(engine.task("draw_s")))
    layers = tuple(Layer(Biasing(point), on=on, name=name) for name, on in (("A", False), ("B", True), ("C", True)))
    frame = stage(engine, Scenario("draw_s", (), layers=layers))
    durations, radii = frame.health.layer_durations, frame.layer_radii
    assert (durations[0], radii[0]) == (None, None)
    assert durations[1] is not None and durations[1] > 0.1
    assert durations[2] is not None and durations[2] < 0.01  # what is there already needs no flow
    assert radii[1] is not None and radii[2] is not None


def nearest(*distances):
    return [Nearest(distance, (f"link {k}",), 0.0) for k, distance in enumerate(distances)]


def test_a_margin_that_the_meshes_do_not_keep_is_said_with_what_they_keep():
    scenario = Scenario("draw_s", (Sphere((0.0, -0.5, 0.4)),), space="cspace", margin=0.02)
    assert margin_doubts(scenario, nearest(0.5, 0.02 - 0.9 * MARGIN_TOLERANCE)) == ()
    assert margin_doubts(scenario, nearest(0.5, 0.0134, 0.015)) == (
        "on rollout 2 the arm's link 1 keeps 13 mm from the obstacle; 20 mm were asked for",
    )
    (entered,) = margin_doubts(scenario, nearest(-0.0044))
    assert "link 0 enters the obstacle by 4 mm" in entered
    for asks_for_none in ({"duration": 0.3}, {"warp": 0.5}, {"avoidance": False}):
        assert margin_doubts(replace(scenario, **asks_for_none), nearest(0.001)) == ()


@pytest.mark.parametrize(("margin", "kept"), [(0.01, False), (0.002, True)])
def test_the_last_frame_says_what_margin_the_meshes_keep(engine, initial, margin, kept):
    scenario = replace(initial("draw_s"), space="cspace", margin=margin)
    frame = stage(engine, scenario, Stage.CERTIFIED)
    model, arm = load_collision_model(), engine._shown.arm
    clearance = [
        model.nearest_to_obstacle(arm.p[arm.index == k], scenario.obstacle).distance for k in range(len(frame.rollouts))
    ]
    assert (min(clearance) > margin - MARGIN_TOLERANCE) == kept
    said = f"keeps {1e3 * min(clearance):.2g} mm from the obstacle; 10 mm were asked for"
    assert [said in doubt for doubt in frame.health.arm_doubts] == ([] if kept else [True])
    assert set(frame.health.arm_doubts) <= set(frame.health.doubts)
