"""Parts of the page in a real browser, a visit each: the tour by its keys, the board, the arm's model, videos."""

import time
from dataclasses import replace

import numpy as np
import pytest
from browsing import (
    BOX,
    LIGHT,
    PATIENCE,
    PHONE,
    begin,
    close_page,
    open_page,
    open_tab,
    press,
    project,
    travel,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium
from decoding import decoded
from other_arms import seven_joints
from playwright.sync_api import expect

from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.tour import STEPS
from dt_viz.session import arms
from dt_viz.session.teaching import board_of
from dt_viz.ui.scene.export import RESOLUTIONS, FilmSettings

pytestmark = [pytest.mark.browser, needs_chromium]


def test_keys_of_the_tour_lead_through_all_steps_and_back_to_what_was_there(browser, server):
    page, visitor = open_page(browser, server, PHONE)
    session, tour = visitor.session, visitor._panel.tour
    own = encode(Saved(session.scenario))
    press(page.get_by_role("button", name="Take the tour", exact=True).first)
    for k, step in enumerate(STEPS):
        if k:
            page.keyboard.press("ArrowRight")
        text = page.get_by_text(f"{k + 1} of {len(STEPS)} · {step.title}")
        text.wait_for()
        box = page.get_by_role("note").evaluate(BOX)
        assert np.abs(np.subtract(box["whole"], box["seen"])).max() < 1 and not box["spills"]
        assert tour.number == k and visitor.camera.chosen is None  # these keys do not turn the view meanwhile
    page.keyboard.press("ArrowRight")  # there is no seventh
    page.keyboard.press("ArrowLeft")
    page.get_by_text(f"{len(STEPS) - 1} of {len(STEPS)}").wait_for()
    field = page.get_by_label("Task", exact=True).first
    field.focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Escape")
    field.evaluate("element => element.blur()")
    assert session.wait_idle(PATIENCE) and tour.number == len(STEPS) - 2
    page.keyboard.press("Escape")
    page.get_by_role("note").wait_for(state="detached")
    wait_until(lambda: not session.visits, "the visitor's own scenario")
    assert encode(Saved(session.scenario)) == own
    close_page(page, server, visitor)


U = np.linspace(0, 1, 14)
S = np.stack([-0.11 * np.sin(1.5 * np.pi * (2 * U - 1)), -0.34 * (U - 0.5)], axis=1)


def test_an_s_is_drawn_where_the_mouse_is_and_learned(browser, server, robot):
    page, visitor = open_page(browser, server, (1000, 720))
    board = board_of(robot)
    press(page.get_by_role("button", name="Draw your own"))
    wait_until(lambda: visitor.pictures.board.visible, "the board")
    until_drawn(visitor)
    takes, places = visitor.pictures._takes, board.at(S)
    page.mouse.move(*project(page, visitor, places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*project(page, visitor, place))
        time.sleep(0.06)
    page.mouse.up()
    wait_until(lambda: takes.name.text == "drawn 1", "the take")
    drawn = takes.drawn.node.points[:, 0]
    np.testing.assert_allclose(drawn @ board.normal, board.centre @ board.normal, atol=1e-5)
    fine = np.stack([np.interp(np.linspace(0, 1, 300), U, x) for x in places.T], axis=1)
    assert np.linalg.norm(drawn[:, None] - fine, axis=-1).min(axis=1).max() < 0.04  # a page that is busy skips moves
    assert len(drawn) > 50  # dots
    learn = page.get_by_role("button", name="Learn", exact=True)
    wait_until(learn.is_enabled, "the take's check")
    until_drawn(visitor)
    press(learn)
    wait_until(lambda: visitor.shown is not None and visitor.shown.task.title == "Your data", "the learned motion")
    visitor.session.edit("test", view=replace(LIGHT, rollouts=True))
    assert visitor.session.wait_idle(PATIENCE)
    (path,) = visitor.shown.rollouts
    np.testing.assert_allclose(path[[0, -1]], places[[0, -1]], atol=0.03)
    assert not visitor.pictures.board.visible
    close_page(page, server, visitor)


def choose_model(page, title, instead_of):
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


def test_the_arm_changes_in_place_and_back(browser, server, monkeypatch):
    monkeypatch.setattr(arms, "load_aside", lambda _name, progress: progress(0.5, "covering") or seven_joints())
    page, visitor = open_page(browser, server, (720, 450))
    open_tab(page, "Arm")
    choose_model(page, "Franka Panda", instead_of="JACO")
    wait_until(lambda: is_shown(visitor, "panda", 7), "the arm with seven joints")
    assert visitor.session.wait_idle(PATIENCE)
    assert visitor.robot.playback.live.q is not None and len(visitor.robot.playback.live.q) == 7
    hand = visitor.robot.hand
    visitor.session.step("play", view=replace(visitor.session.scenario.view, playing=True))
    wait_until(lambda: not np.array_equal(visitor.robot.hand, hand), "the hand to move")
    travel(page, "Undo")
    wait_until(lambda: is_shown(visitor, "", 6), "the arm as before")
    close_page(page, server, visitor)


SIZE = 320, 180
FEW = FilmSettings(rate=1, motion=2.0, turn=3.0, rest=0.0, patience=PATIENCE)


def test_a_motion_and_a_turn_are_rendered_and_downloaded(browser, server, initial, monkeypatch, tmp_path):
    monkeypatch.setitem(RESOLUTIONS, "1280 × 720", SIZE)
    for module in ("page", "scene.export"):
        monkeypatch.setattr(f"dt_viz.ui.{module}.SETTINGS", FEW)
    page, visitor = open_page(browser, server, (640, 480))
    begin(visitor, replace(initial("draw_s"), view=replace(LIGHT, handles=False, rollouts=True, arm=True)))
    scenario, camera = visitor.session.scenario, np.array(visitor.client.camera.position)
    page.evaluate("isLookedAt = true")
    open_tab(page, "Picture")
    assert not page.get_by_label("Video of", exact=True).is_visible()

    def choose(label, option):
        press(page.get_by_label(label, exact=True))
        press(page.get_by_role("option", name=option, exact=True))

    def saved(what):
        choose("Video of", what)
        with page.expect_download() as download:
            press(page.get_by_role("button", name="Save video"))
        assert download.value.suggested_filename == "dt-viz-draw_s.mp4"
        download.value.save_as(tmp_path / what)
        _, frames = decoded(tmp_path / what)
        return frames.astype(int)

    choose("Save as", "MP4")
    frames = saved("Motion")
    assert frames.shape == (3, SIZE[1], SIZE[0], 3)
    turn = saved("Turntable")
    assert turn.shape == (3, SIZE[1], SIZE[0], 3)
    for shown in (frames, turn):
        assert (shown > 240).all(axis=3).mean() > 0.3 and shown.std() > 15  # on white
        assert all((np.abs(a - b).max(axis=2) > 60).sum() > 100 for a, b in zip(shown[1:], shown[:-1], strict=True))
    assert visitor.session.scenario is scenario and np.array_equal(visitor.client.camera.position, camera)
    wait_until(lambda: visitor.robot.playback.film is None, "the robot to go on")
    close_page(page, server, visitor)
