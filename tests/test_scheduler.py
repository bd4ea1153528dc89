"""Which thread computes when, and work in lanes."""

import logging
import threading
from time import monotonic, sleep

import numpy as np
import pytest
from pages import wait_until

from dt_viz import scheduler as scheduler_module
from dt_viz.errors import UnwantedError, never
from dt_viz.scheduler import LEAST, LONGEST, MOMENT, Jobs, Rank, Scheduler, checkpoint

PATIENCE = 30.0  # seconds until a hanging test fails; nothing here takes long
LANE = "lane"
DRAG, FIRST, REFINEMENT = Rank


def unexpected(error):
    pytest.fail(str(error))


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    """No computation comes first because it has waited for long, unless a test wants that."""
    monkeypatch.setattr(scheduler_module, "PATIENCE", 10 * PATIENCE)


class Crowd:
    """Computations, each in a thread, that keep their slots until they may go, and the order in which they begin."""

    def __init__(self, num):
        self.scheduler, self.order, self.threads, self.may_go = Scheduler(num), [], {}, {}

    def come(self, name, rank, cancelled=never, jobs=None, work=lambda: None):
        """Return when this one has begun or waits."""
        self.may_go[name] = threading.Event()

        def compute():
            scheduler_module._thread.jobs = jobs
            try:
                with self.scheduler.slot(rank, cancelled):
                    self.order.append(name)
                    while not self.may_go[name].wait(0.01):
                        work()
            except UnwantedError:
                self.order.append(f"{name} left")

        num = len(self.order) + len(self.scheduler._waiting)
        self.threads[name] = threading.Thread(target=compute, daemon=True)
        self.threads[name].start()
        wait_until(lambda: len(self.order) + len(self.scheduler._waiting) > num)

    def go(self, *names):
        """End computations one after another; return when all that can begin then have begun."""
        for name in names:
            self.may_go[name].set()
            self.threads[name].join(PATIENCE)
            assert not self.threads[name].is_alive()
            sleep(0.05)

    def close(self):
        self.go(*self.threads)


@pytest.fixture(name="crowd")
def _crowd(request):
    crowd = Crowd(getattr(request, "param", 2))
    yield crowd
    crowd.close()


@pytest.mark.parametrize(("crowd", "num_others"), [(1, 1), (2, 1), (4, 3)], indirect=["crowd"])
def test_one_slot_is_for_drags_and_the_others_for_all_else(crowd, num_others):
    for k in range(6):
        crowd.come(f"refinement {k}", REFINEMENT)
        crowd.come(f"drag {k}", DRAG)
    running = [place.rank for place in crowd.scheduler._running]
    assert sorted(running) == [DRAG, *num_others * [REFINEMENT]]


def test_first_pictures_come_before_refinements(crowd):
    for name, rank in (("a", REFINEMENT), ("b", REFINEMENT), ("c", FIRST), ("d", FIRST)):
        crowd.come(name, rank)
    crowd.go("a", "c", "d", "b")
    assert crowd.order == ["a", "c", "d", "b"]


@pytest.mark.parametrize("rank", Rank)
def test_visitors_have_slots_in_turn_whatever_each_of_them_asks_for(crowd, rank):
    greedy, modest = Jobs(unexpected), Jobs(unexpected)
    for name, jobs in (("g1", greedy), ("g2", greedy), ("g3", greedy), ("m1", modest), ("m2", modest)):
        crowd.come(name, rank, jobs=jobs)
    crowd.go("g1", "m1", "g2", "m2", "g3")
    assert crowd.order == ["g1", "m1", "g2", "m2", "g3"]


def test_a_refinement_that_has_waited_for_long_comes_before_a_first_picture(crowd, monkeypatch):
    crowd.come("a", FIRST)
    crowd.come("r", REFINEMENT)
    monkeypatch.setattr(scheduler_module, "PATIENCE", 0.1)
    sleep(0.15)
    crowd.come("b", FIRST)
    crowd.go("a", "r", "b")
    assert crowd.order == ["a", "r", "b"]


