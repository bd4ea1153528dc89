"""What the page shows of the whole arm, without a browser: a scene takes handles also while nobody looks."""

from dataclasses import fields, replace
from itertools import pairwise
from typing import cast

import numpy as np
import pytest
import trimesh
from other_arms import OTHER_ARMS
from pages import frame_of, ignored
from scenes import avoiding, changed
from scipy.spatial import KDTree
from viser import transforms  # noqa: TID251

from dt_viz.kernels.tubes import evenly_bent, tubes
from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import BASE_PANEL
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import ArmMotion
from dt_viz.ui.scene.arm import (
    CELL,
    NUM_ARMS,
    Arms,
    ArmSequence,
    arms_along,
    bodies,
    light_links,
    simplified,
)
from dt_viz.ui.scene.palette import LIGHT, STYLES
from dt_viz.ui.scene.picture import Arrows, Lines, Look
from dt_viz.ui.scene.rollouts import HandAxes, Rollouts, demonstrations, ghost
from dt_viz.ui.scene.scene import OF_A_MOTION, OF_A_TASK, ScenePictures
from dt_viz.ui.scene.tubes import INSIDE, NUM_RINGS, NUM_SIDES, RolloutTubes, tube_faces
from dt_viz.ui.tabs.plots import NUM_SAMPLES, JointPlots, joint_curves
from dt_viz.ui.tabs.show import IN_SCENE

ROBOT = load_jaco()
REACHING = np.array([0.9, 3.6, 1.6, 0.4, 2.9, -0.3])


def motion(num=60, seconds=4.0, *, sway=0.0):
    """From the ready pose to another, unevenly timed; without avoidance `sway` rad less of joint 1 in its middle."""
    u = np.linspace(0, 1, num) ** 1.5
    q = ROBOT.home + u[:, None] * (REACHING - ROBOT.home)
    without = q - sway * np.sin(np.pi * u)[:, None] * np.eye(6)[0]
    return ArmMotion(seconds * u, q, without)


def frame(arm=None, *, scenario=None, **changes):
    return frame_of(scenario or avoiding("draw_s", (Sphere((0.0, -0.5, 0.4)),)), arm=arm, **changes)


# --- Along the motion ---


def test_a_motion_that_rests_has_arms_too():
    q = np.repeat([ROBOT.home, REACHING], 5, axis=0)
    first, middle, last = arms_along(ROBOT, ArmMotion(np.arange(10.0), q, q), 3)
    np.testing.assert_allclose([first, last], [ROBOT.home, REACHING], atol=1e-9)
    np.testing.assert_allclose(middle, (ROBOT.home + REACHING) / 2, atol=1e-6)
    assert np.isfinite(arms_along(ROBOT, ArmMotion(np.arange(4.0), q[:4], q[:4]), 3)).all()


def test_arms_go_from_start_to_goal_with_the_hand_in_equal_steps():
    arm = motion(400)
    q = arms_along(ROBOT, arm)
    np.testing.assert_allclose(q[[0, -1]], arm.q[[0, -1]])
    hand = ROBOT.end_effector(arm.q)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(hand, axis=0), axis=1))])
    nearest = np.linalg.norm(hand[:, None] - ROBOT.end_effector(q), axis=-1).argmin(axis=0)
    np.testing.assert_allclose(along[nearest], np.linspace(0, along[-1], NUM_ARMS), atol=0.005)


# --- Meshes ---


def test_a_simplified_mesh_stays_within_a_cell_of_the_original():
    ball = trimesh.creation.icosphere(subdivisions=5)
    light = simplified(ball, 0.1)
    assert len(light.faces) < len(ball.faces) / 4
    radii = np.linalg.norm(light.vertices, axis=1)
    assert 1 - 0.1 * np.sqrt(3) < radii.min() and radii.max() <= 1 + 1e-12
    assert (np.diff(np.sort(light.faces, axis=1), axis=1) > 0).all()
    assert light.is_watertight


def test_light_links_have_the_size_of_the_links():
    links = light_links(ROBOT)
    assert list(links) == [1, 2, 3, 4, 5]
    for joint, light in links.items():
        ((_, shell),) = [part for part in bodies(ROBOT)[joint + 1].parts if part[0] == LIGHT.arm]
        assert len(light.faces) < len(shell.faces) / 2
        np.testing.assert_allclose(light.bounds, shell.bounds, atol=CELL)


# --- The scene ---


