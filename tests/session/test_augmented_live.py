"""Augmented motions in everything that is live: stacks, certificates, the whole arm, the arm in the loop, pictures."""

import re
from dataclasses import replace

import numpy as np
import pytest
from crossings import crossings
from drawings import frechet
from scenes import avoiding, biases, changed, kinds

import dt_viz as dt
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.control.controller import ArmController, Phase
from dt_viz.errors import DataError, FormatError
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import ImitationSettings
from dt_viz.learning.interface import STATES
from dt_viz.learning.preparation import ImitationError, prepare
from dt_viz.learning.state import learn
from dt_viz.motion.stack import FINE, LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Scenario, Start
from dt_viz.scenario.slices import Panel
from dt_viz.scenario.tasks import TASKS, TaskEntry, drawing_task
from dt_viz.session.frame import Stage
from dt_viz.warning import Kind
from tests.benchmarks.learning import path_from

EIGHT = "draw_8"
TICK = 0.01
BY_HAND = {Kind.ARM_ENTERS}  # warnings that may come where only the path of the hand avoids
CASES = crossings()


def last(engine, scenario):
    return list(engine.frames(scenario))[-1]


def in_the_way(engine, fraction=0.3, diameter=0.08, **settings):
    """The 8 with a sphere on its mean path."""
    place = as_point(engine.task(EIGHT).mean_path[round(100 * fraction)])
    return avoiding(EIGHT, Sphere(place, diameter), **settings)


# --- Plain or augmented ---


NEED_MEMORY = {EIGHT, "draw_s_wavy"}  # tasks that the plain state does not draw


@pytest.mark.parametrize(
    "task", [pytest.param(name, marks=[pytest.mark.slow] * (name not in {*NEED_MEMORY, "draw_s"})) for name in TASKS]
)
def test_what_ships_is_learned_in_the_plain_state_where_that_draws_it(fits, new_engine, task):
    demonstrations = TASKS[task]().demonstrations
    assert (missed(fits.get(demonstrations), demonstrations) > ImitationSettings().max_missed) == (task in NEED_MEMORY)
    for asked in STATES:
        imitation = new_engine().nominal(Scenario(task, state=asked)).imitation
        wanted = "augmented" if task in NEED_MEMORY else "plain"
        assert imitation.state == (wanted if asked == "auto" else asked) and imitation.known_labels == ()
        assert ("misses a demonstration" in imitation.reason) == (task in NEED_MEMORY and asked == "auto")


def test_what_crosses_comes_back_or_begins_far_apart_gets_no_labels():
    for name in ("loop", "eight", "wide eight", "double loop", "reach and retreat", "helix, 4 turns"):
        assert augmented(CASES[name].demonstrations).known_labels == ()
    left = ways((0.1,))
    right = tuple(replace(d, positions=d.positions * [-1.0, 1.0]) for d in left)
    assert augmented((*left, *right)).known_labels == ()


# --- Labels ---


def ways(heights, seed=0, jitter=0.01):
    """Three demonstrations of each way to the goal, from about one start, in turn."""
    rng, u = np.random.default_rng(seed), np.linspace(0, 1, 150)[:, None]
    found = []
    for height in 3 * tuple(heights):
        start = np.array([0.3, 0.0]) + jitter * rng.normal(size=2)
        path = (1 - u) * start + (height + 0.01 * rng.normal()) * np.sin(np.pi * u) * [0.0, 1.0]
        found.append(Demonstration(np.linspace(0, 3 + rng.uniform(), len(u)), path, "way"))
    return tuple(found)


def augmented(demonstrations, labels=None):
    """What is learned in the augmented state."""
    return fit_augmented(demonstrations, labels)


def missed(imitation, demonstrations):
    """Largest Fréchet distance of its motions from demonstrations, relative to the extent."""
    motions = prepare(demonstrations)
    return motions.missed_by(imitation.system, imitation.system.base.demonstrated(motions.starts))


