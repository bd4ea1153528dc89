"""Playback: the arm in the loop, its finished motion, or what it did before, on a thread of its own; its memory."""

import threading
from contextlib import nullcontext
from typing import Any, cast

import numpy as np
import pytest
from pages import PATIENCE

from dt_viz.motion.following import ArmMotion
from dt_viz.scheduler import Jobs, Scheduler
from dt_viz.session.robot_loop import RoundSettings
from dt_viz.ui.playback import LEAST, NUM_SAMPLES, SPAN, Past, Playback, PlaybackSettings, Recording, Replay

PICTURE, REST = 0.02, RoundSettings().rest
FAST = PlaybackSettings(shortest=1 / 200, asleep=1 / 100)


class Arm:
    """An arm in the loop whose first joint turns by a radian in a second."""

    def __init__(self):
        self.q, self.undisturbed, self.arrived, self.left = np.zeros(6), np.ones(6), 0.0, 1.0
        self.asked = []

    def advance(self, seconds, *, moves):
        self.asked.append((seconds, moves))
        if moves:
            self.q = self.q + seconds * np.eye(6)[0]

    def put(self, q):
        self.q = q

    def release(self):
        pass


def unexpected(error):
    pytest.fail(str(error))


def playback_of(arm, draw, fail=None, settings=FAST):
    """A playback of such an arm; what keeps it from moving fails the test, unless it is taken."""
    playback, jobs = Playback(cast(Any, arm), draw, settings), Jobs(unexpected)
    playback.begin(jobs, fail or unexpected)
    return playback, jobs


class Player:
    """A playback whose clock only moves when it is told to, and the places where the arm was drawn."""

    def __init__(self):
        self.arm, self.places = Arm(), []
        asleep = PlaybackSettings(shortest=1e4)  # its thread sleeps until it is closed
        self.playback, self.jobs = playback_of(self.arm, self.draw, settings=asleep)

    def draw(self):
        if self.playback.arm.q is not None:
            self.places.append(self.playback.arm.q[0])

    def play(self, seconds):
        """The places where the arm is meanwhile."""
        before = len(self.places)
        for _ in range(round(seconds / PICTURE)):
            self.playback.advance(PICTURE)
        return self.places[before:]


def ramp(begin, end, seconds):
    q = np.linspace(begin, end, 50)[:, None] * np.eye(6)[:1]
    return ArmMotion(np.linspace(0, seconds, 50), q, q + 1)


@pytest.fixture
def player():
    player = Player()
    yield player
    player.jobs.close()


@pytest.mark.parametrize("moment", [0.0, 0.3, 1.7, 4.0, 4.5])
def test_both_arms_are_shown_at_the_same_moment(moment):
    times = np.linspace(0, 1, 60) ** 1.5 * 4
    motion = ArmMotion(times, np.sin(times)[:, None] * np.arange(6.0), np.cos(times)[:, None] * np.arange(6.0))
    replay = Replay()
    replay.motion = motion
    replay.advance(moment)
    for got, path in ((replay.q, motion.q), (replay.undisturbed, motion.without)):
        assert got is not None
        np.testing.assert_allclose(got, [np.interp(moment, times, angle) for angle in path.T], atol=1e-12)


def test_an_arm_that_cannot_move_is_said_to_and_waits_for_its_next_motion():
    arm: Any = Arm()
    said, moved = [], threading.Event()
    advance = arm.advance

    def stuck(*_, **__):
        raise ZeroDivisionError("no way")

    def stop():
        arm.advance = advance

    arm.advance, arm.stop = stuck, stop
    _, jobs = playback_of(arm, lambda: moved.set() if arm.q[0] > 0.1 else None, said.append)
    assert moved.wait(PATIENCE)
    jobs.close()
    assert [str(error) for error in said] == ["no way"]


def test_it_moves_between_frames_of_drags(monkeypatch):
    slots, moved, drawn = Scheduler(2), [], threading.Event()
    monkeypatch.setattr("dt_viz.ui.playback.SCHEDULER", slots)
    monkeypatch.setattr(slots, "between_drags", lambda: nullcontext(moved.append(True)))
    _, jobs = playback_of(Arm(), drawn.set)
    assert drawn.wait(PATIENCE) and moved
    jobs.close()


