"""Scenario to frames, for the tasks that ship: what a picture promises, whatever the scenario."""

import itertools
import threading
from dataclasses import replace

import numpy as np
import pytest
from oracles import used_fraction
from scenes import avoiding, biases, changed, frame_at, kinds, says

import dt_viz.session.engine as engine_module
from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE
from dt_viz.avoidance.bias import MAX_TARGET_MISS, BiasPoint
from dt_viz.avoidance.passing import ANEW
from dt_viz.errors import UnwantedError
from dt_viz.flows import rollouts
from dt_viz.memo import Memo
from dt_viz.metrics import distance_from_path, maximum_collision_distance
from dt_viz.motion import diagnostics
from dt_viz.motion.certificates import MAX_ROUND_TRIP
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import MeshObstacle, Sphere, as_point
from dt_viz.obstacles.solids import Solid
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import plane_of, switched
from dt_viz.scenario.tasks import TASKS, TaskEntry, drawing_task
from dt_viz.scheduler import Rank, Scheduler
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.ui.page import initial
from dt_viz.warning import Kind

PATIENCE = 60
"""Seconds after which threads that should have ended are given up; nothing takes that long."""
TASK_NAMES = ["draw_s", "lift_box"]
MARGIN_KEPT = 0.9
NUM_MOMENTS = 12


@pytest.fixture(params=TASK_NAMES, name="scenario")
def _scenario(request, initial) -> Scenario:
    return initial(request.param)


def placed(scenario, position, diameter=0.15, **changes):
    x, y, z = (float(c) for c in position)
    return changed(scenario, obstacles=(Sphere((x, y, z), diameter),), **changes)


def mean_end(task):
    return np.mean([path[-1] for path in task.paths], axis=0)


def starts_of(frame):
    return np.stack([path[0] for path in frame.rollouts])


def ends_of(frame):
    return np.stack([path[-1] for path in frame.rollouts])


def depth(frame):
    """How deep a drawn line enters the obstacle, also between its points."""
    return max(maximum_collision_distance(path, frame.scenario.obstacle.signed_distance) for path in frame.rollouts)


def assert_finite(frame):
    for path, times in zip(frame.rollouts, frame.times, strict=True):
        assert np.isfinite(path).all() and np.isfinite(times).all()
    assert np.isfinite(frame.reached).all() and np.isfinite(frame.certificates.clearance)
    field = frame.pictures.field
    if field is not None:
        assert np.isfinite(field.points).all() and np.isfinite(field.velocities).all()
    if frame.arm is not None:
        assert np.isfinite(frame.arm.q).all()


def test_frames_come_in_the_order_of_their_stages_and_hold_what_they_promise(engine, scenario):
    frames = list(engine.frames(scenario))
    assert [frame.stage for frame in frames] == list(Stage)
    for frame in frames:
        assert frame.scenario == scenario
        assert len(frame.rollouts) == len(frame.times) == len(frame.ghost) == len(frame.task.demonstrations)
        assert (frame.pictures.field is not None) == (frame.stage >= Stage.LIVE)
        assert (frame.arm is not None) == (frame.stage >= Stage.FINE)
        assert (frame.certificates.min_det_jacobian is not None) == (frame.stage >= Stage.CERTIFIED)
        assert_finite(frame)
        assert depth(frame) == 0 or frame.stage is Stage.ROLLOUTS
        for path, times in zip(frame.rollouts, frame.times, strict=True):
            assert len(path) == len(times)
            assert (np.diff(times) > 0).all() and times[0] == pytest.approx(0, abs=1e-9)
    assert frames[Stage.LIVE].certificates.clearance > MARGIN_KEPT * scenario.avoidance.margin
    certificates = frames[-1].certificates
    assert certificates.min_det_jacobian > 0 and certificates.round_trip_error < 1e-6 and certificates.lyapunov_falls
    assert set(certificates.warnings) <= set(certificates.collision.warnings)  # only the hand gives way