def test_the_ghost_is_shown_only_where_avoidance_has_moved_a_link(scene):
    arms = Arms(scene, ROBOT)
    arms.show(View(ghost_arm=True))
    assert arms.ghost.visible
    arms.pose(REACHING, REACHING)
    assert not any(link.visible for link in arms.ghost.links)
    arms.pose(REACHING, REACHING + 0.3 * np.eye(6)[3])  # the wrist alone
    assert [link.visible for link in arms.ghost.links] == [False, False, True, True, True]
    arms.pose(REACHING, REACHING + 0.3 * np.eye(6)[0])
    assert all(link.visible for link in arms.ghost.links)


def world_pose(handles, index):
    pose = transforms.SE3.identity()
    for handle in handles[: index + 1]:
        step = transforms.SE3.from_rotation_and_translation(transforms.SO3(np.array(handle.wxyz)), handle.position)
        pose = pose @ step
    return pose


def test_arms_along_the_motion_stand_where_the_arm_would(scene):
    """The arm is a tree of frames, those along the motion are placed in the world: both by the same kinematics."""
    onion, arms, arm = ArmSequence(scene, ROBOT), Arms(scene, ROBOT), motion()
    onion.draw(frame(arm), Look())
    onion.visible = True  # drawn while hidden: it catches up
    for which, q in enumerate(arms_along(ROBOT, arm)):
        arms.pose(q, q)
        for joint, link in onion.links.items():
            pose = world_pose(arms.arm.frames, joint + 1)
            np.testing.assert_allclose(link.position + link.batched_positions[which], pose.translation(), atol=1e-6)
            turned = transforms.SO3(link.batched_wxyzs[which].astype(float)).as_matrix()
            np.testing.assert_allclose(turned, pose.rotation().as_matrix(), atol=1e-6)


@pytest.mark.parametrize("arm", OTHER_ARMS)  # that of seven has a link of which nothing is drawn
def test_an_arm_with_other_joints_is_drawn_where_its_kinematics_say(server, scene, arm):
    robot = OTHER_ARMS[arm]()
    arms, q = Arms(scene, robot), robot.home + np.linspace(0.1, 0.6, robot.num_joints)
    arms.show(View(ghost_arm=True, body_points=True))
    arms.pose(q, robot.home)
    rotations, origins = robot.forward_kinematics(q)
    for joint, (rotation, origin) in enumerate(zip(rotations, origins, strict=True)):
        pose = world_pose(arms.arm.frames, joint + 1)
        np.testing.assert_allclose(pose.translation(), origin, atol=1e-6)
        np.testing.assert_allclose(pose.rotation().as_matrix(), rotation, atol=1e-6)
    shown = [link.visible for link in arms.ghost.links]
    assert len(shown) == sum(bool(body.parts) for body in bodies(robot)[2:]) and any(shown)
    plots, times = JointPlots(server.gui), np.linspace(0.0, 2.0, 9)
    plots.take(robot)
    plots.visible = True
    joints = robot.home + np.linspace(0, 1, 9)[:, None] * (q - robot.home)
    plots.follow(ArmMotion(times, joints, joints))
    num_limited = np.isfinite(robot.lower).sum()
    assert len(plots.angles.data) == 1 + robot.num_joints + 2 * num_limited
    np.testing.assert_allclose(np.radians([curve[-1] for curve in plots.angles.data[1 : robot.num_joints + 1]]), q)
    assert len(plots.speeds.data) == 2 + robot.num_joints


def test_body_points_move_with_the_arm_and_lines_say_from_where(scene):
    arms, points = Arms(scene, ROBOT), load_jaco().body
    q, without = REACHING, REACHING - 0.2 * np.eye(6)[0]
    arms.pose(q, without)
    arms.show(View(body_points=True))  # posed while hidden: they catch up
    body = arms.body
    np.testing.assert_allclose(
        body.spheres.position + body.spheres.batched_positions, points.positions(ROBOT, q), atol=1e-6
    )
    np.testing.assert_allclose(np.asarray(body.spheres.batched_scales), points.radius, atol=1e-7)
    np.testing.assert_allclose(body.paths.node.points[:, 0], points.positions(ROBOT, without), atol=1e-6)
    np.testing.assert_allclose(body.paths.node.points[:, 1], points.positions(ROBOT, q), atol=1e-6)
    on_base, on_hand = body.spheres.batched_colors[points.joint < 0], body.spheres.batched_colors[points.joint == 5]
    assert (on_base == on_base[0]).all() and (on_hand != on_base[0]).any(axis=1).all()


