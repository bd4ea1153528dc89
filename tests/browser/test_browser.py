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
    OF_VISER,
    PATIENCE,
    TRIES,
    begin,
    close_notices,
    close_page,
    open_page,
    page_errors,
    press,
    project,
    until_drawn,
    wait_until,
)
from chromium import needs_chromium
from PIL import Image
from scenes import beside, changing

import dt_viz.learning.store
from dt_viz.learning.store import FitStore
from dt_viz.metrics import maximum_collision_distance
from dt_viz.motion.control import Phase
from dt_viz.obstacles.files import MAX_BYTES
from dt_viz.obstacles.shapes import MeshObstacle
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import anchored
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.panel.verdict import Level
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene.camera import camera_for
from dt_viz.ui.scene.slice_layers import VOLUME
from dt_viz.ui.server import Server
from dt_viz.ui.visitor import Visitor, initial_scenario

WIDTH, HEIGHT = 900, 560
CORNER = (5, 5)
"""CSS pixels where the mouse touches nothing."""
pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.fixture(scope="module")
def server():
    """Knows nothing that other tests have learned, so that it has to learn what a test here chooses."""
    server = Server(TASKS, FitStore(None), task="draw_s", port=0, max_sessions=2)
    yield server
    server.close()


class Tab:
    """One tab for all tests: opening it takes longer than most of them."""

    def __init__(self, browser, server):
        self._browser, self._server, self._opened = browser, server, None
        self.sound = True
        """Whether it can be visited again: not after a test that failed, until that is known of the next one."""

    def visit(self):
        if not self.sound:
            self.close()
        if self._opened is None:
            self._opened = open_page(self._browser, self._server, (WIDTH, HEIGHT))
        self.sound = False
        return self._opened

    def close(self):
        if self._opened is not None:
            page, visitor = self._opened
            self._opened = None
            close_page(page, self._server, visitor)


@pytest.fixture(scope="module")
def tab(browser, server):
    tab = Tab(browser, server)
    yield tab
    tab.close()


@pytest.fixture
def visit(tab, initial, request):
    """The tab as it is when a visitor comes, but for the arm: the hand avoids, and nothing else is drawn or moves."""
    page_errors.clear()
    failed = request.session.testsfailed
    page, visitor = tab.visit()
    begin(visitor, replace(initial("draw_s"), view=LIGHT))
    page.mouse.move(*CORNER)
    open_tab(page, "World")
    look_home(visitor)
    until_drawn(visitor)
    close_notices(page)
    wait_until(lambda: camera_rests(visitor), "the camera to stand where the task wants it")
    yield page, visitor
    tab.sound = request.session.testsfailed == failed
    assert [error for error in page_errors if OF_VISER not in error] == []


def look_home(visitor: Visitor) -> None:
    camera = visitor.client.camera
    camera.position, camera.look_at = camera_for(TASKS["draw_s"](), camera)


def camera_rests(visitor: Visitor) -> bool:
    camera = visitor.client.camera
    wanted, _ = camera_for(TASKS["draw_s"](), camera)
    return bool(np.abs(np.asarray(camera.position) - wanted).max() < 1e-3)


def seen_at(visitor: Visitor) -> tuple[float, float]:
    """CSS pixels of the obstacle."""
    return project(visitor, visitor.session.scenario.obstacles[0].position)


def drag(page, start, end, steps=6):
    page.mouse.move(*start)
    page.mouse.down()
    for k in range(1, steps + 1):
        page.mouse.move(*(a + (b - a) * k / steps for a, b in zip(start, end, strict=True)))
        time.sleep(0.03)
    page.mouse.up()


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


def assert_shows_the_obstacle_where_it_is(visitor: Visitor) -> None:
    session, frame = visitor.session, visitor.shown
    assert frame is not None
    assert frame.scenario.obstacle == session.scenario.obstacle
    (obstacle,) = session.scenario.obstacles
    np.testing.assert_allclose(visitor.pictures.obstacles.items[0].gizmo.position, obstacle.position, atol=1e-9)


