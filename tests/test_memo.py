"""Results that are kept, by what they were computed from."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from dt_viz.memo import Memo, cached_property


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


def on_two_threads(function):
    """What a function returns on two threads at once."""
    with ThreadPoolExecutor(2) as pool:
        return [called.result() for called in [pool.submit(function) for _ in range(2)]]


def test_two_threads_that_compute_a_result_at_once_get_the_same_one():
    memo, together = Memo(), threading.Barrier(2)
    one, other = on_two_threads(lambda: memo("a", 1, lambda: (together.wait(60), object())))
    assert one is other


class Value:
    """Something with a property that takes as long as its function."""

    def __init__(self, compute):
        self.compute = compute

    @cached_property
    def computed(self):
        """What the function returns."""
        return self.compute()


def test_a_property_that_takes_long_delays_no_other_instance():
    begun, ended = threading.Event(), threading.Event()
    slow, quick = Value(lambda: begun.set() or ended.wait(60)), Value(lambda: "there")
    with ThreadPoolExecutor(2) as pool:
        pool.submit(lambda: slow.computed)
        try:
            assert begun.wait(60)
            assert pool.submit(lambda: quick.computed).result(30) == "there"
        finally:
            ended.set()


def test_a_property_is_computed_once_and_by_two_threads_at_once_it_is_the_same_object():
    made, together = [], threading.Barrier(2)
    value = Value(lambda: made.append(together.wait(60)) or object())
    one, other = on_two_threads(lambda: value.computed)
    assert one is other is value.computed and len(made) == 2
    assert isinstance(Value.computed, cached_property) and Value.computed.__doc__ == "What the function returns."
