"""What is said of a motion: each thing by its own cause, whatever else is said."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import avoiding, beside, biases, changed, frame_at, random_scenario, says

from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE
from dt_viz.avoidance.bias import MAX_TARGET_MISS, BiasPoint
from dt_viz.avoidance.hand import BESIDE, Avoidance
from dt_viz.metrics import resample_by_arc_length
from dt_viz.motion.diagnostics import MAX_GOAL_MISS, margin_warnings
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import Nearest
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Layer, Scenario, View
from dt_viz.scenario.stack import plane_of
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.warning import ARM, Kind, MotionWarning, told


def stage(engine, scenario, wanted=Stage.ROLLOUTS):
    return frame_at(engine, scenario, wanted)


def near(goal, obstacle_position, clearance, diameter=0.15):
    """A sphere so near the goal, on the side of where the task's obstacle stands."""
    away = np.array(obstacle_position) - goal
    return Sphere(as_point(goal + (diameter / 2 + clearance) * away / np.linalg.norm(away)), diameter)


@pytest.fixture(name="middle")
def _middle(engine):
    return as_point(engine.task("draw_s").mean_path[50])


def far_below(engine, middle):
    """A point that is misplaced, and does nothing."""
    return BiasPoint((middle[0], middle[1], -0.02), strength=0.0, plane=plane_of(engine.task("draw_s")))


def texts(frame):
    return tuple(warning.text for warning in frame.certificates.warnings)


def kinds(frame):
    return {warning.kind for warning in frame.certificates.warnings}


@pytest.mark.long
@pytest.mark.parametrize("objective", ["trajectory", "velocity"])
@pytest.mark.parametrize("misplaced", [False, True])
def test_a_motion_through_the_obstacle_is_said_whatever_else_is(engine, middle, objective, misplaced):
    layers = biases(far_below(engine, middle)) if misplaced else ()
    scenario = avoiding("draw_s", Sphere(middle, 0.15), duration=0.05, objective=objective, layers=layers)
    frame = stage(engine, scenario)
    clearance = frame.certificates.clearance
    assert clearance < -0.05
    assert says(frame, f"a motion enters the obstacle by {-1e3 * clearance:.0f} mm")
    assert says(frame, "the learned motion strays") == (objective == "velocity")
    assert says(frame, "Bias 1: the point is below the table") == misplaced


def test_a_missed_goal_is_said_beside_a_covered_start_unless_it_is_covered_itself(engine, task="draw_s"):
    goal = stage(engine, avoiding(task)).goal
    start = Sphere(as_point(engine.task(task).starts[0]), 0.12)
    beside = near(goal, engine.task(task).obstacle_position, 1e-3)
    frame = stage(engine, avoiding(task, (beside, start), generator="probability"))
    missed = np.linalg.norm(frame.reached - frame.goal)
    assert missed > MAX_GOAL_MISS
    assert kinds(frame) >= {Kind.START_COVERED, Kind.GOAL_MISSED}
    assert says(frame, f"no way to the goal: motions end {1e3 * missed:.0f} mm beside it")
    covering = stage(engine, avoiding(task, (replace(beside, position=as_point(goal)), start)))
    assert says(covering, "the goal is inside the obstacle: motions end beside it")
    assert kinds(covering) >= {Kind.START_COVERED, Kind.GOAL_COVERED} and Kind.GOAL_MISSED not in kinds(covering)


def test_each_bias_point_speaks_by_its_name(engine, middle):
    off_plane = replace(far_below(engine, middle), position=(middle[0] + 0.04, middle[1] + 0.05, middle[2]))
    layers = Layer(far_below(engine, middle), name="Low"), Layer(replace(off_plane, strength=None), name="Deep")
    frame = stage(engine, avoiding("draw_s", Sphere(middle, 0.15), layers=layers))
    assert says(frame, "Low: the point is below the table")
    assert says(frame, "Deep: the point lies 5 cm before or behind the plane")
    assert {warning.source for warning in frame.certificates.warnings} >= {"Low", "Deep"}
    assert "bias" not in " ".join(texts(frame)).lower()


@pytest.mark.parametrize("seed", range(6))
def test_a_hopeless_bias_point_leaves_the_obstacle_avoided(engine, seed):
    rng, task = np.random.default_rng(seed), engine.task("draw_s")
    path = task.paths[seed % len(task.paths)]
    sphere = Sphere(as_point(path[int(rng.integers(60, 140))] + rng.normal(0, 0.015, 3)), float(rng.uniform(0.1, 0.2)))
    target = BiasPoint(as_point(path[path[:, 2].argmax()] + [0.0, 0.0, 0.10]), radius=0.05, plane=plane_of(task))
    without, with_it = (
        stage(engine, avoiding("draw_s", sphere, layers=(Layer(target, on=on, name="Bias 1"),))) for on in (False, True)
    )
    assert says(with_it, "Bias 1: the region of 5 cm is too small")
    assert with_it.certificates.clearance > 0.85 * min(without.certificates.clearance, 0.01)