def test_what_is_beside_the_arm_keeps_its_pedestal(scene):
    arms = Arms(scene, ROBOT)
    arms.show(View(arm=False))
    assert not arms.arm.visible and not arms.arm.frames[0].visible
    arms.show(View(arm=False, onion=True))
    assert not arms.arm.visible and arms.arm.frames[0].visible
    arms.show(View())
    assert arms.arm.visible


def test_a_stale_arm_is_translucent_says_so_and_recovers(scene):
    arm = Arms(scene, ROBOT).arm
    assert not arm.stale
    arm.stale = True
    assert arm.stale and all((mesh.opacity or 1) < 1 for mesh in arm.meshes)
    arm.stale = False
    assert not arm.stale and all(mesh.opacity is None for mesh in arm.meshes)


def scene_pictures(scene):
    """Everything in a scene, of which nothing that is dragged tells anyone."""
    return ScenePictures(scene, ROBOT, ignored)


def test_what_lies_on_the_slice_is_hidden_while_it_belongs_to_another_motion(engine, initial, scene):
    pictures = scene_pictures(scene)
    view = View(field=True, streamlines=True, grid=True, onion=True, colour="det")
    good = changed(initial("draw_s"), space="cspace", view=view)
    base = changed(good, obstacles=(Sphere((0.0, 0.0, 0.2)),))

    def shown():
        on = {name for name in OF_A_MOTION if pictures.layer(name).visible}
        return on | ({"colour"} if pictures._by_colour["det"].visible else set())

    for scenario, blocked, expected in ((good, False, {*OF_A_MOTION, "colour"}), (base, True, set())):
        frame = next(engine.frames(scenario))
        assert bool(frame.blocked) == blocked
        pictures.draw(frame)
        pictures.adopt(scenario)
        assert shown() == expected
        rollouts = cast(Rollouts, pictures.layer("rollouts"))
        colours = np.array([rollouts.followed.node.color, rollouts.others.node.color])
        assert rollouts.visible and ((np.ptp(colours, axis=1) < 20) == blocked).all()  # grey, until there are new ones
    pictures.draw(next(engine.frames(good)))
    assert shown() == {*OF_A_MOTION, "colour"}


@pytest.fixture
def drawn(engine, initial, scene):
    """The pictures of a scenario that was adopted and drawn."""

    pictures = scene_pictures(scene)
    scenario = replace(
        initial("draw_s"),
        view=View(field=True, streamlines=True, grid=True, onion=True, panels=(BASE_PANEL,), compared=("linear",)),
    )
    pictures.adopt(scenario)
    pictures.draw(next(engine.frames(scenario)))
    return pictures, scenario


def test_the_hands_axes_stand_along_the_motion_where_it_has_an_orientation(scene, monkeypatch):
    picture, told, turned = HandAxes(scene), frame(), transforms.SO3.from_x_radians(0.5).as_matrix()
    picture.draw(told, Look())
    assert not picture.visible
    places = np.linspace(0.0, 0.3, 21).reshape(7, 3)
    monkeypatch.setattr(type(told), "hand_frames", lambda _, num: (places[:num], np.tile(turned, (num, 1, 1))))
    picture.draw(told, Look())
    assert picture.visible
    for axis, along in zip(picture.axes, turned.T, strict=True):
        np.testing.assert_allclose(axis.node.points[:, 0], places, atol=1e-6)
        ends = axis.node.points[:, 1] - places
        np.testing.assert_allclose(ends / np.linalg.norm(ends[0]), along[None].repeat(7, 0), atol=1e-5)
    assert len({tuple(np.ravel(axis.node.colors)[:3]) for axis in picture.axes}) == 3
    picture.draw(told, Look(blocked=True))
    assert not picture.visible


def is_grey(pictures):
    rollouts = cast(Rollouts, pictures.layer("rollouts"))
    shown = {pictures.layer(name).visible for name in (*OF_A_MOTION, *OF_A_TASK)}
    grey = bool(np.ptp(rollouts.followed.node.color) < 20)
    assert shown == {not grey}
    return grey


def test_lines_that_rollouts_cover_are_drawn_where_the_rollouts_are_hidden(drawn):
    pictures, scenario = drawn
    ghost, demonstrations = (pictures.layer(name).node for name in ("ghost", "demonstrations"))
    before = ghost.points, demonstrations.points
    pictures.adopt(replace(scenario, view=replace(scenario.view, rollouts=False)))
    assert len(ghost.points) > len(before[0])
    assert len(demonstrations.points) == sum(len(path) - 1 for path in TASKS["draw_s"]().paths)
    pictures.adopt(scenario)
    np.testing.assert_array_equal(ghost.points, before[0])
    np.testing.assert_array_equal(demonstrations.points, before[1])