@pytest.mark.parametrize(("jitter", "seed"), [(0.0, 0), (0.03, 1)])
@pytest.mark.parametrize(
    ("heights", "labels"),
    [
        ((-0.1, 0.1), (-1.0, 1.0)),
        ((0.17, 0.05), (-1.0, 1.0)),
        ((-0.15, 0.02, 0.15), (-2.0, 0.0, 2.0)),
        ((-0.2, -0.07, 0.07, 0.2), (-3.0, -1.0, 1.0, 3.0)),
    ],
)
def test_labels_are_found_where_the_start_does_not_tell_which_way_is_taken(heights, labels, jitter, seed):
    demonstrations = ways(heights, seed=seed, jitter=jitter)
    imitation = augmented(demonstrations)
    assert imitation.labels == 3 * labels and imitation.known_labels == labels
    assert missed(imitation, demonstrations) < 0.07


@pytest.mark.parametrize(("beside", "given"), [(0.0, False), (0.1, True), (0.2, False)])
def test_a_label_means_the_same_from_starts_beside_the_demonstrated_ones(beside, given):
    demonstrations = ways((-0.1, 0.1))
    imitation = augmented(demonstrations, 3 * (-1.0, 1.0) if given else None)
    states = (imitation.states(np.array([0.3, beside]), label) for label in (-1.0, 1.0))
    low, high = (path_from(imitation.system, state, 2) for state in states)
    apart = np.abs(low - high)[:, 1]
    assert 0.17 < apart.max() < 0.22 and apart[[0, -1]].max() < 1e-9


def test_labels_that_do_not_tell_what_was_drawn_are_said():
    demonstrations = ways((-0.1, 0.1))
    for labels in ((1.0, 1.0, 1.0, -1.0, -1.0, -1.0), 6 * (0.0,)):
        assert "misses its demonstration" in learn(demonstrations, state="augmented", labels=labels).warnings[-1]
    assert not learn(demonstrations, state="augmented", labels=3 * (-1.0, 1.0)).warnings
    with pytest.raises(ImitationError, match=r"labels: found .*'left'.*; accepted: finite numbers"):
        learn(demonstrations, state="augmented", labels=3 * ("left", "right"))  # type: ignore[arg-type]


def with_ways(new_engine):
    """An engine with a task in which the start does not tell which way is taken."""
    engine = new_engine()
    made = drawing_task("ways", "Ways", "", ways((-0.1, 0.1), jitter=0.0))
    engine._tasks = {**engine._tasks, "ways": TaskEntry("Ways", lambda: made)}
    return engine


@pytest.mark.long
def test_an_added_start_takes_the_way_of_its_label_and_that_of_the_nearest_without(new_engine):
    engine = with_ways(new_engine)
    task = engine.task("ways")
    place = as_point(task.starts.mean(axis=0))
    labels = (-1.0, 1.0, None, 0.3)
    frame = last(engine, Scenario("ways", (), starts=tuple(Start(place, label) for label in labels)))
    assert frame.labels == 3 * (-1.0, 1.0) and frame.reason
    low, high, nearest, unknown = frame.rollouts[-4:]
    assert low[:, 2].min() < place[2] - 0.05 and low[:, 2].max() < place[2] + 0.02
    assert high[:, 2].max() > place[2] + 0.05 and high[:, 2].min() > place[2] - 0.02
    host = int(np.linalg.norm(task.starts - place, axis=1).argmin())
    np.testing.assert_array_equal(nearest, unknown)
    np.testing.assert_array_equal(nearest, (low, high)[host % 2])
    plain = last(engine, Scenario("ways", (), state="plain", starts=(Start(place, 1.0),)))
    assert plain.labels == () and len(plain.rollouts) == 6 + 1  # a label means nothing to it


def test_a_style_leaves_the_ways_apart(new_engine):
    engine = with_ways(new_engine)
    for amount, least, most in ((0.0, 0.0, 1e-6), (1.0, 0.005, 0.04)):
        usual, styled = (
            last(engine, Scenario("ways", (), state="augmented", style=style, style_amount=amount))
            for style in ("", "wavy")
        )
        assert usual.labels == styled.labels == 3 * (-1.0, 1.0)
        for a, b in zip(usual.rollouts, styled.rollouts, strict=True):
            assert least <= frechet(a, b) < most


