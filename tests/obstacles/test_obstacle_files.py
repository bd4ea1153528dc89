"""Meshes and clouds from files: what is read, what is repaired, and what is refused, with the reason."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh

from dt_viz.errors import FormatError, UnwantedError, end_if
from dt_viz.files import reading, triangles
from dt_viz.files.checks import MAX_FACES
from dt_viz.files.npz import npz_bytes
from dt_viz.files.shapes import Triangles
from dt_viz.files.values import unpacked
from dt_viz.obstacles import clouds, files, solids
from dt_viz.obstacles.files import MAX_BYTES, ShapeError, read_cloud, read_mesh
from dt_viz.obstacles.shapes import CloudObstacle, MeshObstacle

FORMATS = ("stl", "obj", "ply", "glb", "off", "3mf")
BOX = trimesh.creation.box((0.15, 0.1, 0.05))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (1000, 3))
LABELS: np.ndarray = np.asarray(np.abs(POINTS).max(axis=1) < 0.06)


def exported(mesh: trimesh.Trimesh, kind: str) -> bytes:
    content = mesh.export(file_type=kind)
    assert content is not None
    return content.encode() if isinstance(content, str) else bytes(content)  # pyright: ignore[reportArgumentType]


MANY = exported(trimesh.Trimesh(BOX.vertices, np.resize(BOX.faces, (MAX_FACES + 1, 3)), process=False), "ply")
"""More triangles than a mesh may have."""


def npz(**arrays: np.ndarray) -> bytes:
    return npz_bytes(arrays)


def table(points: np.ndarray, labels: np.ndarray | None = None) -> bytes:
    rows = points if labels is None else np.column_stack([points, labels])
    header = "x,y,z" if labels is None else "x,y,z,occupied"
    return "\n".join([header, *(",".join(f"{value:.6g}" for value in row) for row in rows)]).encode()


def labelled_ply(points: np.ndarray, labels: np.ndarray, name: str = "occupied") -> bytes:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {name}", "end_header"]
    return "\n".join(lines + [f"{x} {y} {z} {int(o)}" for (x, y, z), o in zip(points, labels, strict=True)]).encode()


def refusal(read, content: bytes, name: str, **options) -> str:
    with pytest.raises(ShapeError) as info:
        read(content, name, **options)
    assert str(info.value).startswith(f"{name}: ")
    assert "; accepted: " in str(info.value)
    return str(info.value)


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    """The process that reads is for tests/files; starting one for each file takes a second."""

    def read(kind, given, cancelled, **options):
        first, arrays = reading.answer(kind.__name__, given, **options)
        if "refused" in first:
            raise FormatError(*first["refused"])
        return unpacked(first["value"], kind, "file", dict(zip(first["arrays"], arrays, strict=True)))

    monkeypatch.setattr(files, "read_upload", read)


class TestMeshes:
    @pytest.mark.long
    @pytest.mark.parametrize("kind", [*FORMATS, "stl_ascii"])
    def test_every_format_gives_the_same_solid(self, kind):
        solid, notes = read_mesh(exported(BOX, kind), f"crate.{kind[:3].upper()}")
        assert notes == ()
        np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), (0.15, 0.1, 0.05), atol=1e-6)
        np.testing.assert_allclose(solid.bounds.mean(axis=0), 0, atol=1e-6)
        obstacle = MeshObstacle((0.3, 0.0, 0.0), solid)
        np.testing.assert_allclose(obstacle.signed_distance(np.array([0.3, 0.0, 0.2])), 0.175, atol=2e-3)

    @pytest.mark.long
    def test_parts_of_a_scene_are_placed(self):
        scene = trimesh.Scene()
        for x in (-0.1, 0.1):
            scene.add_geometry(
                trimesh.creation.icosphere(2, 0.05), transform=trimesh.transformations.translation_matrix([x, 0, 0])
            )
        content = scene.export(file_type="glb")
        assert isinstance(content, bytes)
        np.testing.assert_allclose(np.ptp(read_mesh(content, "a.glb")[0].vertices, axis=0).max(), 0.3, atol=1e-3)

    def test_millimetres_are_guessed_and_accepted_with_a_scale(self):
        content = exported(trimesh.creation.box((150, 100, 50)), "stl")
        message = refusal(read_mesh, content, "big.stl")
        assert "150 × 100 × 50 m; is the file in millimetres (scale=0.001)? then that is 0.15 × 0.1 × 0.05 m" in message
        solid = read_mesh(content, "big.stl", scale=1e-3)[0]
        np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), (0.15, 0.1, 0.05), atol=1e-9)
        assert "0.0015 × 0.001 × 0.0005 m" in refusal(read_mesh, content, "small.stl", scale=1e-5)
        assert "scale" in refusal(read_mesh, content, "a.stl", scale=0.0)

    @pytest.mark.long
    def test_a_flat_mesh_is_refused(self):
        flat = trimesh.creation.box((0.1, 0.1, 1e-9))
        assert re.search("volume|thickness|edges", refusal(read_mesh, exported(flat, "ply"), "flat.ply"))

    @pytest.mark.long
    def test_a_thin_wall_and_a_hole_that_was_filled_are_said(self):
        wall, post = trimesh.creation.box((0.3, 0.3, 0.004)), trimesh.creation.box((0.05, 0.05, 0.1))
        post.apply_translation([0.2, 0.0, 0.0])
        corners = np.concatenate([wall.vertices, post.vertices])
        both = trimesh.Trimesh(corners, np.concatenate([wall.faces, post.faces[1:] + 8]), process=False)
        said = " ".join(read_mesh(exported(both, "ply"), "a.ply")[1])
        assert "thinner than about" in said and "holes filled with 1 triangle" in said

    @pytest.mark.parametrize(
        ("content", "name", "words"),
        [
            (b"x" * (MAX_BYTES + 1), "a.obj", "20.0 MB; accepted: at most 20 MB"),
            (bytes(80) + struct.pack("<I", MAX_FACES + 1), "a.stl", "faces: found none that could be read"),
            (MANY, "a.ply", "faces: found more than 500000 of all parts"),
            (
                exported(BOX, "stl")[:96] + struct.pack("<f", np.nan) + exported(BOX, "stl")[100:],
                "a.stl",
                "nan in vertex",
            ),
            (exported(trimesh.PointCloud(POINTS), "ply"), "a.ply", "cloud"),  # pyright: ignore[reportArgumentType]
            *((b"x", name, ".stl, .obj, .ply, .glb, .gltf, .off, .3mf") for name in ("a.step", "mesh", "a.npz")),
            *((b"", f"a.{kind}", "an empty file") for kind in FORMATS),
            *((b"\n", f"a.{kind}", "found") for kind in FORMATS),
        ],
        ids=lambda value: "file" if isinstance(value, bytes) else None,
    )
    def test_bad_input_is_named(self, content, name, words):
        assert words in refusal(read_mesh, content, name)

    def test_huge_counts_make_no_room(self):
        axes = b"".join(b"property float " + axis + b"\n" for axis in (b"x", b"y", b"z"))
        ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\n" + axes + b"end_header\n"
        assert "unexpected length" in refusal(read_mesh, ply, "a.ply")
        text = json.dumps(
            {"asset": {"version": "2.0"}, "accessors": [{"count": 10**12, "componentType": 5126, "type": "VEC3"}]}
        )
        body = text.encode().ljust((len(text) + 3) // 4 * 4)
        glb = b"glTF" + struct.pack("<III", 2, 20 + len(body), len(body)) + b"JSON" + body
        assert "faces: found none" in refusal(read_mesh, glb, "a.glb")


DISTANCES = {
    "fewer nodes": (lambda values: values[1:], "distances: found those of something else"),
    "flat": (lambda values: values.ravel(), "distances: found those of something else"),
    "integers": (lambda values: (1e3 * values).astype(int), "accepted: the name of an array of finite float64"),
    "nan": (lambda values: np.where(values < 0, np.nan, values), "accepted: the name of an array of finite float64"),
    "huge": (lambda values: np.where(values < -0.02, -1e300, values), "distances: found those of something else"),
    "of a larger mesh": (lambda values: values - 0.02, "distances: found those of something else"),
    "of a mesh elsewhere": (lambda values: np.roll(values, 8, axis=1), "distances: found those of something else"),
}
"""What the process that reads makes of a mesh's distances, and words of the refusal."""