@pytest.mark.parametrize("changes", [{"task": "lift_box"}, {"scene": "cloud"}, {"objective": "velocity"}], ids=str)
def test_what_is_drawn_of_another_task_or_scene_is_grey_until_its_own_frame_comes(drawn, engine, changes):
    pictures, scenario = drawn
    assert not is_grey(pictures)
    chosen = replace(scenario, **changes)
    pictures.adopt(chosen)
    assert is_grey(pictures) and pictures.look.stale
    pictures.draw(next(engine.frames(scenario)))  # what was under way when it was chosen
    assert is_grey(pictures)
    pictures.adopt(scenario)
    assert not is_grey(pictures)
    pictures.adopt(chosen)
    pictures.draw(replace(next(engine.frames(scenario)), scenario=chosen))
    assert not is_grey(pictures) and not pictures.look.stale


def test_nothing_is_grey_while_something_is_dragged(drawn):
    pictures, scenario = drawn
    pictures.adopt(changed(scenario, obstacles=(Sphere((0.1, -0.4, 0.3)),), temperature=3.0))
    assert not is_grey(pictures)


@pytest.mark.parametrize("num", [0, 1, 5])
def test_the_browser_gets_a_colour_for_each_arrow_and_of_none_a_single_one(scene, num):
    lines, arrows = Lines(scene, "/lines", STYLES.ghost), Arrows(scene, "/arrows", STYLES.field)
    for _ in range(2):
        lines.show_segments(np.ones((num, 2, 3)), LIGHT)
        arrows.show(np.ones((num, 3)), np.ones((num, 3)), LIGHT)
        assert len(lines.node.points) == len(arrows.node.points) == num
        assert lines.node.colors.shape == (3,)
        assert arrows.node.colors.shape[0] == (num or 3)


# --- Joint plots ---


def test_speeds_are_parts_of_each_joints_limit():
    times = np.linspace(0, 3, 50)
    q = ROBOT.home + times[:, None] * ROBOT.velocity_limits * [1, -1, 0.5, 0, 0.25, -0.5]
    curves = joint_curves(ArmMotion(times, q, q), ROBOT)
    np.testing.assert_allclose(curves.speeds, np.broadcast_to([100, 100, 50, 0, 25, 50], (NUM_SAMPLES, 6)), atol=1e-9)
    np.testing.assert_allclose(curves.angles[[0, -1]], np.degrees(q[[0, -1]]))
    assert (curves.times[0], curves.times[-1]) == (0, 3)


@pytest.mark.parametrize("at", [3, 1234, 3990])
def test_no_peak_of_a_speed_is_lost_between_the_samples_of_the_plot(at):
    times = np.linspace(0, 3, 4000)
    q = np.tile(ROBOT.home, (4000, 1))
    q[at:, 2] += 0.01
    curves = joint_curves(ArmMotion(times, q, q), ROBOT)
    expected = 100 * 0.01 / (times[1] * ROBOT.velocity_limits[2])
    assert curves.speeds[:, 2].max() == pytest.approx(expected)
    assert abs(curves.times[curves.speeds[:, 2].argmax()] - times[at]) < 3 / NUM_SAMPLES


def test_two_samples_at_one_time_give_a_finite_speed():
    arm = ArmMotion(np.array([0.0, 1.0, 1.0, 2.0]), np.tile(ROBOT.home, (4, 1)), np.tile(ROBOT.home, (4, 1)))
    assert np.isfinite(joint_curves(arm, ROBOT).speeds).all()


def test_plots_have_the_limits_of_limited_joints_and_stay_where_there_is_no_motion(server):
    plots = JointPlots(server.gui)
    plots.take(ROBOT)
    plots.visible = True
    for motions in (motion(), None):
        plots.follow(motions)
        for plot in (plots.angles, plots.speeds):
            assert {len(column) for column in plot.data} == {NUM_SAMPLES} and len(plot.data) == len(plot.series)
        limits = sorted({column[0] for column in plots.angles.data[7:]})
        finite = np.concatenate([limit[np.isfinite(limit)] for limit in (ROBOT.lower, ROBOT.upper)])
        np.testing.assert_allclose(limits, np.sort(np.degrees(finite)))
        assert (plots.speeds.data[7] == 100).all()


