"""The scenes of the paper: each can be computed, and what its line says is true."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.io
import trimesh
from scenes import changed, frame_at

from dt_viz.avoidance.bias import MAX_TARGET_MISS
from dt_viz.learning.store import FitStore
from dt_viz.metrics import distance_from_path, maximum_collision_distance, resample_by_arc_length
from dt_viz.obstacles.shapes import CloudObstacle, MeshObstacle, Sphere
from dt_viz.scenario.paper_scenes import CLOVER, SCENES, Clover, offered
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import WHOLE_ARM, anchored
from dt_viz.scenario.tasks import POTS, TASKS, known_tasks
from dt_viz.scenario.tour import STEPS, TASK
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

SHIPPED = [scene.name for scene in offered(TASKS)]


CERTIFIED = {"cube", "learned", "left_pot", "augmented"}
"""Names of scenes whose certificates are quick to compute."""


@pytest.fixture(scope="session")
def live(engine, at_rest):
    """The frame of a scene by its name that follows a drag."""
    return lambda name: at_rest(SCENES[name].scenario(engine.task(SCENES[name].task)), Stage.LIVE)


@pytest.mark.long
@pytest.mark.parametrize("name", SHIPPED)
def test_a_scene_is_shown_without_warnings(live, name):
    frame, scene = live(name), SCENES[name]
    assert frame.scenario.scene == name == scene.name
    assert scene.task in TASKS
    assert scene.title and scene.line.endswith(".")
    assert frame.blocked == () and frame.certificates.warnings == ()
    for path in frame.rollouts:
        np.testing.assert_allclose(path[-1], frame.reached, atol=1e-3)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in CERTIFIED else pytest.mark.slow) for name in SHIPPED]
)
def test_certificates_of_a_scene_hold(engine, name):
    *_, frame = engine.frames(SCENES[name].scenario(engine.task(SCENES[name].task)))
    assert frame.blocked == ()
    avoids = frame.scenario.view.arm or frame.scenario.avoidance.space == "cspace"
    known = () if avoids else frame.certificates.collision.warnings
    assert set(frame.certificates.warnings) <= set(known)
    assert frame.certificates.min_det_jacobian > 0
    assert frame.certificates.round_trip_error < 1e-6
    assert frame.certificates.lyapunov_falls
    assert frame.arm is not None


@pytest.mark.long
def test_letters_of_the_lasa_data_are_a_scene_where_the_user_has_them_all(tmp_path, robot):
    """The files hold drawings that ship with DT-Viz, laid out as those of LASA, which may not be passed on."""
    scene, cells = SCENES["lasa"], np.empty((1, 7), dtype=object)
    for i, demonstration in enumerate(TASKS["draw_c"]().demonstrations):
        cells[0, i] = {"pos": 100 * demonstration.positions.T, "t": demonstration.times[None]}
    for name in scene.tasks - {"Angle"}:
        scipy.io.savemat(tmp_path / f"{name}.mat", {"demos": cells})
    assert scene not in offered(known_tasks(tmp_path))
    scipy.io.savemat(tmp_path / "Angle.mat", {"demos": cells})
    tasks = known_tasks(tmp_path)
    assert scene in offered(tasks) and len(scene.tasks) == 8
    engine = Engine(tasks, FitStore(None), robot)
    frame = frame_at(engine, scene.scenario(engine.task(scene.task)), Stage.LIVE)
    assert [panel.title for panel in frame.pictures.panels][-1] == "LASA Sshape"
    assert {panel.title for panel in frame.pictures.panels} == {f"LASA {name}" for name in scene.tasks}
    assert frame.certificates.warnings == ()


@pytest.mark.parametrize("name", ["lift", "push"])
def test_the_whole_arm_gives_way_to_a_standing_bottle_and_reaches_the_goal(live, name):
    frame = live(name)
    (bottle,) = frame.scenario.obstacles
    assert isinstance(bottle, MeshObstacle)
    vertices, faces = bottle.surface()
    assert trimesh.Trimesh(vertices, faces).is_volume
    assert vertices[:, 2].min() == bottle.position[2] == 0  # stands on the table
    radius = np.linalg.norm(vertices[:, :2], axis=1)
    assert radius[vertices[:, 2] > 0.25].max() < 0.5 * radius.max()  # and has a neck
    (box,) = frame.task.objects
    assert bottle.signed_distance(box.start + box.surface()[0]).min() > 0.005  # beside the box
    assert frame.scenario.avoidance.space == "cspace"
    assert bottle.signed_distance(frame.pictures.field.points).min() > 0
    undisturbed = max(maximum_collision_distance(path, bottle.signed_distance) for path in frame.ghost)
    assert undisturbed > 0.01  # it is in the way
    assert frame.certificates.clearance > 0
    assert frame.durations[WHOLE_ARM] > 0
    np.testing.assert_allclose(frame.reached, frame.goal, atol=1e-3)


def test_the_clover_is_known_by_labelled_points_only_and_every_stroke_leaves_it(live):
    frame = live("cloud")
    (cloud,) = frame.scenario.obstacles
    assert isinstance(cloud, CloudObstacle) and cloud.cloud == CLOVER.cloud
    assert Clover().cloud == cloud.cloud  # the same every time
    points, occupied = cloud.labelled()
    assert 0.05 < occupied.mean() < 0.5
    own = points - cloud.position
    np.testing.assert_array_equal(CLOVER.holds(own), occupied)
    assert not CLOVER.holds((own[occupied][:-1] + own[occupied][1:]) / 2).all()  # it is not convex
    distance = cloud.signed_distance(points)  # from what is learned, which is rounder than the tips of the leaves
    assert (distance[occupied] < 0).mean() > 0.95 and distance[occupied].max() < 0.012
    assert (distance[~occupied] > 0).mean() > 0.95 and distance[~occupied].min() > -0.012
    undisturbed = max(maximum_collision_distance(path, cloud.signed_distance) for path in frame.ghost)
    assert undisturbed > 0.02
    assert max(maximum_collision_distance(path, cloud.signed_distance) for path in frame.rollouts) == 0
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        np.testing.assert_allclose(path[[0, -1]], before[[0, -1]], atol=1e-3)
        for here, there, beyond in ((before, path, 0.06), (path, before, 0.08)):
            away = here[cloud.signed_distance(here) > beyond]  # there nothing else is drawn
            assert len(away) > 50
            assert max(np.linalg.norm(there - point, axis=1).min() for point in away) < 0.033
    assert SCENES["cloud"].view["colour"] == "occupancy"


@pytest.mark.parametrize("name", ["steps", "cube"])
def test_motions_of_a_flat_figure_give_way_in_its_plane(live, name):
    frame = live(name)
    distance = frame.scenario.obstacle.signed_distance
    assert min(maximum_collision_distance(path, distance) for path in frame.ghost) > 0.02
    assert min(distance(path).min() for path in frame.rollouts) > 0.009
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        height, usual = ((part - frame.slice.centre) @ frame.slice.normal for part in (path, before))
        assert np.abs(height).max() <= np.abs(usual).max() + 1e-4


@pytest.mark.long
def test_panels_show_each_step_from_the_base_attractor(live):
    titles = {name: [panel.title for panel in live(name).pictures.panels] for name in SHIPPED}
    assert titles["steps"] == ["base attractor", "imitation", "+ avoidance"]
    assert titles["cube"] == ["base attractor", "+ avoidance"]
    assert titles["learned"] == ["base attractor", "field −V of imitation", "imitation"]
    assert titles["two_points"] == ["imitation", "field −V of bias 1", "+ bias 1", "+ bias 2"]
    assert titles["letters"] == [f"Draw {letter}" for letter in "CGJWZS"]
    assert titles["style"] == ["Draw S", "Draw wavy S", "Draw C, wavy × 1"]
    assert titles["lift"] == titles["left_pot"] == []


@pytest.mark.parametrize("name", SHIPPED)
def test_a_scene_is_changed_by_what_acts_in_it_not_by_how_it_is_looked_at(engine, name):
    scene = SCENES[name]
    task = engine.task(scene.task)
    own = scene.scenario(task)
    for same in ({}, {"view": View(grid=True)}, {"warp": 0.5}, {"starts": ((0.0, -0.5, 0.3),)}, {"arm_rollout": 2}):
        assert not scene.is_changed(replace(own, **same), task)
    for other in ({"margin": 0.02}, {"obstacles": (Sphere((0.0, -0.5, 0.3)),)}, {"imitation": not own.imitation}):
        assert scene.is_changed(changed(own, **other), task)


def test_every_stroke_of_the_j_passes_both_points_within_a_centimetre(live):
    frame = live("two_points")
    points = anchored(frame.scenario)
    assert len(points) == 2
    for point in points.values():
        assert min(np.linalg.norm(path - point.position, axis=1).min() for path in frame.ghost) > 0.02
        for path in frame.rollouts:
            assert np.linalg.norm(resample_by_arc_length(path, 2000) - point.position, axis=1).min() <= 0.0105
    np.testing.assert_allclose(frame.reached, frame.goal, atol=1e-3)


@pytest.mark.parametrize(("name", "chosen"), [("left_pot", 0), ("centre_pot", 1), ("right_pot", 2)])
def test_the_object_falls_into_the_chosen_pot(live, name, chosen):
    frame = live(name)
    assert frame.task.pots == POTS
    assert [pot.x for pot in POTS] == sorted(pot.x for pot in POTS)
    for before, path in zip(frame.ghost, frame.rollouts, strict=True):
        assert [pot.catches(before[-1]) for pot in POTS] == [False, True, False]
        assert [pot.catches(path[-1]) for pot in POTS] == [k == chosen for k in range(3)]


# the steps of the tour


ATTRACTOR, WARP, STABLE, OBSTACLE, ARM, ALL = STEPS


@pytest.fixture
def shown(engine):
    """The certified frame of a step, with changes of its scenario."""

    def frame(step, **changes):
        return frame_at(engine, replace(step.scenario(engine.task(TASK)), **changes), Stage.CERTIFIED)

    return frame


def from_chord(path):
    """Largest distance of a path from the straight line between its ends, metres."""
    along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
    offsets = path - path[0]
    return np.linalg.norm(offsets - np.outer(offsets @ along, along), axis=1).max()


@pytest.mark.parametrize("step", [ATTRACTOR, WARP], ids=lambda step: step.title)
def test_motions_are_straight_to_the_goal_where_nothing_is_warped(shown, step):
    frame = shown(step)
    assert max(map(from_chord, frame.rollouts)) < 1e-6
    assert max(np.linalg.norm(path[-1] - frame.goal) for path in frame.rollouts) < 1e-4


def test_the_full_warp_bends_them_to_the_seven_demonstrations_within_millimetres(shown):
    frame = shown(WARP, warp=1.0)
    misses = [distance_from_path(*pair).mean() for pair in zip(frame.rollouts, frame.task.paths, strict=True)]
    assert len(misses) == 7 and max(misses) < 0.01 and min(map(from_chord, frame.rollouts)) > 0.1
    assert WARP.grows and frame.certificates.min_det_jacobian > 0


def test_from_any_start_the_motion_ends_at_the_goal_and_the_lyapunov_value_falls(shown):
    frame = shown(STABLE)
    assert len(frame.rollouts) > len(frame.task.paths)
    assert max(np.linalg.norm(path[-1] - frame.goal) for path in frame.rollouts) < 1e-4
    assert frame.certificates.lyapunov_falls and frame.certificates.warnings == ()


def test_the_hand_flows_around_the_sphere_that_stands_in_its_way_to_the_same_goal(shown):
    frame, before = shown(OBSTACLE), shown(WARP, warp=1.0)
    assert max(path_depth(frame, path) for path in before.rollouts) > 0.05
    assert max(path_depth(frame, path) for path in frame.rollouts) < 0
    np.testing.assert_allclose(frame.goal, before.goal, atol=1e-6)
    assert frame.scenario.arm_avoidance is None


def path_depth(frame, path):
    """How deep a path is in the obstacles of a frame at most, metres; negative where it is clear."""
    return -frame.scenario.obstacle.signed_distance(path).min()


@pytest.mark.long
@pytest.mark.parametrize("step", [ARM, ALL], ids=lambda step: step.title)
def test_the_whole_arm_is_free_of_contact_and_every_check_holds(shown, step):
    frame = shown(step)
    collision = frame.certificates.collision
    assert frame.scenario.arm_avoidance is not None and frame.scenario.view.arm
    assert collision.obstacle.distance > 0
    assert frame.certificates.warnings == () and not frame.blocked


@pytest.mark.long
def test_at_the_end_the_motion_passes_the_bias_point_beside_the_demonstrations(shown):
    frame = shown(ALL)
    ((_, point),) = anchored(frame.scenario).items()
    target = np.array([point.position])
    assert max(distance_from_path(target, path).max() for path in frame.rollouts) < MAX_TARGET_MISS
    assert min(distance_from_path(target, path).min() for path in frame.task.paths) > 0.03
