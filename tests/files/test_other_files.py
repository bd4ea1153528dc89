"""Files that name other files: whatever a format may name, a reader gives what is in the file, or refuses it."""

import io
import json
import re
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from recorded import POSE, TIMES, bag, lerobot, path_of, table, zipped

from dt_viz.errors import DataError, FormatError
from dt_viz.files.recordings import read_recordings
from dt_viz.files.shapes import read_triangles
from dt_viz.library.takes import demonstrations_of

SECRET = path_of(9)  # what another file holds, of the kind that would be read if it was followed
OWN = path_of(1)
BALL = trimesh.creation.icosphere(1, 0.1)


def hdf5(write: Callable, suffix: str = ".h5") -> Callable[[Path], Path]:
    """Makes an HDF5 file; `write` is given the file, the paths of other files with `SECRET`, raw and HDF5, and h5py."""

    def make(folder: Path) -> Path:
        h5py = pytest.importorskip("h5py")
        raw, other, path = folder / "secret", folder / "secret.h5", folder / f"named{suffix}"
        raw.write_bytes(SECRET.tobytes())
        with h5py.File(other, "w") as file:
            file["pos"] = SECRET
            file["demo_0/pos"] = SECRET
        with h5py.File(path, "w") as file:
            write(file, raw, other, h5py)
        return path

    return make


def external(file, raw, _other, _h5py):
    file.create_dataset("demo_0/pos", SECRET.shape, SECRET.dtype, external=[(str(raw), 0, SECRET.nbytes)])


def virtual(file, _raw, other, h5py):
    layout = h5py.VirtualLayout(SECRET.shape, SECRET.dtype)
    layout[:] = h5py.VirtualSource(str(other), "pos", SECRET.shape)
    file.create_virtual_dataset("demo_0/pos", layout)


def link_to_dataset(file, _raw, other, h5py):
    file["demo_0/pos"] = h5py.ExternalLink(str(other), "pos")


def link_to_group(file, _raw, other, h5py):
    file["pos"] = OWN
    file["data"] = h5py.ExternalLink(str(other), "/")


def soft_link(file, _raw, other, h5py):
    """A soft link may lead through an external one, which is no member of any group that is looked into."""
    file["demo_0/pos"] = h5py.SoftLink("/named")
    file["named"] = h5py.ExternalLink(str(other), "pos")


def parquet(folder: Path, *, own: bool) -> Path:
    """A Parquet file whose columns are, by its metadata, in another one; with data of its own or without."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    for name, values in (("secret", SECRET), ("named", OWN)):
        columns = {"t": TIMES} | {axis: values[:, k] for k, axis in enumerate("xyz")}
        pq.write_table(pa.table(columns), folder / f"{name}.parquet", compression="none")
    path = folder / "named.parquet"
    metadata = pq.read_metadata(path)
    metadata.set_file_path(str(folder / "secret.parquet"))
    metadata.write_metadata_file(folder / "footer")
    footer, content = (folder / "footer").read_bytes(), path.read_bytes()
    path.write_bytes((content[: -8 - int.from_bytes(content[-8:-4], "little")] if own else b"") + footer[4 * own :])
    assert b"secret.parquet" in path.read_bytes()
    return path


def dataset(folder: Path) -> Path:
    """A LeRobot data set whose description names the files of another."""
    lerobot(folder / "secret", ["x", "y", "z"])
    lerobot(folder / "named", ["x", "y", "z"])
    for file in (folder / "named" / "data").rglob("*.parquet"):
        file.unlink()
    information = folder / "named" / "meta" / "info.json"
    there = str(folder / "secret" / "data/chunk-000/episode_{episode_index:06d}.parquet")
    information.write_text(json.dumps(json.loads(information.read_text()) | {"data_path": there}))
    return folder / "named"


def rosbag(folder: Path) -> Path:
    """A bag's folder whose metadata name the file of another."""
    secret = bag(folder / "secret.mcap", POSE)
    bag(folder / "named.mcap", POSE).rename(folder / "named" / "other.mcap")
    metadata = folder / "named" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("named.mcap", str(secret)))
    assert str(secret) in metadata.read_text()
    return folder / "named"


