"""What a visitor has made is kept in his browser: the newest, not too often, and whatever that keeps the page opens."""

import threading
import time
from dataclasses import replace
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import viser  # noqa: TID251 - a page that no browser shows
from pages import PATIENCE, TITLES, Kept, Page, frame_of, wait_until
from scenes import changed, starts_at

from dt_viz.obstacles.shapes import Box, MeshObstacle, Sphere
from dt_viz.obstacles.solids import Solid
from dt_viz.obstacles.surfaces import box_surface
from dt_viz.scenario.own import Own
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.saved import MAX_BYTES, Known, Saved, decode, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN, TASKS, own_task
from dt_viz.session.frame import Stage
from dt_viz.session.session import CHOICES
from dt_viz.session.teaching import Stroke, board_of
from dt_viz.ui import keeping, panel
from dt_viz.ui.keeping import KEY, LANE, PAUSE
from dt_viz.ui.scene.camera import view_of
from dt_viz.ui.scripts import Link, told
from dt_viz.ui.tabs.opening import CHOOSING, SEEING
from dt_viz.ui.tabs.status import verdict
from dt_viz.ui.visitor import initial_scenario

PLACE = (0.1, -0.5, 0.4)
KNOWN = Known(tuple(TITLES))
MADE = changed(Scenario("draw_c", starts=starts_at(PLACE)), obstacles=(Box(PLACE, (0.1, 0.1, 0.2)),), space="task")
SIGHT = ((1.0, -1.0, 1.0), (0.0, -0.5, 0.3))


class Browser(Kept):
    """Notes when it is told to keep something, and what."""

    def __init__(self, **kept: str) -> None:
        super().__init__(kept)
        self.told: list[tuple[float, str]] = []
        self.asked = 0

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        self.asked += key == KEY
        return super().get_item(key, timeout)

    def set_item(self, key: str, value: str) -> None:
        self.told.append((time.monotonic(), value))
        super().set_item(key, value)


class Slow(Browser):
    """Answers only the second time, when it may."""

    answers = False

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        assert timeout is not None
        deadline = time.monotonic() + (0.0 if self.asked == 0 else timeout)
        text = super().get_item(key)
        while not self.answers:
            if time.monotonic() >= deadline:
                raise TimeoutError
            time.sleep(0.01)
        return text


class Blocked(Browser):
    def get_item(self, key: str, timeout: float | None = None) -> Any:
        raise RuntimeError("Failed to read localStorage: forbidden")


class Full(Browser):
    def set_item(self, key: str, value: str) -> None:
        self.told.append((time.monotonic(), value))


@pytest.fixture
def another():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def message(page: Page) -> str:
    said = page.session._screen.progress.message
    return "" if said is None else said.text


def settled(page: Page) -> None:
    assert page.session.jobs.wait_idle(LANE, PATIENCE)


def kept(browser: Browser) -> Saved:
    return decode(browser[KEY], KNOWN)


def made(camera: Any = None, scenario: Scenario = MADE) -> str:
    return encode(Saved(scenario, camera))


@pytest.mark.long
def test_each_edit_is_kept_and_the_next_page_begins_with_it(opened_for):
    browser = Browser()
    page = opened_for(browser)
    settled(page)
    assert browser.told == []  # nothing is edited yet
    page.begin(MADE)
    settled(page)
    assert kept(browser) == Saved(MADE)
    again = opened_for(Browser(**browser))
    assert again.session.scenario == MADE and message(again) == ""
    settled(again)
    assert again.client.local_storage.told == []


def test_the_line_of_status_says_so_until_the_next_edit(opened_for):
    page = opened_for(Browser(**{KEY: made()}))
    progress = replace(page.session._screen.progress, shown=frame_of(MADE, task=None, rollouts=()))
    assert progress.restored == progress.wanted == MADE
    assert "as saved" in verdict(progress).line.split(" · ")
    page.session.edit("test", warp=0.5)
    wanted = page.session._screen.progress.wanted
    assert "as saved" not in verdict(replace(progress, wanted=wanted)).line
    assert "as saved" not in verdict(replace(progress, restored=None)).line


