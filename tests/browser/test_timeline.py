"""The timeline in a real browser: what the robot did, scrubbed, stepped by keys and played."""

from dataclasses import replace

import numpy as np
import pytest
from browsing import LIGHT, begin, click_at, close_page, open_page, open_tab, press, until_drawn, wait_until
from chromium import needs_chromium

from dt_viz.metrics import interpolate

pytestmark = [pytest.mark.browser, needs_chromium]

LEFT_OUT = 5e-3
"""Turn of a joint that is not sent, as it is not seen, rad."""


def shown(visitor):
    """Turns (n, 4) of the joints that the page was sent."""
    return np.array([frame.wxyz for frame in visitor.robot.arms.arm.frames[1:]])


def test_what_the_robot_did_is_scrubbed_stepped_and_played(browser, server, initial):
    page, visitor = open_page(browser, server, (900, 600))
    begin(visitor, replace(initial("draw_s"), view=replace(LIGHT, handles=False, playing=True)))
    playback, robot = visitor.robot.playback, visitor.session.robot

    def as_recorded():
        past = playback.past.motion
        q = interpolate(np.array([playback.past.moment]), past.times, past.q)[0]
        return bool(np.abs(shown(visitor) - robot.joint_frames(q)).max() < LEFT_OUT)

    wait_until(lambda: (past := playback.recording.past) is not None and past.times[-1] > 4, "the robot to move")
    open_tab(page, "Arm")
    time = page.get_by_text("Time [s]", exact=True)
    assert not time.is_visible()
    press(page.get_by_role("button", name="What the robot did"))
    time.wait_for()
    player = playback.past
    assert playback.player is player and np.ptp(player.motion.q, axis=0).max() > 0.1
    bar = time.locator("xpath=ancestor::div[.//*[@role='slider']][1]").locator(".mantine-Slider-track")
    for part in (0.8, 0.3):
        is_there = lambda: abs(player.moment / player.duration - part) < 0.08  # noqa: B023, E731
        click_at(page, bar, part, is_there, "the moment that is clicked")
        wait_until(as_recorded, "the arm as it was then")
    page.evaluate("document.activeElement.blur()")
    before = player.moment
    sample = int(np.searchsorted(player.motion.times, before + 1e-6))
    for key, expected in (("k", sample), ("k", sample + 1), ("j", sample)):
        page.keyboard.press(key)
        moment = player.motion.times[expected]
        wait_until(lambda: abs(player.moment - moment) < 1e-9, "the next sample")  # noqa: B023
        wait_until(as_recorded, "the arm as it was then")
    page.get_by_role("textbox").first.focus()
    for key in ("k", "k", "Space"):
        page.keyboard.press(key)
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("j")  # comes after what was typed
    wait_until(lambda: player.moment < player.motion.times[sample] - 1e-9, "the sample before")
    assert player.moment == player.motion.times[sample - 1] and not player.playing
    page.keyboard.press("Space")
    wait_until(lambda: player.playing and player.moment > player.motion.times[sample] + 0.1, "it to play")
    page.keyboard.press("Space")
    wait_until(lambda: not player.playing, "it to be held")
    assert visitor.session.scenario.view.playing
    page.set_viewport_size({"width": 390, "height": 844})  # a phone, where it is a part of the sheet
    wait_until(lambda: 0 < (time.bounding_box() or {"y": 0})["y"] < 844, "it to be seen")
    page.set_viewport_size({"width": 900, "height": 600})
    time.wait_for()
    until_drawn(visitor)
    press(page.get_by_label("Shown", exact=True))
    press(page.get_by_role("option", name="Live"))
    wait_until(lambda: playback.player is None, "the robot to be shown again")
    time.wait_for(state="hidden")
    close_page(page, server, visitor)
