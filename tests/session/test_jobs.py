"""Work in lanes: one thing at a time in each, the newest or in turn, and no exception ends a lane."""

import logging
import threading
import time

import numpy as np
import pytest

from dt_viz.accounts import Account, QuotaSettings
from dt_viz.checkpoints import checkpoint
from dt_viz.errors import UnwantedError
from dt_viz.session.jobs import Jobs

PATIENCE = 30.0  # seconds until a hanging test fails; nothing here takes long
LANE = "lane"


def test_what_all_lanes_use_is_charged_to_the_visitor():
    account, errors = Account(None, QuotaSettings(rate=1e-9, saved=0.0)), []
    jobs = Jobs(errors.append, account)

    def compute():
        end = time.thread_time() + 0.1
        while time.thread_time() < end:
            pass
        raise UnwantedError

    for lane in ("a", "b"):
        jobs.submit(lane, compute)
    assert jobs.wait_idle(timeout=PATIENCE) and not errors
    assert 0.2 <= account.debt < 0.3


def test_work_gives_way_at_its_checkpoints():
    paused, done = [], []
    jobs = Jobs(lambda error: pytest.fail(str(error)), give_way=lambda: paused.append(len(done)))

    def compute():
        for part in range(3):
            checkpoint()
            done.append(part)

    jobs.submit(LANE, compute)
    assert jobs.wait_idle(timeout=PATIENCE) and paused == [0, 1, 2]
    checkpoint()
    assert len(paused) == 3


class Gate:
    """Work that tells when it has begun and waits until it is let go."""

    def __init__(self):
        self.begun, self.go = threading.Event(), threading.Event()

    def __call__(self):
        self.begun.set()
        assert self.go.wait(PATIENCE)


def test_a_thread_whose_work_is_superseded_is_woken_when_newer_work_comes_and_when_the_visitor_leaves():
    woken, numbers, gates = [], {}, {lane: Gate() for lane in "ab"}
    jobs = Jobs(lambda error: pytest.fail(str(error)), wake=woken.append)

    def compute(lane):
        numbers[lane] = threading.get_ident()
        gates[lane]()

    for lane, gate in gates.items():
        jobs.submit(lane, lambda lane=lane: compute(lane))
        assert gate.begun.wait(PATIENCE)
    assert woken == []
    jobs.submit("a", lambda: None, latest=True)
    assert woken == [numbers["a"]]
    jobs.close()
    assert woken[1:] == [numbers["a"], numbers["b"]]
    for gate in gates.values():
        gate.go.set()
    assert jobs.wait_idle(timeout=PATIENCE)


class Started(Jobs):
    """Jobs that note what they have done, and what failed."""

    def __init__(self):
        self.done, self.errors = [], []
        super().__init__(self.errors.append)

    def note(self, value, lane=LANE, *, latest=True):
        return self.submit(lane, lambda: self.done.append(value), latest=latest)

    def begin(self, gate, lane=LANE):
        self.submit(lane, gate)
        assert gate.begun.wait(PATIENCE)

    def settle(self):
        assert self.wait_idle(timeout=PATIENCE)


@pytest.fixture
def jobs():
    jobs = Started()
    yield jobs
    jobs.close()
    jobs.settle()


@pytest.mark.parametrize("latest", [True, False])
def test_waiting_work_is_overtaken_by_the_latest_or_done_in_turn(jobs, latest):
    gate = Gate()
    jobs.begin(gate)
    assert jobs.busy(LANE) and not jobs.wait_idle(LANE, 0.01)
    dropped = [jobs.note(value, latest=latest) for value in range(10)]
    gate.go.set()
    jobs.settle()
    assert jobs.done == ([9] if latest else [*range(10)])
    assert sum(dropped) == (9 if latest else 0) and not jobs.busy(LANE)


def test_a_lane_waits_for_no_other(jobs):
    gate = Gate()
    jobs.begin(gate)
    jobs.note("other", "other")
    assert jobs.wait_idle("other", PATIENCE) and jobs.done == ["other"]
    gate.go.set()


def test_running_work_is_not_cancelled_but_told(jobs):
    gate, seen = Gate(), []

    def work():
        seen.append(jobs.superseded(LANE))
        gate()
        seen.append(jobs.superseded(LANE))

    jobs.submit(LANE, work)
    assert gate.begun.wait(PATIENCE)
    jobs.submit(LANE, lambda: seen.append(jobs.superseded(LANE)), latest=True)
    gate.go.set()
    jobs.settle()
    assert seen == [False, True, False]


