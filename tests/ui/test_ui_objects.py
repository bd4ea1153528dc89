"""The objects of a task, what a pen draws, and the way of the arm in the loop, without a browser."""

import numpy as np
import pytest

from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import POTS, TASKS
from dt_viz.ui.scene.carried import (
    ALONG,
    INK_PERIOD,
    INK_STEP,
    PATH_PERIOD,
    TRAIL_SECONDS,
    TRAIL_STEP,
    Carried,
    HandPath,
)
from dt_viz.ui.scene.palette import LIGHT, linear
from dt_viz.ui.scene.tubes import RolloutTubes

ROBOT = load_jaco()
DROP, PUSH, DRAW = (TASKS[name]() for name in ("drop_pots", "push_box", "draw_s"))
LEFT, RIGHT = (np.array([POTS[k].x, POTS[k].y, 0.25]) for k in (0, 2))


@pytest.fixture
def carrying(scene):
    return Carried(scene, "/hand", ROBOT.end_effector_offset, ROBOT.hand_axis)


def pose(carrying, hand, arrived, moment=0.0):
    return carrying.pose(moment, hand, arrived, LIGHT)


def test_pots_are_drawn_for_tasks_that_have_some(carrying):
    carrying.stand(DRAW)
    assert carrying.pots == ()
    carrying.stand(DROP)
    assert [tuple(handle.position) for handle in carrying.pots] == [(pot.x, pot.y, 0.0) for pot in POTS]
    before = carrying.pots
    carrying.stand(DROP)
    assert carrying.pots is before
    carrying.stand(DRAW)
    assert carrying.pots == ()


def test_pots_are_open_above():
    for pot in POTS:
        vertices, faces = pot.surface()
        middles = vertices[faces].mean(axis=1)
        over_the_opening = np.linalg.norm(middles[:, :2], axis=1) < 0.9 * pot.radius
        assert over_the_opening.any() and middles[over_the_opening, 2].max() < 0.2 * pot.height


def test_the_ball_is_shown_with_the_arm_once_the_hand_is_known(carrying):
    carrying.stand(DROP)
    ((_, ball),) = carrying.items
    assert not ball.visible
    pose(carrying, LEFT, 0.0)
    assert ball.visible
    np.testing.assert_allclose(ball.position, LEFT)
    for shown in (False, True):
        carrying.show(arm=shown)
        assert ball.visible == shown


def test_the_ball_stays_where_it_was_dropped_until_the_hand_sets_out_again(carrying):
    carrying.stand(DROP)
    ((thing, ball),) = carrying.items
    pose(carrying, LEFT, 0.0)
    for hand, seconds in ((LEFT, 0.5), (RIGHT, 3.0)):  # the hand goes home
        pose(carrying, hand, seconds)
        np.testing.assert_allclose(ball.position, thing.fallen(LEFT, seconds))
    pose(carrying, RIGHT, 0.0)
    np.testing.assert_allclose(ball.position, RIGHT)


def test_a_pushed_box_stays_at_the_goal_until_the_hand_sets_out_again(carrying):
    carrying.stand(PUSH)
    ((box, handle),) = carrying.items
    np.testing.assert_array_equal(handle.position, box.start)
    path = PUSH.paths[0]
    for hand in path:
        pose(carrying, hand, 0.0)
    pushed = np.array(handle.position)
    assert np.linalg.norm(pushed - box.start) > 0.3
    for hand in path[::-1]:
        pose(carrying, hand, 1.0)
    np.testing.assert_array_equal(handle.position, pushed)
    pose(carrying, path[0], 0.0)
    np.testing.assert_array_equal(handle.position, box.start)


class TestDrawing:
    @pytest.fixture
    def carrying(self, carrying):
        carrying.stand(DRAW)
        return carrying

    def drawn(self, carrying, path, arrived=0.0, begin=0.0):
        for k, hand in enumerate(path):
            pose(carrying, hand, arrived, begin + INK_PERIOD * 1.01 * k)
        return carrying.drawing.ink.node.points

    def test_the_pen_leaves_ink_where_it_touches_the_board_only(self, carrying):
        path = np.array(DRAW.paths[0])
        lifted = slice(len(path) // 3, len(path) // 2)
        path[lifted] += 0.05 * DRAW.slice.normal
        ink = self.drawn(carrying, path)
        assert len(ink) > len(path) / 3
        inside = DRAW.paths[0][lifted][5:-5]
        assert np.linalg.norm(ink.mean(axis=1)[:, None] - inside, axis=2).min() > INK_STEP
        assert np.linalg.norm(ink[:, 1] - ink[:, 0], axis=1).max() < 3 * INK_STEP

    def test_the_board_is_wiped_when_the_hand_sets_out_again(self, carrying):
        path = DRAW.paths[0]
        whole = len(self.drawn(carrying, path))
        assert len(self.drawn(carrying, path[::-1], arrived=1.0, begin=100.0)) == whole  # on the way home
        pose(carrying, path[0], 0.0, 300.0)
        assert len(carrying.drawing.ink.node.points) == 0

    def test_it_is_shown_with_the_arm_in_tasks_that_draw(self, carrying):
        drawing = carrying.drawing

        def shown():
            return [node.visible for node in (drawing.board, drawing._pen, drawing.ink.node)]

        assert shown() == [True] * 3
        carrying.show(arm=False)
        assert shown() == [False] * 3
        carrying.show(arm=True)
        carrying.stand(PUSH)
        assert shown() == [False] * 3
        assert len(self.drawn(carrying, PUSH.paths[0])) == 0

    def test_the_pens_tip_is_the_end_effector(self, carrying):
        vertices = carrying.drawing._pen.vertices
        assert np.linalg.norm(vertices - ROBOT.end_effector_offset, axis=1).min() < 1e-6
        assert np.abs(vertices[:, 2]).max() <= np.abs(ROBOT.end_effector_offset[2]) + 1e-6


# --- The way of the arm in the loop ---


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