def test_nothing_moves_before_it_begins():
    """The page that it draws on is being built."""
    arm, drawn = Arm(), threading.Event()
    playback, jobs = Playback(cast(Any, arm), drawn.set), Jobs(unexpected)
    assert not drawn.wait(0.2) and arm.asked == []
    playback.begin(jobs, unexpected)
    assert drawn.wait(PATIENCE)
    jobs.close()


def test_the_arm_of_a_neglected_page_comes_to_the_goal_and_rests_there_until_it_is_touched():
    arm: Any = Arm()
    arm.note = "as the arm says"
    drawn, playback = threading.Semaphore(0), cast(Playback, None)

    def draw():
        arm.arrived = max(0.0, float(arm.q[0]) - 0.1)
        drawn.release()

    def drawn_again(times):
        for _ in range(times):
            assert drawn.acquire(timeout=PATIENCE)

    playback, jobs = playback_of(arm, draw)
    playback.neglected = True
    while playback.note == "as the arm says":
        drawn_again(1)
    assert playback.note == "rests until you touch the page" and arm.arrived > 0
    drawn_again(3)
    there = arm.q
    drawn_again(10)
    assert arm.q[0] == there[0]
    playback.neglected = False
    drawn_again(10)
    assert arm.q[0] > there[0] and playback.note == "as the arm says"
    jobs.close()


def test_its_time_has_the_chosen_pace_and_a_pause_stops_it(player):
    player.playback.play(True, 2.0, replays=False)
    assert player.play(0.5)[-1] == pytest.approx(1.0)
    player.playback.play(False, 2.0, replays=False)
    assert player.play(0.5)[-1] == pytest.approx(1.0)
    assert player.arm.asked[-1] == (pytest.approx(2 * PICTURE), False)  # it still hears that its hand is held
    np.testing.assert_array_equal(player.playback.arm.undisturbed, np.ones(6))


class TestReplay:
    @pytest.fixture(autouse=True)
    def _replays(self, player):
        player.playback.replay.motion = ramp(3.0, 4.0, 0.5)
        player.playback.play(True, 1.0, replays=True)

    def test_the_motion_is_repeated_after_a_rest(self, player):
        places = player.play(0.5 + REST + 0.2)
        assert places[0] == pytest.approx(3.0 + PICTURE / 0.5)
        assert max(places) == 4.0 and places[-1] == pytest.approx(3.4, abs=0.1)
        assert sum(place == 4.0 for place in places) * PICTURE == pytest.approx(REST, abs=2 * PICTURE)
        assert player.arm.asked == []
        assert player.playback.arm.undisturbed[0] == pytest.approx(player.playback.arm.q[0] + 1)

    def test_a_new_motion_takes_over_at_the_same_moment(self, player):
        player.play(0.2)
        player.playback.replay.motion = ramp(5.0, 6.0, 0.5)
        assert player.play(PICTURE)[-1] == pytest.approx(5.44)

    def test_the_arm_goes_on_in_the_loop_from_where_the_replay_left_it(self, player):
        left = player.play(0.3)[-1]
        player.playback.play(True, 1.0, replays=False)
        assert player.play(PICTURE)[-1] == pytest.approx(left + PICTURE)


@pytest.fixture
def replay():
    """A motion of unevenly sampled 2 seconds, whose first joint is at the time squared."""
    replay, times = Replay(), 2 * np.linspace(0, 1, 30) ** 1.5
    replay.motion = ArmMotion(times, times[:, None] ** 2 * np.eye(6)[:1], np.zeros((30, 6)))
    return replay


