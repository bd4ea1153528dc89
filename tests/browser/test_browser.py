"""The page in a real browser: headless Chromium, real mouse events."""

import io
import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from browsing import (
    LIGHT,
    PATIENCE,
    TRIES,
    begin,
    close_notices,
    close_page,
    drag,
    open_page,
    open_tab,
    press,
    project,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium
from pages import camera_for
from PIL import Image
from scenes import changing

from dt_viz.metrics import maximum_collision_distance
from dt_viz.obstacles.shapes import MeshObstacle
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.page import Page
from dt_viz.ui.scene.slice_layers import VOLUME

WIDTH, HEIGHT = 720, 450
CORNER = (5, 5)  # CSS pixels where the mouse touches nothing
pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(scope="module")
def tab(browser, server):
    """One tab for all tests: opening it takes longer than most of them."""
    page, visitor = open_page(browser, server, (WIDTH, HEIGHT))
    yield page, visitor
    close_page(page, server, visitor)


@pytest.fixture
def visit(tab, initial):
    """The tab as it is when a visitor comes, but for the arm: the hand avoids, and nothing else is drawn or moves."""
    page, visitor = tab
    begin(visitor, replace(initial("draw_s"), view=LIGHT))
    page.mouse.move(*CORNER)
    open_tab(page, "World")
    look_home(visitor)
    until_drawn(visitor)
    close_notices(page)
    wait_until(lambda: camera_rests(visitor), "the camera to stand where the task wants it")
    return page, visitor


def look_home(visitor: Page) -> None:
    camera = visitor.client.camera
    camera.position, camera.look_at = camera_for(TASKS["draw_s"](), camera)


def camera_rests(visitor: Page) -> bool:
    camera = visitor.client.camera
    wanted, _ = camera_for(TASKS["draw_s"](), camera)
    return bool(np.abs(np.asarray(camera.position) - wanted).max() < 1e-3)


def seen_at(page, visitor: Page) -> tuple[float, float]:
    """CSS pixels of the obstacle."""
    return project(page, visitor, visitor.session.scenario.obstacles[0].position)


def drag_until(page, visitor, done, reset, ends):
    """Drag between the two pixels of `ends()` until `done()`; again after `reset()`, as a page drawn by software
    may not show the handles in their place yet: then the drag has turned the camera instead."""
    for _ in range(TRIES):
        reset()
        look_home(visitor)
        until_drawn(visitor)
        wait_until(lambda: camera_rests(visitor), "the camera to be back")
        close_notices(page)
        start, end = ends()
        page.mouse.move(*start)
        until_drawn(visitor)
        drag(page, start, end)
        time.sleep(0.2)  # viser holds the last event back for a moment
        until_drawn(visitor)
        if done():
            return
    pytest.fail(f"{TRIES} drags in vain, the next would be from and to {ends()}: {visitor.session.scenario}")


def assert_shows_the_obstacle_where_it_is(visitor: Page) -> None:
    session, frame = visitor.session, visitor.shown
    assert frame is not None
    assert frame.scenario.obstacle == session.scenario.obstacle
    (obstacle,) = session.scenario.obstacles
    np.testing.assert_allclose(visitor.pictures.markers.obstacles.items[0].node.position, obstacle.position, atol=1e-9)


def test_dragging_the_gizmo_moves_the_rollouts_clear_of_the_obstacle(visit):
    page, visitor = visit
    before = visitor.shown
    centre = np.array(visitor.session.scenario.obstacles[0].position)
    tip = centre + np.array([0, 0, 0.8 * visitor.pictures.markers.obstacles.items[0].node.scale])
    drag(page, project(page, visitor, tip), project(page, visitor, tip + np.array([0, 0, 0.06])))
    wait_until(lambda: visitor.session.scenario.obstacles[0].position[2] > centre[2] + 0.03, "the drag to arrive")
    assert visitor.session.wait_idle(PATIENCE)
    moved = np.array(visitor.session.scenario.obstacles[0].position) - centre
    np.testing.assert_allclose(moved[:2], 0, atol=1e-6)  # the arrow moves it upwards only

    assert_shows_the_obstacle_where_it_is(visitor)
    after = visitor.shown
    earlier, later = ([path[len(path) // 2] for path in shown.rollouts] for shown in (before, after))
    assert np.abs(np.subtract(later, earlier)).max() > 0.01
    obstacle = after.scenario.obstacle
    assert max(maximum_collision_distance(path, obstacle.signed_distance) for path in after.rollouts) == 0
    assert after.certificates.clearance > 0


def test_dragging_the_sphere_itself_moves_it_in_the_drawing_plane_and_the_last_pose_is_shown(visit):
    page, visitor = visit
    centre = np.array(visitor.session.scenario.obstacles[0].position)
    x, y = project(page, visitor, centre)
    session = visitor.session
    for target in ((x + 40, y - 30), (x - 50, y + 20)):
        (here,) = session.scenario.obstacles

        def put_back(here=here):
            session.edit("test", **changing(session.scenario, obstacles=(here,)))

        def followed(here=here):
            """In the drawing plane, y = const, which a drag by an arrow of the gizmo leaves."""
            shift = np.subtract(session.scenario.obstacles[0].position, here.position)
            return np.linalg.norm(shift) > 0.02 and abs(shift[1]) < 1e-6

        def ends(target=target):
            return np.add(seen_at(page, visitor), (-18, 14)), target

        drag_until(page, visitor, followed, put_back, ends)
    assert session.wait_idle(PATIENCE)
    assert abs(session.scenario.obstacles[0].position[1] - centre[1]) < 1e-6
    assert_shows_the_obstacle_where_it_is(visitor)


def press_unseen(locator):
    """Click wherever the panel is scrolled to."""
    locator.evaluate("element => element.click()")


def click_button(page, name):
    press_unseen(page.get_by_role("button", name=name, exact=True))


def upload_in(page):
    """The input for a file, in its folder, which stays open from test to test."""
    if not page.get_by_role("button", name="Mesh or point cloud").is_visible():
        press(page.get_by_text("From a file", exact=True))
    return page.locator("input[type=file]").first


def test_a_mesh_is_uploaded_in_its_own_unit_and_turned_by_its_handle(visit):
    page, visitor = visit
    session = visitor.session
    session.edit("test", **changing(session.scenario, obstacles=(), avoids=False))
    crate = trimesh.creation.box((150, 100, 50)).export(file_type="stl")
    upload = upload_in(page)
    upload.set_input_files({"name": "crate.stl", "mimeType": "model/stl", "buffer": crate})
    page.get_by_text("seems to be in millimetres: 150 × 100 × 50 units").first.wait_for()
    assert session.scenario.obstacles == ()
    click_button(page, "Read it in millimetres")
    wait_until(lambda: session.scenario.obstacles, "the mesh")
    (mesh,) = session.scenario.obstacles
    assert isinstance(mesh, MeshObstacle) and mesh.size == pytest.approx(0.15)

    pictures = visitor.pictures.markers.obstacles
    wait_until(lambda: [item.has_handles for item in pictures.items] == [True], "its handles")
    (picture,) = pictures.items
    angles = itertools.cycle((0.8, 0.65, 0.5))  # where one try hits another handle the next does not
    arc = 0.65 * picture.node.scale  # the handles that turn are quarters of circles between the arrows

    def turned():
        after = session.scenario.obstacles[0]
        return abs(after.wxyz[0]) < 0.9999 and np.allclose(after.position, mesh.position, rtol=0, atol=1e-6)  # in place

    def along_the_arc():
        grabbed = next(angles)
        turns = [np.array([np.cos(angle), 0.0, np.sin(angle)]) for angle in (grabbed, grabbed - 0.7)]
        return [project(page, visitor, mesh.position + arc * turn) for turn in turns]

    def turn_back():
        session.edit("test", **changing(session.scenario, obstacles=(mesh,)))

    drag_until(page, visitor, turned, turn_back, along_the_arc)
    assert session.wait_idle(PATIENCE)
    (after,) = session.scenario.obstacles
    axis = np.abs(after.wxyz[1:]) / np.linalg.norm(after.wxyz[1:])
    np.testing.assert_allclose(axis, [0, 1, 0], atol=1e-3)  # across the drawing plane
    np.testing.assert_allclose(picture.node.wxyz, after.wxyz, atol=1e-9)


def test_the_saved_png_has_the_chosen_size_and_is_not_blank(visit):
    page, visitor = visit
    visitor.session.edit("test", view=replace(LIGHT, rollouts=True, arm=True, table=True, colour="det"))
    assert visitor.session.wait_idle(PATIENCE)
    open_tab(page, "Picture")
    page.evaluate("isLookedAt = true")
    with page.expect_download() as download:
        press(page.get_by_text("Save picture"))
    page.evaluate("isLookedAt = false")
    image = Image.open(io.BytesIO(download.value.path().read_bytes()))
    assert image.size == (1280, 720)
    assert image.mode == "RGB"
    pixels = np.asarray(image).reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 200
    assert 0.05 < (pixels < 250).any(axis=1).mean() < 0.95
    # the rollouts are there, in their colour; the gizmo's blue and green arrows are not
    assert (np.abs(pixels.astype(int) - (213, 94, 0)).max(axis=1) < 40).sum() > 300
    assert (np.abs(pixels.astype(int) - (32, 128, 255)).max(axis=1) < 40).sum() == 0
    corner = np.asarray(image)[-120:, :450].reshape(-1, 3).astype(int)
    for shade in VOLUME[[0, -1]].astype(int):  # the legend's ends
        assert (np.abs(corner - shade).max(axis=1) < 4).any()