@pytest.mark.long
def test_the_newest_is_kept_at_most_twice_a_second(opened_for, monkeypatch):
    browser = Browser()
    page = opened_for(browser)
    pause, before_pauses = page.session.jobs.pause, []
    monkeypatch.setattr(page.session.jobs, "pause", lambda time: before_pauses.append(len(browser.told)) or pause(time))
    warps = np.linspace(0.9, 0.1, 60)
    for warp in warps:
        page.session.edit("Warp", warp=float(warp))
        time.sleep(0.02)
    settled(page)
    times = [when for when, _ in browser.told]
    assert before_pauses[0] == 1  # the first edit is not held back
    assert len(times) >= 2 and np.diff(times).min() >= 0.95 * PAUSE
    assert kept(browser).scenario.warp == warps[-1]


def test_edits_do_not_wait_for_a_browser_that_does_not_answer(opened_for, monkeypatch):
    monkeypatch.setattr(keeping, "PATIENCE", PATIENCE)
    browser = Slow()
    page = opened_for(browser)
    wait_until(lambda: browser.asked == 2)
    for warp in np.linspace(0.9, 0.1, 20):
        page.session.edit("Warp", warp=float(warp))
    assert browser.asked == 2 and browser.told == []
    browser.answers = True
    settled(page)
    assert kept(browser).scenario.warp == 0.1


def test_a_visitor_who_leaves_is_not_waited_for(opened_for, monkeypatch):
    monkeypatch.setattr(keeping, "PAUSE", 10 * PATIENCE)
    page = opened_for(Browser())
    page.begin(MADE)
    wait_until(lambda: page.client.local_storage.told)
    page.visitor.close()
    assert page.session.jobs.wait_idle(LANE, PATIENCE)


@pytest.mark.long
def test_a_reset_begins_anew_also_in_the_next_page(opened_for):
    browser = Browser(**{KEY: made()})
    page = opened_for(browser)
    page.claim(page["History"], "Reset")
    settled(page)
    assert KEY not in browser and page.session.scenario.obstacles != MADE.obstacles
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert kept(browser).scenario.warp == 0.5
    page.claim(page["History"], "Reset")
    settled(page)
    assert opened_for(Browser(**browser)).session.scenario.task == "draw_s"


def test_a_reset_is_told_after_what_was_edited_before(opened_for):
    browser = Browser()
    page = opened_for(browser)
    for warp in (0.9, 0.8, 0.7):
        page.session.edit("Warp", warp=warp)
    page.give(page.commands["Reset the scene and the camera"])
    settled(page)
    assert KEY not in browser


