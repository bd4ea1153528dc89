"""Triangles of STL, OBJ, PLY and GLB files: what these formats can say, and what is refused of it."""

import json
import struct

import numpy as np
import pytest
import trimesh

from dt_viz.errors import FormatError
from dt_viz.files.glb import read_glb
from dt_viz.files.meshes import read_obj, read_stl
from dt_viz.files.ply import read_ply

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def glb(scene: dict, data: bytes = b"") -> bytes:
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def simplex(**changes) -> bytes:
    """A tetrahedron as a GLB file, with some of its description replaced."""
    vertices, faces = CORNERS.astype("<f4").tobytes(), FACES.astype("<u2").tobytes()
    scene = {
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"byteLength": 72}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return glb(scene | changes, vertices + faces)


def triangles(content: bytes) -> np.ndarray:
    vertices, faces = read_glb(content, max_vertices=100, max_triangles=100)
    return vertices[faces]


class TestGlb:
    def test_parts_are_placed_as_their_nodes_and_the_nodes_above_say(self):
        turned = {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [2, 2, 2], "translation": [1, 0, 0]}
        nodes = [turned | {"children": [1]}, {"mesh": 0, "translation": [0, 0, 5]}]
        x, y, z = CORNERS[FACES][..., 0], CORNERS[FACES][..., 1], CORNERS[FACES][..., 2]
        expected = np.stack([1 - 2 * y, 2 * x, 2 * (z + 5)], axis=-1)
        np.testing.assert_allclose(triangles(simplex(nodes=nodes)), expected, atol=1e-12)

    def test_a_matrix_is_written_column_by_column(self):
        matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]
        found = triangles(simplex(nodes=[{"mesh": 0, "matrix": matrix}]))
        np.testing.assert_allclose(found, CORNERS[FACES] + [7, 8, 9])

    def test_mirrored_parts_still_face_outwards(self):
        found = triangles(simplex(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
        a, b, c = found.swapaxes(0, 1)
        assert np.einsum("ni,ni->", a, np.cross(b, c)) == pytest.approx(1)

    def test_without_a_scene_the_topmost_nodes_are_shown(self):
        assert len(triangles(simplex(scenes=[], nodes=[{"children": [1]}, {"mesh": 0}]))) == 4

    @pytest.mark.parametrize(
        ("mode", "expected"), [(5, [[0, 1, 2], [1, 3, 2]]), (6, [[0, 1, 2], [0, 2, 3]]), (1, None)]
    )
    def test_strips_and_fans_are_triangles_and_lines_are_not(self, mode, expected):
        content = simplex(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}])
        found = triangles(content)
        np.testing.assert_allclose(found, np.empty((0, 3, 3)) if expected is None else CORNERS[expected])

    def test_what_trimesh_writes_is_read_as_trimesh_reads_it(self):
        ball = trimesh.creation.icosphere(1)
        content = trimesh.Scene([ball, trimesh.creation.box()]).export(file_type="glb")
        assert isinstance(content, bytes)
        assert len(triangles(content)) == len(ball.faces) + 12

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            (
                {"nodes": [{"mesh": 0}] * 26, "scenes": [{"nodes": list(range(26))}]},
                "faces: found more than 100 of all instances",
            ),
            ({"nodes": [{"children": [1]}, {"children": [0]}]}, "node 0 in two places, or inside itself"),
            ({"nodes": [{"children": [1, 1]}, {"mesh": 0}]}, "node 1 in two places"),
            ({"nodes": [{"mesh": -1}]}, r"no meshes\[-1\]"),
            ({"nodes": [{"mesh": 0}] * 10_001}, "10001 nodes"),
            ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression; .*no Draco"),
            ({"extensionsRequired": ["EXT_mesh_gpu_instancing"]}, "EXT_mesh_gpu_instancing"),
            ({"accessors": [{"count": 10**12, "type": "VEC3"}]}, "no bufferView in accessor 0"),
            ({"accessors": [{"bufferView": 0, "count": 4, "type": "VEC3", "sparse": {}}]}, "sparse data in accessor 0"),
            ({"buffers": [{"byteLength": 72, "uri": "file:///etc/passwd"}]}, "data in another file"),
            ({"bufferViews": [{"buffer": 1, "byteLength": 48}]}, "data in another file"),
            ({"bufferViews": [{"buffer": 0, "byteLength": 47}]}, "4 entries in a view of 47 bytes"),
            ({"bufferViews": [{"buffer": 0, "byteOffset": 60, "byteLength": 48}]}, "of 72 in all"),
            ({"bufferViews": [{"buffer": 0, "byteLength": 48, "byteStride": 2**40}]}, "4 entries in a view"),
        ],
    )
    def test_what_is_wrong_is_named(self, changes, words):
        with pytest.raises(FormatError, match=words):
            triangles(simplex(**changes))

    def test_pictures_and_materials_are_not_looked_at(self):
        elsewhere = [{"uri": "http://127.0.0.1:1/picture.png"}, {"bufferView": 99}]
        assert len(triangles(simplex(images=elsewhere, textures=[{"source": 0}], materials=[None]))) == 4

    def test_a_long_description_is_not_parsed(self):
        with pytest.raises(FormatError, match="JSON: found 50000"):
            triangles(glb({"extras": ["x" * 5_000_000]}))


