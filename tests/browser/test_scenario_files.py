"""Scenarios as files in a real browser: saved on one server, dropped on another's page, and named by a link."""

import json

import numpy as np
import pytest
from browsing import DROP, PATIENCE, UNHURRIED, close_notices, close_page, kept, open_page, press, take, wait_until
from chromium import needs_chromium

from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.saved import Saved, is_saved
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(scope="module")
def another(fits, robot):
    """Another server."""
    lesson = Saved(Scenario("draw_j", (), warp=0.5))
    server = Server(TASKS, fits, robot, task="push_box", port=0, max_sessions=2, scenarios={"lesson-1": lesson})
    yield server
    server.close()


def new_page(browser):
    """A tab that has not gone anywhere yet, and draws as seldom as those of `open_page`."""
    page = browser.new_page(viewport={"width": 720, "height": 450})
    page.add_init_script(UNHURRIED)
    return page


def saved(page) -> str:
    """What the page saves."""
    with page.expect_download() as download:
        press(page.get_by_role("button", name="Save", exact=True))
    return download.value.path().read_text(encoding="utf-8")


def dropped(page, *files) -> None:
    """Drop files, each a name and a text, on the page, when it is ready for several."""
    wait_until(lambda: page.locator("input[type=file]").first.evaluate("input => input.multiple"), "the script")
    page.evaluate(DROP, [list(file) for file in files])


def moving(visitor) -> list[np.ndarray]:
    """The rollouts that are shown, after all is computed."""
    assert visitor.session.wait_idle(PATIENCE)
    return [*visitor.shown.rollouts]


def test_demonstrations_go_from_server_to_server_byte_for_byte_and_damaged_files_change_nothing(
    browser, server, another
):
    page, visitor = open_page(browser, server, (720, 900))
    dropped(page, *((f"pour_{k}.csv", take().decode()) for k in range(3)))
    page.get_by_text("pour_2").first.wait_for()
    close_notices(page)
    press(page.get_by_role("button", name="Learn", exact=True))
    wait_until(lambda: visitor.shown is not None and visitor.shown.task.title == "Your data", "the learned motion")
    visitor.session.edit("test", warp=1 / 3)
    before, text = moving(visitor), saved(page)
    assert is_saved(text.encode()) and len(json.loads(text)["arrays"]) == 6

    there, other = open_page(browser, another, (720, 900))
    dropped(there, ("anything.json", text))
    wait_until(lambda: other.session.scenario.warp == 1 / 3, "the scenario")
    after = moving(other)
    assert [path.tobytes() for path in before] == [path.tobytes() for path in after]
    assert saved(there) == text
    wait_until(lambda: kept(there) == text, "the browser to keep it")

    for damaged in (text.replace('"warp":0.3', '"warp":9.3'), text.replace("own_data", "another")):
        dropped(there, ("a.json", damaged))
        there.get_by_text("a.json: ").first.wait_for()
        close_notices(there)
        assert saved(there) == text
    close_page(page, server, visitor)
    close_page(there, another, other)


def test_a_link_begins_what_it_names_and_a_reload_goes_on_with_what_was_made_of_it(browser, server):
    known, page = set(server.visitors), new_page(browser)
    page.goto(f"http://127.0.0.1:{server.port}/?scene=fig-4&other=1")

    def visitor():
        wait_until(lambda: set(server.visitors) - known, "the page of a visitor")
        (found,) = set(server.visitors) - known
        wait_until(lambda: found.session.scenario.task == "draw_j", "what the link names")
        assert found.session.wait_idle(PATIENCE)
        return found

    first = visitor()
    assert first.session.scenario.scene == "two_points"
    first.session.edit("test", warp=0.5)
    assert page.evaluate("location.search") == "?other=1"
    wait_until(lambda: '"warp":0.5' in (kept(page) or ""), "the browser to keep it")
    known.add(first)
    page.reload()
    second = visitor()
    assert second.session.scenario.warp == 0.5
    close_page(page, server, second)


def test_a_link_opens_a_saved_scenario_that_the_server_offers(browser, another):
    known, page = set(another.visitors), new_page(browser)
    page.goto(f"http://127.0.0.1:{another.port}/?scenario=lesson-1")
    wait_until(lambda: set(another.visitors) - known, "the page of a visitor")
    (visitor,) = set(another.visitors) - known
    wait_until(
        lambda: (visitor.session.scenario.task, visitor.session.scenario.warp) == ("draw_j", 0.5), "the scenario"
    )
    close_page(page, another, visitor)


def test_a_link_to_nothing_says_what_there_is_and_the_page_opens(browser, server):
    page, known = new_page(browser), set(server.visitors)
    page.goto(f"http://127.0.0.1:{server.port}/?scene=%3Cb%3Enothing%3C%2Fb%3E")
    page.get_by_text("The link: scene: found '<b>nothing</b>'").first.wait_for(timeout=1000 * PATIENCE)
    assert page.get_by_text(next(iter(SCENES))).count()
    (visitor,) = set(server.visitors) - known
    close_page(page, server, visitor)