def test_every_layer_has_a_checkbox():
    switches = {f.name for f in fields(View) if f.type == "bool"}
    switches -= {"playing", "replay", "move_slice", "click_to_start", "handles", "bias_handles", "large_plots"}
    assert {*IN_SCENE, "joint_plots", "health_plots"} == switches | {"panels"}


# --- Rollouts as tubes, and what they cover ---

RADIUS, BALL = 0.003, 0.007
SCENARIO = avoiding("draw_s", (Sphere((0.0, -0.5, 0.4)),))


def helix(turns, rise=0.3, samples=400):
    angle = 2 * np.pi * turns * np.linspace(0, 1, samples)
    return np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), rise * np.linspace(0, 1, samples)], axis=1)


PATHS = np.stack([evenly_bent(helix(turns), NUM_RINGS) for turns in (0.2, 1.0, 3.0)])


def test_a_tube_lies_around_its_path_with_its_faces_outward():
    vertices = tubes(PATHS, RADIUS, 0.0, NUM_SIDES)
    for path, tube in zip(PATHS, vertices, strict=True):
        np.testing.assert_allclose(np.linalg.norm(tube[1:-1] - path[:, None], axis=2), RADIUS, rtol=1e-5)
        np.testing.assert_allclose(tube[[0, -1]], np.repeat(path[[0, -1], None], NUM_SIDES, axis=1), atol=1e-7)
        mesh = trimesh.Trimesh(tube.reshape(-1, 3), tube_faces(1, *tube.shape[:2]))
        mesh.merge_vertices()
        mesh.update_faces(mesh.nondegenerate_faces())
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        assert mesh.is_volume
        assert mesh.volume == pytest.approx(
            NUM_SIDES / 2 * np.sin(2 * np.pi / NUM_SIDES) * RADIUS**2 * length, rel=0.02
        )


def test_rings_do_not_twist_from_one_to_the_next():
    """A corner moves from ring to ring as far as the middle, and what the tangent's turn adds."""
    corners = tubes(PATHS, RADIUS, 0.0, NUM_SIDES)[:, 1:-1]
    steps = np.linalg.norm(np.diff(corners - PATHS[:, :, None], axis=1), axis=-1)
    tangents = np.gradient(PATHS, axis=1)
    tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
    turns = np.linalg.norm(np.diff(tangents, axis=1), axis=-1)
    assert (steps <= 1.1 * RADIUS * turns[..., None] + 1e-7).all()


def test_a_ball_is_at_the_beginning():
    globe = tubes(PATHS, RADIUS, BALL, NUM_SIDES)[:, : -NUM_RINGS - 1]
    np.testing.assert_allclose(np.linalg.norm(globe - PATHS[:, :1, None], axis=-1), BALL, rtol=1e-5)
    assert np.ptp(globe[:, :, 0] @ [0, 0, 1], axis=1).max() > 0.1 * BALL


def test_points_are_denser_where_a_path_bends():
    ends = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]])
    corner = np.concatenate([np.linspace(a, b, 100) for a, b in pairwise(ends)])
    spacing = np.linalg.norm(np.diff(evenly_bent(corner, NUM_RINGS), axis=0), axis=1)
    assert spacing.min() < 0.6 * spacing.max()
    np.testing.assert_allclose(evenly_bent(np.zeros((4, 3)), NUM_RINGS), 0)


def covering(*rollouts, **changes):
    task = TASKS["draw_s"]()
    return frame_of(SCENARIO, task=task, rollouts=rollouts, ghost=rollouts, chosen=0, **changes)


def test_lines_are_drawn_only_beside_the_rollouts(scene):
    task = TASKS["draw_s"]()
    thin, dashed = demonstrations(scene), ghost(scene)
    first = covering(*task.paths)
    for picture in (thin, dashed):
        picture.draw(first, Look(tubes=RolloutTubes(first.rollouts)))
    assert len(thin.node.points) == len(dashed.node.points) == 0
    aside = tuple(path + np.array([0.0, 0.02, 0.0]) for path in task.paths)
    half = replace(first, rollouts=(*aside[:3], *task.paths[3:]))
    thin.draw(half, Look(tubes=RolloutTubes(half.rollouts)))
    middles = thin.node.points.mean(axis=1)
    samples = np.concatenate([evenly_bent(path, NUM_RINGS) for path in half.rollouts])
    assert len(middles) > 100 and KDTree(samples).query(middles)[0].min() > 0.99 * INSIDE
    dashed.draw(first, Look(tubes=RolloutTubes(first.rollouts, shown=False)))
    assert len(dashed.node.points) > 10  # nothing covers it any more
