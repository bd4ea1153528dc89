"""What a visitor has made is kept in his browser: the newest, not too often, and whatever that keeps the page opens."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser  # noqa: TID251 - a page that no browser shows
from pages import PATIENCE, TITLES, Kept, Page, frame_of, wait_until
from scenes import changed, starts_at

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.obstacles.shapes import Box, MeshObstacle, Sphere, box_surface
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario import saved as saved_scenarios
from dt_viz.scenario.own import Own
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.relocation import in_world
from dt_viz.scenario.saved import MAX_BYTES, Known, Saved, decode, encode
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import OWN, TASKS, Task, own_task
from dt_viz.session.engine import MOST_OWN
from dt_viz.session.frame import Stage
from dt_viz.session.session import CHOICES
from dt_viz.session.teaching import Stroke, board_of
from dt_viz.ui import keeping, panel
from dt_viz.ui.keeping import KEY, LANE, PAUSE, PLACES
from dt_viz.ui.page import initial
from dt_viz.ui.scene.camera import view_of
from dt_viz.ui.scripts import Link, Window
from dt_viz.ui.tabs.status import verdict

PLACE = (0.1, -0.5, 0.4)
KNOWN = Known((*TITLES, *PLACES), None)
MADE = changed(Scenario("draw_c", starts=starts_at(PLACE)), obstacles=(Box(PLACE, (0.1, 0.1, 0.2)),), space="task")
SIGHT = ((1.0, -1.0, 1.0), (0.0, -0.5, 0.3))


class Browser(Kept):
    """Notes what it is told to keep as a scenario."""

    def __init__(self, **kept: str) -> None:
        super().__init__(kept)
        self.told: list[str] = []
        self.asked = 0

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        self.asked += key == KEY
        return super().get_item(key, timeout)

    def set_item(self, key: str, value: str) -> None:
        if key == KEY:
            self.told.append(value)
        super().set_item(key, value)

    @property
    def scenarios(self) -> list[Scenario]:
        """Scenarios that it was told to keep."""
        return [decode(text, KNOWN).scenario for text in self.told]


class Slow(Browser):
    """Answers only the second time, when it may."""

    def __init__(self, **kept: str) -> None:
        super().__init__(**kept)
        self.answers = threading.Event()

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        first, text = self.asked == 0, super().get_item(key)
        if not self.answers.wait(0.0 if first else timeout):
            raise TimeoutError
        return text


class Blocked(Browser):
    def get_item(self, key: str, timeout: float | None = None) -> Any:
        raise RuntimeError("Failed to read localStorage: forbidden")


class Full(Browser):
    def set_item(self, key: str, value: str) -> None:
        self.told.append(value)


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


def look_from_the_top(page: Page) -> None:
    """Move the camera, as its first report may do, too."""
    page.visitor.camera.look(TASKS["draw_s"]())
    page.visitor.camera.view("Top")


def kept(browser: Browser) -> Saved:
    return decode(browser[KEY], KNOWN)


def taught(browser: Browser) -> dict[str, Saved]:
    """The own tasks that are kept, by their places."""
    return {place: decode(browser[key], KNOWN) for place, key in PLACES.items() if key in browser}


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
    progress = replace(again.session._screen.progress, shown=frame_of(MADE, task=None, rollouts=()))
    assert "as saved" in verdict(progress).line.split(" · ")
    again.session.edit("test", warp=0.5)
    progress = replace(again.session._screen.progress, shown=progress.shown)
    assert "as saved" not in verdict(progress).line


def test_the_newest_is_kept_after_a_pause(opened_for, monkeypatch):
    page, pauses, goes_on = opened_for(browser := Browser()), [], threading.Event()
    settled(page)
    rest, pause = page.session.jobs.rest, lambda seconds: (pauses.append(seconds), goes_on.wait(PATIENCE))
    monkeypatch.setattr(
        page.session.jobs, "rest", lambda seconds, *lane: rest(seconds, *lane) if lane else pause(seconds)
    )
    for warp in np.linspace(0.9, 0.1, 20):
        page.session.edit("Warp", warp=float(warp))
        wait_until(lambda: pauses)
    assert [scenario.warp for scenario in browser.scenarios] == [0.9]  # the first edit is not held back
    goes_on.set()
    settled(page)
    assert [scenario.warp for scenario in browser.scenarios] == [0.9, 0.1] and pauses == 2 * [PAUSE]


def test_edits_do_not_wait_for_a_browser_that_does_not_answer(opened_for, monkeypatch):
    monkeypatch.setattr(keeping, "PATIENCE", PATIENCE)
    browser = Slow()
    page = opened_for(browser)
    wait_until(lambda: browser.asked == 2)
    for warp in np.linspace(0.9, 0.1, 20):
        page.session.edit("Warp", warp=float(warp))
    assert browser.asked == 2 and browser.told == []
    browser.answers.set()
    settled(page)
    assert kept(browser).scenario.warp == 0.1


@pytest.mark.long
def test_after_a_reset_the_next_page_begins_with_its_task_as_that_begins(opened_for):
    browser = Browser(**{KEY: made()})
    page = opened_for(browser)
    page.claim(page["Reset"], "Reset")
    settled(page)
    fresh = page.session.scenario
    assert fresh == initial(page.session.engine.task(MADE.task)) and kept(browser).scenario == fresh
    assert opened_for(Browser(**browser)).session.scenario == fresh
    page = opened_for(browser)
    for warp in (0.9, 0.8, 0.7):
        page.session.edit("Warp", warp=warp)
    page.give(page.commands["Reset the scene and the camera"])
    settled(page)
    assert kept(browser).scenario == fresh
    page.session.undo()
    settled(page)
    assert kept(browser).scenario.warp == 0.7


BEGINS_ANEW = "The page begins anew. What this browser keeps: "
VERTICES, FACES = box_surface(np.full(3, 0.05))
FORGED = {
    "damaged": (made()[: len(made()) // 2], BEGINS_ANEW),
    "forged": (made().replace('"warp":1.0', '"warp":7.0'), BEGINS_ANEW),
    "another version": (made().replace('"version":2', '"version":99'), BEGINS_ANEW),
    "too large": (made() + " " * MAX_BYTES, BEGINS_ANEW),
    "of a task that is not here": (made().replace("draw_c", "own_data_1"), BEGINS_ANEW),
    "of a task that never was": (made().replace("draw_c", "own_data_99"), BEGINS_ANEW),
    "something else": ('{"theme": "dark"}', BEGINS_ANEW),
    "an open shape": (
        made(scenario=changed(MADE, obstacles=(MeshObstacle(PLACE, Solid(VERTICES, FACES[:4])),))),
        "scenario: mesh: found",
    ),
}


@pytest.mark.parametrize(("text", "said"), FORGED.values(), ids=FORGED)
def test_what_makes_no_sense_is_forgotten_and_the_page_begins_anew_and_says_so_once(opened_for, text, said):
    browser = Browser(**{KEY: text})
    page = opened_for(browser)
    page.settle()
    assert page.session.scenario.task == "draw_s" and message(page).startswith(said)
    assert KEY not in browser or said != BEGINS_ANEW
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


@pytest.mark.parametrize("text", [made(), None], ids=["kept", "nothing"])
def test_the_page_opens_before_a_slow_browser_has_told_and_goes_on_with_it_when_it_does(opened_for, text):
    browser = Slow(**({} if text is None else {KEY: text}))
    page = opened_for(browser)
    assert page.session.scenario.task == "draw_s" and message(page) == keeping.SLOW
    look_from_the_top(page)
    assert browser.told == []
    browser.answers.set()
    wanted = page.session.scenario if text is None else MADE
    wait_until(lambda: page.session.scenario == wanted)
    page.settle()
    assert page.session._screen.progress.restored == (None if text is None else MADE)
    look_from_the_top(page)
    settled(page)
    assert {*browser.scenarios} == {wanted} and kept(browser).camera is not None


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
@pytest.mark.parametrize("task", ["draw_s", "draw_j"], ids=["edited", "being chosen"])
def test_what_a_slow_browser_tells_after_an_edit_or_while_a_task_is_chosen_is_not_taken(opened_for, task):
    browser, chosen = Slow(**{KEY: made()}), threading.Event()
    page = opened_for(browser)
    wait_until(lambda: browser.asked > 1)  # after an edit it would not be asked again

    def choose(session: Any, title: str) -> None:
        assert chosen.wait(PATIENCE)
        session.choose_task(title)

    if task == "draw_s":
        page.session.edit("Warp", warp=0.5)
    else:
        page.visitor._panel.begin(choose, page.session, task)
    browser.answers.set()
    wait_until(lambda: not page.visitor._keeper._attempts)
    chosen.set()
    page.settle()
    assert page.session.scenario.task == task and kept(browser).scenario == page.session.scenario


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


def with_large_shape(page: Page) -> None:
    box = MeshObstacle(PLACE, Solid(*box_surface(np.full(3, 0.05))))
    page.begin(changed(MADE, obstacles=(box, *MADE.obstacles)))


def with_takes(page: Page) -> None:
    teach(page)
    page.begin(MADE)


@pytest.mark.parametrize(
    ("browser", "room", "make", "text"),
    [
        (Browser, 200, with_large_shape, keeping.OWN_SHAPES),
        (Browser, 500, with_takes, keeping.OWN_TAKES),
        (Full, 10**6, lambda page: page.begin(MADE), keeping.FULL),
    ],
    ids=["shape", "takes", "no room"],
)
def test_what_is_not_kept_is_said_once_and_all_else_is_kept(opened_for, monkeypatch, browser, room, make, text):
    page, said = opened_for(browser()), []
    monkeypatch.setattr(keeping, "MAX_KEPT", len(made()) + room)
    page.session.say = lambda text, severity: said.append(text)
    make(page)
    settled(page)
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert said == [text]
    assert page.client.local_storage.scenarios[-1] == replace(MADE, warp=0.5)


def teach(page: Page, num: int = 2) -> None:
    """Draw some strokes on the board."""
    opening, board, u = page.visitor._panel.opening, board_of(page.session.robot), np.linspace(0, 1, 40)
    opening.teach()
    for k in range(num):
        path = np.stack([0.1 * np.sin((3 + 0.1 * k) * u), 0.3 * u], axis=1)
        opening.add("drawn", Stroke([*(2 * u)], [*board.at(path)]), board)
    page.settle()


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
    again.settle()
    assert open_takes(again) == ("1 · drawn 1", "2 · drawn 2") and not again["Learn"].disabled
    assert again.session.scenario == page.session.scenario and message(again) == ""
    assert again.session._screen.progress.restored == again.session.scenario  # the status says so in a word
    teach(again, 1)
    assert len(kept_takes(again.client.local_storage)) == 3
    again.session.undo()
    again.settle()
    assert kept_takes(again.client.local_storage) == ("drawn 1", "drawn 2")
    again.claim(again["Cancel"], True)
    again.settle()
    assert kept_takes(again.client.local_storage) == () and '"version":2' in again.client.local_storage[KEY]


@pytest.mark.long
def test_takes_wait_while_another_task_is_chosen_and_once_learned_are_kept_with_their_task(opened_for):
    browser = Browser()
    page = opened_for(browser)
    teach(page)
    page.claim(page["Task"], "Draw J")
    page.settle()
    assert open_takes(page) == () and kept(browser).scenario.task == "draw_j"
    assert len(kept_takes(browser)) == 2
    teach(page, 1)
    assert len(open_takes(page)) == 3
    browser.told.clear()
    page.claim(page["Learn"], True)
    page.settle()
    told, own = [decode(text, KNOWN) for text in browser.told], taught(browser)["own_data_1"].own
    assert all(saved.lesson is not None or saved.scenario.task == "own_data_1" for saved in told)
    assert kept(browser).lesson is None and own is not None and own.lesson is not None
    again = opened_for(Browser(**browser))
    again.settle()
    assert open_takes(again) == () and again.session.scenario.task == "own_data_1"
    teach(again, 1)
    assert open_takes(again) == tuple(f"{k} · drawn {k}" for k in range(1, 5))


@pytest.mark.long
def test_a_file_has_the_takes_too_and_those_that_were_open_come_back_by_undo(opened_for, monkeypatch):
    page = opened_for(Browser())
    teach(page, 3)
    sent = []
    monkeypatch.setattr(page.client, "send_file_download", lambda _name, content, **_how: sent.append(content))
    page.claim(page["Save"], "Save")
    page.done()
    page.claim(page["Cancel"], True)
    page.settle()
    teach(page, 1)
    page.visitor._panel.opening.load("mine.json", sent[0])
    page.settle()
    assert len(open_takes(page)) == 3
    page.session.undo()
    page.settle()
    assert len(open_takes(page)) == 1


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
        browser.answers.set()
        wait_until(lambda page=page: not page.visitor._keeper._attempts)
        page.settle()
        assert len(open_takes(page)) == (num or 2)
        assert len(kept_takes(browser)) == (num or 2)


def test_a_link_begins_its_task_afresh_also_where_that_is_what_was_kept_and_undo_brings_it_back(opened_for):
    page = opened_for(Browser(**{KEY: made()}))
    page.visitor.reported(Window(1280, Link("task", MADE.task)))
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario == initial(page.session.engine.task(MADE.task))
    settled(page)
    assert kept(page.client.local_storage).scenario == page.session.scenario
    page.session.undo()
    assert page.session.scenario.choices == MADE.choices
    page.visitor.reported(Window(1280, Link("scene", "fig-4")))
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert (page.session.scenario.scene, page.session.scenario.task) == ("two_points", "draw_j")


# --- tasks of the visitor's own ---


def own(task: str = "draw_s", shift: Any = (0.1, 0.0, 1 / 3)) -> Task:
    """A task of demonstrations of one's own."""
    return own_task(TASKS[task]().demonstrations).placed(0.8, shift)


