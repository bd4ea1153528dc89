"""A visitor's own recordings in a real browser: several files are chosen at once, or dropped, seen, and learned."""

import pytest
from browsing import PATIENCE, close_notices, close_page, open_page, press, take, travel, wait_until
from chromium import needs_chromium

pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(name="tab")
def _tab(browser, server):
    page, visitor = open_page(browser, server, (720, 900))
    yield page, visitor
    close_page(page, server, visitor)


def test_six_files_chosen_at_once_are_seen_and_learned_by_a_click_and_undo_goes_back(tab):
    page, visitor = tab
    files = [{"name": f"pour_{k}.csv", "mimeType": "text/csv", "buffer": take()} for k in range(5)]
    files.append({"name": "astray.csv", "mimeType": "text/csv", "buffer": take((-0.1, -0.5, 0.5))})
    wait_until(lambda: page.locator("input[type=file]").first.evaluate("input => input.multiple"), "the script")
    page.locator("input[type=file]").first.set_input_files(files)
    page.get_by_text("pour_4").first.wait_for()
    assert page.get_by_text("it is left out").count() == 1 and page.get_by_text("astray").count() >= 1
    takes = visitor.pictures._takes
    wait_until(lambda: takes.visible, "the takes in the scene")
    assert sum(len(lines.node.points) > 0 for lines in takes.learned) == 5
    close_notices(page)
    press(page.get_by_role("button", name="Learn", exact=True))
    wait_until(lambda: visitor.shown is not None and visitor.shown.task.title == "Your data", "the learned motion")
    assert len(visitor.shown.task.demonstrations) == 5
    wait_until(lambda: not takes.visible, "the learned motion in place of the takes")
    assert visitor.session.wait_idle(PATIENCE)
    assert page.get_by_role("textbox", name="Task").count() or page.locator("input[value='Your data']").count()
    travel(page, "Undo")
    wait_until(lambda: visitor.shown is not None and visitor.shown.scenario.task == "draw_s", "the task before")
