"""Obstacles that are dragged through motions: what is remembered from one frame to the next, and what is left of it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scenes import changed, frame_at

from dt_viz.avoidance.arm_field import WholeArmSettings
from dt_viz.avoidance.detour import DETOUR
from dt_viz.avoidance.passing import ANEW
from dt_viz.metrics import discrete_frechet, resample_by_arc_length
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import solve
from dt_viz.motion.stack import FINE, LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Stage

DIAMETER = 0.15  # diameter of the dragged ball, metres
JUMP = DIAMETER / 2
"""Distance of a rollout from that in the frame before that is not wanted, metres: one that changes sides moves by about
the ball's diameter."""
NOTHING_DRAWN = View(field=False)
DRAGS = {
    # task, who gives way: a place near which motions change sides, direction of the drag, and the distance beyond the
    # place at which they have changed sides in a drag, too, metres
    ("draw_s", "task"): ((0.0908, -0.5029, 0.2338), (0.74, 0.54, -0.40), 0.042),
    ("push_box", "cspace"): ((0.2362, -0.4867, 0.1760), (-0.72, -0.42, 0.55), 0.059),
}


def dragged(engine, scenarios):
    """The frames of stage LIVE of scenarios, each of which goes on from the one before."""
    frames, passing = [], ANEW
    for scenario in scenarios:
        frames.append(frame_at(engine, replace(scenario, passing=passing), Stage.LIVE))
        passing = frames[-1].passing
    return frames


class Drag:
    """A ball of 15 cm that is dragged straight through a motion."""

    def __init__(self, initial, task, space):
        self.scenario = changed(initial(task), space=space, view=NOTHING_DRAWN)
        place, direction, self.beyond = DRAGS[task, space]
        self._place, self._direction = np.array(place), np.array(direction)

    def at(self, offset):
        """The scenario with the ball that far beyond the place, metres."""
        x, y, z = (float(c) for c in self._place + offset * self._direction)
        return changed(self.scenario, obstacles=(Sphere((x, y, z), DIAMETER),))

    def between_sides(self, engine):
        """The same with the place at which motions change sides, where nothing was dragged."""
        before, after = -0.012, 0.012
        first = ways(engine.solved(self.at(before), LIVE)).side
        assert first @ ways(engine.solved(self.at(after), LIVE)).side < 0.5
        while after - before > 1e-4:
            middle = (before + after) / 2
            if first @ ways(engine.solved(self.at(middle), LIVE)).side > 0.5:
                before = middle
            else:
                after = middle
        self._place = self._place + before * self._direction
        return self

    def dragged(self, engine, offsets):
        """The frames of stage LIVE of an engine."""
        return dragged(engine, [self.at(offset) for offset in offsets])


ONE_SLOW = [("draw_s", "task"), pytest.param(("push_box", "cspace"), marks=pytest.mark.slow)]


@pytest.fixture(scope="module")
def between(initial, new_engine):
    """The drag of a task in a space, through the place at which motions change sides."""
    return cache(lambda task, space: Drag(initial, task, space).between_sides(new_engine()))


@pytest.fixture(name="drag", params=DRAGS, ids=str)
def _drag(request, between):
    return between(*request.param)


def resampled(frame):
    return np.stack([resample_by_arc_length(path, 60) for path in frame.rollouts])


def largest_step(frames):
    return max(float(discrete_frechet(a, b).max()) for a, b in pairwise(map(resampled, frames)))


def ways(solved):
    """The ways out of the only obstacle."""
    (way,) = solved.stack.built[0].made.detours if solved.arm is None else solved.arm.detours
    return way


def test_no_motion_jumps_where_a_drag_goes_on(drag, new_engine):
    offsets = np.arange(-0.005, 0.004, 0.001)
    assert largest_step([drag.dragged(new_engine(), [offset])[0] for offset in offsets[4:8]]) > JUMP
    assert largest_step(drag.dragged(new_engine(), offsets)) < JUMP / 4


