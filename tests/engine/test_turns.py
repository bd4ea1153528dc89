"""Turns: one at a time, who is in a hurry first, and nobody is left out."""

import threading

import pytest

import dt_viz.engine.turns as turns_module
from dt_viz.engine.turns import Turns

PATIENCE = 30
"""Seconds after which a test gives up; nothing takes that long."""


class Crowd:
    """Threads that want the turn, and the order in which they get it."""

    def __init__(self, turns):
        self.turns, self.order, self.threads = turns, [], []

    def join_queue(self, name, *, patient=False):
        """Returns when this one waits."""
        waiting = len(self.turns._queue)

        def want():
            with self.turns.taken(patient=patient):
                self.order.append(name)

        self.threads.append(threading.Thread(target=want, daemon=True))
        self.threads[-1].start()
        while len(self.turns._queue) == waiting:
            threading.Event().wait(0.001)

    def all_gone(self):
        for thread in self.threads:
            thread.join(PATIENCE)
        return not any(thread.is_alive() for thread in self.threads)


@pytest.fixture(name="crowd")
def _crowd():
    return Crowd(Turns())


@pytest.fixture(params=[True, False], name="over")
def _over(request, monkeypatch):
    """Whether the slice of time is over as soon as it begins, or never."""
    monkeypatch.setattr(turns_module, "SLICE", -1.0 if request.param else float("inf"))
    return request.param


def test_who_is_in_a_hurry_goes_first_and_else_who_came_first(crowd):
    with crowd.turns.taken():
        for name, patient in (("a", True), ("b", False), ("c", True), ("d", False)):
            crowd.join_queue(name, patient=patient)
    assert crowd.all_gone()
    assert crowd.order == ["b", "d", "a", "c"]


def test_who_is_patient_gives_way_to_all_that_hurry_and_joins_the_end_of_the_queue(crowd, monkeypatch):
    monkeypatch.setattr(turns_module, "SLICE", float("inf"))
    with crowd.turns.taken(patient=True):
        crowd.turns.give_way()  # nobody is there
        crowd.join_queue("patient", patient=True)
        crowd.turns.give_way()  # nobody hurries
        assert crowd.order == []
        crowd.join_queue("first")
        crowd.join_queue("second")
        crowd.turns.give_way()
        assert crowd.order == ["first", "second", "patient"]
    assert crowd.all_gone()


def test_who_hurries_gives_way_to_its_like_only_after_a_slice_of_time(crowd, over):
    with crowd.turns.taken():
        crowd.join_queue("patient", patient=True)
        crowd.join_queue("other")
        crowd.turns.give_way()
        assert crowd.order == (["other"] if over else [])
    assert crowd.all_gone()


def test_the_turn_ends_with_an_exception(crowd):
    with pytest.raises(ZeroDivisionError), crowd.turns.taken():
        crowd.join_queue("next")
        raise ZeroDivisionError
    assert crowd.all_gone()


class UnwantedError(Exception):
    """What a checkpoint raises."""


@pytest.mark.parametrize("had", [False, True])
def test_who_is_not_wanted_any_more_waits_no_longer_and_takes_the_turn_from_nobody(crowd, had):
    """Whether it waits for its first turn, or gave it away."""
    turns, held, ended = crowd.turns, threading.Event(), threading.Event()
    waits, unwanted = threading.Event(), threading.Event()

    def checkpoint():
        waits.set()
        if unwanted.is_set():
            raise UnwantedError

    def hurry():
        with turns.taken():
            held.set()
            ended.wait(PATIENCE)

    def refine():
        with pytest.raises(UnwantedError), turns.taken(patient=True, checkpoint=checkpoint):
            first.start()
            while not held.is_set():
                turns.give_way(checkpoint)

    first, refining = threading.Thread(target=hurry, daemon=True), threading.Thread(target=refine, daemon=True)
    if not had:
        first.start()
        assert held.wait(PATIENCE)
    refining.start()
    assert held.wait(PATIENCE) and waits.wait(PATIENCE)
    unwanted.set()
    refining.join(PATIENCE)
    assert not refining.is_alive()
    crowd.join_queue("next")
    assert crowd.order == []  # the first one still has the turn
    ended.set()
    assert crowd.all_gone()
    assert crowd.order == ["next"]


def test_in_a_storm_only_one_has_the_turn_and_all_get_it(over):
    turns, alone, crowded = Turns(), threading.Semaphore(1), []

    def want(patient):
        for _ in range(100):
            with turns.taken(patient=patient):
                for _ in range(3):
                    if not alone.acquire(blocking=False):
                        crowded.append(threading.current_thread().name)
                        return
                    threading.Event().wait(0)
                    alone.release()
                    turns.give_way()

    threads = [threading.Thread(target=want, args=(k % 2 == 0,), daemon=True) for k in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()
    assert crowded == []