def test_wrong_choices_are_named():
    demonstrations = TASKS["draw_s"]().demonstrations
    with pytest.raises(ImitationError, match="state: found 'other'; accepted: auto, plain, augmented"):
        dt.fit(demonstrations, state="other")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ImitationError, match="none in the plain state"):
        dt.fit(demonstrations, state="plain", labels=[0.0] * 7)


# --- The system ---


def test_in_the_world_motions_are_those_of_the_drawing_placed_there():
    case, rng = CASES["left and right from one start"], np.random.default_rng(1)
    drawn = fit_augmented(case.demonstrations, case.labels)
    axes, origin, scale = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2], rng.normal(size=3), 1.7
    world = drawn.placed(origin, axes, scale)
    times = np.linspace(0, 4, 30)
    for place, label in (([0.01, -0.02], -1.0), ([0.0, 0.03], 1.0), ([0.1, 0.1], None)):
        path = drawn.system.rollout(drawn.states(np.array(place), label), times)[:, :2]
        begin = world.states(origin + scale * axes @ np.array(place), label)
        placed = world.system.rollout(begin, times)[:, :3]
        np.testing.assert_allclose(placed, origin + scale * path @ axes.T, atol=1e-10)


# --- Stacks and their certificates ---


@pytest.mark.parametrize(
    "stack",
    [
        {},
        {"layers": biases(BiasPoint((0.12, -0.5, 0.50)))},
        {"layers": biases(BiasPoint((-0.2, -0.5, 0.5), moves_goal=True))},
    ],
    ids=["a sphere", "and a bias point", "and a moved goal"],
)
def test_around_what_is_in_the_way_every_certificate_holds(engine, stack):
    frame = last(engine, in_the_way(engine, **stack))
    known = frame.certificates
    assert kinds(known.warnings) <= BY_HAND and known.lyapunov_falls is True
    assert known.min_det_jacobian is not None and known.min_det_jacobian > 0
    assert known.round_trip_error is not None and known.round_trip_error < 1e-6
    assert known.clearance > 0.0098
    for path, start in zip(frame.rollouts, frame.task.starts, strict=True):
        np.testing.assert_allclose(path[0], start, atol=1e-6)
        np.testing.assert_allclose(path[-1], frame.rollouts[0][-1], atol=1e-6)


def test_the_whole_arm_gives_way(engine):
    frame = last(engine, in_the_way(engine, space="cspace"))
    assert not frame.blocked and not frame.certificates.warnings
    assert frame.certificates.min_det_jacobian is not None and frame.certificates.min_det_jacobian > 0


# --- Pictures ---


def test_pictures_are_of_the_phase_that_is_asked_for(engine):
    scenario = in_the_way(engine)
    view = replace(scenario.view, streamlines=True, grid=True, colour="lyapunov")
    pictures = {
        phase: next(
            f.pictures
            for f in engine.frames(replace(scenario, view=replace(view, phase=phase)))
            if f.stage is Stage.FINE
        )
        for phase in (1.0, 0.4)
    }
    solved = engine.solved(scenario, FINE)
    for phase, picture in pictures.items():
        rest = solved.stack.rays.z0[0, 3:].copy()
        rest[0] *= phase
        places = picture.field.points
        whole = np.column_stack([places, np.broadcast_to(rest, (len(places), len(rest)))])
        np.testing.assert_allclose(picture.field.velocities, solved.stack.system.velocity(whole)[:, :3], atol=2e-4)
        assert picture.streamlines and len(picture.grid) and np.isfinite(picture.colour.values).any()
    one, other = (picture.field.velocities for picture in pictures.values())
    assert np.abs(one - other).max() > 0.02


@pytest.mark.long
def test_the_scene_shows_both_states_side_by_side(engine):
    scene = SCENES["augmented"]
    frame = last(engine, scene.scenario(engine.task(scene.task)))
    assert frame.remembers and frame.scenario.view.panels == (Panel(task=EIGHT, state="plain"),)
    beside, own = frame.pictures.panels
    assert beside.title.startswith("plain") and own.title.startswith("augmented")
    crossing = [frechet(path, d) for path, d in zip(beside.rollouts, frame.task.paths, strict=True)]
    assert min(crossing) > 0.05 and kinds(frame.certificates.warnings) <= BY_HAND


