"""Files are read one at a time over all visitors, and dropped where their visitor has left."""

import threading
from functools import partial

import pytest
from pages import PATIENCE, wait_until

from dt_viz.errors import UnwantedError
from dt_viz.session.jobs import Jobs
from dt_viz.ui.tabs.from_file import LANE, turn


class Visitor:
    """Has a file read that goes on until it is let go."""

    def __init__(self) -> None:
        self.waits, self.reads, self.let_go, self.done = (threading.Event() for _ in range(4))
        self.errors: list[Exception] = []
        self.jobs = Jobs(self.errors.append)
        self.end = ""

    def read(self) -> None:
        try:
            with turn(lambda *_said: self.waits.set(), partial(self.jobs.superseded, LANE)):
                self.reads.set()
                assert self.let_go.wait(PATIENCE)
            self.end = "read"
        except UnwantedError:
            self.end = "left"
            raise
        finally:
            self.done.set()

    def begin(self) -> None:
        self.jobs.submit(LANE, self.read)


@pytest.fixture(name="first")
def _first():
    first = Visitor()
    yield first
    first.jobs.close()
    first.let_go.set()
    assert first.errors == []


@pytest.fixture(name="both")
def _both(first):
    """One who has a file read and one who waits."""
    second = Visitor()
    first.begin()
    assert first.reads.wait(PATIENCE) and not first.waits.is_set()
    second.begin()
    assert second.waits.wait(PATIENCE)
    yield first, second
    second.jobs.close()
    second.let_go.set()


def test_a_second_visitor_is_told_to_wait_and_comes_next(both):
    first, second = both
    assert not second.reads.wait(0.3)
    first.let_go.set()
    assert second.reads.wait(PATIENCE)
    wait_until(lambda: first.end == "read")


def test_what_was_read_for_a_visitor_who_has_left_is_dropped(both):
    first, second = both
    first.jobs.close()
    first.let_go.set()
    assert first.done.wait(PATIENCE) and first.end == "left"
    assert second.reads.wait(PATIENCE)


def test_who_leaves_while_waiting_is_not_waited_for(both):
    _, second = both
    second.jobs.close()
    assert second.done.wait(PATIENCE) and second.end == "left" and not second.reads.is_set()
