"""Rollouts as tubes, and what they cover."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from pages import frame_of
from scenes import avoiding
from scipy.spatial import KDTree

from dt_viz.kernels.tubes import evenly_bent, tubes
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.rollouts import demonstrations, ghost
from dt_viz.ui.scene.style import Style
from dt_viz.ui.scene.tubes import INSIDE, NUM_RINGS, NUM_SIDES, RolloutTubes, Tubes, tube_faces

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


def test_faces_are_sent_only_when_the_number_of_paths_changes(scene):
    shown = Tubes(scene, "/tubes", Style("rollout", radius=RADIUS))
    shown.show(PATHS, LIGHT)
    faces = shown.node.faces
    shown.show(PATHS + 0.1, LIGHT)
    assert shown.node.faces is faces
    shown.show(PATHS[:0], LIGHT)
    assert len(shown.node.faces) == 1 and np.ptp(shown.node.vertices) == 0


def frame(*rollouts, **changes):
    task = TASKS["draw_s"]()
    return frame_of(SCENARIO, task=task, rollouts=rollouts, ghost=rollouts, chosen=0, **changes)


def test_lines_are_drawn_only_beside_the_rollouts(scene):
    task = TASKS["draw_s"]()
    thin, dashed = demonstrations(scene), ghost(scene)
    first = frame(*task.paths)
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
