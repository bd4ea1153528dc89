"""The presenter's key in a real browser: told, taken out of the address, and told again after a reload."""

import pytest
from browsing import LIGHT, PATIENCE, UNHURRIED, page_errors, wait_until
from chromium import needs_chromium

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

pytestmark = [pytest.mark.browser, needs_chromium]

KEY = "the_key-of-the-presenter"


@pytest.fixture(scope="module")
def presented(fits, robot):
    server = Server(TASKS, fits, robot, task="draw_s", port=0, max_sessions=2, key=KEY)
    yield server
    server.close()


def opened(browser, server, link=""):
    page = browser.new_page(viewport={"width": 900, "height": 600})
    page.set_default_timeout(1000 * PATIENCE)
    page.on("console", lambda message: page_errors.append(message.text) if message.type == "error" else None)
    page.add_init_script(UNHURRIED)
    page.goto(f"http://127.0.0.1:{server.port}/{link}")
    return page


def test_the_key_is_not_left_in_the_address_and_a_reload_presents_again_what_was_made(browser, presented):
    page = opened(browser, presented, f"?present={KEY}&task=draw_j")
    wait_until(lambda: presented.visitors, "the presenter")
    (visitor,) = presented.visitors
    wait_until(lambda: visitor.session.scenario.task == "draw_j", "what else the link asks for")
    wait_until(lambda: page.evaluate("location.search") == "", "an address without what it has told")
    visitor.session.edit("test", view=LIGHT)
    page.get_by_text("Show address").click()
    page.locator(".dt-address svg").wait_for()
    wait_until(lambda: page.evaluate("Object.values(localStorage).some(text => text.includes('draw_j'))"), "a copy")

    watching = opened(browser, presented)
    watching.get_by_text("Draw J").wait_for()
    watching.locator(".dt-qr svg").wait_for()
    assert watching.get_by_text("Show address").count() == watching.get_by_text("Task").count() == 0

    page.reload()
    wait_until(lambda: presented.visitors and presented.visitors[0] is not visitor, "the presenter again")
    wait_until(lambda: presented.visitors[0].session.scenario.task == "draw_j", "what was made")
    watching.close()
    page.close()
    wait_until(lambda: not presented.visitors, "the presenter to leave")