@pytest.mark.parametrize("diameter", [0.04, 0.06, 0.10])
def test_a_margin_out_of_reach_is_said_with_what_is_kept_and_what_helps(engine, middle, diameter):
    sphere = Sphere(as_point(np.add(middle, (0.0, diameter / 2 + 0.002, 0.0))), diameter)  # the motion passes beside it
    scenario = avoiding("draw_s", sphere, generator="probability", margin=0.05)
    frame = stage(engine, scenario)
    kept = frame.certificates.clearance
    assert 0 < kept < 0.05
    (warning,) = frame.certificates.warnings
    assert warning.kind is Kind.TOO_NEAR
    told = "the field does not reach farther; a smaller margin helps"
    assert warning.text == f"a motion keeps only {1e3 * kept:.1f} mm from the obstacle: {told}"
    assert texts(stage(engine, changed(scenario, margin=0.8 * kept))) == ()


def test_a_motion_that_stays_inside_is_said_once(engine, middle):
    frame = stage(engine, avoiding("draw_s", Sphere(middle, 0.15), generator="probability"))
    assert frame.certificates.clearance < 0
    assert texts(frame) == ("a motion does not leave the obstacle: ∇p is flat inside it",)


@pytest.mark.parametrize("seed", [5, 25, 27])
@pytest.mark.parametrize("wanted", [Stage.ROLLOUTS, Stage.FINE])
def test_motions_to_a_goal_that_two_obstacles_cover_end_beside_both(engine, seed, wanted):
    goal, rng = stage(engine, avoiding("draw_s")).goal, np.random.default_rng(seed)
    scenario = avoiding("draw_s", [Sphere(as_point(goal + rng.normal(0, 0.04, 3)), 0.15) for _ in range(2)])
    assert scenario.obstacle.signed_distance(goal) < 0
    frame = stage(engine, scenario, wanted)
    assert frame.certificates.clearance > -BESIDE
    assert texts(frame) == ("the goal is inside the obstacle: motions end beside it",)


def test_equal_layers_are_told_apart(engine, middle):
    point = BiasPoint(as_point(np.add(middle, (0.05, 0.0, 0.0))), plane=plane_of(engine.task("draw_s")))
    layers = tuple(Layer(point, on=on, name=name) for name, on in (("A", False), ("B", True), ("C", True)))
    frame = stage(engine, avoiding("draw_s", layers=layers))
    assert frame.durations["B"] > 0.1
    assert frame.durations["C"] < 0.01  # what is there already needs no flow
    assert frame.durations.keys() == frame.chosen_values.keys() == {"B", "C"}
    assert all("radius" in values for values in frame.chosen_values.values())


def test_what_follows_from_a_cause_is_told_only_where_it_may_have_another():
    cause = MotionWarning(Kind.INEXACT_INVERSE, "steps lose something", "Bias 1")
    follows = [MotionWarning(Kind.ROUND_TRIP, "there and back again misses", source) for source in ("", "Bias 1")]
    other = MotionWarning(Kind.ROUND_TRIP, "there and back again misses", "Bias 2")
    assert told([*follows, cause, other, cause]) == (cause, other)
    assert told([*follows, other]) == (*follows, other)


def nearest(*distances):
    return {place: Nearest(distance, (f"link {place}",), 0.0) for place, distance in enumerate(distances)}


def test_a_margin_that_the_meshes_do_not_keep_is_said_with_what_they_keep():
    scenario = avoiding("draw_s", Sphere((0.0, -0.5, 0.4)), space="cspace", margin=0.02)
    assert margin_warnings(scenario, nearest(0.5, 0.02 - 0.9 * MARGIN_TOLERANCE)) == ()
    text = "on rollout 4 the arm's link 3 keeps 13 mm from the obstacle; 20 mm were asked for"
    distances = nearest(0.5, 0.001, 0.001, 0.0134, 0.015)
    found = margin_warnings(scenario, {place: distances[place] for place in (0, 3, 4)})  # the others have no motion
    assert found == (MotionWarning(Kind.ARM_TOO_NEAR, text, ARM),)
    (entered,) = margin_warnings(scenario, nearest(-0.0044))
    assert entered.kind is Kind.ROLLOUT_ENTERS and "link 0 enters the obstacle by 4 mm" in entered.text
    for asks_for_none in ({"duration": 0.3}, {"warp": 0.5}, {"avoids": False}):
        assert margin_warnings(changed(scenario, **asks_for_none), nearest(0.001)) == ()


