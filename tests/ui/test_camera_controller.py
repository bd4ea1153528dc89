"""The controller: what moves a visitor's camera, and what does not."""

import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pages import CameraClient, camera_for

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene.camera import HOME, MOVED, PAUSE, TURN, CameraController

TASK = TASKS["draw_s"]()
HAND = np.array([0.1, -0.4, 0.3])
ELSEWHERE = (1.0, -1.0, 1.0)


@pytest.fixture
def client():
    return CameraClient()


@pytest.fixture
def controller(client):
    controller = CameraController(cast(Any, client), lambda: HAND)
    controller.look(TASK)
    return controller


def is_at(client, pose, within=1e-9):
    return bool(np.abs(np.stack([client.camera.position, client.camera.look_at]) - pose).max() <= within)


@pytest.mark.parametrize("view", ["Front", "Side", "Top", "Hand", "Home"])
def test_a_view_is_fitted_to_a_window_of_another_size_unless_the_visitor_has_moved_the_camera(client, controller, view):
    controller.view(view)
    assert is_at(client, camera_for(TASK, client.camera, view, hand=HAND))
    client.camera.image_width = 700
    client.moves(client.camera.position, client.camera.look_at)
    narrow = camera_for(TASK, client.camera, view, hand=HAND)
    assert is_at(client, narrow)
    client.moves(ELSEWHERE)
    client.camera.image_width = 1280
    client.moves(ELSEWHERE)
    assert is_at(client, (ELSEWHERE, np.zeros(3)))
    controller.view(view)
    assert is_at(client, camera_for(TASK, client.camera, view, hand=HAND)) and not is_at(client, narrow, 0.01)


def test_a_window_that_is_measured_before_the_camera_has_come_is_fitted_when_it_has(client, controller):
    client.camera.image_width, client.camera.image_height = 780, 1688
    put = client.camera.position, client.camera.look_at
    client.moves((3.0, 3.0, 3.0))  # where a page's camera is at first
    controller.measured(390)
    client.moves(*put)
    size = controller.framing.size
    assert size == (390, 844)
    phone = SimpleNamespace(image_width=size[0], image_height=size[1])
    assert is_at(client, camera_for(TASK, phone))
    client.camera.image_width, client.camera.image_height = 585, 1266  # drawn coarser, to be as quick
    client.moves(client.camera.position, client.camera.look_at)
    assert is_at(client, camera_for(TASK, phone), 1e-2) and not is_at(client, camera_for(TASK, client.camera), 1e-2)


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
    client.moves(ELSEWHERE)
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
    client.camera.position = None
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


@pytest.mark.parametrize("place", [(np.nan, 0, 0), (1e9, 0, 0), ("far", 0, 0)])
def test_a_pose_that_no_camera_has_is_not_gone_on_from(client, controller, place):
    controller.orbits = True
    controller.turn(time.monotonic())
    client.moves(place)
    controller.turn(time.monotonic() + 1)
    home, _ = camera_for(TASK, client.camera)
    assert np.abs(client.camera.position - home).max() < 2 * TURN
