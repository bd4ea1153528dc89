"""Tasks beside the laws that all of them obey (tests/laws): those from files, and pots."""

import numpy as np
import pytest
from scipy.io import savemat

from dt_viz.learning.demonstrations import Demonstration, DemonstrationError
from dt_viz.robot.inverse_kinematics import inverse_kinematics
from dt_viz.robot.models import load_jaco
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