class TestPlayer:
    def test_it_is_held_where_it_is_taken_to_within_its_ends_and_plays_on_from_there_at_its_speed(self, replay):
        for moment in (-1.0, 1e9, 0.5):
            replay.seek(moment)
            replay.advance(0.3)
            assert replay.moment == np.clip(moment, 0.0, 2.0) and not replay.playing
        replay.speed = 2.0
        replay.play()
        replay.advance(0.3)
        assert replay.moment == pytest.approx(1.1)

    def test_a_step_is_one_sample_or_from_between_two_to_the_one_beside(self, replay):
        times = replay.motion.times
        replay.seek(0.0)
        seen = [replay.moment]
        for _ in times[1:]:
            replay.step(1)
            seen.append(replay.moment)
        np.testing.assert_array_equal(seen, times)
        for _ in times[1:]:
            replay.step(-1)
            seen.append(replay.moment)
        np.testing.assert_array_equal(seen[len(times) :], times[-2::-1])
        replay.step(-1)
        assert replay.moment == 0.0
        for num, expected in ((1, times[11]), (-1, times[10])):
            replay.play()
            replay.seek((times[10] + times[11]) / 2)
            replay.step(num)
            assert replay.moment == expected and not replay.playing

    def test_in_a_loop_it_begins_anew_after_a_rest(self, replay):
        replay.seek(1.9)
        replay.play()
        replay.advance(0.1 + REST / 2)
        assert replay.moment == 2.0 and replay.playing and replay.arrived == pytest.approx(REST / 2)
        replay.advance(REST / 2 + 0.3)
        assert replay.moment == pytest.approx(0.3) and replay.playing and replay.arrived == 0

    @pytest.mark.parametrize("begin", [1.9, 2.0 + REST / 2])
    def test_without_a_loop_it_ends_and_is_played_from_its_beginning(self, replay, begin):
        replay.advance(begin)
        replay.loops = False
        replay.advance(0.3)
        assert replay.moment == 2.0 and not replay.playing
        replay.play()
        replay.advance(0.3)
        assert replay.moment == pytest.approx(0.3) and replay.playing

    def test_without_a_motion_nothing_is_done(self):
        replay = Replay()
        replay.step(1)
        replay.seek(1.0)
        replay.play()
        replay.loops = False
        replay.advance(0.3)
        assert replay.moment == replay.duration == replay.arrived == 0.0 and len(replay.trace[0]) == 0
        assert replay.q is None and replay.undisturbed is None


class TestPast:
    @pytest.fixture(autouse=True)
    def _did_something(self, player):
        player.play(1.0)

    def test_it_is_what_was_drawn_and_is_held_at_its_end(self, player):
        places, now = player.places[:], player.arm.q[0]
        assert player.playback.rewind() and player.playback.arm is player.playback.past
        past = player.playback.past
        assert past.moment == past.duration and not past.playing
        assert past.q[0] == pytest.approx(now, abs=LEAST)
        assert set(past.motion.q[:, 0]) <= set(places) and len(past.motion.q) > 0.8 * 1.0 / (LEAST + PICTURE)
        assert (past.undisturbed == 1).all()

    def test_the_robot_goes_on_meanwhile_is_remembered_too_and_shown_again(self, player):
        player.playback.rewind()
        left, before = player.arm.q[0], player.playback.past.duration
        held = player.play(0.5)
        assert len(set(held)) == 1 and player.arm.q[0] == pytest.approx(left + 0.5)
        assert player.playback.past.duration == before
        player.playback.rewind()
        assert player.playback.past.duration == pytest.approx(before + 0.5, abs=LEAST)
        player.playback.resume()
        assert player.play(PICTURE)[-1] == pytest.approx(left + 0.5 + PICTURE)

    def test_another_choice_leaves_it_shown_until_the_motion_is_chosen_and_the_robot_where_it_was(self, player):
        player.playback.rewind()
        player.playback.play(False, 2.0, replays=False)
        assert player.playback.player is player.playback.past
        player.playback.replay.motion = ramp(3.0, 4.0, 0.5)
        player.playback.play(True, 1.0, replays=True)
        assert player.playback.player is player.playback.replay
        player.play(0.1)
        left = player.arm.q[0]
        player.playback.rewind()
        player.playback.play(True, 1.0, replays=False)
        player.playback.resume()
        assert player.arm.q[0] == left

    def test_a_pause_is_not_remembered_but_a_held_hand_is(self, player):
        player.playback.play(False, 1.0, replays=False)
        player.play(5.0)
        player.playback.rewind()
        assert player.playback.past.duration < 1.0
        player.playback.resume()
        player.arm.advance = lambda seconds, *, moves: player.arm.put(player.arm.q + 0.1)
        player.play(0.5)
        player.playback.rewind()
        assert player.playback.past.duration == pytest.approx(1.5, abs=2 * LEAST)


