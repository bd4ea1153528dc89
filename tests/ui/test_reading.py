"""Files are read one at a time over all visitors, and dropped where their visitor has left."""

import threading

import pytest
from pages import PATIENCE, wait_until

from dt_viz.errors import UnwantedError
from dt_viz.ui.reading import Reader


class Visitor:
    """Has a file read that goes on until it is let go."""

    def __init__(self) -> None:
        self.waits, self.reads, self.let_go, self.done = (threading.Event() for _ in range(4))
        self.reader = Reader(self.waits.set)
        self.end = ""

    def read(self) -> None:
        try:
            with self.reader.turn():
                self.reads.set()
                assert self.let_go.wait(PATIENCE)
            self.end = "read"
        except UnwantedError:
            self.end = "left"
            raise
        finally:
            self.done.set()

    def begin(self) -> bool:
        return self.reader.begin(self.read)

    def begin_next(self, read) -> None:
        """Begin once what is under way has ended."""
        wait_until(lambda: self.reader.begin(read))


@pytest.fixture(name="first")
def _first():
    first = Visitor()
    yield first
    first.reader.close()
    first.let_go.set()


@pytest.fixture(name="both")
def _both(first):
    """One who has a file read and one who waits."""
    second = Visitor()
    assert first.begin() and first.reads.wait(PATIENCE) and not first.waits.is_set()
    assert second.begin() and second.waits.wait(PATIENCE)
    yield first, second
    second.reader.close()
    second.let_go.set()


def test_a_second_visitor_is_told_to_wait_and_comes_next(both):
    first, second = both
    assert not second.reads.wait(0.3)
    first.let_go.set()
    assert second.reads.wait(PATIENCE)
    assert first.end == "read"


def test_what_was_read_for_a_visitor_who_has_left_is_dropped(both):
    first, second = both
    first.reader.close()
    first.let_go.set()
    assert first.done.wait(PATIENCE) and first.end == "left"
    assert second.reads.wait(PATIENCE)


def test_who_leaves_while_waiting_is_not_waited_for(both):
    _, second = both
    second.reader.close()
    assert second.done.wait(PATIENCE) and second.end == "left" and not second.reads.is_set()


def test_each_visitor_has_one_file_under_way(first):
    assert first.begin() and first.reads.wait(PATIENCE)
    assert not first.begin()
    first.let_go.set()
    assert first.done.wait(PATIENCE)
    first.begin_next(first.read)


def test_what_nobody_expects_is_logged_and_the_next_file_is_read(first, caplog):
    assert first.reader.begin(lambda: 1 / 0)  # pyright: ignore[reportArgumentType]
    first.begin_next(first.read)
    assert "ZeroDivisionError" in caplog.text
