"""Closing surfaces: small holes and seams are mended, large ones refused with their size."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.errors import FormatError
from dt_viz.obstacles.mending import MAX_FILLED, closed

BALL = trimesh.creation.icosphere(3, 0.1)
BOX = trimesh.creation.box((0.15, 0.1, 0.08))
TUBE = trimesh.creation.cylinder(0.05, 0.2)
UP = [0.0, 0.0, 1.0]


def volume(mesh) -> float:
    found = closed(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    again = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert again.is_watertight and again.is_winding_consistent
    assert again.volume == pytest.approx(found.volume)
    return found.volume


def without(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~faces], process=False)


def above(mesh: trimesh.Trimesh, height: float) -> np.ndarray:
    return mesh.triangles_center[:, 2] > height


def bowl() -> trimesh.Trimesh:
    """With walls, but open where they should meet at the rim."""
    half, inner = BALL.slice_plane([0, 0, 0], [0, 0, -1]), trimesh.creation.icosphere(3, 0.09)
    inner.invert()
    inner = inner.slice_plane([0, 0, 0], [0, 0, -1])
    both = trimesh.util.concatenate([half, inner])
    assert isinstance(both, trimesh.Trimesh)
    return both


@pytest.mark.parametrize(
    ("mesh", "holes"),
    [
        (without(BOX, above(BOX, 0.039)), "1 hole, 21.4% of its closed surface, the largest 18 cm across"),
        (BALL.slice_plane([0, 0, 0], UP), "1 hole, 33"),
        (bowl(), "2 holes, "),
        (without(TUBE, np.abs(TUBE.triangles_center[:, 2]) > 0.099), "2 holes, 19.9%"),
        (without(BALL, above(BALL, 0.09)), "1 hole, "),
    ],
    ids=["box without lid", "half a sphere", "bowl", "tube without caps", "cup"],
)
def test_what_has_large_holes_is_refused_with_their_size_and_a_way_out(mesh, holes):
    with pytest.raises(FormatError) as info:
        closed(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert info.value.found.startswith(holes)
    assert f"up to {MAX_FILLED:.0%}" in info.value.accepted and "convex hull" in info.value.accepted


@given(st.sets(st.integers(0, len(BALL.faces) - 1), min_size=1, max_size=8))
def test_a_few_missing_triangles_are_filled_wherever_they_are(missing):
    mask = np.isin(np.arange(len(BALL.faces)), list(missing))
    assert volume(without(BALL, mask)) == pytest.approx(BALL.volume, rel=5e-3)


def test_holes_that_touch_at_a_corner_are_two_holes():
    around = [k for k, face in enumerate(BALL.faces) if 0 in face]
    shared = without(BALL, np.isin(np.arange(len(BALL.faces)), [around[0], around[2]]))
    found = closed(np.asarray(shared.vertices), np.asarray(shared.faces))
    assert found.notes[0].startswith("2 holes (")
    assert found.volume == pytest.approx(BALL.volume, rel=1e-3)


@pytest.mark.parametrize("shift", [0.0, 1e-9, 3e-7])
def test_seams_are_closed(shift):
    loose = BALL.triangles.reshape(-1, 3) + np.random.default_rng(0).uniform(-shift, shift, (3 * len(BALL.faces), 3))
    mesh = trimesh.Trimesh(loose, np.arange(len(loose)).reshape(-1, 3), process=False)
    assert volume(mesh) == pytest.approx(BALL.volume, rel=1e-3)


def test_the_inside_of_a_hollow_ball_stays_its_inside_stray_vertices_and_doubled_triangles_do_not_count():
    inner = trimesh.creation.icosphere(3, 0.05)
    inner.invert()
    assert volume(trimesh.util.concatenate([BALL, inner])) == pytest.approx(BALL.volume + inner.volume)
    stray = trimesh.Trimesh(np.concatenate([BALL.vertices, [[1e30, 0, 0]]]), BALL.faces, process=False)
    assert volume(stray) == pytest.approx(BALL.volume)
    doubled = trimesh.Trimesh(BALL.vertices, np.concatenate([BALL.faces, BALL.faces[::2, ::-1]]), process=False)
    assert volume(doubled) == pytest.approx(BALL.volume)


@given(st.integers(0, 2**32 - 1))
def test_triangles_that_face_the_other_way_are_turned(seed):
    faces = BALL.faces.copy()
    turned = np.random.default_rng(seed).random(len(faces)) < 0.3
    faces[turned] = faces[turned, ::-1]
    found = closed(np.asarray(BALL.vertices), faces)
    assert found.notes == ("triangles that faced inwards were turned",)
    assert found.volume == pytest.approx(BALL.volume)


FIN = np.concatenate([BOX.vertices, [[0.0, 0.0, 0.3]]]), np.concatenate([BOX.faces, [[*BOX.faces[0, :2], 8]]])
LOOSE = np.random.default_rng(0).uniform(0, 0.2, (30_000, 3)), np.arange(30_000).reshape(-1, 3)


@pytest.mark.parametrize(
    ("surface", "words"),
    [(FIN, "1 of them more than two"), (LOOSE, "30000 edges that do not join two triangles")],
    ids=["a fin", "loose triangles"],
)
def test_edges_that_do_not_join_two_triangles_are_refused_soon(surface, words):
    with pytest.raises(FormatError, match=words):
        closed(*surface)


def test_a_surface_with_one_side_is_refused():
    """A Klein bottle: closed, but nothing is inside."""
    n = 12
    u, v = (2 * np.pi * k.ravel() / n for k in np.indices((n, n)) + np.reshape([0, 0.5], (2, 1, 1)))
    r = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
    z = np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)
    vertices = 0.05 * np.stack([r * np.cos(u), r * np.sin(u), z], axis=1)

    def node(i: int, j: int) -> int:
        return i * n + j % n if i < n else (-j - 1) % n  # all the way round, the other way up

    quads = [[node(i, j), node(i + 1, j), node(i + 1, j + 1), node(i, j + 1)] for i in range(n) for j in range(n)]
    faces = np.array(quads)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    with pytest.raises(FormatError, match="one side only"):
        closed(vertices, faces)