def bring(page: Page, task: Task) -> str:
    """Take an own task, and show it; return its name."""
    name = page.session.bring(task).name
    page.session.choose_task(name)
    settled(page)
    return name


def offered(page: Page) -> tuple[str, ...]:
    """Titles of the visitor's own tasks in the list."""
    return tuple(title for title in page["Task"].options if title not in TITLES.values())


def assert_same(one: Task, other: Task) -> None:
    assert Own.of(one).digest == Own.of(other).digest and one.layers == other.layers
    assert all(np.array_equal(a, b) for a, b in zip(one.paths, other.paths, strict=True))


@pytest.mark.parametrize("then", ["nothing", "another task", "reset", "a scenario", "another scenario of its own"])
def test_what_was_taught_stays_in_the_list_of_tasks_whatever_else_is_done(opened_for, then):
    browser = Browser()
    page = opened_for(browser)
    names = bring(page, own()), bring(page, own("draw_j"))
    tasks = {name: page.session.taught[name][0] for name in names}
    page.session.edit("Warp", warp=0.5)
    if then == "another task":
        page.session.choose_task("draw_w")
    elif then == "reset":
        page.claim(page["Reset"], "Reset")
    elif then != "nothing":
        saved = Saved(MADE) if then == "a scenario" else own_of("draw_c")
        page.visitor._panel.opening.load("mine.json", encode(saved).encode())
    page.settle()
    shown = page.session.scenario
    titles = ("Your data", "Your data 2", *["Your data 3"] * (then == "another scenario of its own"))
    assert offered(page) == titles and [*taught(browser)] == [*PLACES][: len(titles)]
    again = opened_for(Browser(**browser))
    again.settle()
    assert again.session.scenario == shown and message(again) == "" and offered(again) == titles
    for name, task in tasks.items():
        again.claim(again["Task"], task.title)
        again.settle()
        assert again.session.scenario.task == name
        assert_same(again.session.task, task)


