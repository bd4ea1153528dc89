"""The tour on the page, without a browser: what it shows, what it remembers, and what it gives back."""

import threading
from functools import partial

import pytest
from pages import TITLES, Kept, Page, wait_until
from scenes import changed, starts_at

from dt_viz.obstacles.shapes import Box
from dt_viz.scenario.saved import Known, Saved, decode, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tour import STEPS, TASK
from dt_viz.ui.keeping import KEY as MADE_KEY
from dt_viz.ui.scripts import Link, Window
from dt_viz.ui.tabs.tour import BACK, DECLINE, END, KEY, NEXT, NUMBERS, OVER, TAKE
from dt_viz.warning import Severity

PLACE = (0.1, -0.5, 0.4)
MADE = changed(Scenario("draw_c", starts=starts_at(PLACE)), obstacles=(Box(PLACE, (0.1, 0.1, 0.2)),), space="task")


@pytest.fixture
def opened(opened_for):
    """Opens the page for what a browser keeps, and waits until it has asked for that."""

    def opens(**kept: str) -> Page:
        page = opened_for(Kept(kept))
        page.settle()
        return page

    return opens


def press(page: Page, label: str, button: str) -> None:
    page.claim(page[label], button)
    page.settle()


def number(page: Page) -> int | None:
    return page.visitor._panel.tour.number


def is_step(page: Page, k: int) -> bool:
    """Whether step k, from 0, is shown, with its text and its scene; the warp may have grown."""
    card = page.visitor._panel.tour._card
    scene = STEPS[k].scenario(page.session.engine.task(TASK))
    shown = page.session.scenario
    as_it_began = shown.motion.full == scene.motion.full and shown.view == scene.view
    return card.visible and STEPS[k].title in card.content and number(page) == k and as_it_began


def offers(page: Page) -> bool:
    return page.visitor._panel.tour._offer.visible


def test_the_first_visit_offers_it_until_it_is_declined_or_ended(opened):
    page = opened()
    assert offers(page) and number(page) is None
    press(page, "New here?", DECLINE)
    assert not offers(page) and page.client.local_storage[KEY] == OVER
    assert not offers(opened(**{KEY: OVER}))
    page = opened()
    press(page, "New here?", TAKE)
    assert is_step(page, 0) and not offers(page) and page.client.local_storage[KEY] == "1"
    press(page, "Step", END)
    assert number(page) is None and page.client.local_storage[KEY] == OVER


@pytest.mark.parametrize("forged", ["", "0", "7", "-1", "1.0", "१", "over ", "x" * 10**6])
def test_what_no_page_has_kept_is_as_nothing(opened, forged):
    page = opened(**{KEY: forged})
    assert offers(page) and number(page) is None and not page.session.visits


@pytest.mark.long
def test_the_end_gives_back_all_as_it_was_to_the_byte_and_its_history(opened):
    page = opened(**{MADE_KEY: encode(Saved(MADE))})
    page.session.step("Warp", warp=0.5)
    page.settle()
    own, kept = page.session.scenario, page.client.local_storage[MADE_KEY]
    press(page, "New here?", TAKE)
    for k in range(len(STEPS)):
        assert is_step(page, k) and page.client.local_storage[KEY] == NUMBERS[k]
        page.session.step("Imitate", imitation=False)
        page.session.step("play", warp=0.25)
        for _ in range(3):  # what is done in a step is undone in it, and no more
            page.session.undo()
        assert is_step(page, k) and (k != 2 or page.session.scenario.warp == 1)
        page.session.step("play", warp=0.25)
        page.settle()
        assert page.client.local_storage[MADE_KEY] == kept
        if k < len(STEPS) - 1:
            press(page, "Step", NEXT)
    press(page, "Step", BACK)
    assert is_step(page, len(STEPS) - 2)
    press(page, "Step", END)
    assert page.session.scenario is own and not page.session.visits
    page.settle()
    assert page.client.local_storage[MADE_KEY] == kept
    page.session.redo()
    assert page.session.scenario is own
    page.session.undo()
    assert page.session.scenario == MADE


def test_the_camera_is_where_it_was(opened):
    page = opened()
    camera = page.visitor.camera
    camera.look(page.session.task)
    camera.view("Top")
    page.settle()
    before, kept = camera.chosen, page.client.local_storage[MADE_KEY]
    press(page, "New here?", TAKE)
    assert camera.chosen is None and page.client.local_storage[MADE_KEY] == kept
    press(page, "Step", END)
    sight = page.visitor._keeper.begun
    assert sight is not None and sight.scenario is page.session.scenario
    assert sight.camera == tuple(tuple(place.tolist()) for place in before)


