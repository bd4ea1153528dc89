"""Teaching in a real browser: an S is drawn on the board with the mouse, learned, and its rollouts are seen."""

import time
from dataclasses import replace

import numpy as np
from browsing import LIGHT, PATIENCE, kept, open_page, press, project, travel, until_drawn, wait_until
from chromium import needs_chromium
from pytest import fixture, mark

from dt_viz.session.teaching import board_of
from dt_viz.ui.keeping import LANE

pytestmark = [mark.browser, needs_chromium]
U = np.linspace(0, 1, 14)
S = np.stack([-0.11 * np.sin(1.5 * np.pi * (2 * U - 1)), -0.34 * (U - 0.5)], axis=1)


@fixture(name="tab")
def _tab(browser, server):
    page, visitor = open_page(browser, server, (1000, 720))
    yield page, visitor
    page.close()
    wait_until(lambda: not server.visitors, "the visitor to leave")


def draw(page, visitor, places):
    """Draw through places on the board with the mouse."""
    page.mouse.move(*project(page, visitor, places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*project(page, visitor, place))
        time.sleep(0.06)
    page.mouse.up()


def test_an_s_is_drawn_with_the_mouse_and_learned_and_put_back_and_a_reload_opens_what_was_added(tab, robot, server):
    page, visitor = tab
    board = board_of(robot)
    press(page.get_by_role("button", name="Draw your own"))
    wait_until(lambda: visitor.pictures.board.visible, "the board")
    until_drawn(visitor)
    takes, places = visitor.pictures._takes, board.at(S)
    draw(page, visitor, places)
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
    press(page.get_by_role("button", name="Draw your own"))
    wait_until(lambda: visitor.pictures.board.visible, "the board again")
    wait_until(lambda: takes.visible and takes.name.text == "drawn 1", "the take again")
    until_drawn(visitor)
    draw(page, visitor, board.at(S + np.array([0.02, 0.0])))
    wait_until(lambda: takes.name.text == "drawn 2", "another take")
    travel(page, "Undo")
    wait_until(lambda: takes.name.text == "drawn 1", "the take before")
    travel(page, "Redo")
    wait_until(lambda: takes.name.text == "drawn 2", "the other take again")
    assert visitor.session.jobs.wait_idle(LANE, PATIENCE)
    until_drawn(visitor)
    assert "drawn 2" in (kept(page) or "")
    page.reload()
    wait_until(lambda: server.visitors and visitor not in server.visitors, "another visitor")
    (visitor,) = server.visitors
    wait_until(lambda: visitor.pictures._takes.name.text == "drawn 2", "the takes after the reload")
    page.get_by_text("as saved").wait_for()
    assert visitor.session.scenario.task == "own_data_1"
    until_drawn(visitor)
    page.keyboard.press("Escape")
    wait_until(lambda: not visitor.pictures._takes.visible, "the motion again")
