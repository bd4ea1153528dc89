"""Playback: the arm in the loop, its finished motion, or what it did before, on a thread of its own."""

import threading
import time
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import pytest
from pages import PATIENCE, wait_until

from dt_viz.motion.following import ArmMotion
from dt_viz.session.jobs import Jobs
from dt_viz.session.recording import LEAST, Past
from dt_viz.session.robot_loop import RoundSettings
from dt_viz.ui.playback import Playback, PlaybackSettings, Replay

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


def test_the_arm_moves_without_being_asked_to():
    arm, moved = Arm(), threading.Event()
    _, jobs = playback_of(arm, lambda: moved.set() if arm.q[0] > 0.1 else None)
    assert moved.wait(PATIENCE)
    jobs.close()


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


def test_nothing_moves_before_it_begins():
    """The page that it draws on is being built."""
    arm, drawn = Arm(), threading.Event()
    playback, jobs = Playback(cast(Any, arm), drawn.set), Jobs(unexpected)
    assert not drawn.wait(0.2) and arm.asked == []
    playback.begin(jobs, unexpected)
    assert drawn.wait(PATIENCE)
    jobs.close()


def test_each_picture_waits_for_its_turn_and_what_fails_in_it_gives_it_back():
    arm: Any = Arm()
    may, drawn, said, given_back = threading.Semaphore(0), threading.Semaphore(0), [], []

    @contextmanager
    def turn():
        may.acquire(timeout=PATIENCE)
        yield
        given_back.append(True)

    def draw():
        drawn.release()
        if len(arm.asked) == 2:
            raise ValueError("no way")

    arm.stop = lambda: None
    playback, jobs = Playback(cast(Any, arm), draw, FAST), Jobs(unexpected)
    playback.begin(jobs, said.append, turn)
    for number in range(1, 4):
        assert not drawn.acquire(timeout=0.1)
        assert len(given_back) == number - 1
        may.release()
        assert drawn.acquire(timeout=PATIENCE)
        wait_until(lambda: len(given_back) == number)  # noqa: B023
    assert [str(error) for error in said] == ["no way"]
    jobs.close()
    may.release()
    assert jobs.wait_idle(timeout=PATIENCE)


def test_the_longer_a_picture_takes_the_fewer_there_are():
    begun, enough = [], threading.Event()

    def draw():
        begun.append(time.monotonic())
        time.sleep(0.005)
        if len(begun) > 5:
            enough.set()

    settings = PlaybackSettings(shortest=1e-3, longest=PATIENCE)
    _, jobs = playback_of(Arm(), draw, settings=settings)
    assert enough.wait(PATIENCE)
    jobs.close()
    assert np.diff(begun)[1:].min() > 0.9 * 0.005 / settings.part


def test_an_arm_never_falls_behind_however_few_pictures_there_are():
    assert PlaybackSettings().longest < RoundSettings().longest


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

    def test_the_time_at_the_goal_is_counted_from_arrival_to_the_next_round(self, player):
        rests = []
        for _ in range(200):
            player.play(PICTURE)
            rests.append((player.places[-1], player.playback.arm.arrived))
        assert all((rest > 0) <= (place == 4.0) for place, rest in rests)
        assert REST - 2 * PICTURE < max(rest for _, rest in rests) <= REST

    def test_the_arm_goes_on_in_the_loop_from_where_the_replay_left_it(self, player):
        left = player.play(0.3)[-1]
        player.playback.play(True, 1.0, replays=False)
        assert player.play(PICTURE)[-1] == pytest.approx(left + PICTURE)

    def test_without_a_motion_nothing_is_posed(self, player):
        player.playback.replay.motion = None
        assert (
            player.playback.arm.q is None
            and player.playback.arm.undisturbed is None
            and player.playback.arm.arrived == 0
        )


