"""Results that are kept, by what they were computed from."""

import pytest

from dt_viz.memo import Memo


def test_a_result_is_computed_once_and_kinds_do_not_mix():
    memo, made = Memo(), []
    for kind, key in (("a", 1), ("a", 1), ("b", 1), ("a", 2), ("b", 1)):
        assert memo(kind, key, lambda k=(kind, key): made.append(k) or k) == (kind, key)
    assert made == [("a", 1), ("b", 1), ("a", 2)]


def test_the_results_that_were_used_last_stay():
    memo, made = Memo(), []
    for key in (1, 2, 1, 3, 1, 2):
        memo("a", key, lambda key=key: made.append(key), newest=2)
    assert made == [1, 2, 3, 2]
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
