"""A property computed once: kept, and never waited for."""

import threading
from concurrent.futures import ThreadPoolExecutor

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


def test_it_is_computed_once_for_each_instance_and_documented_on_the_class():
    one, other = Holder(), Holder()
    assert one.value is one.value
    assert one.value is not other.value
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
    waits = other.is_alive()
    ready.set()
    thread.join(PATIENCE)
    assert not waits


def test_threads_that_compute_it_at_the_same_time_get_the_same_value():
    barrier = threading.Barrier(4)
    holder = Holder(lambda: barrier.wait(PATIENCE))
    with ThreadPoolExecutor(4) as pool:
        seen = list(pool.map(lambda _: holder.value, range(4)))
    assert len(set(map(id, seen))) == 1
