"""Objects of the tasks: how the hand moves them."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from dt_viz.scenario.objects import FINGERS, WALL, Ball, Hand, LiftedBox, PushedBox
from dt_viz.scenario.tasks import POTS, TASKS

BALL = Ball(POTS)
LEFT = np.array([POTS[0].x, POTS[0].y, 0.25])
BETWEEN = np.array([(POTS[0].x + POTS[1].x) / 2, POTS[0].y, 0.25])


def followed(thing, path, arrived=0.0):
    """Places of an object while the hand takes a path (T, 3)."""
    place, places = path[0] if thing.start is None else thing.start, []
    for before, now in pairwise(path):
        place = thing.moved(place, Hand(now, before, path[-1] if arrived else now, arrived))
        places.append(place)
    return np.array(places)


def between(*corners, samples=200):
    u = np.linspace(0, len(corners) - 1, samples)
    return np.stack([np.interp(u, range(len(corners)), axis) for axis in np.array(corners).T], axis=1)


@pytest.mark.parametrize("task", TASKS)
def test_surfaces_are_closed_and_face_outward(task):
    task = TASKS[task]()
    for thing in (*task.pots, *task.objects):
        mesh = trimesh.Trimesh(*thing.surface())
        mesh.merge_vertices()
        assert mesh.volume > 0 and mesh.is_winding_consistent


@pytest.mark.parametrize("task", ["push_box", "lift_box", "drop_pots"])
def test_each_demonstration_moves_its_object_without_a_jump(task):
    task = TASKS[task]()
    (thing,) = task.objects
    for path in task.paths:
        fine = between(*path, samples=2000)
        places = followed(thing, fine)
        steps, of_hand = (np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (places, fine[1:]))
        assert (steps <= 1.2 * of_hand.max() + 1e-9).all()
        assert np.linalg.norm(places[-1] - places[0]) > 0.25
        assert np.ptp(places[:, :2], axis=0).max() < 0.8


class TestBall:
    @pytest.mark.parametrize(("place", "bottom"), [(LEFT, WALL), (BETWEEN, 0.0)])
    def test_it_falls_straight_down_faster_and_faster_and_rests_in_the_pot_or_on_the_table(self, place, bottom):
        seconds = np.linspace(0, 0.8, 81)
        path = np.stack([BALL.fallen(place, t) for t in seconds])
        np.testing.assert_array_equal(path[:, :2], np.broadcast_to(place[:2], (81, 2)))
        assert path[0, 2] == place[2]
        assert path[-1, 2] == pytest.approx(bottom + BALL.radius)
        height = path[:, 2]
        falling = height > height[-1]
        np.testing.assert_allclose(np.diff(height[falling], 2), -9.81 * 0.01**2)
        assert seconds[~falling][0] < 0.3  # before the motion begins again

    def test_what_is_let_go_of_below_where_it_would_rest_stays(self):
        low = np.array([0.3, -0.3, 0.01])
        np.testing.assert_array_equal(BALL.fallen(low, 1.0), low)


class TestPushedBox:
    BOX = PushedBox((0.0, -0.5), (-1.0, 0.0))

    def test_it_is_pushed_ahead_of_the_fingers_and_stays_where_they_leave_it(self):
        path = between([0.3, -0.5, 0.1], [-0.2, -0.5, 0.1], [-0.2, -0.5, 0.4], [0.3, -0.5, 0.4])
        places = followed(self.BOX, path)
        gap = path[1:, 0] - places[:, 0]
        assert gap.min() > FINGERS + self.BOX.sizes[0] / 2 - 1e-9
        assert places[-1] == pytest.approx([-0.2 - FINGERS - 0.035, -0.5, 0.095])
        np.testing.assert_array_equal(places[70:] - places[-1], 0)

    @pytest.mark.parametrize(
        "path",
        [
            between([0.3, -0.5, 0.3], [-0.3, -0.5, 0.3]),  # above it
            between([0.3, -0.4, 0.1], [-0.3, -0.4, 0.1]),  # beside it
            between([-0.1, -0.5, 0.1], [-0.3, -0.5, 0.1]),  # ahead of it
        ],
    )
    def test_a_hand_that_passes_leaves_it(self, path):
        np.testing.assert_array_equal(followed(self.BOX, path) - self.BOX.start, 0)

    def test_it_is_taken_aside_by_friction_only(self):
        aside = between([0.06, -0.5, 0.1], [0.0, -0.5, 0.1], [-0.1, -0.3, 0.1])
        place = followed(self.BOX, aside)[-1]
        pushed = self.BOX.start[0] - place[0]
        assert 0 < place[1] + 0.5 <= 0.5 * pushed + 1e-9

    def test_before_a_hand_it_is_what_that_pushes_towards_the_goal(self):
        box = PushedBox.before(np.array([0.1, 0.2]), np.array([0.1, 0.9]))
        assert box.direction == pytest.approx((0, 1)) and box.middle == pytest.approx((0.1, 0.27))


class TestLiftedBox:
    BOX = LiftedBox((0.0, -0.5), 0.1)

    def test_it_rises_with_the_hand_once_that_has_been_inside(self):
        path = between([0.3, -0.3, 0.4], [0.0, -0.5, 0.1], [0.0, -0.5, 0.4])
        places = followed(self.BOX, path)
        assert places[:98, 2].max() == 0
        np.testing.assert_allclose(places[-1], [0, -0.5, 0.3], atol=0.01)
        place = places[-1]
        for now in between(path[-1], path[0]):
            place = self.BOX.moved(place, Hand(now, now, path[-1], 1.0))
        np.testing.assert_array_equal(place, places[-1])

    def test_a_hand_that_never_reached_in_leaves_it_and_it_is_never_taken_below_the_table(self):
        path = between([0.3, -0.3, 0.4], [0.0, -0.5, 0.2], [0.0, -0.5, 0.4])
        np.testing.assert_array_equal(followed(self.BOX, path) - self.BOX.start, 0)
        path = between([0.0, -0.5, 0.1], [0.0, -0.5, 0.15], [0.0, -0.5, 0.02])
        assert followed(self.BOX, path)[:, 2].min() >= 0
