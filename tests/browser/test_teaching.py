"""Teaching in a real browser: an S is drawn on the board with the mouse, learned, and its rollouts are seen."""

import time
from dataclasses import replace

import numpy as np
from browsing import LIGHT, PATIENCE, close_page, open_page, press, project, until_drawn, wait_until
from chromium import needs_chromium
from pytest import fixture, mark

from dt_viz.session.teaching import board_of

pytestmark = [mark.browser, needs_chromium]
U = np.linspace(0, 1, 14)
S = np.stack([-0.11 * np.sin(1.5 * np.pi * (2 * U - 1)), -0.34 * (U - 0.5)], axis=1)


@fixture(name="tab")
def _tab(browser, server):
    page, visitor = open_page(browser, server, (1000, 720))
    yield page, visitor
    close_page(page, server, visitor)


def test_an_s_is_drawn_with_the_mouse_and_learned_and_escape_leaves(tab, robot):
    page, visitor = tab
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
    press(page.get_by_role("button", name="Draw your own"))
    wait_until(lambda: visitor.pictures.board.visible, "the board again")
    page.keyboard.press("Escape")
    wait_until(lambda: not visitor.pictures.board.visible, "the motion again")
