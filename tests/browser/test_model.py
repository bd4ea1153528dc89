"""Arm → Model in a real browser: one visitor's arm changes in place and back, another's does not."""

from dataclasses import replace

import numpy as np
import pytest
from browsing import LIGHT, PATIENCE, close_page, open_page, open_tab, press, travel, wait_until
from chromium import needs_chromium
from other_arms import seven_joints
from playwright.sync_api import expect

from dt_viz.session import arms

pytestmark = [pytest.mark.browser, needs_chromium]


def choose(page, title, instead_of):
    """Choose a model on a page that shows another one: choosing the one that is shown would tell nobody."""
    expect(page.get_by_label("Model", exact=True).first).to_have_value(instead_of, timeout=1000 * PATIENCE)
    press(page.get_by_label("Model", exact=True).first)
    press(page.get_by_role("option", name=title, exact=True))


def is_shown(visitor, name, num_joints):
    shown = visitor.shown
    return (
        shown is not None
        and shown.scenario.arm == name
        and len(visitor.robot.arms.arm.frames) == 1 + num_joints
        and visitor.robot.hand is not None
    )


def test_the_arm_changes_in_place_and_back_for_its_visitor_alone(browser, server, monkeypatch):
    monkeypatch.setattr(arms, "load_aside", lambda _name, progress: progress(0.5, "covering") or seven_joints())
    (page, visitor), (other_page, other) = (open_page(browser, server, (720, 450)) for _ in range(2))
    try:
        for each in (visitor, other):
            each.session.edit("test", view=LIGHT)
        untouched, live = other.session.scenario, other.robot
        open_tab(page, "Arm")
        choose(page, "Franka Panda", instead_of="JACO")
        wait_until(lambda: is_shown(visitor, "panda", 7), "the arm with seven joints")
        assert visitor.session.wait_idle(PATIENCE)
        assert visitor.robot.playback.live.q is not None and len(visitor.robot.playback.live.q) == 7
        hand = visitor.robot.hand
        visitor.session.step("play", view=replace(visitor.session.scenario.view, playing=True))
        wait_until(lambda: not np.array_equal(visitor.robot.hand, hand), "the hand to move")
        travel(page, "Undo")
        wait_until(lambda: is_shown(visitor, "", 6), "the arm as before")
        travel(page, "Redo")
        wait_until(lambda: is_shown(visitor, "panda", 7), "the other arm again")
        choose(page, "JACO", instead_of="Franka Panda")
        wait_until(lambda: is_shown(visitor, "", 6), "the arm as it was")
        assert visitor.session.wait_idle(PATIENCE)
        assert page.get_by_label("Model", exact=True).first.input_value() == "JACO"
        assert other.session.scenario is untouched and other.robot is live and len(other.robot.arms.arm.frames) == 7
    finally:
        close_page(page, server, visitor)
        close_page(other_page, server, other)