@pytest.mark.parametrize(
    ("task", "begin", "end"),
    [
        ("draw_s", (0.0975, -0.5, 0.4508), (0.0940, -0.5, 0.4634)),  # the ball comes over a start
        ("draw_s", (0.0671, -0.5, 0.4717), (0.0682, -0.5, 0.4617)),  # motions come near on the ball's other side
        pytest.param(  # starts come near, one after the other
            *("lift_box", (0.2874, -0.3515, 0.3476), (0.2974, -0.3450, 0.3529)), marks=pytest.mark.slow
        ),
    ],
)
def test_no_motion_jumps_where_an_obstacle_comes_over_starts(task, begin, end, initial, new_engine):
    engine, scenario = new_engine(), changed(initial(task), space="task", view=NOTHING_DRAWN)
    balls = [Sphere(as_point(place), DIAMETER) for place in np.linspace(begin, end, 14)]
    frames = dragged(engine, [changed(scenario, obstacles=ball) for ball in balls])
    assert largest_step(frames) < JUMP


@pytest.mark.parametrize("drag", ONE_SLOW, indirect=True, ids=str)
def test_sides_are_kept_at_rest_and_do_not_depend_on_the_steps(drag, new_engine):
    rested = []
    for num in (4, 8):
        engine = new_engine()
        last = drag.dragged(engine, np.linspace(-0.012, 0.004, num))[-1]
        live, fine = (engine.solved(last.scenario, precision) for precision in (LIVE, FINE))
        assert ways(fine).kept and ways(fine).direction is ways(fine).side
        assert ways(fine).side @ ways(live).side > 0.9
        rested.append(ways(fine))
    assert rested[0].side @ rested[1].side > 0.99
    assert rested[0].side @ ways(new_engine().solved(drag.at(0.004), FINE)).side < 0.5


def test_a_change_of_sides_is_complete_at_rest(drag, new_engine):
    engine, fresh = new_engine(), new_engine()
    last = drag.dragged(engine, np.linspace(-0.012, drag.beyond, 10))[-1]
    rested, alone = ways(engine.solved(last.scenario, FINE)), ways(fresh.solved(drag.at(drag.beyond), FINE))
    assert rested.side @ alone.side > 0.999


@pytest.mark.parametrize("drag", ONE_SLOW, indirect=True, ids=str)
def test_where_nothing_was_dragged_nothing_is_remembered(drag, new_engine):
    engine, scenario = new_engine(), drag.at(0.0)
    drag.dragged(engine, [0.0])
    shown = engine.solved(scenario, FINE)
    alone = solve(scenario.motion, engine.nominal(scenario), FINE, engine.follower)
    np.testing.assert_array_equal(shown.stack.bundle.positions, alone.stack.bundle.positions)
    if shown.arm is not None and alone.arm is not None:
        np.testing.assert_array_equal(shown.arm.p, alone.arm.p)


@pytest.mark.parametrize("drag", ONE_SLOW, indirect=True, ids=str)
def test_a_scenario_with_its_passing_gives_one_motion_after_any_history_and_on_any_thread(drag, new_engine, initial):
    rng, used = np.random.default_rng(1), new_engine()
    wanted = drag.dragged(used, np.arange(-0.005, 0.004, 0.001))[-1].scenario
    passing = ANEW
    for _ in range(12):
        task = str(rng.choice(["draw_s", "push_box"]))
        ball = Sphere(as_point(used.task(task).mean_path[50] + rng.normal(size=3) * 0.05), rng.uniform(0.08, 0.2))
        other = changed(initial(task), obstacles=ball, space=str(rng.choice(["task", "cspace"])), view=NOTHING_DRAWN)
        stage = (Stage.LIVE, Stage.FINE)[rng.integers(2)]
        passing = frame_at(used, replace(other, passing=passing), stage).passing
    with ThreadPoolExecutor(1) as thread:
        elsewhere = thread.submit(
            lambda: [new_engine().solved(wanted, precision) for precision in (LIVE, FINE)]
        ).result()
    for precision, fresh in zip((LIVE, FINE), elsewhere, strict=True):
        found, undecided = used.solved(wanted, precision), used.solved(replace(wanted, passing=None), precision)
        np.testing.assert_array_equal(found.stack.bundle.positions, fresh.stack.bundle.positions)
        if found.arm is not None:
            np.testing.assert_array_equal(found.arm.p, fresh.arm.p)
        assert ways(found).side @ ways(undecided).side < 0.5  # the drag is seen in it


