"""The way of the arm in the loop, without a browser."""

import numpy as np
import pytest

from dt_viz.ui.scene import palette
from dt_viz.ui.scene.rollouts import Middles
from dt_viz.ui.scene.way import BESIDE, PERIOD, STEP, TRAIL_SECONDS, WayAhead

AHEAD = np.linspace([0.0, 0.0, 0.3], [0.2, 0.0, 0.3], 5)


@pytest.fixture(name="middles")
def _middles():
    return Middles()


@pytest.fixture(name="way")
def _way(scene, middles):
    return WayAhead(scene, middles)


def moved(way, seconds, speed=0.1, begins=0.0):
    """Move the hand along the x axis; return where it is."""
    times = np.arange(begins, begins + seconds, 0.04)
    for t in times:
        way.show(t, np.array([speed * t, 0.0, 0.0]), lambda: AHEAD)
    return float(speed * times[-1])


def test_the_way_ahead_is_drawn_as_it_is(way):
    way.show(0.0, AHEAD[0], lambda: AHEAD)
    np.testing.assert_allclose(way.ahead.node.points, np.stack([AHEAD[:-1], AHEAD[1:]], axis=1))
    way.show(PERIOD / 2, AHEAD[1], lambda: AHEAD[1:])
    assert len(way.ahead.node.points) == 4  # it is sent a few times a second only
    way.show(PERIOD, AHEAD[1], lambda: AHEAD[1:])
    assert len(way.ahead.node.points) == 3


@pytest.mark.parametrize(("off", "drawn"), [(0.5 * BESIDE, 0), (1.5 * BESIDE, 4)])
def test_the_way_ahead_is_not_drawn_along_a_rollout(way, middles, off, drawn):
    middles.of((AHEAD + np.array([0.0, off, 0.0]),))
    way.show(0.0, AHEAD[0], lambda: AHEAD)
    assert len(way.ahead.node.points) == drawn


def test_the_trail_is_where_the_hand_was_and_fades(way):
    here = moved(way, 10.0)
    trail = way._trail.points
    assert here - trail[-1, 1, 0] <= 0.1 * PERIOD + 1e-6
    assert trail[0, 0, 0] == pytest.approx(here - 0.1 * TRAIL_SECONDS, abs=2 * STEP + 0.1 * PERIOD)
    np.testing.assert_allclose(trail[1:, 0], trail[:-1, 1])
    green = way._trail.colors[:, 0, 1].astype(int)
    assert (np.diff(green) <= 0).all()
    assert green[-1] - palette.linear(palette.WAY)[1] < 20
    assert palette.linear(palette.WAY_FADED)[1] - green[0] < 40


def test_the_trail_of_a_hand_at_rest_goes(way):
    here = np.array([moved(way, 3.0), 0.0, 0.0])
    for t in np.arange(3.0, 3.0 + TRAIL_SECONDS + 2 * PERIOD, PERIOD):
        way.show(t, here, lambda: AHEAD)
    assert np.ptp(way._trail.points, axis=1).max(initial=0.0) == 0
    moved(way, 1.0, begins=6.0)
    way.forget()
    way.show(8.0, here, lambda: AHEAD)
    assert np.ptp(way._trail.points, axis=1).max(initial=0.0) == 0
