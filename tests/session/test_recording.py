"""What the robot has just done: the order of what is remembered, how much of it, and reads while it is written."""

import threading

import numpy as np
import pytest

from dt_viz.session.recording import LEAST, NUM_SAMPLES, SPAN, Recording

PERIOD = 1 / 20
WIDEST = 8
"""Largest number of joints of an arm."""


def recorded(num, period=PERIOD, joints=6):
    """A recording of so many samples, whose postures are their numbers."""
    recording = Recording()
    for k in range(num):
        add(recording, k, period, joints)
    return recording


def add(recording, k, period=PERIOD, joints=6):
    recording.add(period, np.full(joints, float(k)), np.full(joints, -float(k)), float(k), seeks=k % 2 == 0)


def past_of(recording):
    past = recording.past
    assert past is not None
    return past


@pytest.mark.parametrize("num", [2, 500, NUM_SAMPLES, NUM_SAMPLES + 1, 3 * NUM_SAMPLES + 7])
def test_the_samples_are_the_newest_in_their_order(num):
    past = past_of(recorded(num))
    numbers = np.arange(num - len(past.times), num)
    np.testing.assert_array_equal(past.q, np.tile(numbers[:, None], 6))
    np.testing.assert_array_equal(past.without, -past.q)
    np.testing.assert_array_equal(past.arrived, numbers)
    np.testing.assert_array_equal(past.seeks, numbers % 2 == 0)
    np.testing.assert_allclose(past.times, PERIOD * np.arange(len(numbers)), atol=1e-9)


@pytest.mark.parametrize("period", [1.01 * LEAST, PERIOD, 1 / 6, 7.0])
def test_the_last_minute_is_remembered_however_many_pictures_there_are(period):
    past = past_of(recorded(4000, period))
    assert SPAN - period < past.times[-1] <= SPAN + 1e-9
    assert past.q[-1, 0] == 3999


def test_a_minute_is_remembered_where_samples_come_faster():
    past = past_of(recorded(10_000, 0.01))
    assert SPAN - LEAST - 0.01 < past.times[-1] <= SPAN + 1e-9
    assert np.diff(past.times).min() >= LEAST and np.diff(past.q[:, 0]).max() <= np.ceil(LEAST / 0.01)


def test_it_begins_with_two_samples():
    assert recorded(0).past is None and recorded(1).past is None and len(past_of(recorded(2)).times) == 2


def test_what_was_read_stays_as_it_was():
    recording = recorded(NUM_SAMPLES)
    past = past_of(recording)
    before = past.q.copy()
    for k in range(NUM_SAMPLES):
        add(recording, -k)
    np.testing.assert_array_equal(past.q, before)


def test_a_read_during_a_write_is_of_whole_samples_in_their_order():
    recording, read, ends = recorded(NUM_SAMPLES), [], threading.Event()

    def write():
        k = NUM_SAMPLES
        while not ends.is_set():
            add(recording, k)
            k += 1

    writer = threading.Thread(target=write)
    writer.start()
    while len(read) < 300:
        read.append(past_of(recording))
    ends.set()
    writer.join()
    assert read[-1].q[-1, 0] > read[0].q[-1, 0] > 0
    for past in read:
        assert (np.diff(past.q[:, 0]) == 1).all() and (past.q == past.q[:, :1]).all()
        np.testing.assert_array_equal(past.without, -past.q)
        np.testing.assert_array_equal(past.arrived, past.q[:, 0])


def test_it_takes_less_than_400_kilobytes():
    recording = recorded(2, joints=WIDEST)
    assert recording._rows is not None and recording._rows.nbytes + recording._times.nbytes < 400e3
