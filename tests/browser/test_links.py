"""Links and the presenter's key, on pages of a server that is started as users do: with several processes."""

import json
import urllib.request

import pytest
from browsing import PATIENCE, UNHURRIED, kept, wait_until
from chromium import needs_chromium
from demo import address, started

from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tour import STEPS
from dt_viz.serving.supervisor import several_reason

pytestmark = [pytest.mark.browser, needs_chromium]

LESSON = Saved(Scenario("draw_j", (), warp=0.5))
SHOWN = {
    "?tour": f"1 of {len(STEPS)} · {STEPS[0].title}",
    "?tour=4": f"4 of {len(STEPS)} · {STEPS[3].title}",
    "?scene=fig-5&other=1": "Fig. 5",
    "?task=lift_box": "Lift",
    "?scenario=lesson-1": "Draw J",
    "?scene=%3Cb%3Enothing%3C%2Fb%3E": "The link: scene: found '<b>nothing</b>'",
}
"""What a page shows after it was opened by a link."""


@pytest.fixture(scope="module")
def demo(cache, fits, tmp_path_factory):
    """Address of the page."""
    folder = tmp_path_factory.mktemp("scenarios")
    (folder / "lesson-1.json").write_text(encode(LESSON))
    with started(cache, "--scenarios", str(folder), patience=4 * PATIENCE) as process:
        where = address(process).replace("ws", "http")
        with urllib.request.urlopen(f"{where}/health", timeout=PATIENCE) as response:
            assert json.load(response)["processes"] > 1 or several_reason()
        yield where


def opened(browser, where, width=900):
    page = browser.new_page(viewport={"width": width, "height": 700})
    page.set_default_timeout(1000 * PATIENCE)
    page.add_init_script(UNHURRIED)
    page.goto(where)
    return page


def shows(page, text):
    """Whether a text, or a field with that value, is seen on the page."""
    values = page.locator("input").evaluate_all("all => all.map(input => input.value)")
    return any(text in value for value in values) or page.get_by_text(text).count() > 0


@pytest.mark.parametrize("link", SHOWN)
def test_a_link_opens_what_it_names_whichever_process_has_the_page(browser, demo, link):
    rest = "?other=1" if "other" in link else ""
    for _ in range(2):  # connections go to the processes in turn
        page = opened(browser, f"{demo}/{link}")
        wait_until(lambda page=page: shows(page, SHOWN[link]), "what the link names")
        wait_until(lambda page=page, rest=rest: page.evaluate("location.search") == rest, "an address without the link")
        page.close()


def test_the_printed_key_makes_a_presenter_and_is_in_no_request_but_that_of_the_page(browser, cache, fits):
    asked = []
    with started(cache, "--present", patience=4 * PATIENCE) as process:
        printed = address(process, r"To present, open http://(\S+);").replace("ws", "http")
        where, _, key = printed.partition("/?present=")
        assert len(key) > 16
        page = opened(browser, f"{printed}&task=draw_j")
        page.on("request", lambda request: asked.append(f"{request.url} {request.headers}"))
        page.get_by_text("Show address").wait_for()
        wait_until(lambda: shows(page, "Draw J"), "what else the link asks for")
        wait_until(lambda: page.evaluate("location.search") == "", "an address without the key")
        wait_until(lambda: '"task":"draw_j"' in (kept(page) or ""), "the browser to keep it")
        page.reload()
        page.get_by_text("Show address").wait_for()
        wait_until(lambda: shows(page, "Draw J"), "what was made")
        assert asked and not any(key in text for text in asked)

        page.goto(f"{where}/?present={key[::-1]}")
        page.get_by_text("This key is not the one").wait_for()
        page.get_by_text("Follow the presenter's camera").wait_for()
        assert page.evaluate("location.search") == ""
        page.reload()
        page.get_by_text("Follow the presenter's camera").wait_for()
        assert page.get_by_text("This key is not the one").count() == 0
        page.close()
