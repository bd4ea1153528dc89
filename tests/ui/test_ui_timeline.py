"""The timeline on a page: its window, what its controls and keys do, and the marks in the plots."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from pages import all_of, frame_of, wait_until

from dt_viz.motion.following import ArmMotion
from dt_viz.scenario.scenario import View
from dt_viz.ui.playback import Recording
from dt_viz.ui.tabs.plots import cursor_html, place_along
from dt_viz.ui.tabs.timeline import BACK, LIVE, ON, PAST, PAUSE, PLAY, REPLAY

TIMES = np.linspace(0, 2, 21)
Q = TIMES[:, None] * np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
FORGED = [math.nan, math.inf, "1.0", None, True, [], 2**70, 1e9, -1e9]


class Watched:
    """A page with a motion that can be played, and what it shows of that."""

    def __init__(self, page):
        self.page = page
        page.session.edit("test", **all_of(replace(page._initial, view=View())))
        page.visitor.robot.playback.resume()
        page.visitor.robot.playback.past.motion = None
        self.playback.replay.motion = ArmMotion(TIMES, Q + page.session.robot.home, Q + page.session.robot.home)
        replay = self.playback.replay
        replay.playing, replay.loops, replay.speed = True, True, 1.0
        wait_until(lambda: self.timeline._playback is not None and not self.timeline.panel.visible)
        self.timeline._source.value = LIVE  # or what a test has shown before is no news

    @property
    def playback(self):
        return self.page.visitor.robot.playback

    @property
    def timeline(self):
        return self.page.visitor._panel.show.timeline

    @property
    def player(self):
        assert self.playback.player is not None
        return self.playback.player

    def did_something(self, seconds=3.0):
        home = self.page.session.robot.home
        for k in range(round(seconds * 20)):
            self.playback.recording.add(0.05, home + 0.01 * k, home, 0.0, seeks=True)

    def claim(self, label, value):
        """Send a value to the control of the timeline with this label."""
        controls = [self.timeline._source, self.timeline._moment, self.timeline._loops, self.timeline._speed]
        handles = [self.timeline._buttons, *(control.handle for control in controls)]
        (handle,) = (handle for handle in handles if handle.label == label)
        self.page.claim(handle, value)

    def press(self, key):
        (command,) = (c for c in self.page.commands.values() if c.hotkey == key and c.modifier is None)
        self.page.give(command)

    def shows(self, source):
        wait_until(lambda: self.timeline.panel.visible == (source != LIVE))
        assert source in (LIVE, self.timeline._source.value)


@pytest.fixture
def watched(page):
    return Watched(page)


def test_its_window_is_there_while_it_is_asked_for(watched):
    watched.did_something()
    page = watched.page
    page.claim(page["Replay"], True)
    watched.shows(REPLAY)
    page.claim(page["Replay"], False)
    watched.shows(LIVE)
    page.claim(page["What the robot did"], True)
    watched.shows(PAST)
    for source in (REPLAY, PAST, LIVE):
        watched.claim("Shown", source)
        watched.shows(source)
        assert page.session.scenario.view.replay == (source == REPLAY) and watched.timeline._player is (
            {REPLAY: watched.playback.replay, PAST: watched.playback.past}.get(source)
        )


def test_time_buttons_loop_and_pace_act_on_what_is_played(watched):
    watched.claim("Shown", REPLAY)
    watched.shows(REPLAY)
    assert watched.player.playing
    watched.claim("Time [s]", 1.23)
    assert watched.player.moment == 1.23 and not watched.player.playing
    wait_until(lambda: watched.timeline._buttons.options == (BACK, PLAY, ON))
    watched.claim("Play", ON)
    assert watched.player.moment == pytest.approx(1.3)
    wait_until(lambda: watched.timeline._moment.handle.value == 1.3)
    assert watched.timeline._moment.handle.max == 2.0
    watched.claim("Play", BACK)
    assert watched.player.moment == pytest.approx(1.2)
    watched.claim("Play", PLAY)
    assert watched.player.playing
    wait_until(lambda: watched.timeline._buttons.options == (BACK, PAUSE, ON))
    watched.claim("Play", PAUSE)
    watched.claim("Loop", False)
    watched.claim("Pace", 0.25)
    assert (watched.player.playing, watched.player.loops, watched.player.speed) == (False, False, 0.25)


def test_keys_play_and_step_what_is_shown_and_pause_the_robot_without_it(watched):
    for key in ("J", "K"):
        watched.press(key)  # nothing is played
    watched.press("space")
    assert not watched.page.session.scenario.view.playing
    watched.press("space")
    watched.claim("Shown", REPLAY)
    watched.shows(REPLAY)
    watched.press("space")
    assert not watched.player.playing and watched.page.session.scenario.view.playing
    watched.claim("Time [s]", 1.0)
    watched.press("K")
    assert watched.player.moment == pytest.approx(1.1)
    for _ in range(2):
        watched.press("J")
    assert watched.player.moment == pytest.approx(0.9)
    watched.press("space")
    assert watched.player.playing


@pytest.mark.parametrize("claim", FORGED, ids=repr)
def test_no_value_leads_beyond_what_is_played(watched, claim):
    watched.claim("Shown", REPLAY)
    watched.shows(REPLAY)
    watched.claim("Time [s]", 0.5)
    for label in ("Time [s]", "Shown", "Play", "Pace", "Loop"):
        watched.claim(label, claim)
    player = watched.player
    assert player is watched.playback.replay and isinstance(player.loops, bool)
    if isinstance(claim, float) and not math.isfinite(claim):
        assert (player.moment, player.speed) == (0.5, 1.0)
    else:
        assert 0 <= player.moment <= 2 and 0.25 <= player.speed <= 3


def test_of_a_robot_that_has_done_nothing_that_is_said(watched):
    watched.playback.recording, watched.playback.replay.motion = Recording(), None
    watched.page.claim(watched.page["What the robot did"], True)
    message = watched.page.session._screen.progress.message
    assert message is not None and message.text == "The robot has done nothing yet."
    assert watched.playback.player is None
    watched.claim("Shown", REPLAY)  # nor is there a motion
    watched.shows(REPLAY)
    watched.press("K")
    watched.playback.advance(0.1)
    assert watched.player.moment == 0.0


def test_the_joints_plots_show_the_past_while_it_is_shown(watched):
    plots = watched.page.visitor._panel.show.plots
    motion = watched.playback.replay.motion
    watched.page.session.edit("test", view=View(joint_plots=True))
    plots.draw(frame_of(watched.page.session.scenario, arm=motion, profiles=None, chosen=None))
    shown = plots.joints[0].angles
    assert shown.data[0][-1] == 2.0
    watched.did_something()
    watched.claim("Shown", PAST)
    wait_until(lambda: shown.data[0][-1] == watched.playback.past.duration)
    np.testing.assert_allclose(np.radians(shown.data[1][-1]), watched.playback.past.q[0], atol=1e-9)
    plots.draw(frame_of(watched.page.session.scenario, arm=motion, profiles=None, chosen=None))
    assert shown.data[0][-1] == watched.playback.past.duration
    watched.claim("Shown", LIVE)
    wait_until(lambda: shown.data[0][-1] == 2.0)


def test_plots_are_marked_at_the_moment_that_is_shown(watched):
    def marked():
        return {axis: float(at) for axis, at in re.findall(r"--dt-(\w+):([\d.]+)", watched.timeline._mark.content)}

    plots, robot = watched.page.visitor._panel.show.plots, watched.page.session.robot
    plots.draw(
        frame_of(watched.page.session.scenario, rollouts=(robot.end_effector(Q + robot.home),), arm=None, profiles=None)
    )
    assert marked() == {}
    watched.claim("Shown", REPLAY)
    watched.shows(REPLAY)  # and how long it is
    watched.player.playing = False
    watched.claim("Time [s]", 0.5)
    wait_until(lambda: marked().get("time") == 0.25)
    assert marked()["path"] == pytest.approx(0.25, abs=1e-3)
    watched.claim("Shown", LIVE)
    wait_until(lambda: marked() == {})


def test_large_plots_are_in_windows_in_place_of_the_tab(watched):
    plots, gui = watched.page.visitor._panel.show.plots, watched.page.gui
    boxes = [handle for handle in watched.page.inputs if handle.label == "Large plots"]
    num_others = sum(panel.visible for panel in gui._panel_handle_from_uuid.values())

    def large_of(shown):
        return [large for large, each in zip((False, True), shown, strict=True) if each.visible]

    for view, joints, health, num_windows in (
        (View(), [], [], 0),
        (View(joint_plots=True), [False], [], 0),
        (View(joint_plots=True, large_plots=True), [True], [], 1),
        (View(health_plots=True, large_plots=True), [], [True], 1),
        (View(compared=("linear",)), [], [], 0),
        (View(compared=("linear",), large_plots=True), [], [], 1),  # along the path (fig. 6)
        (View(large_plots=True), [], [], 0),
    ):
        watched.page.session.edit("test", view=view)
        assert (large_of(plots.joints), large_of(plots.health)) == (joints, health)
        assert sum(panel.visible for panel in gui._panel_handle_from_uuid.values()) == num_others + num_windows
        assert sum(box.visible for box in boxes) == bool(view.compared) + bool(view.joint_plots or view.health_plots)


def test_a_place_is_marked_where_the_path_is_nearest():
    path = np.array([[0.0, 0, 0], [1, 0, 0], [1, 3, 0]])
    assert [place_along(path, np.array(place)) for place in ((-1, 0, 0), (1.2, 0.1, 0), (1, 9, 9))] == [0.0, 0.25, 1.0]
    assert "path" not in cursor_html(time=0.5, path=None)