@pytest.fixture
def replay():
    """A motion of unevenly sampled 2 seconds, whose first joint is at the time squared."""
    replay, times = Replay(), 2 * np.linspace(0, 1, 30) ** 1.5
    replay.motion = ArmMotion(times, times[:, None] ** 2 * np.eye(6)[:1], np.zeros((30, 6)))
    return replay


class TestPlayer:
    @pytest.mark.parametrize("moment", [0.0, 0.01, 0.7, 1.2345, 2.0])
    def test_what_is_shown_is_between_the_samples_beside_the_moment(self, replay, moment):
        replay.seek(moment)
        assert replay.moment == moment and not replay.playing
        assert replay.q[0] == pytest.approx(np.interp(moment, replay.motion.times, replay.motion.q[:, 0]), abs=1e-12)
        assert (replay.q[1:] == 0).all()

    def test_it_is_held_where_it_is_taken_to_and_plays_on_from_there(self, replay):
        replay.seek(0.5)
        replay.advance(0.3)
        assert replay.moment == 0.5
        replay.play()
        replay.advance(0.3)
        assert replay.moment == pytest.approx(0.8)

    @pytest.mark.parametrize("moment", [-1.0, 1e9])
    def test_it_is_taken_no_farther_than_its_ends(self, replay, moment):
        replay.seek(moment)
        assert replay.moment == np.clip(moment, 0.0, 2.0)

    def test_a_step_is_one_sample(self, replay):
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

    def test_a_step_from_between_two_samples_goes_to_the_one_beside(self, replay):
        times = replay.motion.times
        for num, expected in ((1, times[11]), (-1, times[10])):
            replay.play()
            replay.seek((times[10] + times[11]) / 2)
            replay.step(num)
            assert replay.moment == expected and not replay.playing

    @pytest.mark.parametrize("speed", [0.25, 1.0, 3.0])
    def test_its_time_passes_at_its_speed(self, replay, speed):
        replay.speed = speed
        for _ in range(10):
            replay.advance(0.05)
        assert replay.moment == pytest.approx(0.5 * speed)

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
        assert replay.moment == replay.duration == 0.0 and replay.q is None and len(replay.trace[0]) == 0


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

    def test_the_robot_goes_on_meanwhile_and_is_shown_again(self, player):
        player.playback.rewind()
        left = player.arm.q[0]
        held = player.play(0.5)
        assert len(set(held)) == 1 and player.arm.q[0] == pytest.approx(left + 0.5)
        player.playback.resume()
        assert player.play(PICTURE)[-1] == pytest.approx(left + 0.5 + PICTURE)

    def test_what_it_does_meanwhile_is_remembered_too(self, player):
        player.playback.rewind()
        before = player.playback.past.duration
        player.play(0.5)
        assert player.playback.past.duration == before
        player.playback.rewind()
        assert player.playback.past.duration == pytest.approx(before + 0.5, abs=LEAST)

    def test_another_choice_leaves_it_shown_until_the_motion_is_chosen(self, player):
        player.playback.rewind()
        player.playback.play(False, 2.0, replays=False)
        assert player.playback.player is player.playback.past
        player.playback.play(True, 1.0, replays=True)
        assert player.playback.player is player.playback.replay

    def test_from_the_motion_to_the_past_and_back_the_robot_is_where_it_was(self, player):
        player.playback.replay.motion = ramp(3.0, 4.0, 0.5)
        player.playback.play(True, 1.0, replays=True)
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

    def test_each_jump_is_counted(self, player):
        playback, counted = player.playback, []
        for jump in (playback.rewind, lambda: playback.past.step(-1), lambda: playback.past.seek(0.2), playback.resume):
            before = playback.jumps
            jump()
            counted.append(playback.jumps - before)
        assert counted == [1, 1, 1, 1]
        player.play(0.3)
        assert playback.jumps == before + 1


def test_nothing_is_shown_of_a_robot_that_has_done_nothing(player):
    assert not player.playback.rewind() and player.playback.player is None


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