# --- the arm ---


def beside_goal(nominal, distance):
    """What the arm avoids: a ball on the motion at this distance from the goal, metres."""
    mean = np.mean(nominal.paths, axis=0)
    x, y, z = mean[np.argmin(np.abs(np.linalg.norm(mean - nominal.goal, axis=1) - distance))]
    return Sphere((float(x), float(y), float(z)), 0.15)


def test_a_reference_posture_is_kept_only_while_something_is_in_the_way(engine, robot, initial):
    nominal, follower = engine.nominal(initial("push_box")), Follower(robot)
    ball = beside_goal(nominal, 0.11)
    scenario = changed(initial("push_box"), obstacles=ball, space="cspace")
    other = follower.admission(nominal, scenario.arm_avoidance).nominal
    solved = solve(scenario, other, LIVE, follower)
    x, y, z = ball.position
    moved, away = (changed(scenario, obstacles=ball.moved((x, y, z + by))) for by in (0.005, 0.5))
    assert solved.passing.goes_on(moved.obstacles) and solved.passing.posture == other.posture is not None
    assert not solved.passing.goes_on(away.obstacles) and not ANEW.goes_on(moved.obstacles)


def test_an_engine_keeps_the_posture_that_it_shows_while_an_obstacle_is_dragged(new_engine, initial):
    engine = new_engine()
    nominal = engine.nominal(initial("push_box"))
    balls = [beside_goal(nominal, distance) for distance in np.arange(0.11, 0.205, 0.01)]
    scenarios = [changed(initial("push_box"), obstacles=ball, space="cspace", view=NOTHING_DRAWN) for ball in balls]
    frames = dragged(engine, scenarios)
    reference_postures = [engine.solved(frame.scenario, LIVE).nominal.posture for frame in frames]
    assert not any(frame.blocked for frame in frames)
    assert reference_postures[0] is not None and set(reference_postures) == {reference_postures[0]}
    assert new_engine().solved(scenarios[-1], LIVE).nominal.posture != reference_postures[0]


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 9))])
def test_motions_change_no_faster_than_the_obstacle_moves(new_engine, initial, seed):
    """Ways out turn and durations grow with the drag, also where a side is changed or does not clear the obstacle."""
    engine, rng = new_engine(), np.random.default_rng(seed)
    task = engine.task("push_box")
    through = task.mean_path[round(rng.uniform(0.3, 0.7) * 100)]
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    before = posture = None
    balls = [Sphere(as_point(through + step * direction), 0.15) for step in np.arange(-0.02, 0.02, 1e-3)]
    for frame in dragged(
        engine, [changed(initial("push_box"), obstacles=ball, space="cspace", view=NOTHING_DRAWN) for ball in balls]
    ):
        scenario, ball = frame.scenario, frame.scenario.obstacles[0]
        assert not frame.blocked
        arm = engine.solved(scenario, LIVE).arm
        if before is not None and engine.solved(scenario, LIVE).nominal.posture == posture:
            assert abs(arm.duration - before.duration) <= 1.001e-3 * WholeArmSettings().duration_change
            for way, last in zip(arm.detours, before.detours, strict=True):
                if way is not None and last is not None:
                    assert way.direction @ last.direction > np.cos(1.1 * DETOUR.turning * 1e-3 / ball.radius)
        before, posture = arm, engine.solved(scenario, LIVE).nominal.posture


def test_after_a_drag_other_settings_act_at_once(new_engine, initial):
    engine, task = new_engine(), "push_box"
    through = engine.task(task).mean_path[45]
    balls = [Sphere(as_point(through + np.array([0, 0, step])), 0.15) for step in (0.0, 1e-3)]
    scenarios = [changed(initial(task), obstacles=ball, space="cspace", view=NOTHING_DRAWN) for ball in balls]
    last = dragged(engine, scenarios)[-1]
    scenario, wider = last.scenario, replace(changed(last.scenario, margin=0.04), passing=last.passing)
    before = engine.solved(scenario, LIVE).arm
    frame_at(engine, wider, Stage.LIVE)
    after = engine.solved(wider, LIVE).arm
    assert ways(engine.solved(scenario, LIVE)).kept and after.cleared
    assert after.duration > before.duration + 0.05