def test_two_pages_of_one_browser_add_up_what_is_taught_in_them(opened_for, robot, another):
    browser = Browser()
    one, other = opened_for(browser), Page(another, robot, kept=browser)
    settled(other)
    brought = [(page, bring(page, own(task))) for page, task in zip((one, other) * 2, TITLES, strict=False)]
    assert message(one) == message(other) == "" and len(taught(browser)) == 4
    before = {Own.of(page.session.taught[name][0]).digest for page, name in brought}
    again = opened_for(Browser(**browser))
    again.settle()
    assert {Own.of(task).digest for task, _ in again.session.taught.values()} == before
    assert again.session.scenario == replace(other.session.scenario, task="own_data_4")
    other.close()


def test_a_deleted_task_is_gone_for_good_and_the_one_before_it_is_shown_unless_that_is_undone(opened_for):
    browser = Browser()
    page = opened_for(browser)
    assert not page.visitor._panel._titles().keys() - TITLES.keys()
    bring(page, own())
    name = bring(page, own("draw_j"))
    task = page.session.task

    def delete() -> None:
        page.claim(page["Own task"], panel.DELETE)
        page.settle()

    delete()
    assert message(page) == "“Your data 2” is deleted; Undo brings it back."
    assert page["Task"].value == "Your data" and offered(page) == ("Your data",) and [*taught(browser)] == [*PLACES][:1]
    page.session.undo()
    page.settle()
    assert offered(page) == ("Your data", "Your data 2") and [*taught(browser)] == [*PLACES][:2]
    assert page.session.scenario.task == name and page.session.task is task
    delete()
    delete()
    assert offered(page) == () and taught(browser) == {}
    assert page["Task"].value == [*TITLES.values()][-1]
    assert not [handle for handle in page.inputs if handle.label == "Own task" and handle.visible]
    again = opened_for(Browser(**browser))
    again.settle()
    assert offered(again) == () and message(again) == ""