class TestStl:
    def test_a_binary_file_may_begin_like_a_text(self):
        mesh = trimesh.Trimesh(CORNERS, FACES).export(file_type="stl")
        assert isinstance(mesh, bytes)
        vertices, faces = read_stl(b"solid facet".ljust(80) + mesh[80:], max_triangles=4)
        np.testing.assert_allclose(vertices[faces], CORNERS[FACES])

    def test_facets_have_three_corners(self):
        text = b"solid\nfacet\nouter loop\n" + b"vertex 0 0 0\n" * 4 + b"endloop\nendfacet\nendsolid\n"
        with pytest.raises(FormatError, match="line 9: found a facet without three vertices"):
            read_stl(text, max_triangles=4)


class TestObj:
    def read(self, text: str) -> np.ndarray:
        vertices, faces = read_obj(text.encode("latin-1"), max_vertices=9, max_triangles=9)
        return vertices[faces]

    @pytest.mark.parametrize(
        "face", ["f 1 2 3", "f 1/7 2/7 3/7", "f 1//7 2//7 3//7", "f -3/1/1 -2/1/1 -1/1/1", "f 1 \\\n2 3"]
    )
    def test_faces_name_their_corners_in_many_ways(self, face):
        text = f"# K\xf6rper\nmtllib /etc/passwd\nv 0 0 0 1\nv 1 0 0 0.5 0.5 0.5\nv 0 1 0\nusemtl x\n{face}\n"
        np.testing.assert_allclose(self.read(text), CORNERS[[[0, 1, 2]]])

    def test_polygons_become_fans(self):
        square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        assert len(self.read(square + "f 1 2 3 4\n")) == 2

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("v 0 0\n", "line 1: found '0 0'"),
            ("v 0 0 0\nf 1 2 x\n", "line 2: found 'x'"),
            ("v 0 0 0\nf 1 0 1\n", "vertex 0; accepted: numbers from 1"),
            ("f 1 2\n", "three vertices"),
            ("v 0 0 0\n" * 10, "vertices: found more than 9"),
            ("v 0 0 0\nf" + " 1" * 12, "faces: found 10; accepted: at most 9"),
            ("f 1 \\\n" + "2 " * 60_000 + "\\\n", "more than 100000"),
        ],
    )
    def test_what_is_wrong_is_named(self, text, words):
        with pytest.raises(FormatError, match=words):
            self.read(text)


SQUARE_AND_TRIANGLE = """ply
format {format} 1.0
element extra 2
property list uchar short junk
element vertex 5
property float x
property float y
property float z
element face 2
property uchar colour
property list uchar int vertex_indices
end_header
"""


class TestPly:
    lists = ([1, 2, 3], [])
    points = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0))
    polygons = ([0, 1, 2, 3], [1, 4, 2])

    def written(self, form: str) -> bytes:
        header = SQUARE_AND_TRIANGLE.format(format=form).encode()
        if form == "ascii":
            rows = [*([len(junk), *junk] for junk in self.lists), *self.points]
            rows += [[7, len(polygon), *polygon] for polygon in self.polygons]
            return header + "\n".join(" ".join(map(str, row)) for row in rows).encode()
        order = "<" if "little" in form else ">"
        body = b"".join(struct.pack(f"{order}B{len(junk)}h", len(junk), *junk) for junk in self.lists)
        body += b"".join(struct.pack(f"{order}3f", *point) for point in self.points)
        body += b"".join(struct.pack(f"{order}BB{len(p)}i", 7, len(p), *p) for p in self.polygons)
        return header + body

    @pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
    def test_polygons_of_any_length_become_fans_and_other_elements_are_skipped(self, form):
        ply = read_ply(self.written(form), max_vertices=5, max_triangles=3)
        np.testing.assert_array_equal(ply.vertices, self.points)
        np.testing.assert_array_equal(ply.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2]])
        assert ply.labels is None
        with pytest.raises(FormatError, match="3 triangles; accepted: at most 2"):
            read_ply(self.written(form), max_vertices=5, max_triangles=2)
        with pytest.raises(FormatError, match=r"complete|numbers"):
            read_ply(self.written(form)[:-3], max_vertices=5, max_triangles=3)

    @pytest.mark.parametrize(
        ("header", "words"),
        [
            ("element vertex 3\nproperty float x\nproperty float y\n", "no property z"),
            ("element vertex 3\nelement vertex 3\n", "twice"),
            ("element vertex -3\n", "how many"),
            ("element vertex 3\nproperty real x\n", "property real x"),
            ("element face 1\nproperty list float int vertex_indices\n", "whole number"),
            ("element vertex 0\n" + "property float a\n" * 101, "more than 100 properties"),
            ("element other 99999999\n", "at most"),
        ],
    )
    def test_what_is_wrong_with_a_header_is_named(self, header, words):
        with pytest.raises(FormatError, match=words):
            read_ply(f"ply\nformat ascii 1.0\n{header}end_header\n".encode(), max_vertices=9, max_triangles=9)

    def test_corners_are_whole_numbers(self):
        content = self.written("ascii").replace(b"1 4 2", b"1 4 2.5")
        with pytest.raises(FormatError, match="not whole"):
            read_ply(content, max_vertices=9, max_triangles=9)
