"""Files are read one at a time over all visitors, and reading ends with its visitor."""

import threading

import pytest
from pages import PATIENCE, wait_until

from dt_viz.engine import engine
from dt_viz.interruption import UnwantedError, checkpoint
from dt_viz.ui.reading import Reader


class Visitor:
    """Has a file read that goes on until it is let go, passing checkpoints."""

    def __init__(self) -> None:
        self.waits, self.reads, self.let_go, self.done = (threading.Event() for _ in range(4))
        self.reader = Reader(self.waits.set)
        self.end = ""

    def read(self) -> None:
        try:
            with self.reader.turn():
                self.reads.set()
                while not self.let_go.wait(0.001):
                    checkpoint()
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


def test_who_leaves_while_reading_makes_room(both):
    first, second = both
    first.reader.close()
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


def test_reading_pauses_at_its_checkpoints_while_others_drag(first, monkeypatch):
    monkeypatch.setattr("dt_viz.ui.reading.LONGEST_PAUSE", PATIENCE)
    passed = threading.Event()

    def read() -> None:
        with first.reader.turn():
            first.reads.set()
            checkpoint()
            passed.set()

    with engine._turns.taken():  # as who follows a hand has it
        assert first.reader.begin(read) and first.reads.wait(PATIENCE)
        assert not passed.wait(0.3)
    assert passed.wait(PATIENCE)


def test_reading_does_not_pause_for_who_is_patient_nor_for_ever(first, monkeypatch):
    def read() -> None:
        with first.reader.turn():
            checkpoint()
        first.done.set()

    with engine._turns.taken(patient=True):
        monkeypatch.setattr("dt_viz.ui.reading.LONGEST_PAUSE", 1e6)
        assert first.reader.begin(read) and first.done.wait(PATIENCE)
    first.done.clear()
    with engine._turns.taken():
        monkeypatch.setattr("dt_viz.ui.reading.LONGEST_PAUSE", 0.01)
        first.begin_next(read)
        assert first.done.wait(PATIENCE)


def test_what_nobody_expects_is_logged_and_the_next_file_is_read(first, caplog):
    assert first.reader.begin(lambda: 1 / 0)  # pyright: ignore[reportArgumentType]
    first.begin_next(first.read)
    assert "ZeroDivisionError" in caplog.text
