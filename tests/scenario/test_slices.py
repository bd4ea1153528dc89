"""Slices: their pose goes round, and lines of a function lie where it has that value."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dt_viz.scenario.slices import Slice, SlicePose, level_line
from dt_viz.scenario.tasks import TASKS

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
