"""Pages in a real browser: headless Chromium, what is waited for in it, and where things are seen."""

import time
from contextlib import suppress

import numpy as np
import pytest
from pages import all_of

from dt_viz.scenario.scenario import Scenario, View
from dt_viz.ui.page import Page

PATIENCE = 240.0
"""Seconds after which a test gives up; nothing takes that long, even on a machine that has other work."""
TRIES = 8
"""Drags or clicks until the page, which may still be on its way to what was asked of it, has taken one."""
HIDDEN = ("playing", "rollouts", "ghost", "field", "arm", "table", "demonstrations")
LIGHT = View(handles=True, **dict.fromkeys(HIDDEN, False))
"""The obstacle only: drawing the lines by software takes a tenth of a second, and the arm most of one."""

UNHURRIED = """
    window.requestAnimationFrame = callback => setTimeout(() => callback(performance.now()), 200);
    window.cancelAnimationFrame = clearTimeout;
    for (const name of ['clear', 'drawArrays', 'drawArraysInstanced', 'drawElements', 'drawElementsInstanced']) {
        const draw = WebGL2RenderingContext.prototype[name];
        WebGL2RenderingContext.prototype[name] = function(...given) { if (window.isLookedAt) draw.apply(this, given); };
    }
    const still = new CSSStyleSheet();
    still.replaceSync('*, ::before, ::after {animation: none !important}');
    document.adoptedStyleSheets.push(still);
"""
"""Five frames a second are enough, no pixels where `isLookedAt` is not set, and no spinners: drawing by software takes
whole cores.

Timers also run where the browser gives no frames for a while, as after a change of the window's size. What is clicked
or dragged is found by rays through the scene's triangles, which needs no pixels.
"""


def wait_until(condition, what):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.05)


def until_drawn(visitor):
    """Until the page has drawn what it was sent, and what it has sent itself has arrived: messages keep their order."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        visitor.client.flush()
        with suppress(TimeoutError):  # a page that is busy may lose what it is asked
            visitor.client.get_render(height=16, width=16, timeout=PATIENCE / TRIES)
            return
    pytest.fail("the page draws nothing")


RNG = np.random.default_rng(5)
DROP = """files => {
    const transfer = new DataTransfer();
    for (const [name, text] of files) transfer.items.add(new File([text], name));
    for (const type of ['dragover', 'drop'])
        document.body.dispatchEvent(new DragEvent(type, {dataTransfer: transfer, bubbles: true, cancelable: true}));
}"""
"""Drops files, each a name and a text, on the page."""

STORED = "Object.keys(localStorage).find(key => key.endsWith('dt-viz'))"
"""Script that finds the name under which the browser keeps what was made on the page."""

PHONE = (390, 844)  # width and height of the window of a phone, CSS pixels
BOX = """element => {
    const {left, top, right, bottom} = element.getBoundingClientRect();
    const seen = [Math.max(left, 0), Math.max(top, 0), Math.min(right, innerWidth), Math.min(bottom, innerHeight)];
    const isFixed = inner => getComputedStyle(inner).position === 'fixed';
    for (let inner = element; inner.parentElement && !isFixed(inner); inner = inner.parentElement) {
        const around = inner.parentElement;
        if (getComputedStyle(around).overflow === 'visible') continue;
        const clip = around.getBoundingClientRect();
        seen[0] = Math.max(seen[0], clip.left);
        seen[1] = Math.max(seen[1], clip.top);
        seen[2] = Math.min(seen[2], clip.right);
        seen[3] = Math.min(seen[3], clip.bottom);
    }
    return {whole: [left, top, right, bottom], seen, spills: element.scrollWidth > element.clientWidth + 1};
}"""
"""An element's box, the part of it that nothing around it cuts off, and whether its own content is wider than it."""

page_errors: list[str] = []  # what pages have complained of in their consoles
OF_OTHERS = ("Unable to preventDefault inside passive event listener", "GPU stall due to ReadPixels")
"""Said by viser's own page of any drag, and by Chromium where it draws by software; nothing is lost."""