def test_a_task_that_another_page_put_in_the_place_of_a_deleted_one_stays(opened_for):
    page = opened_for(browser := Browser())
    bring(page, own())
    browser[PLACES["own_data_1"]] = text = encode(own_of("draw_c"))
    page.claim(page["Own task"], panel.DELETE)
    page.settle()
    assert offered(page) == () and browser[PLACES["own_data_1"]] == text
    bring(page, own("draw_w"))
    assert browser[PLACES["own_data_1"]] == text and [*taught(browser)] == [*PLACES][:2]


class Small(Browser):
    """Has room for so many tasks."""

    room = 1

    def set_item(self, key: str, value: str) -> None:
        if key == KEY or len(self.keys() - {KEY}) < self.room:
            super().set_item(key, value)


def test_a_task_that_has_no_room_is_said_with_its_remedy_and_is_kept_once_there_is_room(opened_for):
    browser = Small()
    page = opened_for(browser)
    said = []
    page.session.say = lambda text, severity: said.append(text)
    bring(page, own())
    bring(page, own("draw_j"))
    (text,) = said
    assert text.startswith("“Your data 2” is not kept in this browser: found no room") and "Save makes a file" in text
    assert kept(browser).scenario.task == "own_data_1" and len(taught(browser)) == 1
    page.session.choose_task("own_data_1")
    page.claim(page["Own task"], panel.DELETE)
    page.settle()
    assert [*taught(browser)] == ["own_data_2"] and offered(page) == ("Your data 2",)
    assert len(said) == 2  # that the other one is deleted


