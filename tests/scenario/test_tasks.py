"""Tasks beside the laws that all of them obey (tests/laws): those from files, pots, objects and slices."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from dt_viz.learning.demonstrations import Demonstration, DemonstrationError
from dt_viz.robot.inverse_kinematics import inverse_kinematics
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.objects import FINGERS, WALL, Ball, Hand, LiftedBox, PushedBox
from dt_viz.scenario.slices import Slice, SlicePose, level_line
from dt_viz.scenario.tasks import DRAWING_SIZE, POTS, TASKS, known_tasks, own_task


def write_shape(path, dim):
    """A file in the layout of the LASA data: seven straight motions to the origin, millimetres."""
    times = np.linspace(0, 2, 50)
    demos = np.empty((1, 7), dtype=object)
    for i in range(7):
        position = np.outer(np.linspace(40, 20, dim) + i, 1 - times / 2)
        demos[0, i] = {"pos": position, "vel": position, "acc": position, "t": times[None], "dt": 0.04}
    savemat(path, {"demos": demos, "dt": 0.04})


def test_each_file_of_a_folder_becomes_a_task_before_the_robot(tmp_path):
    write_shape(tmp_path / "Line.mat", 2)
    entry = known_tasks(tmp_path)["Line"]
    task = entry()
    assert entry.title == task.title == "LASA Line"
    points = np.concatenate(task.paths)
    assert np.ptp(points, axis=0).max() == pytest.approx(DRAWING_SIZE)
    assert np.ptp(points[:, 1]) < 1e-12  # the blackboard is y = const


def test_a_file_in_space_is_refused_and_named(tmp_path):
    write_shape(tmp_path / "Solid.mat", 3)
    with pytest.raises(DemonstrationError, match=r"Solid.mat: pos: found 3 coordinates; accepted: 2"):
        known_tasks(tmp_path)["Solid"]()


def test_the_arm_reaches_above_and_into_every_pot_which_catches_what_is_let_go_over_its_opening_only():
    robot, height = load_jaco(), TASKS["drop_pots"]().paths[0][-1, 2]
    for pot in POTS:
        for z in (pot.height + 0.05, height):
            q = inverse_kinematics(robot, np.array([pot.x, pot.y, z]))
            assert robot.hand_direction(q)[2] < -0.2
        over = np.array(pot.opening) + np.array([0.9 * pot.radius, 0.0, 0.1])
        assert pot.catches(over)
        assert not pot.catches(over + np.array([0.2 * pot.radius, 0.0, 0.0]))
        assert not pot.catches(over - np.array([0.0, 0.0, 0.11]))


def test_own_data_become_a_task_where_they_are_with_a_slice_and_a_camera_that_look_at_them():
    s = np.linspace(0, 1, 50)
    paths = [np.stack([0.3 * s - 0.1, 0.1 * k - 0.5 - 0.2 * s, 0.4 - 0.3 * s * (1 - s)], axis=1) for k in range(2)]
    task = own_task(tuple(Demonstration(2 * s, path, f"{k}") for k, path in enumerate(paths)))
    np.testing.assert_array_equal(task.paths[1], paths[1])
    np.testing.assert_allclose(task.slice.axes.T @ task.slice.axes, np.eye(2), atol=1e-12)
    assert task.slice.axes[2, 0] == pytest.approx(0, abs=1e-12)
    assert all((np.abs(task.slice.across(path)) < task.slice.half_size).all() for path in paths)
    eye, look_at = map(np.array, task.camera)
    assert np.linalg.norm(eye - look_at) > 1 and eye[2] > look_at[2]
    drawing = own_task(tuple(Demonstration(2 * s, path[:, :2], f"{k}") for k, path in enumerate(paths)))
    assert drawing.draws and drawing.title == task.title == "Own data"


@pytest.mark.parametrize("name", ["draw_s", "push_box", "drop_pots"])
def test_a_placed_task_is_the_same_one_scaled_and_moved(name):
    task, scale, shift = TASKS[name](), 0.6, np.array([0.1, -0.05, 0.2])
    placed = task.placed(scale, shift)
    for found, path in zip(placed.paths, task.paths, strict=True):
        np.testing.assert_allclose(found, scale * path + shift, atol=1e-15)
    np.testing.assert_allclose(placed.slice.centre, scale * task.slice.centre + shift)
    np.testing.assert_allclose(placed.slice.half_size, scale * np.array(task.slice.half_size))
    for point, was in zip(placed.camera, task.camera, strict=True):
        np.testing.assert_allclose(point, scale * np.array(was) + shift)
    np.testing.assert_allclose(placed.obstacle_position, scale * np.array(task.obstacle_position) + shift)
    assert placed.demonstrations is task.demonstrations
    assert not placed.pots
    assert not placed.objects


# objects of the tasks: how the hand moves them


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


# slices: their pose goes round, and lines of a function lie where it has that value


numbers = st.floats(-1, 1)
poses = st.builds(
    lambda x, y, z, turn: SlicePose((x, y, z), tuple(np.roll(Rotation.from_rotvec(turn).as_quat(), 1).tolist())),
    numbers,
    numbers,
    numbers,
    st.tuples(*[st.floats(-3, 3)] * 3),
)


@given(poses)
def test_a_pose_goes_round(pose):
    home = TASKS["draw_s"]().slice
    moved = home.posed(pose)
    np.testing.assert_allclose(moved.axes.T @ moved.axes, np.eye(2), atol=1e-12)
    again = home.posed(moved.pose)
    np.testing.assert_allclose(again.grid(0.1), moved.grid(0.1), atol=1e-12)
    np.testing.assert_allclose(moved.across(moved.lattice(0.1)), home.across(home.lattice(0.1)), atol=1e-12)
    assert abs(moved.pose.position @ moved.normal - moved.centre @ moved.normal) < 1e-12


@pytest.mark.parametrize("task", list(TASKS))
def test_the_tasks_own_pose_leaves_the_slice_where_it_is(task):
    home = TASKS[task]().slice
    assert home.posed(None) is home
    np.testing.assert_allclose(home.posed(home.pose).border, home.border, atol=1e-12)
    assert home.key == replace(home).key != replace(home, half_size=(0.1, 0.1)).key


def test_level_lines_lie_where_the_function_has_that_value_and_not_where_it_has_none():
    rng = np.random.default_rng(1)
    normal, offset = rng.normal(size=3), 0.1
    points = np.stack([*np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 7), indexing="ij")], axis=-1)
    points = points @ rng.normal(size=(2, 3))
    segments = level_line(points, points @ normal - offset)
    assert len(segments) > 5
    np.testing.assert_allclose(segments @ normal, offset, atol=1e-12)
    points = Slice(np.zeros(3), np.eye(3)[:, :2], (1.0, 1.0)).grid(0.1)
    segments = level_line(points, np.where(points[..., 0] < 0.05, points[..., 1] - 0.03, np.nan))
    np.testing.assert_allclose(segments[..., 1], 0.03, atol=1e-12)
    assert np.ptp(segments[..., 0]) == pytest.approx(1.0) and segments[..., 0].max() < 0.05