def close_notices(page):
    """They cover the scene; the one about software rendering may come late, and go by itself at any moment."""
    page.locator("button.mantine-Notification-closeButton").evaluate_all("all => all.forEach(button => button.click())")


def open_page(browser, server, size, ratio=1):
    """A new tab, its width and height in CSS pixels, each of so many of its screen, and the visitor made for it.

    Its first scenario is drawn, without the arm.
    """
    known = set(server.visitors)
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, has_touch=True, device_scale_factor=ratio)
    page.set_default_timeout(1000 * PATIENCE)
    page.on("console", lambda message: page_errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page_errors.append(str(error)))
    page.add_init_script(UNHURRIED)
    page.goto(f"http://127.0.0.1:{server.port}")
    wait_until(lambda: set(server.visitors) - known, "the page of a visitor")
    (visitor,) = set(server.visitors) - known
    visitor.session.edit("test", view=LIGHT)
    assert visitor.session.wait_idle(PATIENCE)
    page.get_by_text("· stable").wait_for()
    until_drawn(visitor)
    close_notices(page)
    return page, visitor


def close_page(page, server, visitor):
    page.close()
    wait_until(lambda: visitor not in server.visitors, "the visitor to leave")


def begin(visitor: Page, scenario: Scenario) -> None:
    """Begin with a scenario, and wait until it is shown."""
    visitor.session.edit("test", **all_of(scenario))
    visitor.session.end_gesture()
    assert visitor.session.wait_idle(PATIENCE)
    assert visitor.shown is not None and visitor.shown.scenario.choices == scenario.choices


def project(page, visitor: Page, point) -> tuple[float, float]:
    """CSS pixels of a world point: the camera looks along its z axis, y down, vertical field of view.

    The window's size is the browser's own: viser's page tells that of its picture, which is smaller while it is slow.
    """
    camera = visitor.client.camera
    w, x, y, z = camera.wxyz
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    seen = rotation.T @ (np.asarray(point) - camera.position)
    width, height = page.viewport_size["width"], page.viewport_size["height"]
    focal = height / 2 / np.tan(camera.fov / 2)
    return width / 2 + focal * seen[0] / seen[2], height / 2 + focal * seen[1] / seen[2]


def kept(page) -> str | None:
    """What the browser keeps of what was made on the page; None if it keeps nothing."""
    return page.evaluate(f"localStorage.getItem({STORED})")


def press(locator):
    """Click without waiting for two alike pictures of the page, which may be long in coming."""
    locator.click(force=True)


def travel(page, name):
    """Press a button of the history once the page has been told that there is such a step."""
    button = page.get_by_role("button", name=name, exact=True)
    wait_until(lambda: button.evaluate("node => getComputedStyle(node).pointerEvents") == "auto", f"a step to {name}")
    press(button)


def open_tab(page, name):
    """A tab of the panel."""
    press(page.get_by_role("tab", name=name, exact=True))


def drag(page, start, end, steps=6):
    page.mouse.move(*start)
    page.mouse.down()
    for k in range(1, steps + 1):
        page.mouse.move(*(a + (b - a) * k / steps for a, b in zip(start, end, strict=True)))
        time.sleep(0.03)
    page.mouse.up()


def take(goal=(0.2, -0.45, 0.3)):
    """The content of a file with a recorded motion, each time another."""
    u = np.linspace(0, 1, 150)
    start = np.array([-0.2, -0.4, 0.2]) + RNG.normal(scale=0.01, size=3)
    path = start + (3 * u**2 - 2 * u**3)[:, None] * (np.array(goal) - start) + RNG.normal(scale=0.001, size=(150, 3))
    rows = np.column_stack([3 * u, path])
    return "\n".join(["timestamp,pos_x,pos_y,pos_z", *(",".join(f"{v:.5f}" for v in row) for row in rows)]).encode()