def test_what_it_did_since_it_set_out_is_traced():
    replay, arrived = Replay(), np.array([0, 0, 0.1, 0.2, 0, 0, 0, 0.1])
    times = np.arange(8.0)
    q = times[:, None] * np.ones(6)
    replay.motion = Past(times, q, q, arrived=arrived, seeks=(arrived == 0).astype(float))
    for moment, begin, end in ((1.5, 0, 2), (3.0, 0, 4), (4.0, 4, 5), (7.0, 4, 8)):
        replay.seek(moment)
        np.testing.assert_array_equal(replay.trace[0], q[begin:end])
        np.testing.assert_array_equal(replay.trace[1], arrived[begin:end])
        assert replay.arrived == arrived[end - 1] and replay.seeks == (arrived[end - 1] == 0)


@pytest.mark.parametrize("shown", ["robot", "motion"])
def test_a_film_is_drawn_while_all_else_waits_and_goes_on_afterwards(player, shown):
    playback = player.playback
    playback.replay.motion = ramp(5.0, 6.0, 2.0)
    playback.play(True, 1.0, replays=shown == "motion")
    player.play(0.2)
    arm, place, jumps = playback.arm, playback.arm.q[0], playback.jumps
    playback.film = reel = Replay()
    reel.motion = ramp(8.0, 9.0, 1.0)
    reel.seek(0.5)
    assert playback.arm.q[0] == pytest.approx(8.5) and playback.jumps != jumps
    assert playback.player is (arm if shown == "motion" else None)  # what the timeline steers
    assert np.ptp(playback.trace[0][:, 0]) == pytest.approx(0.5, abs=0.02)
    assert player.play(1.0) == []
    playback.film = None
    assert playback.arm is arm and arm.q[0] == place and playback.jumps == jumps
    assert player.play(0.2)[-1] > place


# --- What the robot has just done ---

PERIOD = 1 / 20


def recorded(num, period=PERIOD) -> Any:
    """A recording of so many samples, whose postures are their numbers."""
    recording = Recording()
    for k in range(num):
        add(recording, k, period)
    return recording


def add(recording, k, period=PERIOD):
    recording.add(period, np.full(6, float(k)), np.full(6, -float(k)), float(k), seeks=k % 2 == 0)


@pytest.mark.parametrize("num", [2, 500, NUM_SAMPLES, NUM_SAMPLES + 1, 3 * NUM_SAMPLES + 7])
def test_the_samples_are_the_newest_in_their_order(num):
    past = recorded(num).past
    numbers = np.arange(num - len(past.times), num)
    np.testing.assert_array_equal(past.q, np.tile(numbers[:, None], 6))
    np.testing.assert_array_equal(past.without, -past.q)
    np.testing.assert_array_equal(past.arrived, numbers)
    np.testing.assert_array_equal(past.seeks, numbers % 2 == 0)
    np.testing.assert_allclose(past.times, PERIOD * np.arange(len(numbers)), atol=1e-9)


@pytest.mark.parametrize("period", [0.01, 1.01 * LEAST, PERIOD, 1 / 6, 7.0])
def test_the_last_minute_is_remembered_however_many_pictures_there_are(period):
    past, apart = recorded(7000, period).past, np.ceil(LEAST / period)  # number of pictures from sample to sample
    assert SPAN - apart * period - 1e-6 < past.times[-1] <= SPAN + 1e-9
    assert np.diff(past.times).min() >= LEAST and np.diff(past.q[:, 0]).max() <= apart
    assert 7000 - apart <= past.q[-1, 0] < 7000


def test_it_begins_with_two_samples():
    assert recorded(0).past is None and recorded(1).past is None and len(recorded(2).past.times) == 2


def test_what_was_read_stays_as_it_was():
    recording = recorded(NUM_SAMPLES)
    past = recording.past
    before = past.q.copy()
    for k in range(NUM_SAMPLES):
        add(recording, -k)
    np.testing.assert_array_equal(past.q, before)
