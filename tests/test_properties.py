"""A property computed once: kept, and never waited for."""

import threading

from dt_viz.properties import cached_property

PATIENCE = 30
"""Seconds after which a test gives up; nothing takes that long."""


class Holder:
    """Computes a value that waits for something else."""

    def __init__(self, before=lambda: None):
        self._before = before

    @cached_property
    def value(self):
        """A new object."""
        self._before()
        return object()


def test_it_is_computed_once_for_each_instance():
    one, other = Holder(), Holder()
    assert one.value is one.value
    assert one.value is not other.value


def test_it_is_documented_on_the_class():
    assert Holder.value.__doc__ == "A new object."


def test_what_one_instance_computes_keeps_no_other_waiting():
    """`functools.cached_property` of Python 3.10 and 3.11 fails here."""
    ready, started = threading.Event(), threading.Event()
    slow = Holder(lambda: (started.set(), ready.wait(PATIENCE)))
    thread = threading.Thread(target=lambda: slow.value, daemon=True)
    thread.start()
    assert started.wait(PATIENCE)
    other = threading.Thread(target=lambda: Holder().value, daemon=True)
    other.start()
    other.join(PATIENCE / 2)
    try:
        assert not other.is_alive()
    finally:
        ready.set()
        thread.join(PATIENCE)


def test_threads_that_compute_it_at_the_same_time_get_the_same_value():
    barrier, seen = threading.Barrier(4), []
    holder = Holder(lambda: barrier.wait(PATIENCE))
    threads = [threading.Thread(target=lambda: seen.append(holder.value), daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert len(seen) == len(threads)
    assert len(set(map(id, seen))) == 1
