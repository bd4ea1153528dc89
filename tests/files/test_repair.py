"""Damaged meshes: what a few missing and turned triangles leave is the same solid, and large holes are refused."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dt_viz.errors import FormatError
from dt_viz.files.repair import repaired
from dt_viz.obstacles import solids
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario.paper_scenes import bottle

BALL = trimesh.creation.icosphere(3, 0.1)
BOX = trimesh.creation.box((0.15, 0.1, 0.08))
TUBE = trimesh.creation.cylinder(0.05, 0.2)
UP = [0.0, 0.0, 1.0]
SHAPES = {
    "ball": trimesh.creation.icosphere(4, 0.07),
    "bottle": trimesh.Trimesh(bottle().vertices, bottle().faces),
    "box": BOX.subdivide().subdivide().subdivide().subdivide(),
    "hollow ball": trimesh.util.concatenate([BALL, trimesh.creation.icosphere(3, 0.07).copy()]),
}
SHAPES["hollow ball"].faces[len(BALL.faces) :] = SHAPES["hollow ball"].faces[len(BALL.faces) :, ::-1]


def repair(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    vertices, faces, _ = repaired(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return trimesh.Trimesh(vertices, faces, process=False)


def without(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~faces], process=False)


def above(mesh: trimesh.Trimesh, height: float) -> np.ndarray:
    return mesh.triangles_center[:, 2] > height


def volume(mesh: trimesh.Trimesh) -> float:
    again = repair(mesh)
    assert again.is_watertight and again.is_winding_consistent
    return float(again.volume)


@pytest.fixture(scope="module", autouse=True)
def _coarsely():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=32**3, num_samples=6000))
        yield


@pytest.mark.long
@given(st.sampled_from(sorted(SHAPES)), st.sampled_from([0.0, 0.01, 0.05]), st.integers(0, 2**32 - 1))
@settings(max_examples=12)
def test_a_mesh_with_missing_and_turned_triangles_is_the_same_solid(name, missing, seed):
    """1 % or 5 % of the triangles missing, 10 % turned."""
    rng, whole = np.random.default_rng(seed), SHAPES[name]
    faces = whole.faces[rng.random(len(whole.faces)) >= missing]
    turned = rng.random(len(faces)) < 0.1
    damaged = repair(trimesh.Trimesh(whole.vertices, np.where(turned[:, None], faces[:, ::-1], faces), process=False))
    expected = Solid(whole.vertices, whole.faces).distances
    found = Solid(damaged.vertices, damaged.faces).distances
    at = expected.nodes[np.abs(expected.values.ravel()) > expected.cell]
    wrong = (found(at) < 0) != (expected(at) < 0)
    assert wrong.mean() < 1e-4


@given(st.sets(st.integers(0, len(BALL.faces) - 1), min_size=1, max_size=8))
def test_a_few_missing_triangles_are_filled_wherever_they_are(missing):
    mask = np.isin(np.arange(len(BALL.faces)), list(missing))
    assert repair(without(BALL, mask)).volume == pytest.approx(BALL.volume, rel=5e-3)


def bowl() -> trimesh.Trimesh:
    """With walls, but open where they should meet at the rim."""
    half, inner = BALL.slice_plane([0, 0, 0], [0, 0, -1]), trimesh.creation.icosphere(3, 0.09)
    inner.invert()
    both = trimesh.util.concatenate([half, inner.slice_plane([0, 0, 0], [0, 0, -1])])
    assert isinstance(both, trimesh.Trimesh)
    return both


@pytest.mark.parametrize(
    "mesh",
    [
        BALL.slice_plane([0, 0, 0], UP),
        bowl(),
        without(TUBE, np.abs(TUBE.triangles_center[:, 2]) > 0.099),
        without(BALL, above(BALL, 0.09)),
        without(BALL, above(BALL, 0.095)),
    ],
    ids=["half a sphere", "bowl", "tube without caps", "cup", "ball with a round hole"],
)
def test_what_has_large_holes_is_refused_with_a_way_out(mesh):
    open_mesh = repair(mesh)
    with pytest.raises(FormatError) as info:
        _ = Solid(open_mesh.vertices, open_mesh.faces).distances
    assert info.value.found.startswith("large holes") and "convex hull" in info.value.accepted


def test_a_lid_is_filled_and_said():
    vertices, faces, notes = repaired(np.asarray(BOX.vertices), BOX.faces[~above(BOX, 0.039)])
    assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(BOX.volume)
    assert notes == ("holes filled with 2 triangles, 27.27% of the surface",)


@pytest.mark.parametrize("shift", [0.0, 1e-9, 3e-7])
def test_seams_are_closed(shift):
    loose = BALL.triangles.reshape(-1, 3) + np.random.default_rng(0).uniform(-shift, shift, (3 * len(BALL.faces), 3))
    mesh = repair(trimesh.Trimesh(loose, np.arange(len(loose)).reshape(-1, 3), process=False))
    inside = Solid(mesh.vertices, mesh.faces).distances.interior
    assert len(inside) * Solid(mesh.vertices, mesh.faces).distances.cell ** 3 == pytest.approx(BALL.volume, rel=0.01)


def test_stray_vertices_and_doubled_triangles_do_not_count_and_the_outside_is_outwards():
    stray = trimesh.Trimesh(np.concatenate([BALL.vertices, [[1e30, 0, 0]]]), BALL.faces, process=False)
    assert volume(stray) == pytest.approx(BALL.volume)
    doubled = trimesh.Trimesh(BALL.vertices, np.concatenate([BALL.faces, BALL.faces[::2, ::-1]]), process=False)
    assert volume(doubled) == pytest.approx(BALL.volume)
    assert volume(trimesh.Trimesh(BALL.vertices, BALL.faces[:, ::-1], process=False)) == pytest.approx(BALL.volume)


@pytest.mark.parametrize("offset", [1e3, 1e-30, 1e30])
def test_where_and_how_large_it_is_does_not_matter(offset):
    scale = offset if offset != 1e3 else 1.0
    mesh = trimesh.Trimesh(BOX.vertices * scale + (offset == 1e3) * offset, BOX.faces, process=False)
    assert len(repair(mesh).vertices) == 8


def test_triangles_without_area_are_refused():
    with pytest.raises(FormatError, match="only triangles without area"):
        repaired(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(FormatError, match="only triangles without area"):
        repaired(np.asarray(BOX.vertices), np.array([[0, 1, 1]]))


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
    with pytest.raises(FormatError, match="one side only"):
        repaired(vertices, np.array(quads)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
