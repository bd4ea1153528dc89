"""Scenarios as files in a real browser: saved on one server, and dropped on another's page."""

import json

import numpy as np
import pytest
from browsing import DROP, PATIENCE, close_notices, close_page, kept, open_page, press, take, wait_until
from chromium import needs_chromium

from dt_viz.scenario.saved import is_saved
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(scope="module")
def another(fits, robot):
    """Another server."""
    server = Server(TASKS, fits, robot, task="push_box", port=0, max_sessions=2)
    yield server
    server.close()


def saved(page) -> str:
    """What the page saves."""
    with page.expect_download() as download:
        press(page.get_by_role("button", name="Save", exact=True))
    return download.value.path().read_text(encoding="utf-8")


def until_ready(page) -> None:
    """Wait until the page takes several files."""
    wait_until(lambda: page.locator("input[type=file]").first.evaluate("input => input.multiple"), "the script")


def dropped(page, name, text) -> None:
    """Drop a file on the page, when it is ready."""
    until_ready(page)
    page.evaluate(DROP, [[name, text]])


def moving(visitor) -> list[np.ndarray]:
    """The rollouts that are shown, after all is computed."""
    assert visitor.session.wait_idle(PATIENCE)
    return [*visitor.shown.rollouts]


def test_demonstrations_go_from_server_to_server_byte_for_byte_and_damaged_files_change_nothing(
    browser, server, another
):
    page, visitor = open_page(browser, server, (720, 900))
    until_ready(page)
    files = [{"name": f"pour_{k}.csv", "mimeType": "text/csv", "buffer": take()} for k in range(3)]
    page.locator("input[type=file]").first.set_input_files(files)
    page.get_by_text("pour_2").first.wait_for()
    close_notices(page)
    press(page.get_by_role("button", name="Learn", exact=True))
    wait_until(lambda: visitor.shown is not None and visitor.shown.task.title == "Your data", "the learned motion")
    visitor.session.edit("test", warp=1 / 3)
    before, text = moving(visitor), saved(page)
    assert is_saved(text.encode()) and len(json.loads(text)["arrays"]) == 6

    there, other = open_page(browser, another, (720, 900))
    dropped(there, "anything.json", text)
    wait_until(lambda: other.session.scenario.warp == 1 / 3, "the scenario")
    after = moving(other)
    assert [path.tobytes() for path in before] == [path.tobytes() for path in after]
    assert saved(there) == text
    of_task = "Object.entries(localStorage).find(([key]) => key.endsWith('-task-1'))?.[1]"
    wait_until(lambda: '"task":"own_data_1"' in (kept(there) or ""), "the browser to keep it")
    assert json.loads(there.evaluate(of_task))["own"] == json.loads(text)["own"]
    there.reload()
    wait_until(lambda: another.visitors and other not in another.visitors, "another visitor")
    (other,) = another.visitors
    wait_until(lambda: other.session.scenario.warp == 1 / 3, "the scenario and its task after the reload")
    there.get_by_text("as saved").wait_for()
    close_notices(there)
    assert saved(there) == text

    for damaged in (text.replace('"warp":0.3', '"warp":9.3'), text.replace("own_data", "another")):
        dropped(there, "a.json", damaged)
        there.get_by_text("a.json: ").first.wait_for()
        close_notices(there)
        assert saved(there) == text
    close_page(page, server, visitor)
    close_page(there, another, other)
