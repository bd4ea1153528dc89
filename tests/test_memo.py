"""Results that are kept, by what they were computed from."""

import threading
from typing import Any, cast

import numpy as np
import pytest
from scenes import changed, changing

from dt_viz.memo import Memo
from dt_viz.motion import following
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.session import LANE, Session


def test_a_result_is_computed_once_kinds_do_not_mix_and_the_results_that_were_used_last_stay():
    memo, made = Memo(), []
    for kind, key in (("a", 1), ("a", 1), ("b", 1), ("a", 2), ("b", 1), ("a", 1), ("a", 3), ("a", 1), ("a", 2)):
        assert memo(kind, key, lambda k=(kind, key): made.append(k) or k, newest=2) == (kind, key)
    assert made == [("a", 1), ("b", 1), ("a", 2), ("a", 3), ("a", 2)]
    assert memo.count("a") == 2


def test_what_fails_is_tried_again_and_leaves_what_is_kept():
    memo = Memo()
    memo("a", 1, lambda: "kept", newest=1)

    def fail():
        raise ValueError

    with pytest.raises(ValueError):
        memo("a", 2, fail, newest=1)
    assert memo("a", 2, lambda: "made", newest=2) == "made"
    assert memo("a", 1, fail, newest=2) == "kept"


def test_two_threads_that_compute_a_result_at_once_get_the_same_one():
    memo, together = Memo(), threading.Barrier(2)
    found: list[Any] = []

    def make():
        together.wait(60)
        return object()

    threads = [threading.Thread(target=lambda: found.append(memo("a", 1, make))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 2 and found[0] is found[1]


def test_engines_that_share_what_is_learned_and_postures_compute_them_once(fits, robot, initial, monkeypatch):
    made, reference_postures = [], following.reference_postures
    monkeypatch.setattr(
        following, "reference_postures", lambda *given: made.append(given[-1]) or reference_postures(*given)
    )
    shared, scenario = Memo(), initial("push_box")
    x, y, z = scenario.obstacles[0].position
    beside = changed(scenario, obstacles=scenario.obstacles[0].moved((x - 0.1, y, z)), space="cspace")
    engines = [Engine(TASKS, fits, robot, shared) for _ in range(2)]
    learned = {id(engine.nominal(beside).learned) for engine in engines}
    for engine in engines:
        list(engine.follower.alternatives(engine.nominal(beside), beside.arm_avoidance))
    assert len(learned) == 1 and len(made) == len(set(made)) > 0  # each number of lots once


class Blank:
    """A display that shows nothing."""

    def __getattr__(self, name):
        return lambda *_, **__: None


@pytest.mark.long
def test_one_thread_alone_computes_for_a_session(new_engine, initial, monkeypatch):
    """Its worker, whoever edits, asks for the task, pushes, holds or moves the arm."""
    users, compute = set(), Memo.__call__

    def recorded(self, *args, **kwargs):
        users.add(threading.current_thread().name)
        return compute(self, *args, **kwargs)

    monkeypatch.setattr(Memo, "__call__", recorded)
    engine = new_engine()
    session = Session(engine, lambda _engine, task: initial(task), "draw_s", cast(Any, Blank()))
    try:
        assert session.wait_idle(60)

        def move():
            while threads[0].is_alive() or threads[1].is_alive():
                engine.arm.advance(0.05, moves=True)

        def edit(number):
            session.edit("temperature", **changing(session.scenario, temperature=3.0 + number))
            session.choose_task(("draw_s", "lift_box")[number])
            assert session.task.name in {"draw_s", "lift_box"}
            engine.arm.push()
            engine.arm.hold(np.array([0.0, -0.5, 0.4]))
            engine.arm.release()

        threads = [threading.Thread(target=edit, args=(number,)) for number in range(2)]
        threads.append(threading.Thread(target=move))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert session.wait_idle(60)
    finally:
        session.close()
    assert users == {LANE}