def poses_near(paths, num, seed):
    """Places up to 5 cm from the mean path, ends left out."""
    rng = np.random.default_rng(seed)
    count = min(len(path) for path in paths)
    mean = np.mean([path[np.linspace(0, len(path) - 1, count).astype(int)] for path in paths], axis=0)
    along = rng.integers(round(0.3 * count), round(0.7 * count), num)
    offset = rng.normal(size=(num, 3))
    offset *= rng.uniform(0, 0.05, (num, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    return mean[along] + offset


@pytest.mark.parametrize("task", TASK_NAMES)
def test_no_drawn_segment_crosses_the_obstacle_wherever_it_stands(engine, initial, task):
    starts = engine.task(task).starts
    for pose in poses_near(engine.task(task).paths, 3, seed=0):
        for frame in engine.frames(placed(initial(task), pose, diameter=0.12)):
            if frame.stage in (Stage.LIVE, Stage.FINE):
                where = f"obstacle at {pose}, {frame.stage.name}"
                assert depth(frame) == 0, where
                assert frame.certificates.clearance > 0.8 * frame.scenario.avoidance.margin, where
                tolerance = 1e-5 if frame.stage is Stage.FINE else 5e-4
                np.testing.assert_allclose(starts_of(frame), starts, rtol=0, atol=tolerance, err_msg=where)
                goals = np.broadcast_to(frame.goal, ends_of(frame).shape)
                np.testing.assert_allclose(ends_of(frame), goals, rtol=0, atol=tolerance, err_msg=where)
            if frame.stage is Stage.FINE:
                break


def beside_goal(engine, scenario, diameter, clearance):
    """The scenario with its obstacle so near the goal, on the side of where it first stands."""
    goal = frame_at(engine, scenario, Stage.ROLLOUTS).goal
    away = np.array(scenario.obstacles[0].position) - goal
    return placed(scenario, goal + (diameter / 2 + clearance) * away / np.linalg.norm(away), diameter)


@pytest.mark.parametrize(("diameter", "clearance"), [(0.08, 0.03), (0.15, 0.0005), (0.15, 0.015)])
def test_motions_end_exactly_at_a_free_goal_or_it_is_said_that_they_miss_it(engine, scenario, diameter, clearance):
    frame = frame_at(engine, beside_goal(engine, scenario, diameter, clearance), Stage.FINE)
    assert depth(frame) < 1e-5
    np.testing.assert_allclose(ends_of(frame), np.broadcast_to(frame.reached, ends_of(frame).shape), rtol=0, atol=1e-4)
    missed = np.linalg.norm(frame.reached - frame.goal)
    said = Kind.GOAL_MISSED in kinds(frame.certificates.warnings)
    assert missed < 1e-4 or (said and clearance < 0.02), (missed, frame.certificates.warnings)


@pytest.mark.parametrize("offset", [(0.02, 0.0, 0.03), (0.0, 0.0, 0.07), (0.001, 0.0, 0.0)])
def test_motions_to_a_covered_goal_stay_outside_and_end_beside_the_obstacle(engine, scenario, offset):
    goal = frame_at(engine, scenario, Stage.ROLLOUTS).goal
    centre = goal + np.array(offset)
    for wanted in (Stage.LIVE, Stage.FINE):
        frame = frame_at(engine, placed(scenario, centre, 0.15), wanted)
        assert depth(frame) < 1e-5
        assert np.linalg.norm(frame.reached - centre) < 0.075 + 0.03  # the margin, or the obstacle's own image of it
        assert Kind.GOAL_COVERED in kinds(frame.certificates.warnings)


def test_without_avoidance_the_rollouts_are_the_ghost(engine, scenario):
    for frame in engine.frames(changed(scenario, avoids=False)):
        assert not frame.durations
        for path, ghost in zip(frame.rollouts, frame.ghost, strict=True):
            if frame.stage <= Stage.LIVE:
                np.testing.assert_allclose(path, ghost, rtol=0, atol=1e-12)
            assert distance_from_path(ghost, path).max() < 1e-12


def test_without_imitation_motions_are_straight(engine, scenario):
    frame = frame_at(engine, changed(scenario, imitation=False, avoids=False), Stage.LIVE)
    for path, start in zip(frame.rollouts, frame.task.starts, strict=True):
        np.testing.assert_allclose(path[[0, -1]], [start, frame.goal], rtol=0, atol=1e-12)
        along = (frame.goal - start) / np.linalg.norm(frame.goal - start)
        aside = (path - start) - np.outer((path - start) @ along, along)
        assert np.abs(aside).max() < 1e-12


def test_the_field_is_drawn_outside_the_obstacle_and_is_the_velocity_of_the_motion(engine, scenario):
    frame = frame_at(engine, scenario, Stage.LIVE)
    live, fine = frame.pictures.field, frame_at(engine, scenario, Stage.FINE).pictures.field
    assert live is not None and fine is not None
    assert scenario.obstacle.signed_distance(live.points).min() > 0
    np.testing.assert_array_equal(fine.points, live.points)
    largest = np.linalg.norm(fine.velocities, axis=1).max()
    # the fastest arrows stand where the stack stretches most, and show the tolerance of the live stage most
    assert np.abs(fine.velocities - live.velocities).max() < 0.05 * largest


AWKWARD = {
    "on the goal": ("goal", 0.15, Kind.GOAL_COVERED),
    "on a start": ("start", 0.15, Kind.START_COVERED),
    "around everything": ("middle", 2.0, Kind.START_COVERED),
}


@pytest.mark.parametrize("case", AWKWARD)
@pytest.mark.parametrize("imitation", [True, False])
def test_an_awkward_obstacle_is_said_in_words_and_everything_stays_finite(engine, scenario, case, imitation):
    where, diameter, kind = AWKWARD[case]
    task = engine.task(scenario.task)
    position = {"goal": mean_end(task), "start": task.starts[0], "middle": scenario.obstacles[0].position}[where]
    for frame in engine.frames(placed(scenario, position, diameter, imitation=imitation)):
        assert_finite(frame)
        assert kind in kinds(frame.certificates.warnings), frame.certificates.warnings
        if frame.stage is Stage.FINE:
            break


@pytest.mark.parametrize("duration", [None, 0.0, 0.3])
@pytest.mark.parametrize("generator", ["probability", "free-space"])
def test_a_motion_either_clears_the_obstacle_or_that_is_said(engine, scenario, generator, duration):
    frame = frame_at(engine, changed(scenario, generator=generator, duration=duration), Stage.LIVE)
    assert_finite(frame)
    assert (depth(frame) == 0) != bool(frame.certificates.warnings)


def test_the_arm_follows_the_chosen_rollout(engine, robot, scenario):
    scenario = replace(scenario, view=replace(scenario.view, replay=True))
    for chosen in (0, 3):
        frame = frame_at(engine, replace(scenario, arm_rollout=chosen), Stage.LIVE)
        assert frame.arm is not None
        beside = distance_from_path(robot.end_effector(frame.arm.q), frame.rollouts[chosen]).max()
        assert beside < 1e-3 or Kind.PATH_MISSED in kinds(frame.certificates.warnings)
        assert frame.arm.times[0] == frame.times[chosen][0]
        assert frame.arm.times[-1] >= frame.times[chosen][-1]  # later where the joints cannot keep up
        assert used_fraction(frame.arm.times, frame.arm.q, robot.velocity_limits) <= 1 + 1e-9


@pytest.mark.parametrize(("beyond", "radius"), [((0.0, 0.2, 0.15), 0.4), ((0.0, 0.05, 0.05), 0.2)])
def test_times_increase_where_a_strong_bias_stretches_space_at_the_goal(engine, initial, robot, beyond, radius):
    scenario = changed(initial("drop_pots"), obstacles=())
    target = mean_end(engine.task("drop_pots")) + np.array(beyond)
    point = BiasPoint(as_point(target), radius=radius, strength=4.0)
    frames = engine.frames(changed(scenario, layers=biases(point)))
    for frame in itertools.islice(frames, Stage.CERTIFIED):  # certificates change no times
        for times in frame.times:
            assert (np.diff(times) > 0).all()
        if frame.arm is not None:
            assert (np.diff(frame.arm.times) > 0).all()
            assert used_fraction(frame.arm.times, frame.arm.q, robot.velocity_limits) <= 1 + 1e-9


def test_a_motion_that_would_take_too_many_samples_says_so(new_engine, initial, monkeypatch):
    scenario = initial("draw_s")
    frame = frame_at(new_engine(), scenario, Stage.FINE)
    assert Kind.UNSAMPLED not in kinds(frame.certificates.warnings)
    most = sum(len(path) for path in frame.rollouts) - 5
    for module in (rollouts, diagnostics):
        monkeypatch.setattr(module, "MAX_SAMPLES", most)
    frame = frame_at(new_engine(), scenario, Stage.FINE)
    assert sum(len(path) for path in frame.rollouts) == most
    assert Kind.UNSAMPLED in kinds(frame.certificates.warnings)


@pytest.mark.long
@pytest.mark.parametrize("space", ["task", "cspace"])
def test_wherever_refining_is_cancelled_it_leaves_nothing_half_done(fits, robot, space):
    (demonstration, *_), passed = TASKS["draw_s"]().demonstrations, []
    one = TaskEntry("One", lambda: drawing_task("one", "One", "", (demonstration,)))
    undisturbed = Engine({"one": one}, fits, robot)
    scenario = avoiding("one", Sphere(one().obstacle_position), space=space)
    *_, expected = undisturbed.frames(scenario, cancelled=lambda: passed.append(None) is not None)
    assert len(passed) >= len(Stage)
    for moment in np.linspace(0, len(passed) - 1, NUM_MOMENTS).astype(int):
        left, stages = iter(range(moment)), []
        engine = Engine({"one": one}, fits, robot)
        with pytest.raises(UnwantedError):
            for frame in engine.frames(scenario, cancelled=lambda left=left: next(left, None) is None):
                stages.append(frame.stage)
        assert stages[:2] == [Stage.ROLLOUTS, Stage.LIVE]  # what follows a hand comes first, and whole
        *_, found = engine.frames(scenario)
        for path, times, same, at in zip(found.rollouts, found.times, expected.rollouts, expected.times, strict=True):
            np.testing.assert_allclose(path, same, rtol=0, atol=1e-9)
            np.testing.assert_allclose(times, at, rtol=0, atol=1e-9)
        assert (found.certificates, found.durations) == (expected.certificates, expected.durations)


def test_a_hand_is_followed_while_all_others_refine(new_engine, initial, monkeypatch):
    slots = Scheduler(2)
    monkeypatch.setattr(engine_module, "SCHEDULER", slots)
    frames = new_engine().frames(initial("lift_box"))
    with slots.slot(Rank.REFINEMENT):
        assert [next(frames).stage, next(frames).stage] == [Stage.ROLLOUTS, Stage.LIVE]


def test_refining_that_is_not_wanted_any_more_does_not_wait_for_its_slot(new_engine, initial, monkeypatch):
    """Else a hand that moves again would wait for all others to rest."""
    slots, ended, unwanted = Scheduler(1), threading.Event(), threading.Event()
    monkeypatch.setattr(engine_module, "SCHEDULER", slots)
    frames = new_engine().frames(initial("draw_s"), cancelled=unwanted.is_set)

    def refine():
        with pytest.raises(UnwantedError):
            list(frames)
        ended.set()

    assert [next(frames).stage, next(frames).stage] == [Stage.ROLLOUTS, Stage.LIVE]
    with slots.slot(Rank.REFINEMENT):
        threading.Thread(target=refine, daemon=True).start()
        assert not ended.wait(0.1)
        unwanted.set()
        assert ended.wait(PATIENCE)


@pytest.mark.long
def test_as_a_task_begins_it_is_computed_once_for_all_visitors(fits, robot, initial):
    shared, last, ball = Memo(), Stage.CERTIFIED, initial("draw_s").obstacles[0]
    layers = biases(BiasPoint(as_point(np.add(ball.position, (0.1, 0.0, 0.1)))))
    scenario = replace(changed(initial("draw_s"), space="cspace", layers=layers), passing=ANEW)
    first, second = (Engine(TASKS, fits, robot, shared) for _ in range(2))
    one, same = frame_at(first, scenario, last), frame_at(second, scenario, last)
    assert same.motion is one.motion and same.certificates == one.certificates
    dragged = placed(scenario, np.add(ball.position, 0.01), passing=one.passing)
    assert frame_at(first, dragged, last).motion is not frame_at(second, dragged, last).motion
    mesh = changed(scenario, obstacles=(MeshObstacle(ball.position, Solid(*ball.surface())),))
    assert frame_at(first, mesh, Stage.LIVE).motion is not frame_at(second, mesh, Stage.LIVE).motion


def random_edit(rng, scenario, initial):
    kind = rng.integers(0, 6)
    if kind == 0:
        return changed(initial(str(rng.choice(TASK_NAMES))), temperature=scenario.avoidance.temperature)
    if kind == 1:
        return changed(scenario, generator=str(rng.choice(["free-space", "probability"])), duration=0.4)
    if kind == 2:
        return changed(scenario, imitation=bool(rng.integers(2)), avoids=bool(rng.integers(2)))
    if kind == 3:
        return changed(scenario, arm_rollout=int(rng.integers(7)), temperature=float(rng.uniform(1, 12)))
    position = np.array(scenario.obstacles[0].position) + rng.normal(size=3) * 0.03
    return placed(scenario, position, float(rng.uniform(0.05, 0.2)))


@pytest.mark.parametrize("seed", range(2))
def test_the_same_scenario_gives_the_same_frame_whatever_was_shown_before(new_engine, initial, seed):
    used, rng = new_engine(), np.random.default_rng(seed)
    scenario = initial(TASK_NAMES[seed])
    for _ in range(8):
        scenario = random_edit(rng, scenario, initial)
        frame_at(used, scenario, Stage.LIVE)
    a, b = frame_at(used, scenario, Stage.LIVE), frame_at(new_engine(), scenario, Stage.LIVE)
    for first, second in ((a.rollouts, b.rollouts), (a.times, b.times), (a.ghost, b.ghost)):
        for left, right in zip(first, second, strict=True):
            np.testing.assert_array_equal(left, right)
    assert a.pictures.field is not None and b.pictures.field is not None
    np.testing.assert_array_equal(a.pictures.field.velocities, b.pictures.field.velocities)
    assert (a.certificates, a.durations) == (b.certificates, b.durations)
    assert (a.arm is None) == (b.arm is None)


@pytest.mark.parametrize("space", ["task", "cspace"])
def test_a_bias_point_that_motions_pass_giving_way_is_said_with_the_distance(engine, initial, space):
    scenario = initial("draw_s")
    target = np.add(scenario.obstacles[0].position, (0.10, 0.0, 0.0))
    point = BiasPoint(as_point(target), plane=plane_of(engine.task("draw_s")))
    scenario = changed(scenario, space=space, layers=biases(point))
    frame = frame_at(engine, scenario, Stage.ROLLOUTS)
    missed = max(np.linalg.norm(path - target, axis=1).min() for path in frame.rollouts)
    told = [warning for warning in frame.certificates.warnings if warning.kind is Kind.TARGET_MISSED]
    assert len(told) == 1
    assert missed > MAX_TARGET_MISS
    assert told[0].text.startswith("Bias 1: the arm" if space != "task" else "Bias 1: a motion")
    said = float(told[0].text.split()[-4])
    assert said == pytest.approx(1e3 * missed, abs=2)  # the samples are that far beside the motion between them
    off = replace(scenario, stack=switched(scenario, "Bias 1"))
    for quiet in (off, replace(scenario, warp=0.5), changed(scenario, avoids=False)):
        assert not says(frame_at(engine, quiet, Stage.ROLLOUTS), "Bias 1")


@pytest.mark.long
@pytest.mark.parametrize(
    "task", [pytest.param(name, marks=() if name == "draw_s" else pytest.mark.slow) for name in TASKS]
)
def test_every_check_of_the_first_picture_holds(engine, at_rest, robot, task):
    scenario = initial(engine.task(task))
    frame = at_rest(scenario, Stage.CERTIFIED)
    certificates, report = frame.certificates, frame.certificates.collision
    assert (frame.blocked, certificates.found) == ((), ())
    assert certificates.lyapunov_falls
    assert certificates.min_det_jacobian > 0
    assert certificates.round_trip_error < MAX_ROUND_TRIP
    assert report.itself is None
    assert report.table.distance > 0
    assert np.linalg.norm(frame.reached - frame.goal) < 1e-5
    # the report is of the motion that the arm shows: look at the meshes on all of them, where one was in the way
    arm, margin = engine.solved(scenario, FINE).arm, scenario.avoidance.margin
    assert np.unique(arm.index).tolist() == list(range(len(frame.task.paths)))

    def clearance(q):
        return min(load_jaco().collision.obstacle_distance(q, part)[0].min() for part in scenario.obstacles)

    if task != "drop_pots":  # there it stands beyond the pots
        assert clearance(arm.q) < margin - MARGIN_TOLERANCE
    assert clearance(arm.p) > margin - MARGIN_TOLERANCE
    assert np.all((robot.lower <= arm.p) & (arm.p <= robot.upper))


@pytest.mark.parametrize(("passing", "rank"), [(ANEW, Rank.FIRST_PICTURE), (None, Rank.DRAG)])
def test_the_first_picture_of_a_task_takes_no_slot_of_a_hand(new_engine, initial, monkeypatch, passing, rank):
    slots, taken = Scheduler(2), []
    slot = slots.slot
    monkeypatch.setattr(engine_module, "SCHEDULER", slots)
    monkeypatch.setattr(slots, "slot", lambda rank=Rank.DRAG, *more: (taken.append(rank), slot(rank, *more))[1])
    frame_at(new_engine(), replace(initial("draw_s"), passing=passing), Stage.LIVE)
    assert taken == [rank, rank]