@pytest.mark.parametrize("woken", [True, False])
def test_a_computation_that_is_cancelled_while_it_waits_leaves(crowd, woken):
    cancelled = threading.Event()
    crowd.come("a", REFINEMENT)
    crowd.come("b", REFINEMENT, cancelled.is_set)
    cancelled.set()
    began = monotonic()
    if woken:
        crowd.scheduler.wake()
    crowd.threads["b"].join(PATIENCE)
    assert crowd.order == ["a", "b left"] and not crowd.scheduler._waiting
    assert not woken or monotonic() - began < LONGEST / 2


def test_newer_work_ends_at_once_what_waits_for_a_slot(crowd, monkeypatch):
    monkeypatch.setattr(scheduler_module, "SCHEDULER", crowd.scheduler)
    monkeypatch.setattr(scheduler_module, "LONGEST", PATIENCE)
    jobs, done = Jobs(unexpected), threading.Event()

    def refine():
        with crowd.scheduler.slot(REFINEMENT, lambda: jobs.superseded(LANE)):
            pytest.fail("it has begun")

    crowd.come("a", REFINEMENT)
    jobs.submit(LANE, refine)
    wait_until(lambda: crowd.scheduler._waiting)
    jobs.submit(LANE, done.set, latest=True)
    assert done.wait(PATIENCE / 3)


def test_one_that_leaves_the_queue_lets_the_next_one_begin(crowd, monkeypatch):
    monkeypatch.setattr(scheduler_module, "LONGEST", PATIENCE)
    free, cancelled = threading.Event(), threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(Scheduler, "_is_next", lambda *_: free.is_set())
        crowd.come("a", DRAG, cancelled.is_set)
    crowd.come("b", DRAG)
    cancelled.set()
    crowd.scheduler.wake()
    wait_until(lambda: crowd.order == ["a left", "b"])


def test_a_computation_that_is_cancelled_before_it_waits_takes_no_slot(crowd):
    with pytest.raises(UnwantedError), crowd.scheduler.slot(REFINEMENT, lambda: True):
        pytest.fail("it has begun")
    assert not crowd.scheduler._waiting and not crowd.scheduler._running


def test_an_exception_gives_the_slot_back(crowd):
    with pytest.raises(ValueError, match="no"), crowd.scheduler.slot():
        raise ValueError("no")
    crowd.come("a", DRAG)
    assert crowd.order == ["a"]