def address(folder: Path) -> Path:
    """A database whose name, which rosbags gives to SQLite as part of an address, is that of another."""
    secret = bag(folder / "secret.db3", POSE)
    secret.rename(folder / "secret.db3")
    (folder / "named").mkdir()
    path = folder / "named" / "x%2f..%2f..%2fsecret.db3"
    path.write_bytes(b"no database")
    return path


def address_in_metadata(folder: Path) -> Path:
    """A bag's folder in which such a name is that of one of its files."""
    path = address(folder)
    metadata = (folder / "secret" / "metadata.yaml").read_text()
    (path.parent / "metadata.yaml").write_text(metadata.replace("secret.db3", path.name))
    return path.parent


def text(name: str, content: str) -> Callable[[Path], Path]:
    """Makes a file of text, in which {} stands for the path of another file with `SECRET`."""

    def make(folder: Path) -> Path:
        secret, path = folder / "secret.csv", folder / name
        secret.write_bytes(table(["t", "x", "y", "z"], [TIMES, *SECRET.T]))
        path.write_text(content.replace("{}", str(secret)))
        return path

    return make


def npz(folder: Path) -> Path:
    """An archive with a member that is a symbolic link, as Unix packs them."""
    np.save(folder / "secret.npy", SECRET)
    path = folder / "named.npz"
    path.write_bytes(zipped({symbolic("positions.npy"): str(folder / "secret.npy")}))
    return path


def symbolic(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name)
    member.create_system, member.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return member


TAKES = {
    "external storage": (hdf5(external), "dataset 'pos': found data in other files"),
    "a virtual dataset": (hdf5(virtual), "dataset 'pos': found data in other files"),
    "an external link to a dataset": (hdf5(link_to_dataset), "link 'pos': found a link of the kind ExternalLink"),
    "an external link to a group": (hdf5(link_to_group), "link 'data': found a link of the kind ExternalLink"),
    "a soft link": (hdf5(soft_link), "link 'pos': found a link of the kind SoftLink"),
    "external storage in HDF5 as MATLAB writes it": (hdf5(external, ".mat"), "accepted: a MATLAB file of version 5"),
    "Parquet's columns": (lambda folder: parquet(folder, own=True), None),
    "Parquet without data": (lambda folder: parquet(folder, own=False), "something that cannot be read"),
    "a description of a data set": (dataset, "folder: found no .parquet file"),
    "metadata of a bag": (rosbag, "something that cannot be read"),
    "the name of a database": (address, "something that cannot be read"),
    "the name of a database in metadata": (address_in_metadata, "name: found 'x%2f..%2f..%2fsecret.db3'"),
    "a reference in JSON": (text("named.json", '{"$ref": "file://{}"}'), "no takes in '$ref'"),
    "a path in a table": (text("named.csv", "{}\n"), "no places"),
    "a symbolic link in an archive of arrays": (npz, "pickled objects are never opened"),
}
"""Each kind of recorded motions, and what names another file there: what makes it, and words of its refusal; None
where the file has its own data, too, and these are read."""


def packed(path: Path) -> tuple[str, bytes]:
    """Name and content of what a visitor would send: a file, or an archive of a folder."""
    if path.is_file():
        return path.name, path.read_bytes()
    files = {str(each.relative_to(path.parent)): each.read_bytes() for each in path.rglob("*") if each.is_file()}
    return f"{path.name}.zip", zipped(files)


@pytest.mark.parametrize("visits", [False, True], ids=["own", "sent"])
@pytest.mark.parametrize("kind", TAKES)
def test_recorded_motions_that_name_other_files_are_not_read_from_these(kind, visits, tmp_path):
    make, words = TAKES[kind]
    path = make(tmp_path)
    try:
        if visits:
            takes = read_recordings([packed(path)], {}, [])
            positions = [take.positions for take in takes.takes]
        else:
            positions = [take.positions for take in demonstrations_of(path)]
    except (FormatError, DataError) as error:
        assert words is not None and words in str(error)
        return
    assert words is None
    (found,) = positions
    assert found is not None
    np.testing.assert_allclose(found, OWN)


