"""The camera: what is to be seen of a task fills the part of the window that the panel leaves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pages import camera_for

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene.camera import (
    HAND,
    HOME,
    VIEWS,
    Framing,
    axes,
    framed,
    places_of,
    shot_beside,
    shot_of,
    turned,
    window_size,
)


def screen(size):
    return SimpleNamespace(image_width=size[0], image_height=size[1])


def pixels(points, position, look_at, size):
    """(N, 2) columns and rows, as three.js projects them, and the depth (N,)."""
    ahead = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    seen = (points - position) @ np.stack([right, np.cross(ahead, right), ahead], axis=1)
    focal = size[1] / 2 / np.tan(Framing.field_of_view / 2)
    return seen[:, :2] / seen[:, 2:] * focal + np.array(size) / 2, seen[:, 2]


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080), (844, 390), (390, 844), (900, 560)], ids=str)
@pytest.mark.parametrize(("task", "view"), [*((task, HOME) for task in TASKS), *(("lift_box", view) for view in VIEWS)])
def test_a_task_is_seen_beside_the_panel_and_as_large_as_can_be(task, view, size):
    task = TASKS[task]()
    camera = screen(size)
    at, depth = pixels(places_of(task), *camera_for(task, camera, view), size)
    narrow = size[0] < Framing.narrow
    low, high = (
        np.zeros(2),
        np.array(size) - [0 if narrow else Framing.panel, Framing.under * narrow * size[1]],
    )
    assert depth.min() > 0.1
    room = Framing.margin * (high - low)
    assert (at.min(axis=0) > low + room - 1).all() and (at.max(axis=0) < high - room + 1).all()
    empty = (high - low - 2 * room - np.ptp(at, axis=0)) / (high - low)
    assert empty.min() < 0.01


@pytest.mark.parametrize("size", [(1600, 900), (390, 844), (844, 390)], ids=str)
def test_a_presentation_shows_the_task_above_the_caption_in_all_of_the_width(size):
    task, camera = TASKS["draw_s"](), screen(size)
    at, _ = pixels(places_of(task), *camera_for(task, camera, alone=True), size)
    high = np.array([size[0], size[1] * (1 - Framing.caption)])
    room = Framing.margin * high
    assert (at.min(axis=0) > room - 1).all() and (at.max(axis=0) < high - room + 1).all()
    assert (np.ptp(at, axis=0) > high - 2 * room - 2).any()


@pytest.mark.parametrize("task", TASKS)
def test_the_hand_is_seen_from_near_in_the_middle_of_the_free_part_and_from_the_side_of_the_task(task):
    size = 1280, 720
    task, camera, hand = TASKS[task](), screen(size), (0.1, -0.4, 0.3)
    near, home = (camera_for(task, camera, view, hand=np.array(hand)) for view in (HAND, HOME))
    assert np.linalg.norm(near[0] - hand) < 0.8 * np.linalg.norm(home[0] - home[1])
    assert np.cross(near[1] - near[0], home[1] - home[0]) == pytest.approx(np.zeros(3), abs=1e-9)
    (at,), _ = pixels(np.array([hand]), *near, size)
    assert at == pytest.approx([(size[0] - Framing.panel) / 2, size[1] / 2], abs=60)


@pytest.mark.parametrize("size", [(1280, 720), (390, 844)], ids=str)
def test_what_is_in_the_middle_of_the_free_part_stays_there_while_the_camera_turns(size):
    pose = np.array([0.8, -1.6, 0.8]), np.array([0.0, -0.3, 0.3])
    across, upright = (tangents.mean() for tangents in Framing(size).free)
    focal = size[1] / 2 / np.tan(Framing.field_of_view / 2)
    middle = np.array(size) / 2 + focal * np.array([across, -upright])
    places = []
    for angle in (0.0, 0.4, 2.0, 2 * np.pi):
        position, look_at = turned(pose, Framing(size), angle)
        ahead, right, up = axes(look_at - position)
        places.append(position + np.linalg.norm(look_at - position) * (ahead + across * right + upright * up))
        assert pixels(places[:1], position, look_at, size)[0] == pytest.approx(middle[None], abs=1e-6)
        assert position[2] == pose[0][2] and look_at[2] == pose[1][2]
    assert places == pytest.approx(np.tile(places[0], (4, 1)))
    assert position == pytest.approx(pose[0]) and turned(pose, Framing(size), 1.0)[0] != pytest.approx(pose[0], abs=0.1)


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
        x, y = (at - 1).T * np.tan(Framing.field_of_view / 2) * [[1], [-1]]
        inside = [across[0] - 1e-9 <= x.min(), x.max() <= across[1] + 1e-9]
        return bool(depth.min() > 0 and all(inside) and upright[0] - 1e-9 <= y.min() and y.max() <= upright[1] + 1e-9)

    assert sees_all(position)
    for aside in np.concatenate([np.zeros((1, 3)), rng.normal(scale=0.1, size=(30, 3))]):
        assert not sees_all(position + 1e-3 * ahead + aside - (aside @ ahead) * ahead)


@pytest.mark.parametrize("size", [(0, 0), (10, 720), (np.nan, 720), ("wide", 720), (10**9, 720), (None, None)])
def test_a_size_that_no_window_has_is_not_believed(size):
    assert window_size(screen(size)) == Framing.size


@pytest.mark.parametrize("window", [(1280, 720), (1920, 1080), (390, 844)], ids=str)
@pytest.mark.parametrize("size", [(1920, 1080), (1280, 1280), (600, 1200)], ids=str)
def test_a_saved_picture_has_in_its_middle_what_is_seen_beside_the_panel(window, size):
    """Points of the plane at which the camera looks: the free part's corners touch two of the picture's borders."""
    framing, pose = replace(Framing(window), margin=0.0), camera_for(TASKS["lift_box"](), screen(window))
    straight = shot_of(pose)
    taken = shot_beside(pose, straight.wxyz, Framing(window), size)
    ahead, right, up = axes(pose[1] - pose[0])
    depth = np.linalg.norm(pose[1] - pose[0])
    across, upright = framing.free
    corners = [pose[0] + depth * (ahead + x * right + y * up) for x in across for y in upright]
    offsets = (np.array(corners) - taken.position) @ np.stack([right, up], axis=1) / depth / np.tan(taken.fov / 2)
    offsets[:, 0] *= size[1] / size[0]  # from -1 to 1 in the picture
    assert offsets.mean(axis=0) == pytest.approx([0, 0], abs=1e-9)
    assert np.abs(offsets).max() == pytest.approx(1, abs=1e-9)
