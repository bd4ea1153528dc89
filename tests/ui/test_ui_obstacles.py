"""Obstacles in the page, without a browser: the scene follows the scenario, and controls edit the selected one."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from pages import Bound, frame_of, ignored, painted_at
from scenes import avoiding, changing

from dt_viz.errors import UnwantedError
from dt_viz.obstacles import files as shapes
from dt_viz.obstacles import solids
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, MeshObstacle, Sphere, as_point, rotation
from dt_viz.obstacles.solids import Solid
from dt_viz.pictures.sketchbook import Pictures
from dt_viz.pictures.slice_fields import occupancy_picture
from dt_viz.scenario.scenario import MAX_OBSTACLES, View
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene.draggables import Obstacles, shaded
from dt_viz.ui.scene.markers import in_slice
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.slice_layers import OccupancySlice
from dt_viz.ui.tabs.from_file import PLACED
from dt_viz.ui.tabs.world import add, add_obstacles, delete, duplicate, name_of, offered, with_room
from dt_viz.warning import Severity

SHAPES = offered()
BALL = Sphere((0.0, -0.5, 0.4), 0.12)
BOX = Box((0.1, -0.5, 0.5), (0.2, 0.1, 0.06), (0.9, 0.1, 0.3, -0.3))
TUBE = Cylinder((-0.1, -0.5, 0.3), 0.08, 0.2)
ALL = (BALL, BOX, TUBE)
CRATE = trimesh.creation.box((0.15, 0.1, 0.05))
MESH = MeshObstacle((0.1, -0.5, 0.4), Solid(CRATE.vertices, CRATE.faces), (0.9, 0.1, 0.3, -0.3))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3))
CLOUD = CloudObstacle((-0.1, -0.5, 0.4), Cloud(POINTS[:600], np.linalg.norm(POINTS[:600], axis=1) < 0.06))


@pytest.fixture
def shown(server):
    yield Obstacles(server.scene, ignored)
    server.scene.reset()


@pytest.fixture(autouse=True)
def _coarse_distances(monkeypatch):
    """What is looked at here are places and sizes, not distances to within a millimetre."""
    monkeypatch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=20_000))


def scenario(*obstacles, selected=0, **changes):
    return avoiding("draw_s", obstacles, view=View(selected=selected, handles=True), **changes)


# --- The scene ---


def test_the_scene_follows_the_scenario_whatever_comes_and_goes(shown):
    resized = MESH.resized(0.3), CLOUD.resized(0.05)
    for obstacles in (ALL, (), (TUBE,), (BOX, TUBE), ALL[::-1], (MESH, CLOUD), resized, (BALL,) * 5, (BOX,)):
        shown.adopt(scenario(*obstacles))
        assert len(shown.items) == len(obstacles)
        for item, obstacle in zip(shown.items, obstacles, strict=True):
            np.testing.assert_allclose(item.node.position, obstacle.position)
            np.testing.assert_allclose(item.node.wxyz, obstacle.wxyz)
            placed = item.mesh.scale * item.mesh.vertices @ rotation(obstacle.wxyz).T + item.node.position
            is_rounded = isinstance(obstacle, MeshObstacle | CloudObstacle)
            rounding = 0.04 * obstacle.size if is_rounded else 1e-6  # by two thirds of a cell of the distances
            np.testing.assert_allclose(obstacle.signed_distance(placed), 0, atol=rounding)
            assert item.node.disable_rotations == isinstance(obstacle, Sphere)


@pytest.mark.parametrize(("selected", "expected"), [(0, [1, 0, 0]), (1, [0, 1, 0]), (2, [0, 0, 1]), (7, [0, 0, 1])])
def test_only_the_selected_obstacle_has_handles_and_none_in_a_picture(shown, selected, expected):
    def handles():
        return [int(item.has_handles) for item in shown.items]

    shown.adopt(scenario(*ALL, selected=selected))
    assert handles() == expected
    with shown.without_handles():
        assert handles() == [0, 0, 0]
        assert all(item.node.visible and item.mesh.visible for item in shown.items)
    assert handles() == expected


def test_obstacles_that_are_not_avoided_are_fainter(shown):
    shown.adopt(scenario(*ALL))
    before = [item.mesh.opacity for item in shown.items]
    shown.adopt(scenario(*ALL, avoids=False))
    assert all(item.mesh.opacity < opacity for item, opacity in zip(shown.items, before, strict=True))


@pytest.mark.parametrize("obstacle", ALL)
def test_surfaces_are_drawn_outward_with_sharp_edges(obstacle):
    vertices, faces = shaded(obstacle.moved((0.0, 0.0, 0.0)))
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    normals = np.cross(b - a, c - a)
    assert ((normals * (a + b + c)).sum(axis=1) > 0).all()  # seen from their middle, all three are convex
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    summed = np.zeros_like(vertices, dtype=float)
    for corner in range(3):
        np.add.at(summed, faces[:, corner], normals)
    shading = summed[faces[:, 0]] / np.linalg.norm(summed[faces[:, 0]], axis=1, keepdims=True)
    assert (shading * normals).sum(axis=1).min() > 0.9  # no face is shaded as if it leaned to its neighbour


def test_what_is_dragged_stays_in_the_slice_and_under_the_pointer():
    area = TASKS["draw_s"]().slice
    camera, grabbed, pointer = np.array([0.8, -1.6, 0.7]), np.array([0.02, -0.53, 0.44]), np.array([0.1, -0.6, 0.5])
    shift = in_slice(area, camera, grabbed, pointer)
    assert shift @ np.cross(*area.axes.T) == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(np.cross(grabbed + shift - camera, pointer - camera), 0, atol=1e-12)


# --- The panel ---


@pytest.fixture
def opened(server):
    bound = Bound(scenario(BALL))
    files, session = add_obstacles(server.gui, bound), cast(Any, bound.edited)
    yield SimpleNamespace(files=files, session=session, bound=bound, said=session.said)
    server.gui.reset()


def test_what_is_added_is_selected_stands_apart_and_is_a_step_for_undo(opened):
    for number, shape in enumerate([*SHAPES.values()][: MAX_OBSTACLES - 1], start=1):
        before = opened.session.scenario.obstacles
        add(opened.session, shape)
        *others, added = opened.session.scenario.obstacles
        assert tuple(others) == before
        assert added.moved((0.0, 0.0, 0.0), added.wxyz) == shape
        assert opened.session.scenario.selected == number == opened.session.steps
    assert len(opened.session.scenario.obstacles) == MAX_OBSTACLES
    add(opened.session, BALL)
    assert len(opened.session.scenario.obstacles) == MAX_OBSTACLES


@pytest.mark.parametrize("shape", SHAPES.values(), ids=list(SHAPES))
@pytest.mark.parametrize("task", ["draw_s", "lift_box", "push_box"])
def test_a_new_obstacle_is_near_the_motion_but_covers_no_end_of_it(task, shape):
    task = TASKS[task]()
    placed = with_room(shape, (Sphere(task.obstacle_position, 0.1),), task)
    ends = np.stack([path[k] for path in task.paths for k in (0, -1)])
    assert placed.signed_distance(ends).min() > 0
    assert placed.signed_distance(np.concatenate(task.paths)).min() < 0
    assert np.linalg.norm(np.subtract(placed.position, task.obstacle_position)) > 0.05


def test_deleting_and_duplicating_act_on_the_selected_obstacle(opened):
    opened.session.edit("", **changing(opened.session.scenario, obstacles=ALL), view=View(selected=1))
    duplicate(opened.session)
    assert opened.session.scenario.obstacles[:3] == ALL
    copy = opened.session.scenario.obstacles[3]
    assert copy.moved(BOX.position, copy.wxyz) == BOX
    opened.session.edit("", view=View(selected=1))
    delete(opened.session)
    assert opened.session.scenario.obstacles == (BALL, TUBE, copy)
    for _ in range(4):
        delete(opened.session)
    assert opened.session.scenario.obstacles == ()
    duplicate(opened.session)
    assert opened.session.scenario.obstacles == ()
    add(opened.session, BALL)
    assert len(opened.session.scenario.obstacles) == 1


SIZED = (*ALL, MESH, CLOUD)
SIZES = [
    (0, "Diameter [cm]", replace(BALL, diameter=0.2)),
    (1, "Size y [cm]", replace(BOX, sizes=(0.2, 0.2, 0.06))),
    (2, "Diameter [cm]", replace(TUBE, diameter=0.2)),
    (2, "Height [cm]", replace(TUBE, height=0.2)),
    (3, "Size [cm]", MESH.resized(0.2)),
    (4, "Size [cm]", CLOUD.resized(0.2)),
]


@pytest.mark.parametrize(("selected", "label", "expected"), SIZES)
def test_the_sizes_are_those_of_the_selected_obstacle(opened, selected, label, expected):
    opened.session.edit("", **changing(opened.session.scenario, obstacles=SIZED), view=View(selected=selected))
    opened.bound.set(label, 20.0)
    changed = opened.session.scenario
    assert changed.obstacles == (*SIZED[:selected], expected, *SIZED[selected + 1 :])
    assert opened.bound[label].control.value == 20.0
    hidden = opened.bound.inputs(visible=False)
    assert hidden and all(item.change(changed, 7.0) == {} for item in hidden)


@pytest.mark.long
def test_a_file_that_is_uploaded_becomes_an_obstacle(opened):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=40.0)  # millimetres
    cloud = trimesh.PointCloud(ball.vertices)
    files = {
        "ball.stl": (ball.export(file_type="stl"), MeshObstacle, "2: mesh"),
        "ball.ply": (ball.export(file_type="ply"), MeshObstacle, "3: mesh"),
        "cloud.ply": (cloud.export(file_type="ply"), CloudObstacle, "4: cloud"),
    }
    for name, (content, shape, label) in files.items():
        opened.files.load(content, name, 0.001)
        *_, added = opened.session.scenario.obstacles
        assert isinstance(added, shape) and added.radius == pytest.approx(0.04, abs=0.01)
        assert f"{opened.session.scenario.selected + 1}: {name_of(added)}" == label
        assert opened.said[-1] == (f"{name}: {PLACED}", Severity.NOTE)


def stl(mesh):
    return mesh.export(file_type="stl")


BALL_MESH = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
BAD = {
    "half.stl": (stl(BALL_MESH)[:3000], "a complete .stl file"),
    "tiny.stl": (stl(BALL_MESH.copy().apply_scale(1e-6)), "a largest side of 0.01 m to 1 m"),
    "what.txt": (b"?", "stl, obj, ply, glb, gltf, off, 3mf, npz, csv"),
    "huge.csv": (b"ply\n" * (shapes.MAX_BYTES // 4 + 1), "file: found 20.0 MB; accepted: at most 20 MB"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_with_what_was_found_and_the_scene_stays(opened, name):
    before = opened.session.scenario
    content, words = BAD[name]
    opened.files.load(content, name, 1.0)
    ((text, severity),) = opened.said
    assert severity is Severity.ALARM and text.startswith(f"{name}: ") and "found " in text and "accepted: " in text
    assert words in text and not opened.files.again.visible
    assert opened.session.scenario == before and opened.session.steps == 0


@pytest.mark.long
def test_a_file_in_another_unit_is_read_in_that_once_it_is_asked_for(opened):
    opened.files.load(stl(BALL_MESH.copy().apply_scale(1000)), "ball.stl", 1.0)
    question = "ball.stl seems to be in millimetres: 80 × 80 × 80 units. Read it in millimetres?"
    assert opened.said == [(question, Severity.WARNING)]
    assert opened.files.again.visible and opened.files.again.label == "Read it in millimetres"
    for _ in range(2):
        opened.files.load_again()
        _, added = opened.session.scenario.obstacles
        assert added.size == pytest.approx(0.08, abs=1e-3)
        assert not opened.files.again.visible and opened.files.unit.value == "millimetres"
    assert opened.said == [(question, Severity.WARNING), (f"ball.stl: {PLACED}", Severity.NOTE)]


def test_a_file_whose_visitor_has_left_becomes_no_obstacle(opened):
    before = opened.session.scenario
    opened.session.jobs.close()
    with pytest.raises(UnwantedError):
        opened.files.load(stl(BALL_MESH), "ball.stl", 1.0)
    assert opened.session.scenario == before and not opened.said


def test_another_file_than_there_is_room_for_is_refused(opened):
    opened.session.edit("", **changing(opened.session.scenario, obstacles=(BALL,) * MAX_OBSTACLES))
    opened.files.load(stl(BALL_MESH), "ball.stl", 1.0)
    ((text, severity),) = opened.said
    assert severity is Severity.ALARM and "delete one first" in text


def test_large_meshes_are_drawn_with_fewer_triangles():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    vertices, faces = shaded(MeshObstacle((0.0, 0.0, 0.0), Solid(ball.vertices, ball.faces)))
    assert len(faces) < len(ball.faces) / 2
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.1).max() < 0.004


# --- The learned occupancy ---


def test_the_map_is_painted_on_the_slice_the_right_way_up(server):
    picture, task = OccupancySlice(server.scene), TASKS["draw_s"]()
    ball = Sphere(as_point(task.slice.centre + task.slice.axes @ [0.08, 0.12]), 0.1)  # to the upper right
    made = occupancy_picture(task.slice, (ball,), coarse=True)
    picture.draw(frame_of(scenario(ball), pictures=Pictures(occupancy=made)), Look())
    image = picture.image.handle
    painted = painted_at(image, task.slice.half_size, image.image[..., 3] > 190)
    np.testing.assert_allclose(painted, ball.position, atol=0.004)
    np.testing.assert_allclose(picture.level.node.points, made.level, atol=1e-6)
    server.scene.reset()


def test_obstacles_are_open_towards_the_viewer_while_their_map_is_shown(shown):
    shown.adopt(scenario(*ALL))
    assert {item.mesh.side for item in shown.items} == {"front"}
    shown.adopt(replace(scenario(*ALL), view=View(colour="occupancy")))
    assert {item.mesh.side for item in shown.items} == {"back"}