@pytest.mark.parametrize("size", [5000, MAX_BYTES])
def test_a_task_that_is_too_large_is_said_and_leaves_what_was_kept_before(opened_for, monkeypatch, size):
    monkeypatch.setattr(keeping, "MAX_KEPT", 5000)
    monkeypatch.setattr(saved_scenarios, "MAX_BYTES", size)
    browser = Browser(**{KEY: made()})
    page = opened_for(browser)
    bring(page, own())
    assert "“Your data” is not kept in this browser: found more than 0.005 MB" in message(page)
    assert "Save makes a file of it" in message(page)
    assert kept(browser).scenario == MADE and taught(browser) == {}
    page.session.choose_task("draw_j")
    settled(page)
    assert kept(browser).scenario.task == "draw_j"


def test_one_task_too_many_is_refused_and_none_is_lost(opened_for):
    page = opened_for(Browser())
    for k in range(MOST_OWN):
        page.session.bring(own(shift=(0.01 * k, 0.0, 0.0)))
    page.settle()
    page.visitor.resume(own_of("draw_c"))
    page.settle()
    again = opened_for(Slow(**page.client.local_storage))
    again.session.bring(own("draw_j"))
    again.client.local_storage.answers.set()
    settled(again)
    assert message(page) == "Your data: tasks: found 12 of yours; accepted: at most 12: delete one first"
    assert page.session.scenario.task == "draw_s" and "at most 12" in message(again)
    for each in (page, again):
        assert len(offered(each)) == len(taught(each.client.local_storage)) == MOST_OWN


