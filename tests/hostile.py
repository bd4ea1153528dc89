"""Mutated files of every kind that is read, always the same ones, and a program that reads what it is given.

The program takes files from its standard input and prints a line of JSON for each: why it was refused (or nothing), the
processor time of it and of the processes that it starts, in seconds, and by how much its memory grew meanwhile, in MB;
at the end the largest memory of those processes, in MB. Another exception than the readers' own ends it, as a crash
does. Reading is apart from the test because memory can only be measured for a whole process.
"""

import base64
import copy
import faulthandler
import io
import json
import os
import re
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from multiprocessing import forkserver
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import recorded
import trimesh

from dt_viz import saving
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import Avoidance
from dt_viz.errors import DataError, never, parsing
from dt_viz.files.reading import read_upload
from dt_viz.files.recordings import Recordings
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning import demonstrations as demos
from dt_viz.learning.imitation import ImitationSettings, fit
from dt_viz.obstacles import clouds, solids
from dt_viz.obstacles import files as shapes
from dt_viz.obstacles.occupancy import solid_map, unit_map
from dt_viz.obstacles.shapes import ORIGIN, Box, CloudObstacle, Cylinder, MeshObstacle, Sphere
from dt_viz.saving import SavedMotion, save_motion
from dt_viz.scenario.own import Own
from dt_viz.scenario.saved import Known, Saved, check_shapes, decode, encode
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import OWN, TASKS, own_task

PROCESS = Path("/proc/self")  # what Linux says of this process
MAX_ADDRESS_SPACE = 4 * 2**30  # of the program: what goes beyond ends it before the machine suffers
MAX_SECONDS = 300  # after which a file ends the program
NUMBERS = (0, 1, -1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63, -(2**63), 10**12)
WORDS = ("", "0", "-1", "nan", "-inf", "1e308", "-1e308", "1e-320", "999999999999", "9" * 400, "0x10", "1_0", "\u0661")
VALUES = (None, True, -1, 0, 1, 3, 2**31, 2**63, 1e308, -0.5, "", "x" * 1000, [], {}, [[[]]], [0] * 1000)
BYTES = (0, 1, 9, 10, 32, 44, 45, 48, 127, 128, 255)
BALL = trimesh.creation.icosphere(2, 0.1)
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (400, 3))
LABELS = np.linalg.norm(POINTS, axis=1) < 0.08

Rng = np.random.Generator
Mutation = Callable[[bytes, Rng], bytes]


def parts(rng: Rng, content: bytes) -> tuple[bytes, bytes, bytes]:
    """The content in three, the middle one rather small."""
    start = int(rng.integers(len(content) + 1))
    end = min(len(content), start + int(rng.geometric(0.02)))
    return content[:start], content[start:end], content[end:]


def flipped(content: bytes, rng: Rng) -> bytes:
    changed = bytearray(content)
    for place in rng.integers(len(content), size=rng.integers(1, 20)) if content else ():
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def overwritten(content: bytes, rng: Rng) -> bytes:
    before, middle, after = parts(rng, content)
    return before + bytes([int(rng.choice(BYTES))]) * len(middle) + after


def truncated(content: bytes, rng: Rng) -> bytes:
    return content[: int(rng.integers(len(content) + 1))]


def without_block(content: bytes, rng: Rng) -> bytes:
    before, _, after = parts(rng, content)
    return before + after