def test_dragging_the_gizmo_moves_the_rollouts_clear_of_the_obstacle(visit):
    page, visitor = visit
    before = visitor.shown
    centre = np.array(visitor.session.scenario.obstacles[0].position)
    tip = centre + np.array([0, 0, 0.8 * visitor.pictures.obstacles.items[0].gizmo.scale])
    drag(page, project(visitor, tip), project(visitor, tip + np.array([0, 0, 0.06])))
    wait_until(lambda: visitor.session.scenario.obstacles[0].position[2] > centre[2] + 0.03, "the drag to arrive")
    assert visitor.session.wait_idle(PATIENCE)
    moved = np.array(visitor.session.scenario.obstacles[0].position) - centre
    np.testing.assert_allclose(moved[:2], 0, atol=1e-6)  # the arrow moves it upwards only

    assert_shows_the_obstacle_where_it_is(visitor)
    after = visitor.shown
    assert (
        max(np.abs(a[len(a) // 2] - b[len(b) // 2]).max() for a, b in zip(after.rollouts, before.rollouts, strict=True))
        > 0.01
    )
    obstacle = after.scenario.obstacle
    assert max(maximum_collision_distance(path, obstacle.signed_distance) for path in after.rollouts) == 0
    assert after.certificates.clearance > 0


def test_dragging_the_sphere_itself_moves_it_in_the_drawing_plane_and_the_last_pose_is_shown(visit):
    page, visitor = visit
    centre = np.array(visitor.session.scenario.obstacles[0].position)
    x, y = project(visitor, centre)
    session = visitor.session
    for target in ((x + 40, y - 30), (x - 60, y + 20), (x + 25, y + 35)):
        (here,) = session.scenario.obstacles

        def put_back(here=here):
            session.edit("test", **changing(session.scenario, obstacles=(here,)))

        def followed(here=here):
            """In the drawing plane, y = const, which a drag by an arrow of the gizmo leaves."""
            shift = np.subtract(session.scenario.obstacles[0].position, here.position)
            return np.linalg.norm(shift) > 0.02 and abs(shift[1]) < 1e-6

        def ends(target=target):
            return np.add(seen_at(visitor), (-18, 14)), target

        drag_until(page, visitor, followed, put_back, ends)
    assert session.wait_idle(PATIENCE)
    assert abs(session.scenario.obstacles[0].position[1] - centre[1]) < 1e-6
    assert_shows_the_obstacle_where_it_is(visitor)


def test_undo_takes_a_drag_back_and_redo_does_it_again(visit):
    page, visitor = visit
    first = visitor.session.scenario
    x, y = project(visitor, first.obstacles[0].position)
    drag(page, (x - 18, y + 14), (x + 30, y - 20))
    wait_until(lambda: visitor.session.scenario != first and visitor.session.wait_idle(0.5), "the drag")
    second = visitor.session.scenario
    press(page.get_by_role("button", name="Undo", exact=True))
    wait_until(lambda: visitor.session.scenario.obstacle == first.obstacle, "undo")
    press(page.get_by_role("button", name="Redo", exact=True))
    wait_until(lambda: visitor.session.scenario.obstacle == second.obstacle, "redo")
    assert visitor.session.wait_idle(PATIENCE)
    assert_shows_the_obstacle_where_it_is(visitor)


def open_tab(page, name):
    """A tab of the panel."""
    press(page.get_by_role("tab", name=name, exact=True))


def choose(page, visitor, dropdown, option):
    """Choose in a dropdown of the panel, once it is where it stays, and shows what was chosen before.

    Its list may still be on its way to its place: no pixel of it is clicked.
    """
    until_drawn(visitor)
    press(page.get_by_label(dropdown, exact=True))
    press_unseen(page.get_by_role("option", name=option, exact=True))


def press_unseen(locator):
    """Click wherever the panel is scrolled to."""
    locator.evaluate("element => element.click()")


def click_button(page, name):
    press_unseen(page.get_by_role("button", name=name, exact=True))


def test_a_box_is_added_dragged_and_deleted_and_a_click_selects_the_sphere(visit):
    page, visitor = visit
    session, pictures = visitor.session, visitor.pictures.obstacles
    session.edit("test", **changing(session.scenario, avoids=False))
    (sphere,) = session.scenario.obstacles
    click_button(page, "Box")
    wait_until(lambda: [item.handles.shown for item in pictures.items] == [False, True], "the box and its handles")
    before = np.array(session.scenario.obstacles[1].position)
    boxed = session.scenario.obstacles

    def dragged():
        place = np.array(session.scenario.obstacles[1].position)
        return np.linalg.norm(place - before) > 0.03 and session.wait_idle(PATIENCE)

    def along_its_face():
        x, y = project(visitor, before - (0.05, 0.05, 0.015))  # away from the handles
        return (x, y), (x - 50, y + 30)

    drag_until(
        page,
        visitor,
        dragged,
        lambda: session.edit("test", **changing(session.scenario, obstacles=boxed)),
        along_its_face,
    )
    assert session.scenario.obstacles[0] == sphere
    np.testing.assert_allclose(pictures.items[1].gizmo.position, session.scenario.obstacles[1].position, atol=1e-9)

    x, y = project(visitor, sphere.position)
    page.mouse.click(x - 18, y + 14)
    wait_until(lambda: [item.handles.shown for item in pictures.items] == [True, False], "the sphere to be selected")
    choose(page, visitor, "Selected", "2: box")
    wait_until(lambda: session.scenario.selected == 1, "the box to be selected")
    click_button(page, "Delete")
    wait_until(lambda: session.scenario.obstacles == (sphere,) and len(pictures.items) == 1, "the box to go")
    click_button(page, "Delete")
    page.get_by_text("no obstacle").first.wait_for()


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

    pictures = visitor.pictures.obstacles
    wait_until(lambda: [item.handles.shown for item in pictures.items] == [True], "its handles")
    (picture,) = pictures.items
    angles = itertools.cycle((0.8, 0.65, 0.5))  # where one try hits another handle the next does not
    arc = 0.65 * picture.gizmo.scale  # the handles that turn are quarters of circles between the arrows

    def turned():
        after = session.scenario.obstacles[0]
        return abs(after.wxyz[0]) < 0.9999 and np.allclose(after.position, mesh.position, rtol=0, atol=1e-6)  # in place

    def along_the_arc():
        grabbed = next(angles)
        turns = [np.array([np.cos(angle), 0.0, np.sin(angle)]) for angle in (grabbed, grabbed - 0.7)]
        return [project(visitor, mesh.position + arc * turn) for turn in turns]

    drag_until(
        page,
        visitor,
        turned,
        lambda: session.edit("test", **changing(session.scenario, obstacles=(mesh,))),
        along_the_arc,
    )
    assert session.wait_idle(PATIENCE)
    (after,) = session.scenario.obstacles
    axis = np.abs(after.wxyz[1:]) / np.linalg.norm(after.wxyz[1:])
    np.testing.assert_allclose(axis, [0, 1, 0], atol=1e-3)  # across the drawing plane
    np.testing.assert_allclose(picture.gizmo.wxyz, after.wxyz, atol=1e-9)


def test_a_file_that_is_too_large_is_refused_with_a_reason_and_the_next_can_be_chosen(visit):
    page, visitor = visit
    upload = upload_in(page)
    upload.set_input_files({"name": "city.stl", "mimeType": "model/stl", "buffer": bytes(MAX_BYTES + 1)})
    page.get_by_text("city.stl: file: found 20.0 MB; accepted: at most 20 MB").wait_for(timeout=1000 * PATIENCE)
    page.get_by_text("Uploading city.stl").wait_for(state="detached", timeout=1000 * PATIENCE)
    upload.set_input_files({"name": "no.stl", "mimeType": "model/stl", "buffer": bytes(100)})
    page.get_by_text("no.stl: faces").first.wait_for(timeout=1000 * PATIENCE)
    assert visitor.session.scenario.obstacles[1:] == ()


def test_a_bias_point_is_added_dragged_in_the_drawing_plane_and_switched_off_in_the_stack(visit):
    page, visitor = visit
    session, pictures = visitor.session, visitor.pictures.anchors
    session.edit("test", **changing(session.scenario, obstacles=()))
    click_button(page, "Bias")
    wait_until(lambda: beside(session.scenario) and session.wait_idle(0.3), "the bias point")

    def place():
        return np.array(anchored(session.scenario)["Bias 1"].anchor)

    before, layers = place(), beside(session.scenario)

    def beside_its_middle():
        x, y = project(visitor, before)
        return (x - 2, y + 2), (x + 13, y - 11)

    def moved():
        return 0.03 < np.linalg.norm(place() - before) < 0.15

    drag_until(
        page,
        visitor,
        moved,
        lambda: session.edit("test", **changing(session.scenario, layers=layers)),
        beside_its_middle,
    )
    wait_until(lambda: session.wait_idle(0.3) and visitor.shown.scenario == session.scenario, "its picture")
    assert abs(place()[1] - before[1]) < 1e-6  # the drawing plane is y = const
    np.testing.assert_allclose(pictures.items[0].gizmo.position, place(), atol=1e-9)
    assert all(np.linalg.norm(path - place(), axis=1).min() < 0.015 for path in visitor.shown.rollouts)

    open_tab(page, "Stack")
    press_unseen(page.get_by_role("button", name="● on", exact=True).first)  # of the outermost
    wait_until(lambda: not beside(session.scenario)[0].on and session.wait_idle(0.3), "the switch")
    for path, undisturbed in zip(visitor.shown.rollouts, visitor.shown.ghost, strict=True):
        assert max(np.linalg.norm(undisturbed - point, axis=1).min() for point in path) < 0.02


def test_the_saved_png_has_the_chosen_size_and_is_not_blank(visit):
    page, visitor = visit
    visitor.session.edit("test", view=replace(LIGHT, rollouts=True, arm=True, table=True, colour="det"))
    assert visitor.session.wait_idle(PATIENCE)
    open_tab(page, "Picture")
    with page.expect_download() as download:
        press(page.get_by_text("Save PNG"))
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


def test_what_was_learned_of_a_sphere_without_points_is_shown(visit):
    """The browser complains of points without colours; see the fixture."""
    page, visitor = visit
    visitor.session.edit("test", view=replace(LIGHT, colour="occupancy"))
    assert visitor.session.wait_idle(PATIENCE)
    press(page.get_by_text("Show", exact=True))
    page.get_by_text("Learned occupancy: how likely something is there").wait_for(timeout=1000 * PATIENCE)
    until_drawn(visitor)


def test_reset_brings_back_the_scene_and_the_camera(visit, engine):
    page, visitor = visit
    drag(page, (100, HEIGHT - 60), (260, HEIGHT - 120))
    visitor.session.edit("test", **changing(visitor.session.scenario, temperature=2.0), view=View(grid=True))
    wait_until(lambda: not camera_rests(visitor), "the camera to be turned")
    until_drawn(visitor)
    click_button(page, "Reset")
    wait_until(lambda: camera_rests(visitor), "the camera to be back")
    assert visitor.session.scenario == initial_scenario(engine, "draw_s")


def test_each_visitor_has_a_private_scene_and_a_full_house_says_so(browser, server, visit):
    _, first = visit
    page, second = open_page(browser, server, (WIDTH, HEIGHT))
    third = browser.new_page()
    third.set_default_timeout(1000 * PATIENCE)
    try:
        second.session.edit("test", **changing(second.session.scenario, avoids=False))
        assert second.session.wait_idle(PATIENCE)
        assert first.session.scenario.avoids
        third.goto(f"http://127.0.0.1:{server.port}")
        third.get_by_text("All 2 places are taken").wait_for()
    finally:
        third.close()
        close_page(page, server, second)
    assert len(server.visitors) == 1


def test_a_task_chosen_in_the_page_is_learned_and_shown(visit):
    page, visitor = visit
    choose(page, visitor, "Task", "Lift box")
    wait_until(lambda: visitor.shown is not None and visitor.shown.task.name == "lift_box", "the other task")
    assert len(visitor.shown.rollouts) == 8


SHOWN = {  # the layer's label in the page, the picture's name, and the points that it holds
    "Warped grid ψ⁻¹(grid)": ("grid", lambda picture: [picture.lines.node.points]),
    "Stack side by side": ("panels", lambda picture: [picture.panels[0].rollouts.node.vertices]),
    "Learned generator": ("generator", lambda picture: [picture.arrows.node.points]),
}


def test_each_layer_of_the_transform_is_drawn_once_it_is_switched_on(visit):
    page, visitor = visit
    open_tab(page, "Show")
    for label, (name, drawn) in SHOWN.items():
        picture = visitor.pictures.layer(name)
        assert not picture.visible

        press_unseen(page.get_by_label(label).first)
        wait_until(lambda name=name: getattr(visitor.session.scenario.view, name), f"the checkbox of {name}")
        assert visitor.session.wait_idle(PATIENCE)
        assert picture.visible
        for points in drawn(picture):
            assert np.isfinite(points).all()
            assert len(points) >= len(visitor.shown.rollouts)
            assert np.ptp(points.reshape(-1, 3), axis=0).max() > 0.1


def pixels(page):
    """The scene without the panel, (H, W, 3)."""
    image = Image.open(io.BytesIO(page.screenshot(clip={"x": 0, "y": 0, "width": WIDTH - 340, "height": HEIGHT})))
    return np.asarray(image.convert("RGB")).astype(int)


def bluish(image):
    return (image[..., 2] - image[..., 0] > 25) & (np.ptp(image, axis=-1) < 120)


def greenish(image):
    return (image[..., 1] - image[..., 0] > 25) & (image[..., 1] > image[..., 2])


def darker(image):
    return (image.max(axis=-1) < 150) & (np.ptp(image, axis=-1) < 40)


ARM_LAYERS = {  # the layer's label in the page, its field of View, and which pixels there are then more of
    "Arm without avoidance": ("ghost_arm", darker),
    "Arms along the motion": ("onion", bluish),
    "Body points": ("body_points", greenish),
}


def test_the_layers_of_the_whole_arm_are_seen_once_they_are_switched_on(visit, monkeypatch):
    page, visitor = visit
    session, plain = visitor.session, replace(LIGHT, replay=True, arm=True)
    session.edit("test", view=plain)
    wait_until(lambda: visitor.shown.arm is not None and session.wait_idle(0.2), "a motion")
    q = visitor.shown.arm.q[50]
    monkeypatch.setattr(Replay, "posture", property(lambda _: (q, q + 0.6 * np.eye(6)[0])))
    wait_until(lambda: np.array_equal(visitor.playback.q, q), "the arm to be posed")
    open_tab(page, "Show")
    until_drawn(visitor)
    before = pixels(page)
    for label, (name, coloured) in ARM_LAYERS.items():
        box = page.get_by_label(label, exact=True).first
        press_unseen(box)
        wait_until(lambda name=name: getattr(session.scenario.view, name), f"the checkbox of {name}")
        wait_until(
            lambda coloured=coloured: coloured(pixels(page)).sum() > coloured(before).sum() + 1000, f"{name} to be seen"
        )
        session.edit("test", view=plain)

    press_unseen(page.get_by_label("Joint plots").first)
    drawn = """() => [...document.querySelectorAll('.uplot canvas')].filter(canvas => canvas.width).map(canvas => {
        const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
        let coloured = 0;
        for (let i = 0; i < data.length; i += 4)
            coloured += data[i + 3] > 128 && Math.max(...data.slice(i, i + 3)) - Math.min(...data.slice(i, i + 3)) > 60;
        return coloured;
    })"""
    wait_until(lambda: [count > 300 for count in page.evaluate(drawn)] == [True, True], "both plots to be drawn")


def test_who_avoids_is_chosen_in_the_page(visit):
    page, visitor = visit
    for label, space in (("Arm", "cspace"), ("Hand", "task")):
        choose(page, visitor, "Avoid", label)
        wait_until(lambda space=space: visitor.session.scenario.avoidance.space == space, "the choice to arrive")
        wait_until(lambda space=space: visitor.shown.scenario.avoidance.space == space, "its picture")
    visitor.session.edit("test", view=replace(LIGHT, arm=True))
    press(page.get_by_role("button", name="Let the whole arm avoid"))
    wait_until(lambda: visitor.session.scenario.avoidance.space == "cspace", "the whole arm to avoid again")
    wait_until(lambda: visitor.shown.scenario.avoidance.space == "cspace", "its picture")
    wait_until(lambda: page.get_by_role("button", name="Let the whole arm avoid").count() == 0, "the button to go")


def test_nothing_moves_when_a_message_comes(visit):
    page, visitor = visit
    session, status = visitor.session, visitor._panel.status

    def below():
        until_drawn(visitor)
        return page.get_by_role("button", name="Undo", exact=True).bounding_box()["y"]

    before = below()
    session.edit("test", view=replace(LIGHT, arm=True))
    page.get_by_role("button", name="Let the whole arm avoid").wait_for()
    places = [below()]
    status.learn(0.4, "flow 2 of 3")
    page.get_by_role("button", name="Cancel").wait_for()
    places.append(below())
    status.say(300 * "much to say ", Level.WARNING)
    page.get_by_text("Much to say").wait_for()
    places.append(below())
    assert np.ptp([before, *places]) < 1.5


def test_keys_do_what_the_panel_does(visit):
    page, visitor = visit
    session = visitor.session
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Space")
    wait_until(lambda: session.scenario.view.playing, "the arm to move")
    page.keyboard.press("Space")
    wait_until(lambda: not session.scenario.view.playing, "the arm to rest")
    session.edit("warp", warp=0.5)
    for key, warp in (("z", 1), ("Shift+Z", 0.5), ("z", 1)):
        page.keyboard.press(key)
        wait_until(lambda warp=warp: session.scenario.warp == warp, f"the key {key}")
    shown = page.get_by_role("button", name="Undo", exact=True)
    page.keyboard.press("h")
    shown.wait_for(state="hidden")
    page.keyboard.press("h")
    shown.wait_for()


def test_learning_can_be_cancelled_in_the_page(visit, monkeypatch):
    page, visitor = visit

    def endless(_demonstrations, _settings, progress):
        while True:
            progress(0.5, "without end")
            time.sleep(0.02)

    monkeypatch.setattr(dt_viz.learning.store, "fit", endless)
    open_tab(page, "Stack")
    choose(page, visitor, "Settings of", "Imitation")
    wait_until(lambda: visitor.session.scenario.view.tuned == "Imitation", "its settings")
    choose(page, visitor, "Objective", "velocity")
    page.get_by_text("Without end").wait_for()
    press(page.get_by_role("button", name="Cancel"))
    page.get_by_text("was cancelled. This is “Draw S” as before.").first.wait_for()
    assert visitor.session.wait_idle(PATIENCE)
    assert visitor.session.scenario.objective == visitor.shown.scenario.objective == "trajectory"
    page.get_by_text("· stable ·").wait_for()
    assert page.get_by_role("button", name="Cancel").count() == 0


def test_the_hand_is_dragged_in_a_pause_and_goes_on_to_the_goal_when_it_is_let_go(visit):
    page, visitor = visit
    session = visitor.session
    session.edit(
        "test",
        **changing(session.scenario, obstacles=()),
        view=replace(LIGHT, arm=True),
    )
    wait_until(
        lambda: session.wait_idle(0.3) and visitor.shown.scenario == session.scenario, "a motion without obstacle"
    )
    assert visitor.grip.ball.visible
    before = visitor._hand()

    def from_the_ball():
        x, y = project(visitor, before)
        return (x, y), (x - 50, y - 40)

    drag_until(page, visitor, lambda: np.linalg.norm(visitor._hand() - before) > 0.02, lambda: None, from_the_ball)
    live = visitor.playback.live
    wait_until(lambda: live.phase is not Phase.HELD, "the hand to be where it was let go")
    hand = visitor._hand()
    assert np.linalg.norm(hand - before) > 0.05
    assert abs(hand[1] - before[1]) < 5e-3  # parallel to the drawing plane, y = const
    np.testing.assert_allclose(project(visitor, hand), from_the_ball()[1], atol=12)
    assert np.linalg.norm(live.ahead[0] - hand) < 0.02  # from here on
    session.edit("play", view=replace(LIGHT, arm=True, playing=True, speed=3.0))
    wait_until(lambda: np.linalg.norm(visitor._hand() - visitor.shown.goal) < 5e-3, "the goal")
    wait_until(lambda: live.phase is Phase.HOMING, "the next round")


def test_the_warp_is_played_in_the_page(visit):
    page, visitor = visit
    open_tab(page, "Stack")
    press(page.get_by_text("▶ 0 → 1"))
    wait_until(lambda: visitor.shown.scenario.warp < 1, "a picture on its way")
    wait_until(lambda: visitor.session.scenario.warp == visitor.shown.scenario.warp == 1, "the full stack")
    page.get_by_text("▶ 0 → 1").wait_for()
    visitor.session.undo()
    assert visitor.session.scenario.warp == 1  # it ended as it began


def test_the_slice_is_moved_by_its_handles_and_the_field_with_it(visit):
    page, visitor = visit
    session, home = visitor.session, visitor.shown.slice
    gizmo, right = visitor.pictures.slice.gizmo, home.axes[:, 0]

    def along_its_first_arrow():
        tip = home.centre + 0.8 * gizmo.scale * right
        return project(visitor, tip), project(visitor, tip + 0.06 * right)

    def moved():
        return np.linalg.norm(visitor.shown.slice.centre - home.centre) > 0.03

    moving = replace(LIGHT, streamlines=True, move_slice=True)
    session.edit("test", **changing(session.scenario, obstacles=()), view=moving)
    wait_until(lambda: session.wait_idle(0.3), "the handles")
    drag_until(page, visitor, moved, lambda: session.edit("test", view=moving), along_its_first_arrow)
    wait_until(lambda: session.wait_idle(0.3) and visitor.shown.scenario == session.scenario, "its picture")
    area = visitor.shown.slice
    np.testing.assert_allclose(np.cross(area.centre - home.centre, right), 0, atol=1e-6)  # along the arrow only
    np.testing.assert_allclose(area.axes, home.axes, atol=1e-6)
    (lines,) = [visitor.shown.pictures.streamlines]
    points = np.concatenate(lines)
    assert (np.abs((points - area.centre) @ area.axes) <= np.array(area.half_size) + 0.02).all()


def test_a_click_on_the_slice_starts_a_rollout_and_a_drag_of_the_camera_does_not(visit):
    page, visitor = visit
    session, area = visitor.session, visitor.shown.slice
    session.edit("test", **changing(session.scenario, obstacles=()), view=replace(LIGHT, click_to_start=True))
    wait_until(lambda: session.wait_idle(0.3), "the mode")
    place = area.at(np.array([-0.6, 0.6]) * area.half_size)
    for _ in range(TRIES):
        page.mouse.click(*project(visitor, place))
        until_drawn(visitor)
        if session.scenario.starts:  # else the page was not listening yet
            break
    wait_until(lambda: session.wait_idle(0.3) and visitor.shown.scenario == session.scenario, "its rollout")
    np.testing.assert_allclose(session.scenario.starts[0].place, place, atol=0.01)
    np.testing.assert_allclose(visitor.shown.rollouts[-1][0], session.scenario.starts[0].place, atol=1e-5)
    np.testing.assert_allclose(visitor.shown.rollouts[-1][-1], visitor.shown.goal, atol=1e-4)
    drag(page, (60, 60), (90, 80), steps=4)
    until_drawn(visitor)
    assert len(session.scenario.starts) == 1