# --- The arm in the loop ---


@pytest.fixture(scope="module", name="loop")
def _loop(engine):
    scenario = changed(Scenario(EIGHT), space="cspace", obstacles=(), margin=0.03)
    solved = engine.solved(scenario, LIVE)
    return solved, engine.follower.undisturbed(solved.nominal).tracked.q[0]


def run(controller, q, seconds, passed):
    for _ in range(round(seconds / TICK)):
        velocity = controller.step(q, TICK)
        q = q + TICK * velocity
        passed.append(q)
        if controller.phase is Phase.RESTING and np.abs(velocity).max() < 1e-3:
            break
    return q


def drawn(robot, controller, q):
    """The path of the hand (T, 3), metres, from a posture until it rests, and its last posture."""
    passed: list[np.ndarray] = []
    q = run(controller, q, 30, passed)
    return robot.end_effector(np.array(passed)), q


def farthest_from(hand, path):
    """Distance of the point of a path that a hand passes farthest from, metres."""
    return np.linalg.norm(path[:, None] - hand, axis=2).min(axis=1).max()


def test_the_arm_draws_the_8(engine, loop):
    solved, joints = loop
    controller, robot = ArmController(engine.follower, solved), engine.follower.robot
    hand, q = drawn(robot, controller, joints[0])
    assert controller.phase is Phase.RESTING and controller.left < 1e-3
    assert np.linalg.norm(hand[-1] - solved.nominal.goal) < 1e-3
    assert frechet(hand, solved.stack.bundle.paths[0]) < 0.015
    controller.home(0)
    _, q = drawn(robot, controller, q)
    controller.go()
    assert frechet(drawn(robot, controller, q)[0], solved.stack.bundle.paths[0]) < 0.02


@pytest.mark.parametrize("way", ["pushed", "held"])
def test_after_a_disturbance_it_draws_the_rest(engine, loop, way):
    solved, joints = loop
    robot, controller = engine.follower.robot, ArmController(engine.follower, solved)
    q = run(controller, joints[0], 2.5, [])
    path = solved.stack.bundle.paths[0]
    assert 0.2 < controller.left < 0.9
    reached = np.linalg.norm(path - robot.end_effector(q), axis=1).argmin()
    if way == "pushed":
        q = engine.follower.whole_arm.limits.inside(q + np.array([0.08, 0.0, 0.05, 0.0, 0.0, 0.0]))
    else:
        controller.hold(robot.end_effector(q) + np.array([0.05, 0.0, 0.03]))
        q = run(controller, q, 1.5, [])
        controller.release()
    hand, _ = drawn(robot, controller, q)
    near = np.linalg.norm(path[reached:][:, None] - hand, axis=2).min(axis=1) < 0.05 * 0.40
    assert near.mean() > 0.7
    assert np.linalg.norm(hand[-1] - solved.nominal.goal) < 1e-3


@pytest.mark.parametrize("rollout", [0, 1])
def test_the_arm_draws_the_pattern_of_the_rollout_that_it_begins(new_engine, rollout):
    engine = with_ways(new_engine)
    solved, robot = engine.solved(Scenario("ways", (), state="augmented"), LIVE), engine.follower.robot
    q = engine.follower.undisturbed(solved.nominal).tracked.q[rollout][0]
    path, other = (solved.nominal.paths[k] for k in (rollout, 1 - rollout))
    for aim in ("begin", "home"):
        controller = ArmController(engine.follower, solved)
        if aim == "begin":
            controller.begin(q, rollout)
        else:
            controller.home(rollout)
            _, q = drawn(robot, controller, q)
            controller.go()
        hand, _ = drawn(robot, controller, q)
        assert farthest_from(hand, path) < 0.01 and farthest_from(hand, other) > 0.05


# --- The library ---