FORGED = {
    "damaged": made()[: len(made()) // 2],
    "forged": made().replace('"warp":1.0', '"warp":7.0'),
    "another version": made().replace('"version":2', '"version":99'),
    "too large": made() + " " * MAX_BYTES,
    "of a task that is not here": made().replace("draw_c", "own_data_1"),
    "something else": '{"theme": "dark"}',
}


@pytest.mark.parametrize("text", FORGED.values(), ids=FORGED)
def test_what_makes_no_sense_is_forgotten_and_the_page_begins_anew_and_says_so_once(opened_for, text):
    browser = Browser(**{KEY: text})
    page = opened_for(browser)
    assert page.session.scenario.task == "draw_s"
    assert message(page).startswith("The page begins anew. What this browser keeps: ")
    assert KEY not in browser
    page.begin(MADE)
    settled(page)
    assert kept(browser).scenario == MADE
    assert message(opened_for(Browser(**browser))) == ""


def test_a_browser_that_keeps_nothing_is_told_once_and_nothing_more_is_asked_of_it(opened_for):
    browser = Blocked()
    page = opened_for(browser)
    assert message(page) == keeping.BLOCKED
    page.begin(MADE)
    settled(page)
    assert browser.told == [] and page.session.scenario == MADE


def test_a_browser_without_room_is_noticed_and_that_is_said_once(opened_for):
    browser = Full(**{KEY: made()})
    page = opened_for(browser)
    said = []
    page.session.say = lambda text, severity: said.append(text)
    for warp in (0.5, 0.4):
        page.session.edit("Warp", warp=warp)
        settled(page)
    assert said == [keeping.FULL] and len(browser.told) == 2


def look_from_the_top(page: Page) -> None:
    """Move the camera, as its first report may do, too."""
    page.visitor._camera.look(TASKS["draw_s"]())
    page.visitor._camera.view("Top")


def test_the_page_opens_before_a_slow_browser_has_told_and_goes_on_with_it_when_it_does(opened_for):
    browser = Slow(**{KEY: made()})
    page = opened_for(browser)
    assert page.session.scenario.task == "draw_s" and message(page) == keeping.SLOW
    look_from_the_top(page)
    assert browser.told == []
    browser.answers = True
    wait_until(lambda: page.session.scenario == MADE)
    settled(page)
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session._screen.progress.restored == MADE
    assert {decode(text, KNOWN).scenario for _, text in browser.told} <= {MADE}


def test_what_a_browser_keeps_is_not_overwritten_before_the_page_goes_on_with_it(opened_for, monkeypatch):
    ready, scene = threading.Event(), SCENES["lift"].scenario(TASKS["lift_box"]())
    monkeypatch.setattr(panel, "check_shapes", lambda _scenario: ready.wait(PATIENCE))
    browser = Browser(**{KEY: made(scenario=scene)})
    page = opened_for(browser)
    look_from_the_top(page)
    settled(page)
    assert page.session.scenario.task == "draw_s" and browser.told == []
    ready.set()
    wait_until(lambda: page.session.scenario == scene)
    look_from_the_top(page)
    settled(page)
    assert kept(browser).scenario == scene and kept(browser).camera is not None


def test_a_slow_browser_that_keeps_nothing_is_told_where_the_camera_is_once_it_has_answered(opened_for):
    browser = Slow()
    page = opened_for(browser)
    browser.answers = True
    settled(page)
    look_from_the_top(page)
    settled(page)
    assert kept(browser).camera is not None


def test_a_browser_that_never_tells_is_given_up_and_told_of_edits_only(opened_for, monkeypatch):
    monkeypatch.setattr(keeping, "PATIENCE", 0.01)
    browser = Slow(**{KEY: made()})
    page = opened_for(browser)
    settled(page)
    assert browser.asked == 1 + keeping.ATTEMPTS
    look_from_the_top(page)
    settled(page)
    assert browser.told == []
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert kept(browser).scenario.warp == 0.5


@pytest.mark.long
def test_what_a_slow_browser_tells_while_a_task_is_chosen_or_after_a_reset_is_not_taken(opened_for):
    browser, chosen = Slow(**{KEY: made()}), threading.Event()
    page = opened_for(browser)

    def choose(session: Any, _title: str) -> None:
        assert chosen.wait(PATIENCE)
        session.choose_task("draw_j")

    page.visitor._panel.begin(choose, page.session, "")
    browser.answers = True
    wait_until(lambda: not page.visitor._keeper._attempts)
    chosen.set()
    settled(page)
    assert page.session.scenario.task == "draw_j" and kept(browser).scenario.task == "draw_j"
    browser = Slow(**{KEY: made()})
    page = opened_for(browser)
    page.claim(page["History"], "Reset")
    browser.answers = True
    settled(page)
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario.task == "draw_s" and KEY not in browser


def test_what_a_slow_browser_tells_after_an_edit_is_not_taken(opened_for):
    browser = Slow(**{KEY: made()})
    page = opened_for(browser)
    page.session.edit("Warp", warp=0.5)
    mine = page.session.scenario
    browser.answers = True
    settled(page)
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario == mine and kept(browser).scenario == mine


@pytest.mark.long
def test_two_pages_of_one_browser_keep_the_last_edit_and_complain_of_nothing(opened_for, robot, another):
    browser = Browser()
    one, other = opened_for(browser), Page(another, robot, kept=browser)
    for page, warp in ((one, 0.9), (other, 0.8), (one, 0.7), (other, 0.6)):
        page.session.edit("Warp", warp=warp)
        settled(page)
        assert kept(browser).scenario.warp == warp
    assert message(one) == message(other) == ""
    other.close()


@pytest.mark.long
def test_shapes_from_files_are_kept_and_come_back_beside_the_event_loop(opened_for):
    browser, box = Browser(), MeshObstacle(PLACE, Solid(*box_surface(np.full(3, 0.05))))
    page = opened_for(browser)
    page.begin(changed(MADE, obstacles=(box, Sphere(PLACE))))
    settled(page)
    assert message(page) == "" and kept(browser).scenario.obstacles == (box, Sphere(PLACE))
    again = opened_for(Browser(**browser))
    assert again.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert again.session.scenario == page.session.scenario


def test_a_broken_shape_that_is_kept_is_said_and_the_page_begins_anew(opened_for):
    vertices, faces = box_surface(np.full(3, 0.05))
    text = made(scenario=changed(MADE, obstacles=(MeshObstacle(PLACE, Solid(vertices, faces[:4])),)))
    page = opened_for(Browser(**{KEY: text}))
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert "mesh: found" in message(page) and page.session.scenario.task == "draw_s"


def test_what_is_not_kept_is_said_once_and_all_else_is_kept(opened_for, monkeypatch):
    browser = Browser()
    page = opened_for(browser)
    monkeypatch.setattr(keeping, "MAX_KEPT", len(made()) + 200)
    said = []
    page.session.say = lambda text, severity: said.append(text)
    ball, box = Sphere(PLACE), MeshObstacle(PLACE, Solid(*box_surface(np.full(3, 0.05))))
    page.begin(changed(MADE, obstacles=(box, ball)))
    settled(page)
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert said == [keeping.OWN_SHAPES]
    assert kept(browser).scenario == replace(changed(MADE, obstacles=(ball,)), warp=0.5)


def own_page(opened_for: Any, browser: Browser) -> Page:
    """A page on which a task of the visitor's own is shown."""
    page = opened_for(browser)
    own, _ = page.session.bring(own_task(TASKS["draw_s"]().demonstrations).placed(0.8, (0.1, 0.0, 1 / 3)))
    page.visitor._panel._titles[own.name] = own.title
    page.session.choose_task(own.name)
    settled(page)
    return page


def test_a_task_of_own_demonstrations_is_kept_with_them_and_comes_back(opened_for):
    browser = Browser()
    page = own_page(opened_for, browser)
    again = opened_for(Browser(**browser))
    assert again.session.jobs.wait_idle(CHOICES, PATIENCE)
    settled(again)
    before, after = page.session.task, again.session.task
    assert after is not before and again["Task"].value == "Your data" and message(again) == ""
    assert [np.array_equal(a, b) for a, b in zip(before.paths, after.paths, strict=True)] == [True] * len(after.paths)
    assert again.session.scenario == page.session.scenario
    assert kept(again.client.local_storage).own is not None


def test_a_task_of_large_demonstrations_leaves_what_was_kept_before(opened_for, monkeypatch):
    monkeypatch.setattr(keeping, "MAX_KEPT", 5000)
    browser = Browser(**{KEY: made()})
    page = opened_for(browser)
    own, _ = page.session.bring(replace(TASKS["draw_s"](), name=""))
    page.visitor._panel._titles[own.name] = own.title
    page.session.choose_task(own.name)
    settled(page)
    assert message(page) == keeping.OWN_TASK and kept(browser).scenario == MADE
    page.session.choose_task("draw_j")
    settled(page)
    assert kept(browser).scenario.task == "draw_j"


def idle(page: Page) -> None:
    for lane in (LANE, CHOICES, CHOOSING, SEEING, CHOICES, SEEING, LANE):  # one has the next one work
        assert page.session.jobs.wait_idle(lane, PATIENCE)


def teach(page: Page, num: int = 2) -> None:
    """Draw some strokes on the board."""
    opening, board, u = page.visitor._panel.opening, board_of(page.session.robot), np.linspace(0, 1, 40)
    opening.teach()
    for k in range(num):
        path = np.stack([0.1 * np.sin((3 + 0.1 * k) * u), 0.3 * u], axis=1)
        opening.add("drawn", Stroke([*(2 * u)], [*board.at(path)]), board)
    idle(page)


def open_takes(page: Page) -> tuple[str, ...]:
    opening = page.visitor._panel.opening
    return opening.controls["take"].handle.options if opening.folder.visible else ()


def kept_takes(browser: Any) -> tuple[str, ...]:
    """Names of the takes that are kept and not learned."""
    lesson = kept(browser).lesson
    return () if lesson is None else tuple(take.name for take in lesson.takes)


@pytest.mark.long
@pytest.mark.parametrize("scenario", [None, MADE], ids=["as the page begins", "edited"])
def test_takes_that_are_not_learned_are_kept_and_open_in_the_next_page(opened_for, scenario):
    browser = Browser()
    page = opened_for(browser)
    if scenario is not None:
        page.begin(scenario)
    teach(page)
    before = page.visitor._panel.opening.lesson
    assert before is not None and encode(Saved(page.session.scenario, lesson=before)) == browser[KEY]
    again = opened_for(Browser(**browser))
    idle(again)
    assert open_takes(again) == ("1 · drawn 1", "2 · drawn 2") and not again["Learn"].disabled
    assert again.session.scenario == page.session.scenario and message(again) == ""
    assert again.session._screen.progress.restored == again.session.scenario  # the status says so in a word
    teach(again, 1)
    assert len(kept_takes(again.client.local_storage)) == 3
    again.session.undo()
    idle(again)
    assert kept_takes(again.client.local_storage) == ("drawn 1", "drawn 2")
    again.claim(again["Cancel"], True)
    idle(again)
    assert kept_takes(again.client.local_storage) == () and '"version":2' in again.client.local_storage[KEY]


@pytest.mark.long
def test_takes_that_are_learned_are_kept_with_their_task_and_put_back_in_the_next_page(opened_for):
    browser = Browser()
    page = opened_for(browser)
    teach(page)
    page.claim(page["Learn"], True)
    idle(page)
    told = [decode(text, KNOWN) for _, text in browser.told]
    assert all(saved.lesson is not None or (saved.own is not None and saved.own.lesson) for saved in told[1:])
    saved = kept(browser)
    assert saved.lesson is None and saved.own is not None and saved.own.lesson is not None
    again = opened_for(Browser(**browser))
    idle(again)
    assert open_takes(again) == () and again.session.scenario.task == "own_data_1"
    teach(again, 1)
    assert open_takes(again) == ("1 · drawn 1", "2 · drawn 2", "3 · drawn 3")


@pytest.mark.long
def test_takes_wait_where_another_task_is_chosen_and_are_still_kept(opened_for):
    browser = Browser()
    page = opened_for(browser)
    teach(page)
    page.claim(page["Task"], "Draw J")
    idle(page)
    assert open_takes(page) == () and kept(browser).scenario.task == "draw_j"
    assert len(kept_takes(browser)) == 2
    teach(page, 1)
    assert len(open_takes(page)) == 3


@pytest.mark.long
def test_a_file_has_the_takes_too_and_those_that_were_open_come_back_by_undo(opened_for, monkeypatch):
    page = opened_for(Browser())
    teach(page, 3)
    sent = []
    monkeypatch.setattr(page.client, "send_file_download", lambda _name, content, **_how: sent.append(content))
    page.claim(page["History"], "Save")
    page.done()
    page.claim(page["Cancel"], True)
    idle(page)
    teach(page, 1)
    page.visitor._panel.opening.load("mine.json", sent[0])
    idle(page)
    assert len(open_takes(page)) == 3
    page.session.undo()
    idle(page)
    assert len(open_takes(page)) == 1


def test_takes_that_are_too_long_are_said_once_and_all_else_is_kept(opened_for, monkeypatch):
    browser = Browser()
    page = opened_for(browser)
    monkeypatch.setattr(keeping, "MAX_KEPT", len(made()) + 500)
    said = []
    page.session.say = lambda text, severity: said.append(text)
    teach(page)
    page.begin(MADE)
    settled(page)
    assert said == [keeping.OWN_TAKES] and kept(browser) == Saved(MADE)


@pytest.mark.long
def test_takes_of_a_slow_browser_are_opened_unless_something_is_taught_before(opened_for):
    first = opened_for(Browser())
    teach(first)
    text = first.client.local_storage[KEY]
    for num in (0, 1):
        browser = Slow(**{KEY: text})
        page = opened_for(browser)
        if num:
            opening, board = page.visitor._panel.opening, board_of(page.session.robot)
            opening.teach()
            opening.add("drawn", Stroke([*np.arange(9.0)], [*board.at(np.linspace([0, 0], [0.1, 0.1], 9))]), board)
        browser.answers = True
        wait_until(lambda page=page: not page.visitor._keeper._attempts)
        idle(page)
        assert len(open_takes(page)) == (num or 2)
        assert len(kept_takes(browser)) == (num or 2)


def test_a_link_begins_its_task_afresh_also_where_that_is_what_was_kept_and_undo_brings_it_back(opened_for):
    page = opened_for(Browser(**{KEY: made()}))
    page.visitor.told(Link("task", MADE.task))
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario == initial_scenario(page.session.engine, MADE.task)
    settled(page)
    assert kept(page.client.local_storage).scenario == page.session.scenario
    page.session.undo()
    assert page.session.scenario.choices == MADE.choices
    page.visitor.told(Link("scene", "fig-4"))
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert (page.session.scenario.scene, page.session.scenario.task) == ("two_points", "draw_j")


# --- scenarios of the server ---


def own_of(task: str = "draw_j") -> Saved:
    """A scenario of demonstrations of one's own."""
    return Saved(Scenario(OWN, (), warp=0.5), own=Own.of(own_task(TASKS[task]().demonstrations)))


def test_a_new_visitor_begins_with_the_servers_scenario_and_one_who_was_here_with_his_own(opened_for):
    begins, browser = Saved(MADE, SIGHT), Browser()
    page = opened_for(browser, begins=begins)
    assert page.session.scenario == MADE and message(page) == ""
    assert page.visitor._keeper.sight(frame_of(MADE, task=None)) == SIGHT
    settled(page)
    assert browser.told == []
    mine = replace(MADE, warp=0.25)
    assert opened_for(Browser(**{KEY: made(scenario=mine)}), begins=begins).session.scenario == mine


@pytest.mark.parametrize("kind", [Browser, Blocked])
def test_a_new_visitor_begins_with_the_servers_demonstrations_once(opened_for, kind):
    page = opened_for(kind(), begins=own_of())
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    settled(page)
    assert (page.session.scenario.task, page.session.scenario.warp) == ("own_data_1", 0.5)
    assert page["Task"].value == "Your data"


@pytest.mark.parametrize("begins", [Saved(replace(MADE, warp=0.25)), own_of()], ids=["at once", "with demonstrations"])
@pytest.mark.parametrize("keeps", [True, False])
def test_the_servers_scenario_waits_for_what_a_slow_browser_tells(opened_for, begins, keeps):
    browser = Slow(**({KEY: made()} if keeps else {}))
    page = opened_for(browser, begins=begins)
    look_from_the_top(page)
    assert page.session.scenario.task == "draw_s" and browser.told == []
    browser.answers = True
    warp = MADE.warp if keeps else begins.scenario.warp
    wait_until(lambda: page.session.scenario.warp == warp and page.session.scenario.task != "draw_s")
    settled(page)
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario.warp == warp and all(kept_of.warp == warp for kept_of in texts(browser))


def texts(browser: Browser) -> list[Scenario]:
    """Scenarios that a browser was told to keep."""
    known = Known((*TITLES, OWN))
    return [decode(text, known).scenario for _, text in browser.told]


def test_a_link_opens_a_scenario_that_the_server_offers_by_its_name(opened_for):
    page = opened_for(Browser(), scenarios={"lesson-1": Saved(MADE, SIGHT), "lesson-2": own_of()})
    for name, task in (("lesson-1", MADE.task), ("lesson-2", "own_data_1"), ("../lesson-1", "own_data_1")):
        _token, link = told(f"/window/a/scenario/{quote(name, safe='')}") or ("", 0.0)
        page.visitor.told(link)
        assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
        assert page.session.scenario.task == task
    assert message(page) == "The link: scenario: found '../lesson-1'; accepted: lesson-1, lesson-2"
    page = opened_for(Browser())
    page.visitor.told(Link("scenario", ""))
    assert message(page) == "The link: scenario: found ''; accepted: none: this server offers none"


# --- the camera ---


def drawn(page: Page, scenario: Scenario, stage: Stage) -> None:
    """What the page does with the camera for a frame."""
    frame = frame_of(scenario, stage=stage, task=TASKS[scenario.task]())
    camera, keeper = page.visitor._camera, page.visitor._keeper
    camera.look(frame.task)
    if (sight := keeper.sight(frame)) is not None:
        camera.choose((np.array(sight[0]), np.array(sight[1])))


def assert_is_at(camera: Any, pose: Any) -> None:
    np.testing.assert_allclose(camera, pose)


@pytest.mark.long
def test_a_camera_that_is_moved_is_kept_and_one_that_is_not_is_none(opened_for):
    browser = Browser()
    page = opened_for(browser)
    page.visitor._camera.look(TASKS["draw_s"]())
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert kept(browser).camera is None
    page.visitor._camera.view("Top")
    settled(page)
    top = view_of(TASKS["draw_s"](), page.visitor._camera.framing, "Top")
    assert_is_at(kept(browser).camera, top)
    page.visitor._camera.view("Home")
    settled(page)
    assert kept(browser).camera is None


def test_the_camera_begins_where_it_was_and_goes_its_own_way_afterwards(opened_for):
    page = opened_for(Browser(**{KEY: made(SIGHT)}))
    seen = []
    for scenario, stage in ((MADE, Stage.ROLLOUTS), (MADE, Stage.LIVE), (MADE, Stage.LIVE)):
        drawn(page, scenario, stage)
        seen.append((tuple(page.camera.position), tuple(page.camera.look_at)))
    assert seen[0] == seen[1] == SIGHT  # panels stand beside the scene from the second stage on
    assert seen[2] != SIGHT


def test_the_camera_of_another_task_is_not_taken(opened_for):
    page = opened_for(Browser(**{KEY: made(SIGHT)}))
    drawn(page, Scenario("draw_s"), Stage.LIVE)
    assert tuple(page.camera.position) != SIGHT[0]
