"""Tasks: demonstrations and their place in the robot's world."""

import numpy as np
import pytest
from scipy.io import savemat

from dt_viz.demos import DemonstrationError
from dt_viz.tasks import DRAWING_SIZE, TASKS, lasa_tasks


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
    entry = lasa_tasks(tmp_path)["Line"]
    task = entry()
    assert entry.title == task.title == "LASA Line"
    points = np.concatenate(task.paths)
    assert np.ptp(points, axis=0).max() == pytest.approx(DRAWING_SIZE)
    assert np.ptp(points[:, 1]) < 1e-12  # the blackboard is y = const


def test_a_file_in_space_is_refused_and_named(tmp_path):
    write_shape(tmp_path / "Solid.mat", 3)
    with pytest.raises(DemonstrationError, match=r"Solid.mat: pos: found 3 coordinates; accepted: 2"):
        lasa_tasks(tmp_path)["Solid"]()


@pytest.mark.parametrize("name", TASKS)
def test_the_obstacle_first_stands_on_the_motion(name):
    task = TASKS[name]()
    distance = np.linalg.norm(np.concatenate(task.paths) - task.obstacle_position, axis=1)
    assert distance.min() < 0.03
