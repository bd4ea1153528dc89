"""A page that was taken home plays from the file system, without a network."""

import io

import numpy as np
import pytest
from browsing import PATIENCE, UNHURRIED, close_notices, wait_until
from chromium import needs_chromium
from PIL import Image

from dt_viz.cli import main

pytestmark = [pytest.mark.browser, needs_chromium]


def test_a_page_plays_without_server_and_network(browser, tmp_path, cache, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    file = tmp_path / "s.html"
    assert main(["picture", "draw_s", "--out", str(file)]) == 0 and capsys.readouterr().out == f"{file}\n"
    assert file.stat().st_size < 5e6
    context, complaints, asked = browser.new_context(viewport={"width": 480, "height": 320}), [], []
    context.set_offline(True)
    context.route("**/*", lambda route: route.continue_() if route.request.url == file.as_uri() else route.abort())
    page = context.new_page()
    page.set_default_timeout(1000 * PATIENCE)
    page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.add_init_script(UNHURRIED.replace("200)", "800)"))
    page.goto(file.as_uri())
    page.locator("canvas").first.wait_for()
    moment = page.locator("input[inputmode]").first

    def seen(part):
        """The scene soon after a part of its duration."""
        close_notices(page)
        bar = page.locator(".mantine-Slider-track").bounding_box()
        page.mouse.click(bar["x"] + part * bar["width"], bar["y"] + bar["height"] / 2)
        page.wait_for_timeout(3000)
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        return np.asarray(picture, float)[:260, 160:]

    began = moment.input_value()
    wait_until(lambda: moment.input_value() != began, "the motion to go on")  # it plays by itself
    page.evaluate("isLookedAt = true")
    first, middle = seen(0.05), seen(0.5)
    assert first.std() > 10
    changed = np.abs(middle - first).max(axis=2) > 40
    assert changed.sum() > 300
    assert not complaints
    assert {url for url in asked if not url.startswith(("data:", "blob:"))} == {file.as_uri()}
    context.close()
