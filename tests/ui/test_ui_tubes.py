"""Rollouts as tubes, what they cover, and how they fade where they jump."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from pages import frame_of
from scenes import avoiding
from scipy.spatial import KDTree

from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.scene import rollouts as rollouts_module
from dt_viz.ui.scene.rollouts import COVERED, JUMP, OPACITY, SPARSE, Demonstrations, Ghost, Middles, Rollouts
from dt_viz.ui.scene.tubes import NUM_RINGS, NUM_SIDES, Tubes, evenly_bent, tube_faces, tubes

RADIUS, BALL = 0.003, 0.007
SCENARIO = avoiding("draw_s", (Sphere((0.0, -0.5, 0.4)),))


def helix(turns, rise=0.3, samples=400):
    angle = 2 * np.pi * turns * np.linspace(0, 1, samples)
    return np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), rise * np.linspace(0, 1, samples)], axis=1)


PATHS = np.stack([evenly_bent(helix(turns)) for turns in (0.2, 1.0, 3.0)])


def test_a_tube_lies_around_its_path_with_its_faces_outward():
    vertices = tubes(PATHS, RADIUS)
    for path, tube in zip(PATHS, vertices, strict=True):
        np.testing.assert_allclose(np.linalg.norm(tube[1:-1] - path[:, None], axis=2), RADIUS, rtol=1e-6)
        np.testing.assert_allclose(tube[[0, -1]], np.repeat(path[[0, -1], None], NUM_SIDES, axis=1))
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
    corners = tubes(PATHS, RADIUS)[:, 1:-1]
    steps = np.linalg.norm(np.diff(corners - PATHS[:, :, None], axis=1), axis=-1)
    tangents = np.gradient(PATHS, axis=1)
    tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
    turns = np.linalg.norm(np.diff(tangents, axis=1), axis=-1)
    assert (steps <= 1.1 * RADIUS * turns[..., None] + 1e-9).all()


def test_a_ball_is_at_the_beginning():
    globe = tubes(PATHS, RADIUS, BALL)[:, : -NUM_RINGS - 1]
    np.testing.assert_allclose(np.linalg.norm(globe - PATHS[:, :1, None], axis=-1), BALL, rtol=1e-9)
    assert np.ptp(globe[:, :, 0] @ [0, 0, 1], axis=1).max() > 0.1 * BALL


def test_points_are_denser_where_a_path_bends():
    ends = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]])
    corner = np.concatenate([np.linspace(a, b, 100) for a, b in pairwise(ends)])
    spacing = np.linalg.norm(np.diff(evenly_bent(corner), axis=0), axis=1)
    assert spacing.min() < 0.6 * spacing.max()
    np.testing.assert_allclose(evenly_bent(np.zeros((4, 3))), 0)


def test_faces_are_sent_only_when_the_number_of_paths_changes(scene):
    shown = Tubes(scene, "/tubes", (10, 20, 30), RADIUS)
    shown.show(PATHS)
    faces = shown.node.faces
    shown.show(PATHS + 0.1)
    assert shown.node.faces is faces
    shown.show(PATHS[:0])
    assert len(shown.node.faces) == 1 and np.ptp(shown.node.vertices) == 0


def frame(*rollouts, **changes):
    task = TASKS["draw_s"]()
    return frame_of(SCENARIO, task=task, rollouts=rollouts, ghost=rollouts, chosen=0, **changes)


def test_lines_are_drawn_only_beside_the_rollouts(scene):
    task, tubes = TASKS["draw_s"](), Middles()
    demonstrations, ghost = Demonstrations(scene, tubes), Ghost(scene, tubes)
    first = frame(*task.paths)
    demonstrations.draw(first)
    ghost.draw(first)
    assert len(demonstrations._lines.node.points) == len(ghost._lines.node.points) == 0
    aside = tuple(path + np.array([0.0, 0.02, 0.0]) for path in task.paths)
    half = replace(first, rollouts=(*aside[:3], *task.paths[3:]))
    demonstrations.draw(half)
    middles = demonstrations._lines.node.points.mean(axis=1)
    samples = np.concatenate([evenly_bent(path) for path in half.rollouts])
    assert len(middles) > 100 and KDTree(samples).query(middles)[0].min() > 0.99 * COVERED
    tubes.shown = False
    ghost.draw(first)
    assert len(ghost._lines.node.points) > 10  # nothing covers it any more


class TestJumps:
    @pytest.fixture
    def clock(self, monkeypatch):
        times = [100.0]
        monkeypatch.setattr(rollouts_module.time, "monotonic", lambda: times[0])
        return times

    @pytest.mark.parametrize(("by", "fades"), [(0.9 * JUMP, False), (1.1 * JUMP, True)])
    def test_what_jumps_fades_where_it_was(self, scene, clock, by, fades):
        rollouts, paths = Rollouts(scene, Middles()), (helix(0.5), helix(0.7))
        former = rollouts.former.node
        rollouts.draw(frame(*paths))
        rollouts.fade()
        assert not former.visible
        rollouts.draw(frame(paths[0], paths[1] + [by, 0.0, 0.0]))
        shown = []
        for clock[0] in (100.0, 100.05, 100.1, 100.2):
            rollouts.fade()
            shown.append(former.opacity if former.visible else 0.0)
        if not fades:
            assert shown == [0, 0, 0, 0]
            return
        np.testing.assert_allclose(shown, [OPACITY, OPACITY * 2 / 3, OPACITY / 3, 0])
        middles = former.vertices.reshape(-1, NUM_SIDES, 3).mean(axis=1)
        np.testing.assert_allclose(middles[1:-1], evenly_bent(paths[1])[::SPARSE], atol=1e-6)
        assert former.vertices.nbytes + former.faces.nbytes < 60e3 / 7  # with all seven of a drag frame's 90 kB: 150 kB

    def test_another_task_fades_nothing(self, scene, clock):
        rollouts = Rollouts(scene, Middles())
        rollouts.draw(frame(helix(0.5)))
        rollouts.draw(replace(frame(helix(0.5) + 1.0), task=TASKS["lift_box"]()))
        rollouts.fade()
        assert not rollouts.former.node.visible
