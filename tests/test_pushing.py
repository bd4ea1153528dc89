"""The hand is pushed aside in the middle of its motion: what the arm does then."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from oracles import used_fraction
from scenes import changed

from dt_viz.engine.engine import ArmMotion
from dt_viz.engine.frame import Stage
from dt_viz.motion.pushing import DISTANCES, MAX_TRACKING_ERROR, PUSH_SECONDS
from dt_viz.motion.stack import FINE, build_stack
from dt_viz.ui import playback as playback_module
from dt_viz.ui.playback import Playback

MOMENTS = (0.1, 0.5, 0.9)
"""Of the motion, between 0 and 1."""
PICTURE = 0.005
"""Seconds from one picture of the playback to the next."""
PATIENCE = 30.0
"""Seconds after which a test gives up; nothing takes that long."""


@pytest.fixture(params=["draw_s", "push_box"], name="task")
def _task(request):
    return request.param


def shown(engine, scenario):
    return next(frame for frame in engine.frames(scenario) if frame.stage is Stage.FINE)


def pushes(engine, scenario):
    """The frame, and joints before and what is done after a push at some moments."""
    frame, rng = shown(engine, scenario), np.random.default_rng(3)
    for moment in MOMENTS:
        q = frame.arm.q[int(moment * len(frame.arm.q))]
        yield frame, q, engine.pushed(scenario, q, rng)


def test_the_hand_is_pushed_aside_and_still_reaches_the_goal(engine, initial, robot, task):
    for frame, q, pushed in pushes(engine, initial(task)):
        hand, motion = robot.end_effector(q), pushed.motion
        np.testing.assert_allclose(pushed.path[0], hand, atol=1e-9)
        np.testing.assert_allclose(robot.end_effector(motion.q), pushed.path, atol=MAX_TRACKING_ERROR)
        np.testing.assert_allclose(motion.q[0], q, atol=5e-3)
        assert any(
            np.linalg.norm(pushed.path[pushed.begins] - hand) == pytest.approx(distance) for distance in DISTANCES
        )
        np.testing.assert_allclose(pushed.path[-1], frame.goal, atol=1e-4)
        assert np.linalg.norm(robot.end_effector(motion.q[-1]) - frame.goal) < 1e-3
        assert motion.times[pushed.begins] >= PUSH_SECONDS and (np.diff(motion.times) > 0).all()


def test_after_the_push_it_is_a_motion_of_the_system(engine, initial, task):
    scenario = initial(task)
    system = build_stack(engine.nominal(scenario), scenario.active, FINE).system
    for _, _, pushed in pushes(engine, scenario):
        after = pushed.path[pushed.begins :]
        assert (np.diff(system.lyapunov(after)) < 0).all()
        z = system.transform.forward(after)
        to_goal = system.base.goal - z[0]
        aside = (z - z[0]) - np.outer((z - z[0]) @ to_goal, to_goal) / (to_goal @ to_goal)
        assert np.abs(aside).max() < 1e-6  # a straight ray in base space


@pytest.mark.parametrize("space", ["task", "cspace", "both"])
def test_the_arm_keeps_its_limits_and_keeps_clear(engine, initial, robot, task, space):
    for frame, q, pushed in pushes(engine, changed(initial(task), space=space)):
        motion = pushed.motion
        assert (motion.q >= robot.lower).all() and (motion.q <= robot.upper).all()
        assert used_fraction(motion.times, motion.q, robot.velocity_limits) < 1 + 1e-6
        np.testing.assert_allclose(motion.q[0], q, atol=5e-3)
        assert np.abs(np.diff(motion.q, axis=0)).max() < 0.15
        assert np.linalg.norm(robot.end_effector(motion.q[-1]) - frame.goal) < 1e-3
        assert frame.scenario.obstacle.signed_distance(pushed.path).min() > 0
        assert pushed.path[:, 2].min() > 0


def test_an_obstacle_that_is_not_avoided_hinders_no_push_that_is_clear_of_it_itself(engine, initial):
    off, paths = changed(initial("draw_s"), avoids=False), []
    for scenario in (off, changed(off, obstacles=())):
        arm, rng = shown(engine, scenario).arm, np.random.default_rng(0)
        paths.append([engine.pushed(scenario, arm.q[len(arm.q) // 10], rng).path for _ in range(4)])
    for pushed, free in zip(*paths, strict=True):
        assert off.obstacle.signed_distance(free).min() < 0  # on the way to the goal
        np.testing.assert_allclose(pushed, free, rtol=0, atol=1e-9)


def test_directions_differ_and_come_from_the_generator(engine, initial):
    first, again = (list(pushes(engine, initial("draw_s"))) for _ in range(2))
    for (_, _, a), (_, _, b) in zip(first, again, strict=True):
        np.testing.assert_allclose(a.path, b.path, rtol=0, atol=1e-9)
    scenario, q = initial("draw_s"), first[0][1]
    rng = np.random.default_rng(0)
    one, other = (engine.pushed(scenario, q, rng) for _ in range(2))
    assert np.linalg.norm(one.path[one.begins] - other.path[other.begins]) > 0.01


def test_nothing_is_pushed_that_is_not_shown(new_engine, initial, robot):
    engine, scenario, rng = new_engine(), initial("push_box"), np.random.default_rng(0)
    assert engine.pushed(scenario, robot.home, rng) is None
    shown(engine, scenario)
    assert engine.pushed(replace(scenario, arm_rollout=1), robot.home, rng) is None
    assert engine.pushed(replace(scenario, view=replace(scenario.view, field=False)), robot.home, rng) is not None


# --- Playback ---


class Player:
    """A playback whose clock only moves when it is told to, and the places where the arm was posed."""

    def __init__(self):
        self.places = []
        self.playback = Playback(lambda q, _without: self.places.append(q[0]))

    def play(self, seconds):
        """The places where the arm is meanwhile."""
        before = len(self.places)
        for _ in range(round(seconds / PICTURE)):
            self.playback.advance(PICTURE)
        return self.places[before:]


def ramp(begin, end, seconds):
    q = np.linspace(begin, end, 50)[:, None] * np.eye(6)[:1]
    return ArmMotion(np.linspace(0, seconds, 50), q, q)


@pytest.fixture
def player(monkeypatch):
    monkeypatch.setattr(playback_module, "PICTURES_PER_SECOND", 1e-4)  # its thread sleeps until it is closed
    monkeypatch.setattr(playback_module, "REST", 0.3)
    monkeypatch.setattr(playback_module, "CATCH_UP", 0.1)
    player = Player()
    yield player
    player.playback.close()


def test_a_motion_is_played_without_being_asked_for(monkeypatch):
    monkeypatch.setattr(playback_module, "PICTURES_PER_SECOND", 200)
    arrived = threading.Event()
    playback = Playback(lambda q, _without: arrived.set() if q[0] == 1.0 else None)
    playback.follow(ramp(0.0, 1.0, 0.1))
    assert arrived.wait(PATIENCE)
    playback.close()


def test_a_detour_is_followed_once_from_where_the_arm_is_and_then_the_loop_goes_on(player):
    playback, ended = player.playback, []
    assert playback.q is None
    playback.follow(ramp(0.0, 1.0, 0.5))
    assert player.play(0.2)[-1] == pytest.approx(0.4)
    playback.take_detour(ramp(3.0, 4.0, 0.5), lambda: ended.append("detour"))
    detour = player.play(0.5 + 0.2)
    assert 0.4 < detour[0] < 0.6  # it does not jump there
    assert detour[-1] == 4.0 and ended == []
    back = player.play(0.3)
    back = back[back.index(next(place for place in back if place < 4.0)) :]
    assert ended == ["detour"]
    assert back[0] < 0.05 and 0.1 < back[-1] < 1.0  # the loop from its start
    assert playback.q is not None


def test_a_detour_ends_at_once_when_told_to_and_only_the_newest_one_says_so(player):
    playback, ended = player.playback, []
    playback.follow(ramp(0.0, 1.0, 0.5))
    player.play(0.1)
    playback.take_detour(ramp(3.0, 4.0, 30.0), lambda: ended.append("first"))
    playback.take_detour(ramp(5.0, 6.0, 30.0), lambda: ended.append("second"))
    assert player.play(1.0)[-1] > 5.0
    playback.end_detour()
    assert ended == ["second"]
    assert player.play(PICTURE)[-1] <= 1.0
    playback.end_detour()
    assert ended == ["second"]


def test_a_pause_holds_a_detour(player):
    playback = player.playback
    playback.follow(ramp(0.0, 1.0, 0.5))
    playback.take_detour(ramp(3.0, 4.0, 0.5), lambda: None)
    held = player.play(0.2)[-1]
    assert 3.0 < held < 4.0
    playback.set_pace(False, 1.0)
    assert set(player.play(1.0)) <= {held}
    playback.set_pace(True, 1.0)
    after = player.play(0.4)
    assert held < after[0] < 4.0 and after[-1] == 4.0


def test_a_held_arm_stays_where_it_is_held_also_while_it_is_played_and_goes_on_when_it_is_let_go(player):
    playback, ended = player.playback, []
    playback.hold(None, lambda: ended.append("before there is a motion"))
    playback.follow(ramp(0.0, 1.0, 0.5))
    held = player.play(0.2)[-1]
    playback.hold(None, lambda: ended.append("stopped"))
    assert set(player.play(1.0)) == {held}
    for place in (5.0, 6.0, 7.0):
        playback.hold(ramp(place, 8.0, 0.5), lambda: ended.append("held"))
        assert set(player.play(1.0)) == {place}
    assert ended == []
    playback.take_detour(ramp(7.0, 8.0, 0.3), lambda: ended.append("over"))
    assert player.play(0.4)[-1] == 8.0
    assert player.play(0.4)[-1] <= 1.0
    assert ended == ["over"]
    playback.hold(ramp(5.0, 8.0, 0.5), lambda: ended.append("held"))
    assert player.play(PICTURE) == [5.0]
    playback.end_detour()
    assert player.play(PICTURE)[-1] <= 1.0
    assert ended == ["over", "held"]


def test_letting_go_ends_what_is_held_and_no_detour_that_is_under_way(player):
    playback, ended = player.playback, []
    playback.follow(ramp(0.0, 1.0, 0.5))
    player.play(0.1)
    playback.hold(ramp(3.0, 4.0, 30.0), lambda: ended.append("held"))
    playback.let_go()
    playback.let_go()
    assert ended == ["held"]
    playback.take_detour(ramp(5.0, 6.0, 30.0), lambda: ended.append("detour"))
    playback.let_go()
    assert ended == ["held"]


def test_the_time_at_the_goal_is_counted_from_arrival_to_the_next_round(player):
    playback, rests = player.playback, []
    playback.follow(ramp(0.0, 1.0, 0.2))
    for _ in range(200):
        player.play(PICTURE)
        rests.append((player.places[-1], playback.resting))
    assert all((rest > 0) <= (place == 1.0) for place, rest in rests)
    assert 0.3 - 2 * PICTURE < max(rest for _, rest in rests) <= 0.3