def with_block_again(content: bytes, rng: Rng) -> bytes:
    before, middle, after = parts(rng, content)
    times = int(rng.choice([2, 10, 1000, 100_000]))
    return before + middle * min(times, (shapes.MAX_BYTES - len(content)) // max(len(middle), 1)) + after


def with_number(content: bytes, rng: Rng) -> bytes:
    """A binary number replaced by an extreme one."""
    number, kind = int(rng.choice(len(NUMBERS))), str(rng.choice(["<I", ">I", "<Q", "<H", "<f", "<d"]))
    if kind[1] in "fd":
        packed = struct.pack(kind, float(rng.choice([np.nan, np.inf, -np.inf, 1e-30, 1e30, -1e38])))
    else:
        size = struct.calcsize(kind)
        packed = struct.pack(kind, NUMBERS[number] % 2 ** (8 * size))
    place = int(rng.integers(min(len(content), int(rng.choice([100, 400, 10**9]))) + 1))  # headers rather often
    return content[:place] + packed + content[place + len(packed) :]


def with_word(content: bytes, rng: Rng) -> bytes:
    """A decimal number replaced by an extreme one."""
    found = [match.span() for match in re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", content[:200_000])]
    if not found:
        return content
    nearby = found[: int(rng.choice([5, 20, len(found)]))]
    start, end = nearby[int(rng.integers(len(nearby)))]
    return content[:start] + str(rng.choice(WORDS)).encode() + content[end:]


def with_line_again(content: bytes, rng: Rng) -> bytes:
    lines = content.split(b"\n")
    line = lines[int(rng.integers(len(lines)))] + b"\n"
    times = min(int(rng.choice([2, 100, 10**6, 10**8])), (shapes.MAX_BYTES - len(content)) // len(line))
    return content + b"\n" + line * times


def change_values(tree: dict | list, rng: Rng) -> None:
    """Change some values of what JSON describes, in place."""
    for _ in range(rng.integers(4)):
        owner = tree
        while True:
            keys = list(owner) if isinstance(owner, dict) else list(range(len(owner)))
            if not keys:
                break
            key = keys[int(rng.integers(len(keys)))]
            inner = owner[key]
            if isinstance(inner, dict | list) and inner and rng.random() < 0.85:
                owner = inner
                continue
            owner[key] = copy.deepcopy(VALUES[int(rng.integers(len(VALUES)))])
            break


def with_changed_text(content: bytes, rng: Rng) -> bytes:
    """A saved motion whose description is changed at some places, or some of whose arrays have another number."""
    try:
        with np.load(io.BytesIO(content)) as archive:
            arrays = {name: member for name, member in archive.items() if isinstance(member, np.ndarray)}
        motion = json.loads(str(arrays["motion"]))
    except Exception:  # damaged before
        return content
    if isinstance(motion, dict | list):
        change_values(motion, rng)
    name = list(arrays)[int(rng.integers(len(arrays)))]
    if rng.random() < 0.3 and arrays[name].dtype.kind in "fi" and arrays[name].size:
        arrays[name] = arrays[name].copy()
        arrays[name].flat[int(rng.integers(arrays[name].size))] = rng.choice([0, -1, 2, 10**9, -(2**40)])
    return npz(**arrays | {"motion": np.array(json.dumps(motion))})


def with_changed_scene(content: bytes, rng: Rng) -> bytes:
    """A GLB file whose description is changed at some places, its lengths set right."""
    if len(content) < 20 or content[:4] != b"glTF":
        return content
    (length,) = struct.unpack_from("<I", content, 12)
    try:
        scene = json.loads(content[20 : 20 + length])
    except ValueError:
        return content
    if rng.random() < 0.3:
        scene["nodes"] = [{"mesh": 0} for _ in range(rng.choice([100, 5000, 10_000, 50_000]))]
        scene["scenes"] = [{"nodes": list(range(len(scene["nodes"])))}]
    if rng.random() < 0.1:
        scene["nodes"] = [{"mesh": 0, "children": [int(rng.integers(3))]} for _ in range(3)]
    change_values(scene, rng)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def with_other_shape(content: bytes, rng: Rng) -> bytes:
    """An array's file that claims another shape."""
    shape = str(tuple(int(n) for n in rng.choice([0, 0, 1, 7, 10**5, 10**9], size=rng.integers(1, 4)))).encode()
    header = b"{'descr': '<f8', 'fortran_order': True, 'shape': " + shape + b", }\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + content[128:]


def with_changed_members(content: bytes, rng: Rng) -> bytes:
    """An archive packed anew with one member changed: its header, its length, or how it is packed."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # damaged before
        return content
    if not members:
        return content
    name = list(members)[int(rng.integers(len(members)))]
    data = members[name]
    match int(rng.integers(6)):
        case 0:
            data = with_word(data[:128], rng) + data[128:]
        case 1:
            data = data[:128].replace(b"<f8", str(rng.choice(["<c16", "|O", "<U9", ">f4", "<f2", "<M8[s]"])).encode())
        case 2:
            data = data[:10] + b"(" * int(rng.choice([10, 1000, 60_000])) + data[10:]
            data = data[:6] + b"\2\0" + struct.pack("<I", len(data)) + data[12:]
        case 3:
            data += bytes(int(rng.choice([1, 10**6, 10**8])))
        case 4:
            data = with_other_shape(data, rng)
        case _:
            data = flipped(data, rng)
    members[name] = data
    methods = [zipfile.ZIP_DEFLATED] * 5 + [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", methods[int(rng.integers(len(methods)))], compresslevel=1) as archive:
        for key, value in members.items():
            archive.writestr(key, value)
        if rng.random() < 0.1:
            for k in range(20_000):
                archive.writestr(zipfile.ZipInfo(f"a{k}"), b"")
    return file.getvalue()


EVERYWHERE: tuple[Mutation, ...] = (
    *(flipped, overwritten, truncated, without_block, with_block_again, with_number, with_word, with_line_again),
)


def exported(mesh: trimesh.Trimesh, kind: str, **options: str) -> bytes:
    content = mesh.export(file_type=kind, **options)
    assert isinstance(content, str | bytes)
    return content.encode() if isinstance(content, str) else content


def embedded(glb: bytes) -> bytes:
    """A glTF file with the data of a GLB file inside its text."""
    (length,) = struct.unpack_from("<I", glb, 12)
    scene, data = json.loads(glb[20 : 20 + length]), glb[28 + length :]
    scene["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps(scene).encode()


def npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


STACK = (
    Avoidance(
        (
            Sphere((0.1, 0.0, 0.0), 0.1),
            Box((0.2, 0.1, 0.0)),
            Cylinder((0.2, 0.3, 0.0), wxyz=(0.9, 0.1, 0.3, -0.3)),
            MeshObstacle((0.3, 0.4, 0.0), solids.Solid(BALL.vertices, BALL.faces), scale=0.5),
            CloudObstacle((0.5, 0.5, 0.0), clouds.Cloud(POINTS, LABELS.astype(float))),
        ),
        integration=Integration("rk4", 4),
    ),
    BiasPoint((0.5, 0.2, 0.0), radius=0.2),
)
"""All kinds of transforms and of obstacles."""
LAYERS = tuple(Layer(transform, k == 0, f"Größe {k}") for k, transform in enumerate(STACK))


def saved_motion(layers: tuple[Layer, ...] = LAYERS) -> bytes:
    """A small motion, saved."""
    s = np.linspace(0, 1, 20)
    arcs = [np.stack([s - 1, (1 + 0.1 * k) * s * (1 - s)], axis=1) for k in range(2)]
    demonstrations = tuple(demos.Demonstration(2 * s, arc, f"arc {k}") for k, arc in enumerate(arcs))
    imitation = fit(demonstrations, ImitationSettings(num_layers=2, num_points=12, max_iterations=2))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        save_motion(path, SavedMotion(demonstrations, layers), imitation)
        return path.read_bytes()


def sent_motion() -> bytes:
    """One that a page shows: its names and its settings are the page's."""
    hand, bias = STACK
    assert isinstance(hand, Avoidance)
    hand = replace(hand, integration=Integration())
    return saved_motion((Layer(bias, name="Bias 1"), Layer(hand, name="Avoidance")))


@cache
def saved_scenario() -> bytes:
    """A scenario with demonstrations, what was learned of them, obstacles and transforms of its own, saved."""
    s, rng = np.linspace(0, 1, 20), np.random.default_rng(3)
    turns = rng.normal(size=(20, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    arcs = [np.stack([s - 1, (1 + 0.1 * k) * s * (1 - s), 0 * s], axis=1) for k in range(2)]
    given = tuple(demos.Demonstration(2 * s, arc, f"arc {k}", turns) for k, arc in enumerate(arcs))
    imitation = fit(given, ImitationSettings(num_layers=2, num_points=12, max_iterations=2))
    own = replace(Own.of(replace(own_task(given), imitation=imitation)), moves=((0.5, (0.1, -0.3, 1 / 3)),))
    hand, bias = STACK
    assert isinstance(hand, Avoidance)
    stack = (Layer(bias, name="Bias 1"), Layer(replace(hand, integration=Integration()), name="Avoidance"))
    return encode(Saved(Scenario(OWN, stack), own=own)).encode()


def with_learned(num: int = 2, **arrays: np.ndarray) -> Own:
    """Demonstrations, and what was learned of one elsewhere, some arrays of it changed."""
    s = np.linspace(0, 1, 20)
    given = tuple(demos.Demonstration(2 * s, np.stack([s - 1, s * (1 - s)], axis=1), f"arc {k}") for k in range(num))
    imitation = fit(given[:1], ImitationSettings(num_layers=2, num_points=12, max_iterations=2))
    own = Own.of(replace(own_task(demos.check_demonstrations(given, "test")), imitation=imitation, state="plain"))
    assert own.learned is not None
    return replace(own, learned={**own.learned, **arrays})


def flow_of(counts: tuple[int, int], steps: int, number: int = 0) -> dict[str, np.ndarray]:
    """The arrays of a flow with so many Gaussians along each axis, which moves points by next to nothing."""
    axes = {f"layer_{number}_axis_{j}": np.linspace(-1.0, 1.0, counts[j]) for j in range(2)}
    own = {"weights": np.full((counts[0] * counts[1], 2), 1e-12), "ell_steps_forward": np.array([1.0, steps, 0.0])}
    return {**axes, **{f"layer_{number}_{name}": array for name, array in own.items()}}


def with_changed_json(content: bytes, rng: Rng) -> bytes:
    """With other values in it, if it still is JSON."""
    try:
        tree = json.loads(content)
    except ValueError:
        return content
    change_values(tree, rng)
    return json.dumps(tree).encode()


def hostile_scenario(number: int) -> bytes:
    """The saved scenario of this number, damaged."""
    return mutated(saved_scenario(), (*EVERYWHERE, *(with_changed_json,) * 20), np.random.default_rng((12, number)))


def recorded_seeds() -> Iterator[tuple[str, str, bytes, tuple[Mutation, ...]]]:
    """Recorded motions of every kind, as a visitor's and as one's own, and an archive of some."""
    with TemporaryDirectory() as folder:
        recorded.good_files(Path(folder))
        paths = sorted(Path(folder).glob("[ab].*"))
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for suffix in (".csv", ".npy", ".mat"):
                archive.write(Path(folder, f"a{suffix}"), f"day/take{suffix}")
        yield "takes", "a.zip", file.getvalue(), (with_changed_members,) * 4
        for path in paths:
            if path.suffix not in (".tsv", ".txt", ".dat", ".h5"):  # read as others are
                own = {".npz": (with_changed_members,) * 4, ".npy": (with_other_shape,) * 8}.get(path.suffix, ())
                for kind in ("takes", "demonstrations")[: 1 + (path.name != "a.mat")]:  # which may end the program
                    yield kind, path.name, path.read_bytes(), own


@cache
def seeds() -> tuple[tuple[str, str, bytes, tuple[Mutation, ...]], ...]:
    """For each loader whose files are read how: its kind, a name, a good file, and mutations of such files only."""
    rng = np.random.default_rng(0)
    motions = [np.cumsum(rng.normal(scale=0.01, size=(30, d)), axis=0) for d in (2, 2)]
    rows = [
        "demo,t,x,y",
        *(f"{k},{t},{x:.5g},{y:.5g}" for k, motion in enumerate(motions) for t, (x, y) in enumerate(motion)),
    ]
    arrays = {f"positions_{k}": motion for k, motion in enumerate(motions)}
    arrays |= {f"times_{k}": np.arange(30.0) for k in range(2)} | {"name_0": np.array("first")}
    scene = trimesh.Scene([BALL, trimesh.creation.box((0.1, 0.1, 0.3))]).export(file_type="glb")
    assert isinstance(scene, bytes)
    points, labels = POINTS, LABELS
    table = [
        "x,y,z,occupied",
        *(f"{x:.4f},{y:.4f},{z:.4f},{int(o)}" for (x, y, z), o in zip(points, labels, strict=True)),
    ]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {axis}" for axis in "xyz")]
    cloud = [*header, "property uchar label", "end_header", *(row.replace(",", " ") for row in table[1:])]
    return (
        ("demonstrations", "a.csv", "\n".join(rows).encode(), ()),
        ("demonstrations", "a.npz", npz(**arrays), (with_changed_members,) * 4),
        ("mesh", "a.stl", exported(BALL, "stl"), ()),
        ("mesh", "b.stl", exported(BALL, "stl_ascii"), ()),
        ("mesh", "a.obj", exported(BALL, "obj"), ()),
        ("mesh", "a.ply", exported(BALL, "ply"), ()),
        ("mesh", "b.ply", exported(BALL, "ply", encoding="ascii"), ()),
        ("mesh", "a.glb", scene, (with_changed_scene,) * 8),
        ("mesh", "a.gltf", embedded(scene), ()),
        ("mesh", "a.off", exported(BALL, "off"), ()),
        ("mesh", "a.3mf", exported(BALL, "3mf"), (with_changed_members,) * 4),
        ("cloud", "a.npz", npz(points=points, labels=labels), (with_changed_members,) * 4),
        ("cloud", "b.npz", npz(points=points[labels].astype(np.float32)), (with_changed_members,) * 4),
        ("cloud", "a.csv", "\n".join(table).encode(), ()),
        ("cloud", "a.ply", "\n".join(cloud).encode(), ()),
        *recorded_seeds(),
        ("motion", "a.npz", saved_motion(), (*(with_changed_members,) * 4, *(with_changed_text,) * 20)),
        ("sent", "a.npz", sent_motion(), (*(with_changed_members,) * 4, *(with_changed_text,) * 20)),
    )


def mutated(content: bytes, mutations: tuple[Mutation, ...], rng: Rng) -> bytes:
    """The content after one to three of the mutations."""
    for _ in range(rng.integers(1, 4)):
        content = mutations[int(rng.integers(len(mutations)))](content, rng)
    return content


def hostile_file(number: int) -> tuple[str, str, bytes]:
    """The kind of loader, a name and the content of the file of this number."""
    kind, name, content, own = seeds()[number % len(seeds())]
    return kind, name, mutated(content, EVERYWHERE + own, np.random.default_rng((11, number)))


def read(kind: str, name: str, content: bytes) -> None:
    """Read a file and look whether what it gives can be used."""
    if kind == "demonstrations":
        for demonstration in recorded.read_demonstrations(content, name, arm=recorded.Planar()):
            assert np.isfinite(demonstration.positions).all()
            assert (np.diff(demonstration.times) > 0).all()
        return
    if kind == "takes":
        with parsing(DataError, name, "file", "recorded motions"):
            given = read_upload(Recordings, [(name, content)], answers={}, joint_names=["joint1", "joint2"])
        assert all(np.isfinite(take.values).all() and np.isfinite(take.times).all() for take in given.takes)
        return
    if kind == "motion":
        saving.read_motion(content, name)
        return
    if kind == "sent":
        saving.sent_motion_task(name, content, never)
        return
    if kind == "scenario":
        saved = decode(content, Known(tuple(TASKS)), name)
        text = encode(saved)
        assert encode(decode(text, Known(tuple(TASKS)))) == text
        check_shapes(saved.scenario, name)
        return
    solid = shapes.read_mesh(content, name)[0] if kind == "mesh" else shapes.read_cloud(content, name)[0].solid
    assert solid.distances.depth > 0
    assert np.isfinite(solid.distances.values).all()


def forget() -> None:
    """Forget what was computed of meshes and clouds."""
    for kept in (solids._distances, solids._balls, clouds._solid, solid_map):
        kept.cache_clear()


@contextmanager
def coarsely() -> Iterator[None]:
    """Within this block the distances of meshes and clouds are coarse, and soon computed."""
    fine = solids.SETTINGS, clouds.SETTINGS
    solids.SETTINGS = solids.GridSettings(num_nodes=10**3, num_samples=1000)
    clouds.SETTINGS = clouds.CloudSettings(num_nodes=10**3, num_samples=1000)
    forget()
    try:
        yield
    finally:
        solids.SETTINGS, clouds.SETTINGS = fine
        forget()


def main() -> None:
    import resource  # not on every system

    unit_map(Sphere(ORIGIN, 2.0)).logit(np.zeros((1, 3)))  # compiling is not reading
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESS_SPACE, MAX_ADDRESS_SPACE))
    with coarsely() if "--coarse" in sys.argv else nullcontext():
        read_what_is_given()
    forkserver._forkserver._stop()  # pyright: ignore[reportAttributeAccessIssue] - its processes are counted then
    print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024, flush=True)


def read_what_is_given() -> None:
    import resource

    def seconds() -> float:
        both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        server = forkserver._forkserver._forkserver_pid  # pyright: ignore[reportAttributeAccessIssue]
        ticks = [0] if server is None else PROCESS.with_name(f"{server}").joinpath("stat").read_text()
        ticks = ticks.rpartition(")")[2].split()[11:15] if isinstance(ticks, str) else ticks
        waiting = sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")  # of the forkserver and the processes that it forked
        return sum(used.ru_utime + used.ru_stime for used in both) + waiting

    def megabytes(name: str) -> float:
        (kilobytes,) = re.findall(rf"{name}:\s+(\d+) kB", PROCESS.joinpath("status").read_text())
        return int(kilobytes) / 1024

    while line := sys.stdin.buffer.readline():
        faulthandler.dump_traceback_later(MAX_SECONDS, exit=True)
        kind, name, size = json.loads(line)
        content = sys.stdin.buffer.read(size)
        forget()  # what was computed of files before
        PROCESS.joinpath("clear_refs").write_text("5")  # forget the largest memory so far
        start, before, message = seconds(), megabytes("VmRSS"), ""
        try:
            read(kind, name, content)
        except DataError as error:
            message = str(error)
        faulthandler.cancel_dump_traceback_later()  # waiting for the next file is no reading
        print(json.dumps([message, seconds() - start, megabytes("VmHWM") - before]), flush=True)


if __name__ == "__main__":
    main()
