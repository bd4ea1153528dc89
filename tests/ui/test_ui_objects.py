"""The objects of a task, and what a pen draws, without a browser."""

import numpy as np
import pytest

from dt_viz.robot.robot import load_jaco
from dt_viz.scenario.tasks import POTS, TASKS
from dt_viz.ui.scene.drawing import PERIOD, STEP, Drawing
from dt_viz.ui.scene.objects import Objects

ROBOT = load_jaco()
DROP, PUSH, DRAW = (TASKS[name]() for name in ("drop_pots", "push_box", "draw_s"))
LEFT, RIGHT = (np.array([POTS[k].x, POTS[k].y, 0.25]) for k in (0, 2))


@pytest.fixture
def objects(scene):
    return Objects(scene)


def test_pots_are_drawn_for_tasks_that_have_some(objects):
    objects.stand(DRAW)
    assert objects.pots == ()
    objects.stand(DROP)
    assert [tuple(handle.position) for handle in objects.pots] == [(pot.x, pot.y, 0.0) for pot in POTS]
    before = objects.pots
    objects.stand(DROP)
    assert objects.pots is before
    objects.stand(DRAW)
    assert objects.pots == ()


def test_pots_are_open_above():
    for pot in POTS:
        vertices, faces = pot.surface()
        middles = vertices[faces].mean(axis=1)
        over_the_opening = np.linalg.norm(middles[:, :2], axis=1) < 0.9 * pot.radius
        assert over_the_opening.any() and middles[over_the_opening, 2].max() < 0.2 * pot.height


def test_the_ball_is_shown_with_the_arm_once_the_hand_is_known(objects):
    objects.stand(DROP)
    ((_, ball),) = objects.items
    assert not ball.visible
    objects.pose(LEFT, 0.0)
    assert ball.visible
    np.testing.assert_allclose(ball.position, LEFT)
    for shown in (False, True):
        objects.show(arm=shown)
        assert ball.visible == shown


def test_the_ball_stays_where_it_was_dropped_until_the_hand_sets_out_again(objects):
    objects.stand(DROP)
    ((thing, ball),) = objects.items
    objects.pose(LEFT, 0.0)
    for hand, seconds in ((LEFT, 0.5), (RIGHT, 3.0)):  # the hand goes home
        objects.pose(hand, seconds)
        np.testing.assert_allclose(ball.position, thing.fallen(LEFT, seconds))
    objects.pose(RIGHT, 0.0)
    np.testing.assert_allclose(ball.position, RIGHT)


def test_a_pushed_box_stays_at_the_goal_until_the_hand_sets_out_again(objects):
    objects.stand(PUSH)
    ((box, handle),) = objects.items
    np.testing.assert_array_equal(handle.position, box.start)
    path = PUSH.paths[0]
    for hand in path:
        objects.pose(hand, 0.0)
    pushed = np.array(handle.position)
    assert np.linalg.norm(pushed - box.start) > 0.3
    for hand in path[::-1]:
        objects.pose(hand, 1.0)
    np.testing.assert_array_equal(handle.position, pushed)
    objects.pose(path[0], 0.0)
    np.testing.assert_array_equal(handle.position, box.start)


class TestDrawing:
    @pytest.fixture
    def drawing(self, scene):
        drawing = Drawing(scene, "/hand", ROBOT.end_effector_offset)
        drawing.stand(DRAW)
        return drawing

    def drawn(self, drawing, path, arrived=0.0, begin=0.0):
        for k, hand in enumerate(path):
            drawing.pose(begin + PERIOD * 1.01 * k, hand, arrived)
        return drawing.ink.node.points

    def test_the_pen_leaves_ink_where_it_touches_the_board_only(self, drawing):
        path = np.array(DRAW.paths[0])
        lifted = slice(len(path) // 3, len(path) // 2)
        path[lifted] += 0.05 * DRAW.slice.normal
        ink = self.drawn(drawing, path)
        assert len(ink) > len(path) / 3
        inside = DRAW.paths[0][lifted][5:-5]
        assert np.linalg.norm(ink.mean(axis=1)[:, None] - inside, axis=2).min() > STEP
        assert np.linalg.norm(ink[:, 1] - ink[:, 0], axis=1).max() < 3 * STEP

    def test_the_board_is_wiped_when_the_hand_sets_out_again(self, drawing):
        path = DRAW.paths[0]
        whole = len(self.drawn(drawing, path))
        assert len(self.drawn(drawing, path[::-1], arrived=1.0, begin=100.0)) == whole  # on the way home
        drawing.pose(300.0, path[0], 0.0)
        assert len(drawing.ink.node.points) == 0

    def test_it_is_shown_with_the_arm_in_tasks_that_draw(self, drawing):
        def shown():
            return [node.visible for node in (drawing._board, drawing._pen, drawing.ink.node)]

        assert shown() == [True] * 3
        drawing.show(arm=False)
        assert shown() == [False] * 3
        drawing.show(arm=True)
        drawing.stand(PUSH)
        assert shown() == [False] * 3
        assert len(self.drawn(drawing, PUSH.paths[0])) == 0

    def test_the_pens_tip_is_the_end_effector(self, drawing):
        vertices = drawing._pen.vertices
        assert np.linalg.norm(vertices - ROBOT.end_effector_offset, axis=1).min() < 1e-6
        assert np.abs(vertices[:, 2]).max() <= np.abs(ROBOT.end_effector_offset[2]) + 1e-6
