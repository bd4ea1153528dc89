"""The way of the arm in the loop, without a browser."""

import numpy as np
import pytest

from dt_viz.ui.scene.hand import ALONG, PATH_PERIOD, TRAIL_SECONDS, TRAIL_STEP, HandPath
from dt_viz.ui.scene.palette import LIGHT, linear
from dt_viz.ui.scene.tubes import RolloutTubes

AHEAD = np.linspace([0.0, 0.0, 0.3], [0.2, 0.0, 0.3], 5)


@pytest.fixture(name="way")
def _way(scene):
    return HandPath(scene)


def show(way, moment, hand, ahead=AHEAD, tubes=None):
    way.show(moment, hand, lambda: ahead, tubes or RolloutTubes(), LIGHT)


def moved(way, seconds, speed=0.1, begins=0.0):
    """Move the hand along the x axis; return where it is."""
    times = np.arange(begins, begins + seconds, 0.04)
    for t in times:
        show(way, t, np.array([speed * t, 0.0, 0.0]))
    return float(speed * times[-1])


def test_the_way_ahead_is_drawn_as_it_is(way):
    show(way, 0.0, AHEAD[0])
    np.testing.assert_allclose(way.ahead.node.points, np.stack([AHEAD[:-1], AHEAD[1:]], axis=1))
    show(way, PATH_PERIOD / 2, AHEAD[1], AHEAD[1:])
    assert len(way.ahead.node.points) == 4  # it is sent a few times a second only
    show(way, PATH_PERIOD, AHEAD[1], AHEAD[1:])
    assert len(way.ahead.node.points) == 3


@pytest.mark.parametrize(("off", "drawn"), [(0.5 * ALONG, 0), (1.5 * ALONG, 4)])
def test_the_way_ahead_is_not_drawn_along_a_rollout(way, off, drawn):
    show(way, 0.0, AHEAD[0], tubes=RolloutTubes((AHEAD + np.array([0.0, off, 0.0]),)))
    assert len(way.ahead.node.points) == drawn


def test_the_trail_is_where_the_hand_was_and_fades(way):
    here = moved(way, 10.0)
    trail = way._trail.points
    assert here - trail[-1, 1, 0] <= 0.1 * PATH_PERIOD + 1e-6
    assert trail[0, 0, 0] == pytest.approx(here - 0.1 * TRAIL_SECONDS, abs=2 * TRAIL_STEP + 0.1 * PATH_PERIOD)
    np.testing.assert_allclose(trail[1:, 0], trail[:-1, 1])
    green = way._trail.colors[:, 0, 1].astype(int)
    assert (np.diff(green) <= 0).all()
    assert green[-1] - linear(LIGHT.way)[1] < 20
    assert linear(LIGHT.way_faded)[1] - green[0] < 40


def test_the_trail_of_a_hand_at_rest_goes(way):
    here = np.array([moved(way, 3.0), 0.0, 0.0])
    for t in np.arange(3.0, 3.0 + TRAIL_SECONDS + 2 * PATH_PERIOD, PATH_PERIOD):
        show(way, t, here)
    assert np.ptp(way._trail.points, axis=1).max(initial=0.0) == 0
    moved(way, 1.0, begins=6.0)
    way.forget()
    show(way, 8.0, here)
    assert np.ptp(way._trail.points, axis=1).max(initial=0.0) == 0
