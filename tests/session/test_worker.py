"""The one-slot worker: the newest job next, the last one always, and no job's exception ends it."""

import logging
import threading

import numpy as np
import pytest

from dt_viz.session.worker import LatestWorker

PATIENCE = 30.0  # seconds until a hanging test fails; nothing here takes long


class Gate:
    """A job that tells when it has begun and waits until it is let go."""

    def __init__(self):
        self.begun, self.go = threading.Event(), threading.Event()

    def __call__(self):
        self.begun.set()
        assert self.go.wait(PATIENCE)


@pytest.fixture
def started():
    """Makes workers that run functions or note values; closes them at the end."""
    workers = []

    def make(run=None, on_error=None):
        done, errors = [], []

        def default(job, _superseded):
            if callable(job):
                job()
            done.append(job)

        worker = LatestWorker(run or default, on_error or errors.append)
        workers.append(worker)
        return worker, done, errors

    yield make
    for worker in workers:
        worker.close()
        worker._thread.join(PATIENCE)
        assert not worker._thread.is_alive()


def test_waiting_jobs_are_overtaken_by_the_latest(started):
    worker, done, _ = started()
    gate = Gate()
    worker.submit(gate)
    assert gate.begun.wait(PATIENCE)
    assert not worker.wait_idle(0.01)
    for job in range(10):
        worker.submit(job)
    gate.go.set()
    assert worker.wait_idle(PATIENCE)
    assert done == [gate, 9]
    assert worker.num_skipped == 9


def test_a_running_job_is_not_cancelled_but_told(started):
    seen, gate, second = [], Gate(), threading.Event()

    def run(job, superseded):
        if job == "first":
            seen.append(superseded())
            gate()
            seen.append(superseded())
        else:
            seen.append(superseded())
            second.set()

    worker, _, _ = started(run)
    worker.submit("first")
    assert gate.begun.wait(PATIENCE)
    worker.submit("second")
    gate.go.set()
    assert second.wait(PATIENCE)
    assert seen == [False, True, False]


def test_jobs_run_one_at_a_time_in_order_and_the_last_is_always_run(started):
    """A storm from several threads; each thread's jobs carry increasing numbers."""
    done, running = [], threading.Semaphore(1)

    def run(job, _superseded):
        assert running.acquire(blocking=False), "two jobs at once"
        done.append(job)
        running.release()

    worker, _, errors = started(run)
    last, lock, pauses = [(0, 0)], threading.Lock(), np.random.default_rng(0).integers(0, 3, (4, 300))

    def storm(thread):
        for k in range(300):
            with lock:
                last[0] = (thread, k)
                worker.submit((thread, k))
            for _ in range(pauses[thread, k]):
                threading.Event().wait(0)

    threads = [threading.Thread(target=storm, args=(thread,)) for thread in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert worker.wait_idle(PATIENCE)
    assert errors == []
    assert done[-1] == last[0]
    for thread in range(4):
        own = [k for t, k in done if t == thread]
        assert own == sorted(set(own))
    assert len(done) + worker.num_skipped == 4 * 300


@pytest.mark.parametrize("page_is_gone", [False, True])
def test_an_exception_is_reported_once_and_survived_even_where_the_report_fails(started, caplog, page_is_gone):
    reported = []

    def report(error):
        reported.append(str(error))
        if page_is_gone:
            raise ConnectionError("the page is gone")

    def fail():
        raise ValueError("no such thing")

    worker, done, _ = started(on_error=report)
    with caplog.at_level(logging.ERROR):
        worker.submit(fail)
        assert worker.wait_idle(PATIENCE)
        worker.submit("next")
        assert worker.wait_idle(PATIENCE)
    assert (reported, done) == (["no such thing"], ["next"])
    assert "Traceback" in caplog.text and "no such thing" in caplog.text
    assert ("the page is gone" in caplog.text) == page_is_gone


def test_a_resting_job_is_woken_by_the_next(started):
    order, begun = [], threading.Event()

    def run(job, superseded):
        order.append(f"{job} begins")
        if job == "first":
            begun.set()
            worker.rest(PATIENCE)
            order.append(f"superseded: {superseded()}")

    worker, _, _ = started(run)
    worker.submit("first")
    assert begun.wait(PATIENCE)
    worker.submit("second")
    assert worker.wait_idle(PATIENCE)
    assert order == ["first begins", "superseded: True", "second begins"]


def test_a_rest_ends_by_itself(started):
    worker, _, _ = started(lambda job, superseded: (worker.rest(0.01), results.append(superseded())))
    results = []
    worker.submit("only")
    assert worker.wait_idle(PATIENCE)
    assert results == [False]


def test_closing_lets_the_running_job_end_and_drops_the_waiting_one(started):
    told, gate = [], Gate()

    def run(job, superseded):
        gate()
        told.append((job, superseded()))

    worker, _, _ = started(run)
    worker.submit("running")
    assert gate.begun.wait(PATIENCE)
    worker.submit("waiting")
    worker.close()
    gate.go.set()
    worker._thread.join(PATIENCE)
    assert told == [("running", True)]
    assert worker.wait_idle(PATIENCE)


def test_a_job_after_closing_is_not_waited_for(started):
    """A control that is still moved while its page closes."""
    worker, done, _ = started()
    worker.close()
    worker._thread.join(PATIENCE)
    worker.submit("too late")
    assert worker.wait_idle(1.0)
    assert done == []
