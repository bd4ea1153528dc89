"""The Compare tab in a browser: methods are ticked, their scores and curves follow the obstacle, their arm is shown."""

import time
from dataclasses import replace

import numpy as np
import pytest
from browsing import (
    LIGHT,
    OF_OTHERS,
    PATIENCE,
    TRIES,
    begin,
    close_page,
    drag,
    open_page,
    open_tab,
    press,
    project,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server
from dt_viz.ui.tabs.compare import TITLES

SIZE = (1280, 720)
pytestmark = [pytest.mark.browser, pytest.mark.slow, needs_chromium]

FIGURES = """() => [...document.querySelectorAll('table')].flatMap(table => [...table.rows])
    .filter(row => row.cells.length > 2 && row.cells[0].tagName === 'TD')
    .map(row => [...row.cells].map(cell => cell.innerText.trim()))"""
"""Rows of the table that have figures: the method's name and its cells."""
INK = """() => [...document.querySelectorAll('.uplot canvas')].map(canvas => {
    const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let k = 0; k < data.length; k += 4) count += data[k + 3] > 40 && data[k] > data[k + 2] + 40;
    return count;
})"""
"""Number of pixels of each plot that are rather red than blue: those of our curve and of Linear's, no axis or text."""


@pytest.fixture(scope="module")
def server(fits, robot):
    server = Server(TASKS, fits, robot, task="push_box", port=0)
    yield server
    server.close()


@pytest.fixture(scope="module")
def opened(browser, server):
    page, visitor = open_page(browser, server, SIZE)
    yield page, visitor
    close_page(page, server, visitor)


def read(scores):
    """Scores as the table shows them, mm."""
    return [f"{1e3 * v:.0f}" for v in (scores.frechet, scores.hand_depth, scores.arm_depth, scores.goal_error)]


def figures(page):
    """Figures of the table by the method, as they are read."""
    return {name: cells for name, *cells in page.evaluate(FIGURES)}


def test_methods_are_ticked_followed_and_shown_with_their_arm(opened, initial):
    page, visitor = opened
    warnings = []
    page.on("console", lambda message: warnings.append(message.text) if message.type == "warning" else None)
    begin(visitor, replace(initial("push_box"), view=LIGHT))
    open_tab(page, "Compare")
    (sphere,) = visitor.session.scenario.obstacles
    for name in ("EFlow", "Linear"):
        press(page.get_by_label(name, exact=True))
    wait_until(lambda: visitor.session.scenario.view.compared == ("eflow", "linear"), "both methods")
    assert visitor.session.wait_idle(PATIENCE)
    wait_until(lambda: len(found := figures(page)) == 3 and all("–" not in row for row in found.values()), "the table")
    found = figures(page)
    assert list(found) == ["Ours", "EFlow", "Linear"]
    assert found == {compared.method.title: read(compared.scores) for compared in visitor.shown.comparison}
    for title in TITLES:
        page.get_by_text(title).wait_for()

    def drawn():
        page.locator(".uplot").last.scroll_into_view_if_needed()  # again: the page grows while it is filled
        return len(ink := page.evaluate(INK)) == 2 and min(ink) > 30

    wait_until(drawn, "curves in both plots")

    for _ in range(TRIES):  # a page drawn by software may not show the sphere in its place yet
        until_drawn(visitor)
        x, y = project(page, visitor, visitor.session.scenario.obstacles[0].position)
        drag(page, (x, y), (x, y - SIZE[1] / 6))
        time.sleep(0.5)
        if np.ptp([visitor.session.scenario.obstacles[0].position[2], sphere.position[2]]) > 0.05:
            break
        visitor._camera.view()
    assert visitor.session.wait_idle(PATIENCE)
    compared = {compared.method.title: compared.scores for compared in visitor.shown.comparison}
    wait_until(lambda: figures(page) == {title: read(scores) for title, scores in compared.items()}, "other figures")
    moved = figures(page)
    assert moved["Ours"] != found["Ours"] and moved["EFlow"][1] != found["EFlow"][1]
    assert moved["EFlow"][0] == found["EFlow"][0]  # it does not avoid

    assert not visitor.robot.their_arm._ghost.visible
    press(page.get_by_label("Their arm", exact=True))
    page.get_by_role("option", name="EFlow", exact=True).evaluate("element => element.click()")
    wait_until(lambda: visitor.robot.their_arm._ghost.visible, "their arm")
    until_drawn(visitor)
    assert [text for text in warnings if not any(known in text for known in OF_OTHERS)] == []
