"""Tasks: demonstrations and their place in the robot's world."""

import numpy as np
import pytest
from scenes import changed
from scipy.io import savemat

from dt_viz.arm.robot import load_jaco
from dt_viz.arm.tracking import inverse_kinematics, track
from dt_viz.learning.demonstrations import DemonstrationError
from dt_viz.metrics import resample_by_arc_length
from dt_viz.scenario.tasks import DRAWING_SIZE, POTS, TASKS, lasa_tasks
from dt_viz.transforms.avoidance import SPACES
from dt_viz.warning import Kind


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
def test_the_obstacle_first_stands_in_the_way_of_the_motion(name, initial):
    scenario = initial(name)
    clearance = scenario.obstacle.signed_distance(np.concatenate(TASKS[name]().paths)).min()
    assert clearance < scenario.avoidance.margin


OTHER_LETTERS = [name for name in TASKS if name.startswith("draw_") and name != "draw_s"]
"""What the whole arm does for these is much the same as for S, and takes longest."""


def is_slow(name, space):
    """Whether this is as well shown by S."""
    return space != "task" and name in OTHER_LETTERS


@pytest.mark.parametrize(
    ("name", "space"),
    [pytest.param(name, space, marks=[pytest.mark.slow] * is_slow(name, space)) for name in TASKS for space in SPACES],
)
def test_the_obstacle_first_stands_where_hand_and_arm_find_a_way_to_the_goal(name, space, engine, initial):
    *_, frame = engine.frames(changed(initial(name), space=space))
    assert frame.blocked == ()
    # the margin is kept by the spheres that cover the arm, less what they stick out: the meshes may keep less of it
    meshes = frame.certificates.collision.warnings
    assert all(w.kind is Kind.ARM_TOO_NEAR or w in meshes for w in frame.certificates.warnings)
    np.testing.assert_allclose(frame.reached, frame.goal, atol=1e-3)
    if space != "task":
        least = 0.01 if name == "drop_pots" else 0.1  # there the arm only just grazes it
        assert meshes == () and frame.arm_duration > least  # it is in the arm's way, too


@pytest.mark.parametrize("name", TASKS)
def test_the_slice_lies_in_the_motion(name):
    task = TASKS[name]()
    offset = np.concatenate(task.paths) - task.slice.centre
    across = np.abs(offset @ np.cross(*task.slice.axes.T))
    along = np.abs(offset @ task.slice.axes)
    assert np.median(across) < 0.02
    assert (along < task.slice.half_size).all(axis=1).mean() > 0.75


@pytest.mark.parametrize("name", TASKS)
def test_the_arm_follows_every_demonstration_with_its_hand_sloping_down(name):
    task, robot = TASKS[name](), load_jaco()
    paths = np.stack([resample_by_arc_length(path, 100) for path in task.paths])
    starts = np.stack([inverse_kinematics(robot, start) for start in task.starts])
    joints = track(robot, paths, starts)
    assert joints.error.max() < 1e-4
    assert not joints.limits_hit.any() and not joints.damped.any()
    assert (robot.hand_direction(joints.q)[..., 2] < -0.2).all()
    assert (robot.forward_kinematics(joints.q)[1][..., 1:, 2] > 0.05).all()  # no joint near the table


def test_the_arm_reaches_above_and_into_every_pot():
    robot, height = load_jaco(), TASKS["drop_pots"]().paths[0][-1, 2]
    for pot in POTS:
        for z in (pot.height + 0.05, height):
            q = inverse_kinematics(robot, np.array([pot.x, pot.y, z]))
            assert robot.hand_direction(q)[2] < -0.2


def test_a_pot_catches_what_is_let_go_over_its_opening_only():
    pot = POTS[0]
    over = np.array(pot.opening) + np.array([0.9 * pot.radius, 0.0, 0.1])
    assert pot.catches(over)
    assert not pot.catches(over + np.array([0.2 * pot.radius, 0.0, 0.0]))
    assert not pot.catches(over - np.array([0.0, 0.0, 0.11]))