class TestCheckpoints:
    @pytest.fixture(autouse=True)
    def _current(self, crowd, monkeypatch):
        monkeypatch.setattr(scheduler_module, "SCHEDULER", crowd.scheduler)
        monkeypatch.setattr(scheduler_module, "LONGEST", PATIENCE)
        self.parts = 0

    def part(self):
        checkpoint()
        self.parts += 1

    def rests(self):
        sleep(3 * LEAST)
        before = self.parts
        sleep(3 * LEAST)
        return self.parts == before

    @pytest.mark.parametrize("rank", [FIRST, REFINEMENT])
    def test_a_refinement_pauses_while_a_frame_of_a_drag_is_computed_and_a_first_picture_does_not(self, crowd, rank):
        crowd.come("a", rank, work=self.part)
        assert not self.rests()
        crowd.come("d", DRAG)
        assert self.rests() == (rank is REFINEMENT)
        crowd.go("d")
        assert not self.rests()

    def test_a_pause_ends_after_a_while(self, crowd, monkeypatch):
        monkeypatch.setattr(scheduler_module, "LONGEST", LEAST)
        crowd.come("a", REFINEMENT, work=self.part)
        crowd.come("d", DRAG)
        assert not self.rests()

    def test_a_refinement_lends_its_slot_to_a_first_picture_and_has_it_again(self, crowd):
        crowd.come("r", REFINEMENT, work=self.part)
        crowd.come("another", REFINEMENT)
        assert not self.rests() and crowd.order == ["r"]
        crowd.come("f", FIRST)
        wait_until(lambda: crowd.order == ["r", "f"])
        assert self.rests()
        crowd.go("f")
        crowd.go("another")
        assert not self.rests() and [place.rank for place in crowd.scheduler._running] == [REFINEMENT]

    @pytest.mark.parametrize("beside", [None, DRAG, FIRST])
    def test_a_refinement_that_is_cancelled_ends_there_at_once(self, crowd, beside):
        cancelled = threading.Event()
        crowd.come("r", REFINEMENT, cancelled.is_set, work=self.part)
        if beside is not None:
            crowd.come("b", beside)
            assert self.rests()
        cancelled.set()
        crowd.scheduler.wake()
        crowd.threads["r"].join(PATIENCE / 3)
        assert crowd.order[-1] == "r left" and len(crowd.scheduler._running) == (beside is not None)

    def test_work_of_a_visitor_pauses_there_without_a_slot_too_but_a_picture_of_an_arm_does_not(self, crowd):
        jobs, ended = Jobs(unexpected), threading.Event()

        def move():
            while not ended.wait(0.01):
                with crowd.scheduler.between_drags():
                    self.part()

        def read():
            while not ended.wait(0.01):
                self.part()

        crowd.come("d", DRAG)
        for work, pauses in ((read, True), (move, False)):
            jobs.submit(LANE, work)
            assert self.rests() == pauses
            ended.set()
            crowd.scheduler.wake()
            if pauses:
                crowd.go("d")
            assert jobs.wait_idle(timeout=PATIENCE)
            ended.clear()
            if pauses:
                crowd.come("e", DRAG)

    def test_a_picture_of_an_arm_waits_for_a_frame_of_a_drag_for_a_moment(self, crowd):
        crowd.come("d", DRAG)
        began = monotonic()
        with crowd.scheduler.between_drags():
            assert monotonic() - began >= MOMENT

    def test_work_ends_there_once_its_visitor_has_left_in_a_drag_too(self, crowd):
        jobs, gate, done = Jobs(unexpected), Gate(), []

        def compute():
            with crowd.scheduler.slot():
                checkpoint()
                gate()
                checkpoint()
                done.append(True)

        jobs.submit(LANE, compute)
        assert gate.begun.wait(PATIENCE)
        jobs.close()
        gate.go.set()
        assert jobs.wait_idle(timeout=PATIENCE) and not done
        checkpoint()  # of a thread that works for no visitor


@pytest.mark.parametrize("num", [1, 2, 4])
def test_in_a_storm_of_all_ranks_no_more_than_the_slots_are_taken_and_all_get_one(num, monkeypatch):
    crowd, lock, most, ended = Scheduler(num), threading.Lock(), [0, 0], []
    monkeypatch.setattr(scheduler_module, "SCHEDULER", crowd)
    monkeypatch.setattr(scheduler_module, "LEAST", 0.0)
    monkeypatch.setattr(scheduler_module, "LONGEST", 0.01)

    def storm(seed):
        generator = np.random.default_rng(seed)
        for _ in range(30):
            with crowd.slot(Rank(generator.integers(3))):
                for _ in range(generator.integers(4)):
                    with lock:
                        drags = [place.rank is DRAG for place in crowd._running]
                        most[:] = np.maximum(most, [sum(drags), len(drags) - sum(drags)])
                    checkpoint()
        ended.append(seed)

    threads = [threading.Thread(target=storm, args=(seed,), daemon=True) for seed in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert len(ended) == 8 and most[0] <= 1 and most[1] <= max(1, num - 1)
    assert not crowd._waiting and not crowd._running


class Gate:
    """Work that sets an event when it begins, and waits for another one."""

    def __init__(self):
        self.begun, self.go = threading.Event(), threading.Event()

    def __call__(self):
        self.begun.set()
        assert self.go.wait(PATIENCE)


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
        before = monotonic()
        jobs.rest(PATIENCE, LANE)
        jobs.done.append(jobs.superseded(LANE) and monotonic() - before < PATIENCE / 2)

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
