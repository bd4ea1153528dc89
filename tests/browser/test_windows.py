"""The page in windows of a laptop, a projector, and a phone both ways: its first controls, and touch."""

import time
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from browsing import (
    BOX,
    LIGHT,
    PATIENCE,
    PHONE,
    TRIES,
    begin,
    close_notices,
    close_page,
    open_page,
    open_tab,
    project,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium
from pages import camera_for

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.tabs.picture import LARGER

PROJECTOR, LAPTOP, PHONE_ON_ITS_SIDE = (1920, 1080), (1280, 720), (844, 390)

NEAR = 8.0  # accepted distance of what is dragged from the finger, pixels
LATE = 5.0  # time that the events of a drag may take, seconds

pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(scope="module")
def opened(browser, server):
    page, visitor = open_page(browser, server, PHONE)
    yield page, visitor
    close_page(page, server, visitor)


def has_shape(camera, ratio):
    """Whether viser's picture is as wide for its height as the window; it has fewer pixels while drawing is slow."""
    return abs(camera.image_width / camera.image_height / ratio - 1) < 0.01


@pytest.fixture
def visit(opened, initial, request):
    """The page in a window of the test's size, as a visitor finds it, with the obstacle only."""
    page, visitor = opened
    width, height = request.param
    page.set_viewport_size({"width": width, "height": height})
    begin(visitor, replace(initial("draw_s"), view=LIGHT))
    page.get_by_text("· stable").wait_for()
    wait_until(lambda: has_shape(visitor.client.camera, width / height), "the page to have the window's shape")
    until_drawn(visitor)
    close_notices(page)
    return page, visitor


def windows(*sizes):
    """In windows of these sizes; in the slow tests of the others, too."""
    others = {PHONE, PROJECTOR, LAPTOP, PHONE_ON_ITS_SIDE} - set(sizes)
    slow = [pytest.param(size, marks=pytest.mark.slow) for size in sorted(others)]
    return pytest.mark.parametrize("visit", [*sizes, *slow], indirect=True, ids=str)


def boxes(page):
    """Boxes of the first controls, from the top down to what changes as one works."""
    controls = {name: page.get_by_label(name, exact=True) for name in ("Task", "Scene", "Avoid", "Imitate")}
    controls |= {f"name of {name}": page.locator("label").get_by_text(name, exact=True) for name in controls}
    controls["status"] = page.get_by_text("· stable")
    return {name: control.first.evaluate(BOX) for name, control in controls.items()}


def faults(boxes):
    """What is cut, too narrow for its content, or covers something else."""
    found = []
    for name, box in boxes.items():
        if np.abs(np.subtract(box["whole"], box["seen"])).max() > 1 or box["whole"][0] >= box["whole"][2]:
            found.append(f"{name} is cut")
        if box["spills"]:
            found.append(f"{name} is too narrow")
    for (one, a), (other, b) in combinations(boxes.items(), 2):
        lows, highs = np.maximum(a["whole"][:2], b["whole"][:2]), np.minimum(a["whole"][2:], b["whole"][2:])
        if (highs - lows > 1).all():
            found.append(f"{one} overlaps {other}")
    return found


@windows(PHONE, PROJECTOR)
def test_nothing_of_the_first_controls_is_cut_or_overlaps(visit):
    page, _ = visit
    wait_until(lambda: faults(boxes(page)) == [], "the panel is laid out")


@windows(PROJECTOR)
def test_the_presentation_has_a_caption_and_buttons_in_place_of_the_panel(visit):
    page, visitor = visit
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("p")
    page.get_by_role("heading", name="Draw S").wait_for()
    page.get_by_label("Task", exact=True).wait_for(state="hidden")
    shown = {name: page.get_by_role("button", name=name, exact=True) for name in ("Previous", "Next", "End")}
    shown |= {"title": page.get_by_role("heading"), "caption": page.locator(".dt-caption p")}
    assert faults({name: element.evaluate(BOX) for name, element in shown.items()}) == []
    until_drawn(visitor)
    page.keyboard.press("Escape")
    page.get_by_label("Task", exact=True).wait_for()


LEAVES = """tab => {
    const root = tab.closest('[role=tablist]').parentElement;
    const scrolls = node => getComputedStyle(node).overflowX === 'visible' ? scrolls(node.parentElement) : node;
    const found = [];
    let number = 0;
    const kinds = 'label, button:not([role=tab]), [class*=Button-label], input, th, td, p';
    for (const node of root.querySelectorAll(kinds)) {
        const box = node.getBoundingClientRect();
        if (!node.checkVisibility({opacityProperty: true, visibilityProperty: true}) || box.width < 4) continue;
        const around = scrolls(node.parentElement).getBoundingClientRect();
        const name = node.innerText || node.getAttribute('aria-label') || node.value || node.tagName;
        if (box.left < Math.max(around.left, 0) - 1 || box.right > Math.min(around.right, innerWidth) + 1)
            found.push(`${name} is cut`);
        if (node.scrollWidth > node.clientWidth + 1 && node.clientWidth) found.push(`${name} is too narrow`);
        number += 1;
    }
    return number < 3 ? ['nothing is there'] : found;
}"""
"""What is cut at its sides, or too narrow for its content, of a tab's controls, wherever these are scrolled to."""
TABS = ("World", "Stack", "Show", "Arm", "Compare", "Picture")


def faults_of(page, tab):
    """Faults of a tab of the panel."""
    open_tab(page, tab)
    return page.get_by_role("tab", name=tab, exact=True).evaluate(LEAVES)


@windows(PHONE, PHONE_ON_ITS_SIDE, LAPTOP, PROJECTOR)
def test_nothing_of_any_tab_is_cut_or_too_narrow(visit):
    page, _ = visit
    for tab in TABS:
        wait_until(lambda tab=tab: faults_of(page, tab) == [], f"{tab} to be whole")
    open_tab(page, "World")


def touch(page, start, end, steps=6):
    """Drag with one finger."""
    finger = page.context.new_cdp_session(page)

    def send(kind, *places):
        points = [{"x": float(x), "y": float(y)} for x, y in places]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        time.sleep(0.03)

    send("touchStart", start)
    for k in range(1, steps + 1):
        send("touchMove", np.add(start, k / steps * np.subtract(end, start)))
    send("touchEnd")
    finger.detach()


@windows(PHONE)
def test_a_touch_drags_the_sphere(visit):
    page, visitor = visit
    session, camera = visitor.session, visitor.client.camera
    home, _ = camera_for(TASKS["draw_s"](), camera)
    grabbed = replace(session.scenario, view=replace(LIGHT, handles=False))
    (before,) = grabbed.obstacles
    drag = np.array([30.0, -20.0])

    def shift():
        return np.subtract(session.scenario.obstacles[0].position, before.position)

    def missed():
        """How far from where it was dragged to the sphere is seen, pixels."""
        return np.abs(project(page, visitor, before.position + shift()) - begun - drag).max()

    for _ in range(TRIES):  # a page drawn by software may not show the sphere in its place yet
        begin(visitor, grabbed)
        visitor.camera.view()
        wait_until(lambda: np.abs(camera.position - home).max() < 1e-3, "the camera to be back")
        until_drawn(visitor)
        begun = np.array(project(page, visitor, before.position))
        touch(page, begun, begun + drag)
        deadline = time.monotonic() + LATE
        while missed() > NEAR and time.monotonic() < deadline:
            time.sleep(0.1)
        if missed() < NEAR:
            break
    time.sleep(0.3)  # nor does anything of the drag come later that moves it on
    until_drawn(visitor)
    x, y, z = shift()
    assert missed() < NEAR and x > 0.01 and z > 0.01 and abs(y) < 1e-6  # to the right and up, in the drawing plane
    assert np.abs(camera.position - home).max() < 1e-3
    assert session.wait_idle(PATIENCE)


GROUP = ("Front", "Side", "Top", "Hand", "Home")


def views(page):
    """Boxes of the buttons of the camera's views."""
    return {name: page.get_by_role("button", name=name, exact=True).evaluate(BOX) for name in GROUP}


def tabs(page):
    return {tab.inner_text(): tab.evaluate(BOX) for tab in page.get_by_role("tab").all()}


@pytest.mark.slow
@pytest.mark.parametrize("visit", [LAPTOP, PROJECTOR], indirect=True, ids=str)
def test_big_type_is_larger_and_nothing_is_cut_or_overlaps(visit):
    page, visitor = visit
    camera, home = visitor.client.camera, visitor.client.camera.position

    def height():
        low, high = boxes(page)["status"]["whole"][1::2]
        return high - low

    usual = height()
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("b")
    wait_until(lambda: height() > 0.9 * LARGER * usual and faults(boxes(page)) == [], "the larger panel")
    wait_until(lambda: np.linalg.norm(camera.position - home) > 0.01, "the view beside the wider panel")
    open_tab(page, "Picture")
    wait_until(lambda: len({box["whole"][1] for box in views(page).values()}) == 1, "the views in one row")
    wait_until(lambda: faults(tabs(page)) == [], "tabs that are whole")
    open_tab(page, "World")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("b")
    wait_until(lambda: np.abs(camera.position - home).max() < 0.005, "the view as before")


@windows(PHONE)
def test_the_views_lie_in_one_row(visit):
    page, _ = visit
    open_tab(page, "Picture")
    wait_until(lambda: len({box["whole"][1] for box in views(page).values()}) == 1, "the views in one row")
    buttons = views(page)
    lefts = [box["whole"][0] for box in buttons.values()]
    assert lefts == sorted(set(lefts)) and not any(box["spills"] for box in buttons.values())
    if page.viewport_size["width"] > page.viewport_size["height"]:  # a phone's panel is narrower
        assert len({box["whole"][1] for box in tabs(page).values()}) == 1
    open_tab(page, "World")