def test_the_arm_in_the_loop_draws_the_pattern_of_its_label():
    label = -1.0
    across, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    turned = [
        replace(d, positions=np.array([0.1, -0.5, 0.15]) - d.positions[:, :1] * down + d.positions[:, 1:] * across)
        for d in ways((-0.1, 0.1), jitter=0.0)
    ]
    motion, arm = dt.fit(turned, state="augmented"), dt.load_jaco()
    (path, *_), (other, *_) = motion.rollouts(label=label), motion.rollouts(label=-label)
    controller, q = dt.Controller(motion, arm, label), arm.follow(path).q[0]
    controller.begin(q)
    hand, _ = drawn(arm.robot, controller, q)
    assert farthest_from(hand, path.positions) < 0.01 and farthest_from(hand, other.positions) > 0.05
    with pytest.raises(FormatError, match="label: found 3"):
        dt.Controller(motion, arm, 3.0)


@pytest.mark.long
def test_velocities_and_phase_are_what_rollouts_are_made_of():
    case = CASES["wide eight"]
    motion = dt.fit(case.demonstrations)
    around = motion.stack(dt.Avoidance(dt.Sphere((0.0, 0.08, 0.0), diameter=0.05)))
    start = case.demonstrations[1].positions[0] + 0.01
    (path,) = around.rollouts(start[None], spacing=0.002)
    y, phase, step = start, 1.0, 0.004
    for _ in range(round(2 / step)):
        middle = y + step / 2 * around.velocity(y, phase, start)
        between = phase - step / 2 * around.phase_rate(phase, start)
        y = y + step * around.velocity(middle, between, start)
        phase -= step * around.phase_rate(between, start)
    exact = [np.interp(2.0, path.times, x) for x in path.positions.T]
    np.testing.assert_allclose(y, exact, atol=1e-3)
    assert around.state == "augmented" and motion.reason and 0 < phase < 1
    plain = dt.fit(TASKS["draw_s"]().demonstrations, state="plain")
    assert (plain.state, plain.reason, plain.phase_rate(0.5)) == ("plain", "", 0.0)


@pytest.mark.parametrize("given", [False, True])
def test_saved_motions_come_back_with_their_state_and_labels(tmp_path, given):
    case = CASES["left and right from one start"]
    motion = dt.fit(case.demonstrations, labels=case.labels if given else None)
    start = case.demonstrations[0].positions[:1]
    left, right = (motion.rollouts(start, label=label)[0].positions for label in motion.labels[::-1])
    assert max(left[:, 1].max(), right[:, 1].max()) > 0.09 and min(left[:, 1].min(), right[:, 1].min()) < -0.09
    assert motion.labels == (-1.0, 1.0) and bool(motion.reason) != given
    motion.save(tmp_path / "motion.npz")
    again = dt.Motion.load(tmp_path / "motion.npz")
    assert (again.labels, again.reason) == (motion.labels, motion.reason)
    np.testing.assert_array_equal(again.rollouts(start, label=1.0)[0].positions, left)
    with pytest.raises(FormatError, match=r"label: found 3\.0; accepted: -1, 1"):
        motion.rollouts(start, label=3.0)


@pytest.fixture(scope="module")
def two_ways():
    return dt.fit(ways((-0.1, 0.1)), state="augmented")


def test_without_starts_a_label_chooses_the_demonstrations(two_ways):
    motion = two_ways
    assert motion.demonstrated_labels == 3 * (-1.0, 1.0)
    every, low = motion.rollouts(), motion.rollouts(label=-1.0)
    assert len(every) == 6 and len(low) == 3
    for a, b in zip(every[::2], low, strict=True):
        np.testing.assert_allclose(a.positions[[0, 50, -1]], b.positions[[0, 50, -1]], atol=1e-9)
    with pytest.raises(FormatError, match="label: found 7"):
        motion.rollouts(label=7.0)
    with pytest.raises(FormatError, match="none: the demonstrations have none"):
        dt.fit(CASES["wide eight"].demonstrations).rollouts(label=1.0)


