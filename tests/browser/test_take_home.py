"""A page that was taken home plays from the file system, without a network."""

import io

import numpy as np
import pytest
from browsing import PATIENCE, UNHURRIED, close_notices, wait_until
from chromium import needs_chromium
from PIL import Image

from dt_viz.cli import main

pytestmark = [pytest.mark.browser, needs_chromium]

WATCH = """
    window.seen = {rounds: 0, astray: []};
    let before = 0;
    const request = window.requestAnimationFrame;
    window.requestAnimationFrame = callback => request(time => {
        callback(time);
        const viewer = window.__viserMutable, nodes = window.__viserSceneTree?.getState() ?? {};
        const now = Number(document.querySelector('input[inputmode]')?.value ?? 0);
        if (now < before) window.seen.rounds += 1;
        before = now;
        if ([...document.querySelectorAll('body > canvas')].some(picture => !picture.hidden)) return;
        for (const [name, node] of Object.entries(nodes)) {
            const pose = viewer.nodePoseData[name];
            const shown = node.effectiveVisibility && node.message.type !== 'LabelMessage';
            const waits = pose?.position.some(Boolean) && pose.poseUpdateState !== 'updated';
            if (shown && waits) window.seen.astray.push(name);
        }
    });
"""
"""Notes what was drawn, with no picture over it, that was not in its place yet, and how often the motion began anew."""


@pytest.fixture(name="file")
def _file(tmp_path, cache, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    file = tmp_path / "s.html"
    assert main(["picture", "draw_s", "--out", str(file)]) == 0 and capsys.readouterr().out == f"{file}\n"
    assert file.stat().st_size < 5e6
    return file


def test_nothing_is_seen_before_it_is_in_its_place_and_a_legend_names_it(browser, file):
    page = browser.new_page(viewport={"width": 480, "height": 320})
    page.set_default_timeout(1000 * PATIENCE)
    page.add_init_script(UNHURRIED)
    page.add_init_script(WATCH)
    page.goto(file.as_uri())
    wait_until(lambda: page.evaluate("seen.rounds") > 1, "two rounds")
    assert page.evaluate("seen.astray") == []
    assert page.evaluate("Object.keys(__viserSceneTree.getState()).length") > 50
    legend = page.locator("details").inner_text().splitlines()
    assert legend == ["Legend", "demonstrations", "undisturbed", "rollouts", "obstacle", "goal"]
    page.close()


def test_a_page_plays_without_server_and_network(browser, file):
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

    def go_to(part):
        """Click on a part of the motion's duration."""
        close_notices(page)
        bar = page.locator(".mantine-Slider-track").bounding_box()
        page.mouse.click(bar["x"] + part * bar["width"], bar["y"] + bar["height"] / 2)
        page.wait_for_timeout(3000)

    def seen():
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        return np.asarray(picture, float)[:260, 160:]

    began = moment.input_value()
    wait_until(lambda: moment.input_value() != began, "the motion to go on")  # it plays by itself
    page.evaluate("isLookedAt = true")
    go_to(0.05)
    wait_until(lambda: seen().std() > 10, "the scene to be drawn")
    first = seen()
    go_to(0.5)
    wait_until(lambda: (np.abs(seen() - first).max(axis=2) > 40).sum() > 300, "another moment to be drawn")
    assert not complaints
    assert {url for url in asked if not url.startswith(("data:", "blob:"))} == {file.as_uri()}
    context.close()
