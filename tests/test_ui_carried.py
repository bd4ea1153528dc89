"""The ball that the hand carries to the pots, without a browser."""

import numpy as np
import pytest

from dt_viz.scenario.tasks import POTS
from dt_viz.ui.scene.carried import RADIUS, Carried, fallen
from dt_viz.ui.scene.pots import WALL

LEFT = np.array([POTS[0].x, POTS[0].y, 0.25])
BETWEEN = np.array([(POTS[0].x + POTS[1].x) / 2, POTS[0].y, 0.25])


@pytest.mark.parametrize(("place", "bottom"), [(LEFT, WALL), (BETWEEN, 0.0)])
def test_the_ball_falls_straight_down_faster_and_faster_and_rests_in_the_pot_or_on_the_table(place, bottom):
    seconds = np.linspace(0, 0.8, 81)
    path = np.stack([fallen(place, POTS, t) for t in seconds])
    np.testing.assert_array_equal(path[:, :2], np.broadcast_to(place[:2], (81, 2)))
    assert path[0, 2] == place[2]
    assert path[-1, 2] == pytest.approx(bottom + RADIUS)
    height = path[:, 2]
    falling = height > height[-1]
    np.testing.assert_allclose(np.diff(height[falling], 2), -9.81 * 0.01**2)
    assert seconds[~falling][0] < 0.3  # before the motion begins again


def test_what_is_let_go_of_below_where_it_would_rest_stays():
    low = np.array([0.3, -0.3, 0.01])
    np.testing.assert_array_equal(fallen(low, POTS, 1.0), low)


def test_it_is_shown_with_the_arm_in_tasks_with_pots_once_the_hand_is_known(scene):
    carried = Carried(scene)
    carried.stand(POTS)
    assert not carried.ball.visible
    carried.pose(LEFT, 0.0)
    assert carried.ball.visible
    np.testing.assert_allclose(carried.ball.position, LEFT)
    carried.show(arm=False)
    assert not carried.ball.visible
    carried.show(arm=True)
    carried.stand(())
    assert not carried.ball.visible


def test_it_stays_where_it_was_dropped_until_the_hand_sets_out_again(scene):
    carried = Carried(scene)
    carried.stand(POTS)
    carried.pose(LEFT, 0.0)
    for seconds in (0.5, 3.0):
        carried.pose(LEFT + np.array([0.1, 0.2, 0.1]), seconds)  # the hand goes home
        np.testing.assert_allclose(carried.ball.position, fallen(LEFT, POTS, seconds))
    carried.pose(BETWEEN, 0.0)
    np.testing.assert_allclose(carried.ball.position, BETWEEN)