@pytest.mark.usefixtures("coarse")
class TestDistances:
    @pytest.mark.parametrize("change", DISTANCES)
    def test_other_distances_are_refused(self, monkeypatch, change):
        changed, words = DISTANCES[change]
        right = triangles.read_distances
        wrong = lambda *given, **grid: triangles.Distances(changed(right(*given, **grid).values))  # noqa: E731
        monkeypatch.setattr(reading, "READERS", {**reading.READERS, "Distances": wrong})
        solids._distances.cache_clear()
        assert words in refusal(read_mesh, exported(trimesh.creation.icosphere(3, 0.07), "ply"), "a.ply")

    def test_a_mesh_that_nobody_wants_any_more_is_not_measured(self, monkeypatch):
        left, read = [], files.read_upload

        def read_and_leave(kind, given, cancelled, **options):
            end_if(cancelled)
            left.append(kind)
            return read(kind, given, cancelled, **options)

        monkeypatch.setattr(files, "read_upload", read_and_leave)
        solids._distances.cache_clear()
        with pytest.raises(UnwantedError):
            read_mesh(exported(BOX, "ply"), "a.ply", cancelled=lambda: bool(left))
        assert left == [Triangles]


@pytest.fixture
def coarse(monkeypatch):
    """What is read is looked at, not how finely it is mapped."""
    monkeypatch.setattr(clouds, "SETTINGS", clouds.CloudSettings(num_nodes=16**3))
    monkeypatch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=24**3, num_samples=6000))