def test_after_a_reload_the_same_step_is_shown_and_the_end_gives_back_what_was_made(opened):
    page = opened(**{MADE_KEY: encode(Saved(MADE)), KEY: "4"})
    assert is_step(page, 3)
    press(page, "Step", END)
    assert page.session.scenario == MADE
    assert decode(page.client.local_storage[MADE_KEY], Known(tuple(TITLES))).scenario == MADE


@pytest.mark.long
def test_it_begins_once_a_slow_browser_has_told_what_was_made(opened_for):
    """Otherwise the step would be taken for an edit, and what was made be lost."""
    told = threading.Event()

    class Slow(Kept):
        def get_item(self, key, timeout=None):
            if key == MADE_KEY and not told.wait(timeout):
                raise TimeoutError
            return super().get_item(key)

    page = opened_for(Slow({MADE_KEY: encode(Saved(MADE)), KEY: "4"}))
    assert not told.wait(0.3) and number(page) is None
    told.set()
    page.settle()
    assert is_step(page, 3)
    press(page, "Step", END)
    assert page.session.scenario == MADE


def test_the_warp_grows_once_by_itself_where_its_slider_is_beside_the_text(opened, monkeypatch):
    monkeypatch.setattr("dt_viz.ui.tabs.stack.SECONDS", 0.2)
    page = opened(**{KEY: "2"})
    seen = []
    draw = page.session.edit
    page.session.edit = lambda gesture, **changes: (seen.append(changes.get("warp")), draw(gesture, **changes))
    page.visitor._panel.tour.take(page.session, 1)
    page.settle()
    assert page.session.scenario.warp == 1 and seen[0] < 0.5 and seen == sorted(seen)
    slider, _ = page.visitor._panel.tour._warp
    page.claim(slider.handle, 0.25)
    assert page.session.scenario.warp == 0.25
    press(page, "Step", NEXT)
    assert not slider.handle.visible and is_step(page, 2)


def test_a_scene_that_is_chosen_in_the_tour_ends_it_and_undo_leads_to_what_was_made(opened):
    page = opened(**{MADE_KEY: encode(Saved(MADE)), KEY: "3"})
    page.claim(page["Scene"], page["Scene"].options[3])
    page.settle()
    assert number(page) is None and not page.session.visits and page.session.scenario.scene
    page.session.undo()
    assert page.session.scenario.choices == MADE.choices


def test_reset_begins_the_step_anew_and_forgets_nothing(opened):
    page = opened(**{MADE_KEY: encode(Saved(MADE)), KEY: "3"})
    page.session.step("play", warp=0.25)
    press(page, "Reset", "Reset")
    assert is_step(page, 2) and page.session.scenario.warp == 1 and MADE_KEY in page.client.local_storage


def test_a_link_begins_it_and_another_step_than_there_are_is_refused(opened):
    page = opened(**{KEY: OVER})
    for name in ("7", "0", "one"):
        page.visitor.reported(Window(1280, Link("tour", name)))
        page.settle()
        assert number(page) is None
        assert f"tour: found '{name}'; accepted: 1, 2" in page.session._screen.progress.message.text
    page.visitor.reported(Window(1280, Link("tour", "")))
    page.settle()
    assert is_step(page, 0)
    page.visitor.reported(Window(1280, Link("tour", "5")))
    page.settle()
    assert is_step(page, 4)


def test_steps_beyond_the_first_and_the_last_and_buttons_that_are_not_shown_do_nothing(opened):
    page = opened(**{KEY: OVER})
    tour = page.visitor._panel.tour
    turn = partial(page.claim, tour._buttons)
    for button in (NEXT, BACK, END, "Step", 3):
        turn(button)
    page.settle()
    assert number(page) is None and not page.session.visits
    tour.take(page.session, 0)
    page.settle()
    turn(BACK)
    page.settle()
    assert is_step(page, 0)
    tour.take(page.session, len(STEPS) - 1)
    page.settle()
    turn(NEXT)
    page.settle()
    assert is_step(page, len(STEPS) - 1)


def test_the_presentation_shows_the_step_and_its_keys_turn_it(opened):
    page = opened(**{KEY: "3"})
    panel = page.visitor._panel
    panel.presentation.show(True)
    page.give(page.commands["Next scene"])
    page.settle()
    page.session.say("", Severity.NOTE)
    assert is_step(page, 3)
    assert STEPS[3].title in panel.presentation._html.content and STEPS[3].text in panel.presentation._html.content
    escape = next(command for name, command in page.commands.items() if name.startswith("End the presentation"))
    page.give(escape)
    page.settle()
    assert not panel.presentation.on and is_step(page, 3)
    page.give(escape)
    wait_until(lambda: number(page) is None)