@pytest.mark.parametrize(("label", "pushed"), [(-1.0, False), (1.0, True)])
def test_the_hand_in_the_loop_draws_what_the_rollout_does(pushed, label):
    motion = dt.fit(ways((-0.1, 0.1), jitter=0.0), state="augmented").stack(
        dt.Avoidance(dt.Sphere((0.15, 0.1 * label, 0.0), diameter=0.04))
    )
    start = np.array([0.3, 0.0])
    (path,) = motion.rollouts(start[None], label=label, spacing=0.002)
    controller, y, passed, period = dt.HandController(motion, start, label), start, [start], 0.005
    for tick in range(round(2 * path.times[-1] / period)):
        y = y + period * controller.step(y, period)
        if pushed and tick == 150:
            before = controller.phase
            y = y + np.array([0.04, 0.0])
            controller.step(y, 1e-4)
            assert 0.05 < controller.phase - before < 0.16  # it was pushed back
        passed.append(y)
    assert np.linalg.norm(y - motion.goal) < 2e-3 and controller.phase < 0.01
    near = np.linalg.norm(path.positions[:, None] - np.array(passed), axis=2).min(axis=1)
    assert near.max() < (0.04 if pushed else 2e-3)


def test_the_hand_in_the_loop_of_a_plain_motion_needs_no_memory():
    motion = dt.fit(TASKS["draw_s"]().demonstrations, state="plain")
    start = motion.rollouts()[0].positions[0]
    controller = dt.HandController(motion, start)
    np.testing.assert_allclose(controller.step(start + 0.01, 1e-3), motion.velocity(start + 0.01), rtol=0.05, atol=1e-3)
    assert controller.phase == 0


@pytest.mark.parametrize(
    ("wrong", "found"),
    [
        (lambda m: m.velocity([0.3, 0.0], 1.5), "phase: found 1.5; accepted: 0 to 1"),
        (lambda m: m.velocity([0.3, 0.0], np.nan), "phase: found nan"),
        (lambda m: m.phase_rate(-0.2), "phase: found -0.2"),
        (lambda m: m.velocity([0.3, 0.0, 0.0], 1.0), "y: found 1×3 numbers; accepted: places of 2 coordinates"),
        (lambda m: m.velocity([0.3, 0.0], 1.0, start=[0.0, 0.0, 0.0]), "start: found 1×3 numbers"),
        (lambda m: m.velocity([0.3, 0.0], 1.0, start=[0.0, np.nan]), "start: found a number that is not finite"),
        (lambda m: m.rollouts([[0.0, 0.0, 0.0]]), "starts: found 1×3 numbers"),
        (lambda m: m.rollouts([]), "starts: found 1×0 numbers"),
        (lambda m: m.rollouts(np.zeros((0, 2))), "starts: found 0×2 numbers"),
        (lambda m: m.rollouts(spacing=0.0), "spacing: found 0; accepted: metres, above 0"),
        (lambda m: m.rollouts([[0.3, 0.0]], label="1"), "label: found '1'; accepted: -1, 1"),
        (lambda m: dt.HandController(m, [0.3]), "start: found 1×1 numbers"),
        (lambda m: dt.HandController(m, [0.3, 0.0], 5.0), "label: found 5.0"),
        (lambda m: dt.HandController(m, [0.3, 0.0]).step([0.3, 0.0], 0.0), "dt: found 0; accepted: seconds, above 0"),
        (lambda m: dt.HandController(m, [0.3, 0.0]).step([0.3], 0.01), "position: found 1×1 numbers"),
    ],
)
def test_wrong_values_are_named(two_ways, wrong, found):
    with pytest.raises(dt.FormatError, match=re.escape(found)):
        wrong(two_ways)


def test_a_saved_motion_warns_as_before_and_one_whose_labels_do_not_fit_is_refused(tmp_path):
    motion = dt.fit(ways((-0.1, 0.1)), labels=6 * (0.0,))
    motion.save(tmp_path / "motion.npz")
    found = [m.certificates().found for m in (motion, dt.Motion.load(tmp_path / "motion.npz"))]
    assert found[0] == found[1] and "misses its demonstration" in found[0][0].text
    motion._learned = replace(motion._learned, imitation=replace(motion._learned.imitation, labels=(1.0,)))
    with pytest.raises(DataError, match="labels"):
        motion.save(tmp_path / "motion.npz")
