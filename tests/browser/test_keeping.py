"""What a visitor has made is in his browser: after a reload, and in another process that serves the same address."""

import re
from dataclasses import replace

import browsing
import numpy as np
import pytest
from browsing import (
    PATIENCE,
    UNHURRIED,
    open_page,
    open_tab,
    page_errors,
    press,
    travel,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium
from demo import address, started

from dt_viz.scenario.saved import Known, decode
from dt_viz.scenario.slices import BASE_PANEL
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui import keeping
from dt_viz.ui.page import initial
from dt_viz.ui.panel import HISTORY

pytestmark = [pytest.mark.browser, needs_chromium]


def kept(page):
    """The scenario that the browser keeps; None if it keeps nothing."""
    text = browsing.kept(page)
    return None if text is None else decode(text, Known(tuple(TASKS))).scenario


def kept_camera(page):
    """Where the camera is, and where it looks, as the browser keeps it; None where that is how its task begins."""
    text = browsing.kept(page)
    assert text is not None
    return decode(text, Known(tuple(TASKS))).camera


@pytest.fixture
def visit(browser, server):
    page, visitor = open_page(browser, server, (720, 450))
    yield page, visitor
    page.close()
    wait_until(lambda: not server.visitors, "the visitors to leave")


def reload(page, server):
    """The page anew, and its visitor."""
    before = set(server.visitors)
    page.reload()
    wait_until(lambda: set(server.visitors) - before, "the page of a visitor")
    (visitor,) = set(server.visitors) - before
    page.get_by_text("· stable").wait_for()
    assert visitor.session.wait_idle(PATIENCE)
    return visitor


def add(page, shape):
    press(page.get_by_role("button", name=shape, exact=True))


def test_after_a_reload_the_visitor_finds_what_he_has_made(visit, server):
    page, visitor = visit
    open_tab(page, "World")
    add(page, "Cylinder")
    wait_until(lambda: len(visitor.session.scenario.obstacles) == 2, "the cylinder")
    visitor.camera.view("Top")
    wait_until(lambda: kept(page) == visitor.session.scenario, "the browser to keep it")
    until_drawn(visitor)
    seen = visitor.client.camera.position, visitor.client.camera.look_at

    def is_kept():  # the cylinder may have been written before the view
        camera = kept_camera(page)
        return camera is not None and np.allclose(camera, seen, atol=2e-3)

    wait_until(is_kept, "the browser to keep the camera")
    again = reload(page, server)
    assert again.session.scenario == visitor.session.scenario
    page.get_by_text(re.compile("· as saved$")).wait_for()
    until_drawn(again)
    for before, after in zip(seen, (again.client.camera.position, again.client.camera.look_at), strict=True):
        assert after == pytest.approx(before, abs=2e-3)

    open_tab(page, "World")
    add(page, "Delete")
    wait_until(lambda: len(again.session.scenario.obstacles) == 1, "it to be gone")
    page.get_by_text(re.compile("· as saved$")).wait_for(state="detached")
    press(page.get_by_role("button", name="Reset", exact=True))
    fresh = initial(again.session.engine.task("draw_s"))
    wait_until(lambda: kept(page) == fresh, "the browser to keep how it began")
    assert reload(page, server).session.scenario == fresh


def test_undo_brings_back_what_reset_took_also_the_view_and_the_camera(visit, server):
    page, visitor = visit
    session = visitor.session
    session.step("test", warp=0.5)
    session.edit("test", view=replace(session.scenario.view, grid=True, panels=(BASE_PANEL,)))
    assert session.wait_idle(PATIENCE)
    until_drawn(visitor)
    camera, before = visitor.camera, session.scenario
    camera.view("Top")
    until_drawn(visitor)
    pose = camera.chosen
    assert pose is not None

    def settled(is_there, what):
        wait_until(is_there, what)
        assert session.wait_idle(PATIENCE)
        until_drawn(visitor)

    def has_begun():
        return session.scenario.warp == 1 and camera.chosen is None

    def is_as_before():
        return session.scenario == before and camera.chosen is not None and np.allclose(camera.chosen, pose, atol=2e-3)

    press(page.get_by_role("button", name="Reset", exact=True))
    settled(has_begun, "the scene and the camera as they began")
    assert not session.scenario.view.grid
    travel(page, "Undo")
    settled(is_as_before, "the scenario, its view and the camera again")
    travel(page, "Redo")
    settled(has_begun, "them as they began again")
    travel(page, "Undo")
    settled(is_as_before, "what was there")
    travel(page, "Undo")
    wait_until(lambda: session.scenario.warp == 1 and session.scenario.view.grid, "the step before, seen as now")


def test_the_buttons_of_the_history_are_one_row_and_each_has_a_hint_of_its_own(visit):
    page, _ = visit
    buttons = [page.get_by_role("button", name=name, exact=True) for name in HISTORY]
    wait_until(lambda: all(button.bounding_box() for button in buttons), "the buttons")
    assert len({button.bounding_box()["y"] for button in buttons}) == 1
    for button, hint in zip(buttons, HISTORY.values(), strict=True):
        page.mouse.move(5, 5)
        page.get_by_role("tooltip").wait_for(state="detached")
        button.hover(force=True)
        wait_until(lambda hint=hint: page.get_by_role("tooltip").all_inner_texts() == [hint], "the hint")


def test_a_browser_that_is_not_allowed_to_keep_anything_says_so_and_the_page_goes_on(visit, server):
    page, _ = visit
    page.add_init_script("Object.defineProperty(window, 'localStorage', {get() { throw new Error('forbidden'); }})")
    again = reload(page, server)
    page.get_by_text(keeping.BLOCKED).first.wait_for()
    add(page, "Box")
    wait_until(lambda: len(again.session.scenario.obstacles) == 2, "the box")
    assert again.session.wait_idle(PATIENCE)
    page.close()
    page_errors.clear()  # of what is forbidden


def test_a_browser_without_room_says_so_and_the_page_goes_on(visit, server):
    page, visitor = visit
    made = visitor.session.scenario
    wait_until(lambda: kept(page) == made, "the browser to keep it")
    page.evaluate(
        """() => {
            for (let text = 'x'.repeat(2 ** 20), number = 0; text; number++)
                try { localStorage.setItem(`filler-${number}`, text); }
                catch { text = text.slice(text.length / 2 + 1); }
        }"""
    )
    add(page, "Box")
    page.get_by_text(keeping.FULL).first.wait_for()
    assert kept(page) == made
    assert visitor.session.wait_idle(PATIENCE) and len(visitor.session.scenario.obstacles) == 2
    again = reload(page, server)
    assert len(again.session.scenario.obstacles) == 1
    page.evaluate("localStorage.clear()")
    add(page, "Cylinder")
    wait_until(lambda: kept(page) == again.session.scenario, "the browser, which has room again, to keep it")
    page.close()
    page_errors.clear()  # of what had no room


def test_a_killed_server_loses_nothing(browser, cache, fits):
    page = browser.new_page(viewport={"width": 720, "height": 450})
    page.set_default_timeout(1000 * PATIENCE)
    page.add_init_script(UNHURRIED)
    with started(cache, patience=4 * PATIENCE) as process:
        port = address(process).rpartition(":")[2]
        page.goto(f"http://127.0.0.1:{port}")
        page.get_by_role("button", name="Delete", exact=True).wait_for()
        add(page, "Delete")  # there is less to compute than with an obstacle
        wait_until(lambda: (found := kept(page)) is not None and not found.obstacles, "the browser to keep it")
        made = kept(page)
        process.kill()
        process.wait()
    with started(cache, "--port", port, patience=4 * PATIENCE):
        page.get_by_text(re.compile("· as saved$")).wait_for()  # the page connects again by itself
        assert kept(page) == made
        page.close()