@pytest.mark.parametrize("name", ["a/named.csv", "named.csv"])
def test_a_symbolic_link_in_an_archive_of_a_folder_is_no_link(name, tmp_path):
    text("named.csv", "")(tmp_path)
    content = zipped({symbolic(name): str(tmp_path / "secret.csv")})
    with pytest.raises(FormatError, match="no places"):
        read_recordings([("named.zip", content)], {}, [])


# --- meshes ---


def gltf(uri: str, suffix: str) -> bytes:
    """The ball, whose vertices and triangles are in another file."""
    exported = BALL.export(file_type="glb")
    assert isinstance(exported, bytes)
    length = int.from_bytes(exported[12:16], "little")
    scene = json.loads(exported[20 : 20 + length])
    scene["buffers"][0]["uri"] = uri
    content = json.dumps(scene).encode()
    if suffix == ".gltf":
        return content
    content += b" " * (-len(content) % 4)
    sizes = (20 + len(content)).to_bytes(4, "little"), len(content).to_bytes(4, "little")
    return b"glTF\2\0\0\0" + sizes[0] + sizes[1] + b"JSON" + content


def threemf(declared: str, folder: Path) -> bytes:
    """The ball, of which a coordinate is an entity that another file declares."""
    (folder / "secret.dtd").write_text('<!ENTITY x "0.1">')
    exported, file = BALL.export(file_type="3mf"), io.BytesIO()
    assert isinstance(exported, bytes)
    with zipfile.ZipFile(io.BytesIO(exported)) as given, zipfile.ZipFile(file, "w") as archive:
        for name in given.namelist():
            content = given.read(name)
            if name.endswith(".model"):
                first = f"{declared.replace('{}', str(folder))}<model".encode()
                content = content.replace(b"<model", first, 1)
                content = re.sub(rb'<vertex x="[^"]*"', b'<vertex x="&x;"', content, count=1)
                assert b"secret.dtd" in content and b"&x;" in content
            archive.writestr(name, content)
    return file.getvalue()


def obj(folder: Path) -> bytes:
    (folder / "secret.mtl").write_text("newmtl secret\nmap_Kd secret.png\n")
    return f"mtllib {folder}/secret.mtl\nusemtl secret\n{BALL.export(file_type='obj')}".encode()


def ply(folder: Path) -> bytes:
    exported = BALL.export(file_type="ply")
    assert isinstance(exported, bytes)
    return exported.replace(b"\ncomment", f"\ncomment TextureFile {folder}/secret.png\ncomment".encode(), 1)


BUFFER = "file: found data in another file"
DECLARED = '<!DOCTYPE model [<!ENTITY % d SYSTEM "file://{}/secret.dtd"> %d;]>'
MESHES = {
    "a glTF file's buffer": (".gltf", lambda _folder: gltf("secret.bin", ".gltf"), BUFFER),
    "a glTF file's buffer by its path": (".gltf", lambda folder: gltf(f"{folder}/secret.bin", ".gltf"), BUFFER),
    "a glTF file's buffer by an address": (
        ".gltf",
        lambda folder: gltf(f"file://{folder}/secret.bin", ".gltf"),
        BUFFER,
    ),
    "a GLB file's buffer": (".glb", lambda folder: gltf(f"{folder}/secret.bin", ".glb"), BUFFER),
    "a 3MF file's declarations": (".3mf", lambda folder: threemf(DECLARED, folder), "."),
    "an OBJ file's materials": (".obj", obj, None),
    "a PLY file's picture": (".ply", ply, None),
}
"""Each kind of mesh that may name another file: its suffix, its content, and words of its refusal; None as above."""


@pytest.mark.parametrize("kind", MESHES)
def test_meshes_that_name_other_files_are_not_read_from_these(kind, tmp_path, monkeypatch):
    suffix, make, words = MESHES[kind]
    exported = BALL.export(file_type="glb")
    assert isinstance(exported, bytes)
    (tmp_path / "secret.bin").write_bytes(exported[28 + int.from_bytes(exported[12:16], "little") :])
    monkeypatch.chdir(tmp_path)
    files = [(f"named{suffix}", make(tmp_path))]
    assert b"secret" in files[0][1] or suffix == ".3mf"
    if words is None:
        assert read_triangles(files).vertices.shape == BALL.vertices.shape
    else:
        with pytest.raises(Exception, match=words):  # of any kind, as the reader says
            read_triangles(files)