def test_work_runs_one_at_a_time_in_order_and_the_last_is_always_done(jobs):
    """A storm from several threads; each thread's work carries increasing numbers."""
    running, dropped = threading.Semaphore(1), []

    def run(value):
        assert running.acquire(blocking=False), "two at once"
        jobs.done.append(value)
        running.release()

    last, lock, pauses = [(0, 0)], threading.Lock(), np.random.default_rng(0).integers(0, 3, (4, 300))

    def storm(thread):
        for k in range(300):
            with lock:
                last[0] = (thread, k)
                dropped.append(jobs.submit(LANE, lambda k=k: run((thread, k)), latest=True))
            for _ in range(pauses[thread, k]):
                threading.Event().wait(0)

    threads = [threading.Thread(target=storm, args=(thread,)) for thread in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    jobs.settle()
    assert jobs.errors == []
    assert jobs.done[-1] == last[0]
    for thread in range(4):
        own = [k for t, k in jobs.done if t == thread]
        assert own == sorted(set(own))
    assert len(jobs.done) + sum(dropped) == 4 * 300


@pytest.mark.parametrize("page_is_gone", [False, True])
def test_an_exception_is_reported_once_and_survived_even_where_the_report_fails(caplog, page_is_gone):
    reported, done = [], []

    def report(error):
        reported.append(str(error))
        if page_is_gone:
            raise ConnectionError("the page is gone")

    def fail():
        raise ValueError("no such thing")

    jobs = Jobs(report)
    with caplog.at_level(logging.ERROR):
        jobs.submit(LANE, fail)
        jobs.submit(LANE, lambda: done.append("next"))
        assert jobs.wait_idle(LANE, PATIENCE)
    assert (reported, done) == (["no such thing"], ["next"])
    assert "Traceback" in caplog.text and "no such thing" in caplog.text
    assert ("the page is gone" in caplog.text) == page_is_gone


def test_what_is_not_wanted_any_more_is_no_error_and_neither_is_what_fails_after_closing(jobs, caplog):
    def unwanted():
        raise UnwantedError

    gate = Gate()

    def fail():
        gate()
        raise RuntimeError("the client disconnected")

    jobs.submit(LANE, unwanted)
    jobs.submit(LANE, fail)
    assert gate.begun.wait(PATIENCE)
    jobs.close()
    gate.go.set()
    jobs.settle()
    assert jobs.errors == [] and caplog.text == ""


@pytest.mark.parametrize("latest", [True, False])
def test_resting_work_is_woken_by_the_next(jobs, latest):
    begun = threading.Event()

    def rest():
        begun.set()
        jobs.rest(LANE, PATIENCE)
        jobs.done.append(jobs.superseded(LANE))

    jobs.submit(LANE, rest)
    assert begun.wait(PATIENCE)
    jobs.note("next", latest=latest)
    jobs.settle()
    assert jobs.done == [True, "next"]


def test_closing_lets_running_work_end_and_drops_what_waits_and_what_comes_later(jobs):
    gate = Gate()
    jobs.submit(LANE, lambda: (gate(), jobs.done.append(jobs.superseded(LANE))))
    assert gate.begun.wait(PATIENCE)
    jobs.note("waiting", latest=False)
    jobs.close()
    gate.go.set()
    jobs.settle()
    jobs.note("too late")
    assert jobs.wait_idle(LANE, 1.0) and jobs.done == [True]


def test_a_lane_whose_thread_cannot_start_works_as_soon_as_one_can(jobs, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(
            threading.Thread, "start", lambda _: (_ for _ in ()).throw(RuntimeError("can't start new thread"))
        )
        with pytest.raises(RuntimeError, match="can't start"):
            jobs.note("lost")
    assert not jobs.busy(LANE)
    jobs.note("next")
    jobs.settle()
    assert jobs.done == ["next"]


def test_work_for_one_lane_does_not_wake_another_one_that_rests():
    asked = threading.Semaphore(0)

    class Counting(Jobs):
        def superseded(self, lane):
            if lane == LANE:
                asked.release()
            return super().superseded(lane)

    jobs = Counting(lambda error: pytest.fail(str(error)))
    jobs.submit(LANE, lambda: jobs.rest(LANE, PATIENCE))
    assert asked.acquire(timeout=PATIENCE)  # it rests now, or is about to
    for _ in range(20):
        jobs.submit("another", lambda: None)
        assert jobs.wait_idle("another", PATIENCE)
    assert not asked.acquire(blocking=False) and jobs.busy(LANE)
    jobs.submit(LANE, lambda: None)
    assert asked.acquire(timeout=PATIENCE) and jobs.wait_idle(timeout=PATIENCE)