@pytest.mark.usefixtures("coarse")
class TestClouds:
    @pytest.mark.parametrize(
        ("content", "name"),
        [
            (npz(points=POINTS, labels=LABELS), "a.npz"),
            (table(POINTS, LABELS), "a.csv"),
            (labelled_ply(POINTS, LABELS), "a.ply"),
            (labelled_ply(POINTS, LABELS, "label"), "a.ply"),
        ],
    )
    def test_labelled_points(self, content, name):
        cloud, _ = read_cloud(content, name)
        assert cloud.labels is not None
        np.testing.assert_array_equal(cloud.labels, LABELS)
        sizes = np.ptp(cloud.solid.vertices, axis=0)
        np.testing.assert_allclose(sizes, 0.12, atol=0.02)

    @pytest.mark.parametrize(
        ("content", "name"),
        [
            (npz(points=POINTS[LABELS]), "a.npz"),
            (table(POINTS[LABELS]), "a.csv"),
            (exported(trimesh.PointCloud(POINTS[LABELS]), "ply"), "a.ply"),  # pyright: ignore[reportArgumentType]
        ],
    )
    def test_points_without_labels(self, content, name):
        cloud, _ = read_cloud(content, name)
        assert cloud.labels is None
        obstacle = CloudObstacle((0.0, 0.0, 0.0), cloud)
        assert obstacle.signed_distance(np.zeros(3)) < -0.03
        assert obstacle.signed_distance(np.array([0.15, 0.0, 0.0])) > 0.05

    def test_columns_are_found_by_their_names_and_others_are_said(self):
        rows = "\n".join(f"{o},{z},9,{x},{y}" for (x, y, z), o in zip(POINTS, LABELS.astype(int), strict=True))
        cloud, notes = read_cloud(f"Label, z, colour, x, y\n{rows}".encode("utf-8-sig"), "a.csv")
        np.testing.assert_array_equal(cloud.labels, LABELS)
        np.testing.assert_allclose(np.ptp(cloud.points, axis=0), np.ptp(POINTS, axis=0))
        assert notes == ("columns colour are not used",)

    def test_millimetres(self):
        content = npz(points=1e3 * POINTS, labels=LABELS)
        assert "scale=0.001" in refusal(read_cloud, content, "a.npz")
        read_cloud(content, "a.npz", scale=1e-3)

    @pytest.mark.parametrize(
        ("content", "name", "words"),
        [
            (npz(points=POINTS[:40]), "a.npz", "points: found 40; accepted: at least 50"),
            (npz(points=POINTS, labels=np.ones(1000)), "a.npz", "all 1000 points occupied"),
            (npz(points=POINTS, labels=np.zeros(1000)), "a.npz", "all 1000 points free"),
            (npz(points=POINTS, labels=np.multiply(3, LABELS)), "a.npz", "labels: found 3 for point"),
            (npz(points=POINTS, labels=LABELS[:10]), "a.npz", "shape (10,)"),
            (
                npz(points=POINTS, labels=np.where(np.equal(np.arange(1000), 6), np.nan, LABELS)),
                "a.npz",
                "labels: found nan of point 7",
            ),
            (npz(points=POINTS[:, :2]), "a.npz", "shape (1000, 2)"),
            (npz(other=POINTS), "a.npz", "arrays: found no 'points'"),
            (
                npz(points=np.where(np.equal(np.arange(3000).reshape(-1, 3), 7), np.nan, POINTS)),
                "a.npz",
                "nan in point 3",
            ),
            (npz(points=np.array([None] * 60)), "a.npz", "pickled"),
            (b"PK not a zip", "a.npz", "a .npz file"),
            (npz(points=np.zeros((2_000_000, 3))), "a.npz", "when unpacked"),
            (b"a,b,c\n1,2,3\n", "a.csv", "'a,b,c'"),
            (b"x,y,z\n1,2,one\n", "a.csv", "could not convert string 'one'"),
            (b"x,y,z\n", "a.csv", "points: found 0"),
            (b"", "a.csv", "an empty file"),
            (b"ply\n", "a.ply", "a .ply file"),
            (b"x", "a.xyz", ".ply, .npz, .csv"),
        ],
    )
    def test_bad_input_is_named(self, content, name, words):
        assert words in refusal(read_cloud, content, name)

    def test_of_very_many_points_some_are_used(self):
        points = np.random.default_rng(0).uniform(-0.1, 0.1, (150_000, 3)).astype(np.float32)
        cloud, notes = read_cloud(npz(points=points), "a.npz")
        assert len(cloud.points) == 100_000
        assert "100000 of its 150000 points" in notes[0]