@pytest.mark.long
@pytest.mark.parametrize("kept", [pytest.param(True, marks=pytest.mark.slow), False])
def test_the_last_frame_says_what_margin_the_meshes_keep(engine, fits, robot, initial, kept):
    if not kept:  # spheres that do not cover the arm
        spheres = robot.body.spheres.copy()
        spheres["radius"] -= 0.012
        engine = Engine(TASKS, fits, replace(robot, body=BodyPoints(spheres)))
    margin, scenario = 0.01, changed(initial("draw_s"), space="cspace", margin=0.01, view=View(field=False))
    frame = stage(engine, scenario, Stage.CERTIFIED)
    model, arm = load_jaco().collision, engine.solved(scenario, FINE).arm
    assert arm is not None
    clearance = [
        model.nearest_to_obstacle(arm.p[arm.index == k], scenario.obstacle).distance for k in range(len(frame.rollouts))
    ]
    assert (min(clearance) > margin - MARGIN_TOLERANCE) == kept
    said = f"keeps {1e3 * min(clearance):.2g} mm from the obstacle; 10 mm were asked for"
    of_margin = [warning for warning in frame.certificates.warnings if warning.kind is Kind.ARM_TOO_NEAR]
    assert [(said in warning.text, warning.source) for warning in of_margin] == ([] if kept else [(True, ARM)])


def test_the_arm_s_clearance_is_that_from_what_the_arm_avoids(engine):
    """Not from an obstacle that only the end effector avoids, where the fingers may be."""
    task = engine.task("draw_s")
    of_hand = Avoidance(Sphere(task.obstacle_position))
    of_arm = Avoidance(Sphere(as_point(task.mean_path[60]), 0.08), space="cspace")
    stack = (Layer(of_hand, name="Hand"), Layer(of_arm, name="Arm"))
    scenario = Scenario("draw_s", stack, view=View(field=False))
    frame = stage(engine, scenario, Stage.CERTIFIED)
    assert Kind.ARM_ENTERS in kinds(frame)
    assert Kind.ROLLOUT_ENTERS not in kinds(frame)
    p = engine.solved(scenario, FINE).arm.p
    clearance = engine.follower.whole_arm.clearance
    assert clearance(p, of_hand.avoided).min() < 0 < frame.certificates.clearance
    assert frame.certificates.clearance == pytest.approx(clearance(p, of_arm.avoided).min())


# any stack that a user can build


BETWEEN_SAMPLES = 1e-4  # metres by which a motion may be elsewhere between its samples


def assert_said(scenario, frame):
    """Whatever else is said: what goes through the obstacle, ends beside the goal or misses a bias point is."""
    layers, kinds = beside(scenario), {warning.kind for warning in frame.certificates.warnings}
    if scenario.obstacles and frame.certificates.clearance < -BETWEEN_SAMPLES:
        assert kinds & {Kind.START_COVERED, Kind.GOAL_COVERED, Kind.STAYS_INSIDE, Kind.ENTERS}
    missed = np.linalg.norm(frame.reached - frame.goal)
    if missed > MAX_GOAL_MISS and not any(getattr(layer.transform, "moves_goal", False) for layer in layers):
        assert Kind.GOAL_COVERED in kinds or says(frame, f"motions end {1e3 * missed:.0f} mm beside")
    sources = {warning.source for warning in frame.certificates.warnings}
    for layer in layers:
        point = layer.transform
        paths = [path[-1:] if point.moves_goal else resample_by_arc_length(path, 2000) for path in frame.rollouts]
        passed = max(np.linalg.norm(path - point.position, axis=1).min() for path in paths)
        assert passed < MAX_TARGET_MISS + BETWEEN_SAMPLES or layer.name in sources, layer


# 1: three obstacles and a bias point; 1008: a bias point; 1122 is squeezed most
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(k, marks=() if k == 1008 else pytest.mark.slow) for k in range(1000, 1200))]
)
def test_a_random_stack_is_a_diffeomorphism_that_leads_to_its_goal(engine, seed):
    scenario = random_scenario(engine, seed)
    *_, frame = engine.frames(scenario)
    task, certificates = engine.task(scenario.task), frame.certificates
    points = [layer.transform for layer in beside(scenario)]
    assert len(frame.levels) == 1 + len(points) + bool(scenario.obstacles)
    assert all(np.isfinite(path).all() for path in frame.rollouts)
    for path, start in zip(frame.rollouts, task.starts, strict=True):
        np.testing.assert_allclose(path[-1], frame.reached, atol=1e-3)
        np.testing.assert_allclose(path[0], start, atol=1e-3)
    moved = np.linalg.norm(frame.reached - frame.goal)
    may_move = scenario.obstacles or any(getattr(point, "moves_goal", False) for point in points)
    assert moved < 1e-3 or may_move
    assert certificates.min_det_jacobian > 0
    assert certificates.round_trip_error < 1e-6
    assert_said(scenario, frame)
