"""What processes tell each other: limits that hold for all together, and a lock that no killed process keeps."""

import multiprocessing
import os
import signal

import pytest

from dt_viz.serving.board import Board, Share

FORK = "fork" in multiprocessing.get_all_start_methods()


@pytest.fixture
def board():
    return Board(3, 4)


@pytest.fixture
def shares(board):
    return [Share(board, number) for number in range(3)]


def test_connections_of_all_processes_count_and_so_do_those_of_an_address(shares):
    numbers = [share.connect(address) for share, address in zip(shares, ("a", "b", "a"), strict=True)]
    second = shares[0].connect("a")
    for share in shares:
        assert (share.num_connections(), share.num_connections("a"), share.num_connections("c")) == (4, 3, 0)
    shares[0].disconnect(second)
    assert shares[2].num_connections("a") == 2
    for share, number in zip(shares, numbers, strict=True):
        share.disconnect(number)
    assert not shares[1].num_connections()


def test_no_address_is_no_connection_and_an_empty_one_counts(shares):
    number = shares[0].connect("")
    assert shares[1].num_connections() == 1
    shares[0].disconnect(number)
    assert shares[1].num_connections() == 0


def test_the_next_place_is_for_who_has_waited_longest_wherever(shares):
    first, second, third = shares
    first.seat(1, [5.0, 6.0])
    second.seat(0, [3.0])
    assert [first.num_before(came) for came in (3.0, 5.0, 6.0)] == [0, 1, 2]
    for share, expected in ((first, False), (second, True), (third, False)):
        with share.next_place(2) as is_free:
            assert is_free == expected
    second.seat(1, [])
    with first.next_place(2) as is_free:
        assert not is_free  # all places are taken
    assert (third.num_visitors, third.num_waiting) == (2, 2)
    assert [third.num_before(came) for came in (5.0, 6.0)] == [0, 1]
    second.seat(0, [])
    with first.next_place(2) as is_free:
        assert is_free


@pytest.mark.parametrize("num_places", range(1, 7))
def test_who_came_before_in_another_process_is_waited_for_only_where_he_needs_the_place(shares, num_places):
    first, second, third = shares
    first.seat(1, [5.0, 6.0])
    second.seat(0, [3.0, 4.0])
    for share, num_before in ((second, 0), (first, 2)):
        with share.next_place(num_places) as is_free:
            assert is_free == (1 + num_before < num_places)
    third.seat(1, [])
    with first.next_place(num_places) as is_free:
        assert is_free == (num_places > 4)


def test_the_row_of_a_process_that_has_ended_counts_no_more(board, shares):
    shares[1].seat(2, [1.0])
    shares[1].connect("a")
    board.clear(1)
    assert (shares[0].num_visitors, shares[0].num_waiting, shares[0].num_connections()) == (0, 0, 0)


def test_counts_only_grow_also_where_a_process_takes_the_place_of_another(board, shares):
    for share in shares[:2]:
        share.edited(3)
        share.answered(0.03)
    shares[1].refused()
    board.clear(1)
    counts = Share(board, 1).counts
    assert (counts["edits"], counts["refused"], counts["latency"]) == (6, 1, pytest.approx(0.06))
    assert counts["latencies"].tolist() == [0, 0, 2, *[0] * 7]
    Share(board, 1).edited(1)
    assert shares[0].counts["edits"] == 7


def test_the_first_process_prepares_then_all_others(shares):
    assert [share.may_prepare for share in shares] == [True, False, False]
    shares[1].prepared()
    assert not shares[2].may_prepare
    shares[0].prepared()
    assert all(share.may_prepare for share in shares)


@pytest.mark.skipif(not FORK, reason="no fork here")
def test_a_process_that_is_killed_with_the_lock_keeps_nobody_waiting(board, shares):
    context = multiprocessing.get_context("fork")
    has_it = context.Event()

    def hold():
        with shares[1].next_place(1):
            has_it.set()
            signal.pause()

    process = context.Process(target=hold)
    process.start()
    assert has_it.wait(30)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join(30)
    with shares[0].next_place(1) as is_free:
        assert is_free
