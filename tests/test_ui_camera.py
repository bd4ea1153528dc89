"""The camera: what is to be seen of a task fills the part of the window that the panel leaves."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene.camera import (
    FIELD_OF_VIEW,
    MARGIN,
    NARROW,
    PANEL,
    UNDER,
    USUAL,
    VIEWS,
    camera_for,
    framed,
    shown,
    window,
)


def pixels(points, position, look_at, size):
    """(N, 2) columns and rows, as three.js projects them, and the depth (N,)."""
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    seen = (points - position) @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    focal = size[1] / 2 / np.tan(FIELD_OF_VIEW / 2)
    return seen[:, :2] / seen[:, 2:] * focal + np.array(size) / 2, seen[:, 2]


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080), (844, 390), (390, 844), (900, 560)], ids=str)
@pytest.mark.parametrize("view", ["Home", *VIEWS])
@pytest.mark.parametrize("task", TASKS)
def test_a_task_is_seen_beside_the_panel_and_as_large_as_can_be(task, view, size):
    task = TASKS[task]()
    camera = SimpleNamespace(image_width=size[0], image_height=size[1])
    at, depth = pixels(shown(task), *camera_for(task, camera, view), size)
    narrow = size[0] < NARROW
    low, high = np.zeros(2), np.array([size[0] - (0 if narrow else PANEL), size[1] * (1 - UNDER * narrow)])
    assert depth.min() > 0.1
    room = MARGIN * (high - low)
    assert (at.min(axis=0) > low + room - 1).all() and (at.max(axis=0) < high - room + 1).all()
    empty = (high - low - 2 * room - np.ptp(at, axis=0)) / (high - low)
    assert empty.min() < 0.01


@given(st.integers(0, 1000))
def test_no_camera_nearer_by_sees_all_points(seed):
    rng = np.random.default_rng(seed)
    points, direction = rng.normal(size=(20, 3)), rng.normal(size=3)
    across, upright = np.array([-0.5, 0.2]), np.array([-0.3, 0.4])
    position, look_at = framed(points, direction, across, upright)
    ahead = direction / np.linalg.norm(direction)
    assert np.cross(look_at - position, ahead) == pytest.approx(np.zeros(3), abs=1e-9)

    def sees_all(place):
        at, depth = pixels(points, place, place + ahead, (2, 2))
        x, y = (at - 1).T * np.tan(FIELD_OF_VIEW / 2) * [[1], [-1]]
        inside = [across[0] - 1e-9 <= x.min(), x.max() <= across[1] + 1e-9]
        return bool(depth.min() > 0 and all(inside) and upright[0] - 1e-9 <= y.min() and y.max() <= upright[1] + 1e-9)

    assert sees_all(position)
    for aside in np.concatenate([np.zeros((1, 3)), rng.normal(scale=0.1, size=(30, 3))]):
        assert not sees_all(position + 1e-3 * ahead + aside - (aside @ ahead) * ahead)


@pytest.mark.parametrize("size", [(0, 0), (10, 720), (np.nan, 720), ("wide", 720), (10**9, 720), (None, None)])
def test_a_size_that_no_window_has_is_not_believed(size):
    assert window(SimpleNamespace(image_width=size[0], image_height=size[1])) == USUAL