BROKEN = {
    "damaged": encode(Saved(Scenario(OWN), own=Own.of(own())))[:-100],
    "no task": made(),
    "forged": encode(Saved(Scenario(OWN), own=Own.of(own()))).replace('"auto"', '"nearly"'),
    "something else": "[1, 2",
    "nothing": "",
}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN)
def test_a_task_that_makes_no_sense_is_dropped_with_one_line_and_the_others_are_there(opened_for, text):
    first = opened_for(Browser())
    bring(first, own())
    good = {key: value for key, value in first.client.local_storage.items() if key != KEY}
    (task,) = good.values()
    browser = Browser(**{PLACES["own_data_1"]: text, PLACES["own_data_2"]: task})
    page = opened_for(browser)
    settled(page)
    assert message(page).startswith("A task of yours is lost. What this browser keeps: ")
    assert offered(page) == ("Your data 2",) and [*taught(browser)] == ["own_data_2"]
    again = opened_for(Browser(**browser))
    settled(again)
    assert message(again) == ""


class Mute(Browser):
    """Does not answer about some keys, as where a text is larger than the page may send."""

    mute: tuple[str, ...] = (PLACES["own_data_1"],)

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        if key in self.mute:
            raise TimeoutError
        return super().get_item(key, timeout)


def test_what_a_hanging_browser_does_not_tell_is_passed_over_and_not_forgotten(opened_for):
    browser = Mute(**{PLACES["own_data_1"]: "x" * 10**7})
    page = opened_for(browser)
    settled(page)
    assert message(page) == keeping.SILENT
    bring(page, own())
    assert len(browser[PLACES["own_data_1"]]) == 10**7 and kept(browser).scenario.task == "own_data_2"
    first = opened_for(Browser())
    bring(first, own())
    browser = Mute(**first.client.local_storage)
    browser.mute = tuple(PLACES.values())
    page = opened_for(browser)
    settled(page)
    assert message(page) == keeping.SILENT and page.session.scenario.task == "draw_s"
    assert kept(browser).scenario.task == "own_data_1"
    browser.mute = ()
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert offered(page) == ("Your data",) and kept(browser).scenario.warp == 0.5


def test_a_scenario_finds_its_task_also_where_that_has_another_name_on_this_page(opened_for):
    first = opened_for(Browser())
    bring(first, own())
    page = opened_for(Slow(**first.client.local_storage))
    page.session.bring(own("draw_w"))
    page.client.local_storage.answers.set()
    wait_until(lambda: page.session.scenario.task == "own_data_2")
    page.settle()
    assert_same(page.session.task, first.session.task)
    assert kept(page.client.local_storage).scenario.task == "own_data_1"
    assert [*taught(page.client.local_storage)] == ["own_data_1", "own_data_2"]


def test_a_saved_motion_is_kept_with_its_transforms_and_the_arm_that_it_was_opened_with(opened_for):
    drawing = own_task(TASKS["draw_s"]().demonstrations).placed(0.7, (0.1, 0.0, 0.0))
    layers = (Layer(BiasPoint((0.1, 0.2, 0.0), radius=0.1)), Layer(HandAvoidance((Sphere((0.0, 0.1, 0.0), 0.1),))))
    browser = Browser()
    page = opened_for(browser)
    before = page.session.bring(replace(drawing, layers=layers), "panda")
    settled(page)
    again = opened_for(Browser(**browser))
    settled(again)
    ((task, arm),) = again.session.taught.values()
    assert arm == "panda" and Own.of(task).digest == Own.of(before).digest
    assert repr(in_world(before)) != "()"
    for one, other in zip(in_world(task), in_world(before), strict=True):
        np.testing.assert_allclose(*(numbers(layer.transform) for layer in (one, other)), rtol=0, atol=1e-12)
    browser = Browser(**browser)
    settled(opened_for(browser))
    assert len(taught(browser)) == 1


def numbers(transform: Any) -> Any:
    """Places and lengths of a transform."""
    if isinstance(transform, BiasPoint):
        return [*transform.position, transform.radius]
    (ball,) = transform.obstacles
    return [*ball.position, ball.diameter, transform.margin]


