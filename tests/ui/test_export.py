"""Pictures to take home: one at a time for each visitor, on nobody else's thread."""

import logging
import threading
import time

import pytest
from pages import PATIENCE

from dt_viz.ui.scene.export import PictureSaver


class Browser:
    """Renders once it is told to."""

    def __init__(self):
        self.asked, self.shown, self.errors = [], [], []
        self.answer, self.begun = threading.Event(), threading.Event()
        self.error = None
        self.saver = PictureSaver(self.save, self.shown.append, self.errors.append)

    def save(self, resolution, transparent):
        self.asked.append((resolution, transparent))
        self.begun.set()
        assert self.answer.wait(PATIENCE)
        if self.error is not None:
            raise self.error

    def settle(self):
        assert self.saver._thread is not None
        self.saver._thread.join(PATIENCE)


@pytest.fixture
def browser():
    browser = Browser()
    yield browser
    browser.answer.set()


def test_many_clicks_make_one_picture_and_keep_nobody_waiting(browser):
    began = time.monotonic()
    for _ in range(40):
        browser.saver.request("small", False)
    assert time.monotonic() - began < PATIENCE / 2
    browser.answer.set()
    browser.settle()
    assert browser.asked == [("small", False)] and browser.shown == [True, False]
    browser.saver.request("large", True)
    browser.settle()
    assert browser.asked == [("small", False), ("large", True)]


def test_a_browser_that_does_not_answer_is_reported_and_the_next_picture_is_made(browser, caplog):
    browser.error = TimeoutError("no frame")
    browser.answer.set()
    with caplog.at_level(logging.CRITICAL):
        browser.saver.request("small", False)
        browser.settle()
    assert browser.errors == [browser.error] and browser.shown == [True, False]
    browser.error = None
    browser.saver.request("small", False)
    browser.settle()
    assert len(browser.asked) == 2 and len(browser.errors) == 1


def test_of_a_visitor_who_has_left_nothing_is_reported_and_no_picture_is_begun(browser):
    browser.error = RuntimeError("the client disconnected")
    browser.saver.request("small", False)
    assert browser.begun.wait(PATIENCE)
    browser.saver.close()
    browser.answer.set()
    browser.settle()
    browser.saver.request("small", False)
    assert browser.errors == [] and len(browser.asked) == 1
