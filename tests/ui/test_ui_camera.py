"""The camera: what is to be seen of a task fills the free part of the window; what moves it, and what does not."""

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pages import CameraClient, camera_for

from dt_viz.scenario.tasks import TASKS
from dt_viz.session.teaching import board_of
from dt_viz.ui.scene.camera import (
    HAND,
    HOME,
    LOWEST,
    MOVED,
    PAUSE,
    TURN,
    VIEWS,
    CameraController,
    Framing,
    axes,
    followed,
    framed,
    places_of,
    shot_beside,
    shot_of,
    turned,
    view_of,
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


@pytest.mark.parametrize("size", [(1280, 720), (390, 844), (844, 390)], ids=str)
@pytest.mark.parametrize("shown", [HOME, *VIEWS, "panel", "board"])
def test_no_view_is_from_under_the_table(shown, size, robot):
    """What is seen of a phone's window lies over the panel, so a level camera would be far below it."""
    framing, board = Framing(size), board_of(robot)
    for task in (make() for make in TASKS.values()):
        panels = {"panel": [task.slice], "board": [board]}.get(shown, [])
        pose = view_of(task, framing, shown, panels)
        assert pose[0][2] >= LOWEST
        at, depth = pixels(panels[0].border if panels else places_of(task), *pose, size)
        covered = [0, Framing.under * size[1]] if size[0] < Framing.narrow else [Framing.panel, 0]
        assert depth.min() > 0.1 and (at > 0).all() and (at < np.subtract(size, covered)).all()


def test_who_follows_on_a_phone_does_not_look_from_under_the_table_either(robot):
    task, own = TASKS["draw_s"](), Framing((390, 844))
    before = view_of(task, Framing(), panels=[board_of(robot)])
    assert followed(before, Framing(), own)[0][2] >= LOWEST


@pytest.mark.parametrize("ratio", [1, 2, 3])
def test_a_phone_whose_width_is_not_known_yet_is_narrow(ratio):
    framing = Framing(window_size(screen((ratio * 390, ratio * 844))))
    assert framing.size[0] < Framing.narrow
    assert np.ravel(framing.free) == pytest.approx(np.ravel(Framing((390, 844)).free), rel=1e-2)
    assert window_size(screen((1400, 2000)), 700.0) == (700, 1000)


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


@pytest.mark.parametrize("size", [(0, 0), (10, 720), (np.nan, 720), (10**9, 720), (None, None)])
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


# --- What moves a visitor's camera ---


TASK = TASKS["draw_s"]()
GRIP = np.array([0.1, -0.4, 0.3])
ELSEWHERE = (1.0, -1.0, 1.0)


@pytest.fixture
def client():
    return CameraClient()


@pytest.fixture
def controller(client):
    controller = CameraController(cast(Any, client), lambda: GRIP)
    controller.look(TASK)
    return controller


def is_at(client, pose, within=1e-9):
    return bool(np.abs(np.stack([client.camera.position, client.camera.look_at]) - pose).max() <= within)


@pytest.mark.parametrize("view", ["Front", "Side", "Top", "Hand", "Home"])
def test_a_view_is_fitted_to_a_window_of_another_size_unless_the_visitor_has_moved_the_camera(client, controller, view):
    controller.view(view)
    assert is_at(client, camera_for(TASK, client.camera, view, hand=GRIP))
    client.camera.image_width = 700
    client.moves(client.camera.position, client.camera.look_at)
    narrow = camera_for(TASK, client.camera, view, hand=GRIP)
    assert is_at(client, narrow)
    client.moves(ELSEWHERE)
    client.camera.image_width = 1280
    client.moves(ELSEWHERE)
    assert is_at(client, (ELSEWHERE, np.zeros(3)))
    controller.view(view)
    assert is_at(client, camera_for(TASK, client.camera, view, hand=GRIP)) and not is_at(client, narrow, 0.01)


def test_a_window_that_is_measured_before_the_camera_has_come_is_fitted_when_it_has(client, controller):
    client.camera.image_width, client.camera.image_height = 1400, 2000
    put = client.camera.position, client.camera.look_at
    client.moves((3.0, 3.0, 3.0))  # where a page's camera is at first
    controller.measured(700)
    client.moves(*put)
    tablet, phone = (view_of(TASK, Framing(size)) for size in ((700, 1000), (400, 571)))
    assert controller.framing.size == (700, 1000)
    assert is_at(client, tablet)
    client.camera.image_width, client.camera.image_height = 1050, 1500  # drawn coarser, to be as quick
    client.moves(client.camera.position, client.camera.look_at)
    assert is_at(client, tablet, 1e-2) and not is_at(client, phone, 1e-2)


@pytest.fixture
def visited():
    """A camera that stands where viser puts it at first, its controller, and what is noted of it."""
    client, noted = CameraClient(), []
    client.camera.position, client.camera.look_at = np.array([3.0, 3.0, 3.0]), np.zeros(3)
    controller = CameraController(cast(Any, client), lambda: GRIP, moved=lambda: noted.append(controller.chosen))
    controller.look(TASK)
    return client, controller, noted


def test_a_report_from_before_the_page_has_drawn_is_no_move(visited):
    """viser's page reports a look-at as soon as it has it, and a position once it has drawn."""
    client, controller, noted = visited
    home = client.camera.position, client.camera.look_at
    client.moves((3.0, 3.0, 3.0), home[1])
    assert controller.chosen is None
    client.moves(*home)
    controller.view("Front")
    front = client.camera.position, client.camera.look_at
    noted.clear()
    client.moves(home[0], front[1])
    client.moves(*front)
    assert not noted and is_at(client, front)
    client.moves(ELSEWHERE, front[1])
    (chosen,) = noted
    np.testing.assert_array_equal(chosen, [ELSEWHERE, front[1]])


def test_it_is_noted_too_that_the_camera_is_back_where_it_was_put(visited):
    """What is kept in the browser must not stay another pose."""
    client, _, noted = visited
    home = client.camera.position, client.camera.look_at
    client.moves(*home)
    client.moves(ELSEWHERE)
    client.moves(*home)
    assert [chosen is None for chosen in noted] == [False, True]


def test_another_task_or_a_reset_begins_with_its_own_view(client, controller):
    controller.view("Top")
    controller.look(TASK)
    assert is_at(client, camera_for(TASK, client.camera, HOME))


def test_a_locked_camera_is_put_back_and_still_takes_its_views(client, controller):
    client.moves(ELSEWHERE)
    controller.locked = True
    for move in (((0.9, -1.0, 1.0),), (ELSEWHERE, (0.0, 0.0, 0.1))):  # or turned on the spot
        client.moves(*move)
        assert is_at(client, (ELSEWHERE, np.zeros(3)))
    controller.view("Front")
    front = camera_for(TASK, client.camera, "Front")
    assert is_at(client, front)
    client.moves((0.8, -1.0, 1.0))
    assert is_at(client, front)
    controller.locked = False
    client.moves(ELSEWHERE)
    assert is_at(client, (ELSEWHERE, np.zeros(3)))


def test_the_orbit_turns_the_camera_at_an_even_speed_until_it_ends(client, controller):
    before, now = client.camera.position, time.monotonic()
    controller.turn(now + 1)
    assert client.camera.position is before
    controller.orbits = True
    for seconds in (1.0, 1.5, 3.0):
        controller.turn(now + seconds)
    moved, (_, look_at) = client.camera.position - before, camera_for(TASK, client.camera)
    assert moved[2] == pytest.approx(0, abs=1e-9)
    assert 0.2 * 3 * TURN < np.linalg.norm(moved) / np.linalg.norm(before - look_at) < 1.5 * 3 * TURN
    first = client.camera.position
    controller.orbits = False
    controller.turn(now + 60)
    assert client.camera.position is first


def test_the_orbit_waits_for_the_hand_that_moves_the_camera_and_goes_on_from_there(client, controller):
    controller.orbits = True
    now = time.monotonic()
    controller.turn(now + 0.1)
    late = client.camera.position, client.camera.look_at
    controller.turn(now + 0.2)
    client.moves(*late)  # what it was given a moment ago is no move
    client.camera.position = np.full(3, np.nan)
    controller.turn(now + 0.3)
    assert client.camera.position is not None
    client.moves(ELSEWHERE)
    controller.turn(now + PAUSE - 0.1)
    assert is_at(client, (ELSEWHERE, np.zeros(3)))
    controller.turn(time.monotonic() + PAUSE + 0.5)
    assert MOVED < np.abs(client.camera.position - ELSEWHERE).max() < 2 * TURN


@pytest.mark.parametrize("orbits", [True, False])
def test_a_locked_camera_orbits_as_before(client, controller, orbits):
    controller.locked, controller.orbits = True, orbits
    controller.turn(time.monotonic() + 1)
    there = client.camera.position, client.camera.look_at
    client.moves(ELSEWHERE)
    assert is_at(client, there)
    controller.turn(time.monotonic() + 2)
    assert is_at(client, there) != orbits


@pytest.mark.parametrize("place", [(np.nan, 0, 0), (1e9, 0, 0)])
def test_a_pose_that_no_camera_has_is_not_gone_on_from(client, controller, place):
    controller.orbits = True
    controller.turn(time.monotonic())
    client.moves(place)
    controller.turn(time.monotonic() + 1)
    home, _ = camera_for(TASK, client.camera)
    assert np.abs(client.camera.position - home).max() < 2 * TURN
