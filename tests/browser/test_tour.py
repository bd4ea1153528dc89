"""The tour by its keys alone, in a window of a phone: all steps there and back, and the end."""

import numpy as np
import pytest
from browsing import BOX, PATIENCE, PHONE, close_page, open_page, press, wait_until
from chromium import needs_chromium

from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.tour import STEPS

pytestmark = [pytest.mark.browser, needs_chromium]


def test_its_keys_lead_through_all_steps_and_back_to_what_was_there(browser, server):
    page, visitor = open_page(browser, server, PHONE)
    session, tour = visitor.session, visitor._panel.tour
    own = encode(Saved(session.scenario))
    press(page.get_by_role("button", name="Take the tour", exact=True).first)
    for k, step in enumerate(STEPS):
        if k:
            page.keyboard.press("ArrowRight")
        text = page.get_by_text(f"{k + 1} of {len(STEPS)} · {step.title}")
        text.wait_for()
        box = page.get_by_role("note").evaluate(BOX)
        assert np.abs(np.subtract(box["whole"], box["seen"])).max() < 1 and not box["spills"]
        assert tour.number == k and visitor._camera.chosen is None  # these keys do not turn the view meanwhile
    page.keyboard.press("ArrowRight")  # there is no seventh
    page.keyboard.press("ArrowLeft")
    page.get_by_text(f"{len(STEPS) - 1} of {len(STEPS)}").wait_for()
    field = page.get_by_label("Task", exact=True).first
    field.focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Escape")
    field.evaluate("element => element.blur()")
    assert session.wait_idle(PATIENCE) and tour.number == len(STEPS) - 2
    page.keyboard.press("Escape")
    page.get_by_role("note").wait_for(state="detached")
    wait_until(lambda: not session.visits, "the visitor's own scenario")
    assert encode(Saved(session.scenario)) == own
    close_page(page, server, visitor)