def test_a_scenario_of_ones_own_that_was_kept_by_an_older_version_is_taken_into_the_list(opened_for):
    browser = Browser(**{KEY: encode(own_of())})
    page = opened_for(browser)
    page.settle()
    assert page["Task"].value == "Your data" and page.session.scenario.warp == 0.5
    page.session.edit("Warp", warp=0.25)
    settled(page)
    assert [*taught(browser)] == ["own_data_1"] and kept(browser).own is None


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
    for kind in (Browser, Blocked):
        page = opened_for(kind(), begins=own_of())
        page.settle()
        assert (page.session.scenario.task, page.session.scenario.warp) == ("own_data_1", 0.5)
        assert page["Task"].value == "Your data"


@pytest.mark.parametrize("begins", [Saved(replace(MADE, warp=0.25)), own_of()], ids=["at once", "with demonstrations"])
@pytest.mark.parametrize("keeps", [True, False])
def test_the_servers_scenario_waits_for_what_a_slow_browser_tells(opened_for, begins, keeps):
    browser = Slow(**({KEY: made()} if keeps else {}))
    page = opened_for(browser, begins=begins)
    look_from_the_top(page)
    assert page.session.scenario.task == "draw_s" and browser.told == []
    browser.answers.set()
    warp = MADE.warp if keeps else begins.scenario.warp
    wait_until(lambda: page.session.scenario.warp == warp and page.session.scenario.task != "draw_s")
    settled(page)
    assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
    assert page.session.scenario.warp == warp and all(kept_of.warp == warp for kept_of in browser.scenarios)


def test_a_link_opens_a_scenario_that_the_server_offers_by_its_name(opened_for):
    page = opened_for(Browser(), scenarios={"lesson-1": Saved(MADE, SIGHT), "lesson-2": own_of()})
    for name, task in (("lesson-1", MADE.task), ("lesson-2", "own_data_1"), ("../lesson-1", "own_data_1")):
        page.visitor.reported(Window(1280, Link("scenario", name)))
        assert page.session.jobs.wait_idle(CHOICES, PATIENCE)
        assert page.session.scenario.task == task
    assert message(page) == "The link: scenario: found '../lesson-1'; accepted: lesson-1, lesson-2"
    page.visitor.reported(Window(1280, Link("scenario", "lesson-2")))
    page.settle()
    assert page.session.scenario.task == "own_data_1" and offered(page) == ("Your data",)
    page = opened_for(Browser())
    page.visitor.reported(Window(1280, Link("scenario", "")))
    assert message(page) == "The link: scenario: found ''; accepted: none: this server offers none"


# --- the camera ---


def drawn(page: Page, scenario: Scenario, stage: Stage) -> None:
    """What the page does with the camera for a frame."""
    frame = frame_of(scenario, stage=stage, task=TASKS[scenario.task]())
    camera, keeper = page.visitor.camera, page.visitor._keeper
    camera.look(frame.task)
    if (sight := keeper.sight(frame)) is not None:
        camera.choose((np.array(sight[0]), np.array(sight[1])))


@pytest.mark.long
def test_a_camera_that_is_moved_is_kept_and_one_that_is_not_is_none(opened_for):
    browser = Browser()
    page = opened_for(browser)
    page.visitor.camera.look(TASKS["draw_s"]())
    page.session.edit("Warp", warp=0.5)
    settled(page)
    assert kept(browser).camera is None
    page.visitor.camera.view("Top")
    settled(page)
    top = view_of(TASKS["draw_s"](), page.visitor.camera.framing, "Top")
    camera = kept(browser).camera
    assert camera is not None
    np.testing.assert_allclose(camera, top)
    page.visitor.camera.view("Home")
    settled(page)
    assert kept(browser).camera is None


def test_the_camera_begins_where_it_was_and_goes_its_own_way_afterwards(opened_for):
    page = opened_for(Browser(**{KEY: made(SIGHT)}))
    seen = []
    for scenario, stage in (
        (Scenario("draw_s"), Stage.LIVE),  # another task
        (MADE, Stage.ROLLOUTS),
        (MADE, Stage.LIVE),
        (MADE, Stage.LIVE),
    ):
        drawn(page, scenario, stage)
        seen.append((tuple(page.camera.position), tuple(page.camera.look_at)))
    assert seen[1] == seen[2] == SIGHT  # panels stand beside the scene from the second stage on
    assert SIGHT not in (seen[0], seen[3])
