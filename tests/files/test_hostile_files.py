"""Hostile files: whatever the bytes, all loaders end soon, in bounded memory, with what they hold or a clear error."""

import base64
import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import trimesh
from hostile import PROCESS, hostile_file, hostile_scenario, saved_scenario, seeds

from dt_viz.scenario.saved import MAX_BYTES

pytestmark = pytest.mark.skipif(not PROCESS.exists(), reason="memory is measured in Linux's way")

MAX_GROWTH = 100  # of the process that has a file read, MB
MAX_WORKER = 1024  # of the process that reads, MB
MAX_SECONDS = 20  # of processor time, so that other work on the machine does not count
USUAL_SECONDS = 3  # time that all files but few stay below


@dataclass(frozen=True)
class Outcome:
    message: str  # why the file was refused; empty if it was read
    seconds: float
    growth: float


class ReadingProcess:
    """The program that reads; see `hostile.py`."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def read(self, kind: str, name: str, content: bytes) -> Outcome:
        """Have a file read. Fails the test if that ends the program."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps([kind, name, len(content)]).encode() + b"\n" + content)
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        line = self._process.stdout.readline()
        assert line, (
            f"{kind} {name} of {len(content)} bytes ended the program: {self._process.communicate()[1].decode()}"
        )
        return Outcome(*json.loads(line))

    def end(self) -> float:
        """End the program; return the largest memory of the processes that it has started, MB."""
        return float(self._process.communicate()[0])


@contextmanager
def reading(*arguments: str) -> Iterator[ReadingProcess]:
    """The program, after it has read all good files."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    command = [sys.executable, "-W", "error", "-c", "import hostile; hostile.main()", *arguments]
    pipe = subprocess.PIPE
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # of what is killed here, and so leaves its own
        environment["TMPDIR"] = folder
        with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=pipe) as process:
            try:
                program = ReadingProcess(process)
                for kind, name, content, _ in seeds():  # what compiles kernels for this Python is not the files' time
                    assert program.read(kind, name, content).message == ""
                assert program.read("scenario", "a.json", GOOD.encode()).message == ""
                yield program
                assert program.end() < MAX_WORKER
            finally:
                process.kill()


def check(outcome: Outcome, name: str) -> None:
    if outcome.message:
        assert outcome.message.startswith(f"{name}: ")
        assert ": found " in outcome.message and "; accepted: " in outcome.message
        assert len(outcome.message) < 600
    assert outcome.seconds < MAX_SECONDS


@pytest.fixture(scope="module")
def program():
    """A process for all files but those that are mapped finely."""
    with reading("--coarse") as process:
        yield process


def read_all(process: ReadingProcess, numbers: Collection[int]) -> None:
    num, outcomes = len(numbers), []
    for number in numbers:
        kind, name, content = hostile_file(number)
        outcome = process.read(kind, name, content)
        check(outcome, name)
        assert outcome.growth < MAX_GROWTH, f"file {number}, {kind} {name}: {outcome}"
        outcomes.append(outcome)
    num_read = sum(not outcome.message for outcome in outcomes)
    assert sum(outcome.seconds > USUAL_SECONDS for outcome in outcomes) < 0.05 * num
    assert 0.02 * num < num_read < 0.9 * num  # the mutations are neither all fatal nor all harmless


def bzip2_member() -> bytes:
    """Zeros that bzip2 packs into next to nothing, and unpacks all at once."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_BZIP2) as archive, archive.open("points.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "|u1", "fortran_order": False, "shape": (6 * 10**7, 3)})
        for _ in range(180):
            member.write(bytes(10**6))
    return file.getvalue()


def lying_header() -> bytes:
    """A deflated member of 180 MB whose directory says that it has 100 bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npz_member(7_500_000))
    content = file.getvalue()
    place = content.index(b"PK\x01\x02") + 24
    return content[:place] + struct.pack("<I", 100) + content[place + 4 :]


def npz_member(num: int) -> bytes:
    file = io.BytesIO()
    np.save(file, np.zeros((num, 3)))
    return file.getvalue()


def glb(scene: dict, data: bytes) -> bytes:
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    data += bytes(-len(data) % 4)
    length = 28 + len(text) + len(data)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, length) + body


def full_of_text() -> bytes:
    """A 3MF file whose model unpacks to 400 MB."""
    file = io.BytesIO()
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("3D/3dmodel.model", "w", force_zip64=True) as member,
    ):
        member.write(b'<model unit="millimeter"><resources>')
        for _ in range(40):
            member.write(b"<object/>  " * 10**6)
    return file.getvalue()


def deep() -> bytes:
    """A scene of nodes one inside the other."""
    nodes = [{"children": [k + 1]} for k in range(9_999)] + [{"mesh": 0}]
    return glb({"nodes": nodes, "scenes": [{"nodes": [0]}], "meshes": [{"primitives": []}]}, b"")


def instances() -> bytes:
    """A mesh of 130,000 triangles in five thousand places."""
    ball = trimesh.creation.icosphere(7, 0.1)
    ball = trimesh.Trimesh(ball.vertices, ball.faces[:130_000], process=False)
    vertices, faces = ball.vertices.astype("<f4").tobytes(), ball.faces.astype("<u4").tobytes()
    views = [{"buffer": 0, "byteLength": len(vertices)}]
    views.append({"buffer": 0, "byteOffset": len(vertices), "byteLength": len(faces)})
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(ball.vertices), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 3 * len(ball.faces), "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    scene = {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(vertices) + len(faces)}]}
    scene |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}] * 5000}
    return glb(scene | {"scenes": [{"nodes": list(range(5000))}]}, vertices + faces)


def many_arrays() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for k in range(50_000):
            archive.writestr(f"{k}.npy", npz_member(0))
    return file.getvalue()


def of_motion(text: str) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, motion=np.array(text))
    return file.getvalue()


ATTACKS = {
    "a member that bzip2 packs": ("cloud", "a.npz", bzip2_member, "bytes when unpacked"),
    "a motion that bzip2 packs": ("sent", "a.npz", bzip2_member, "bytes when unpacked"),
    "a motion of very many arrays": ("sent", "a.npz", many_arrays, "arrays: found 50000"),
    "a motion of much text": ("sent", "a.npz", lambda: of_motion("{}," * 3_000_000), "found 9000000 characters"),
    "a motion of lists in lists": ("sent", "a.npz", lambda: of_motion("[" * 290_000), "found"),
    "a directory that lies": ("cloud", "a.npz", lying_header, "found"),
    "text in an archive": ("mesh", "a.3mf", full_of_text, "bytes when unpacked"),
    "a mesh in very many places": ("mesh", "a.glb", instances, "faces: found more than 500000 of all parts"),
    "nodes in nodes": ("mesh", "a.glb", deep, "found"),
    "short lines": ("cloud", "a.csv", lambda: b"x,y,z\n" + b"1\n" * 9_999_990, "more than 2000000 lines"),
    "short rows": ("cloud", "a.csv", lambda: b"x,y,z\n" + b"1,1,1\n" * 1_999_990, "points: found 1000001"),
    "short lines of text": ("mesh", "a.obj", lambda: b"f\n" * 10_000_000, "more than 2000000 lines"),
    "one line": ("mesh", "a.obj", lambda: b"f " + b"1 " * 9_999_990, "found"),
    "one line of a ply": ("mesh", "a.ply", lambda: b"ply\nformat ascii 1.0\n" + b"1" * 19_999_900, "found"),
    "much text": ("mesh", "a.stl", lambda: b"solid\n" + b"facet vertex 1 1 1 " * 1_000_000, "found"),
    "short lines of demonstrations": (
        "demonstrations",
        "a.csv",
        lambda: b"t,x,y\n" + b"1\n" * 8_000_000,
        "line 2: found 1 columns",
    ),
}
"""Loader, name and content of a file, and words of its refusal."""


@pytest.mark.long
@pytest.mark.parametrize("attack", ATTACKS)
def test_what_takes_gigabytes_is_refused_in_the_readers_process(program, attack):
    kind, name, make, words = ATTACKS[attack]
    outcome = program.read(kind, name, make())
    assert words in outcome.message
    assert outcome.growth < MAX_GROWTH
    check(outcome, name)


@pytest.mark.long
def test_mutated_files_are_read_or_refused(program):
    """Two of each kind, and thirty of those that are used in the user's own process, or in the server's."""
    kinds = [kind for kind, *_ in seeds()]
    many = "demonstrations", "sent"
    own = (k for k in range(30 * len(kinds)) if k < 2 * len(kinds) or kinds[k % len(kinds)] in many)
    read_all(program, [*own])


@pytest.mark.slow
def test_very_many_mutated_files_are_read_or_refused():
    with reading() as process:
        read_all(process, range(3000))


# --- saved scenarios ---

MAX_SCENARIO_GROWTH, MAX_SCENARIO_SECONDS = 200, 1.0
"""Memory, MB, and processor time in which a scenario is read or refused."""
GOOD = saved_scenario().decode()
FULL = MAX_BYTES - 1000


def with_points(points: np.ndarray) -> str:
    """The good scenario, its cloud with other points."""
    plain = json.loads(GOOD)
    (name,) = (name for name in plain["arrays"] if name.endswith("cloud.points"))
    plain["arrays"][name] |= {"shape": points.shape, "data": base64.b64encode(points.tobytes()).decode()}
    plain["arrays"].pop(name.replace("points", "labels"))
    return json.dumps(plain).replace(f'"{name.replace("points", "labels")}"', "null")


BOMBS = {
    "deep": "[" * FULL,
    "deep in a field": '{"version":2,"class":"Saved","scenario":' + "[" * FULL,
    "wide": '{"version":2,"class":"Saved","scenario":[' + "{}," * (FULL // 3) + "0]}",
    "many fields": "{" + ",".join(f'"{k}":0' for k in range(FULL // 14)) + "}",
    "many of one field": '{"version":2' + ',"camera":0' * (FULL // 11) + "}",
    "many arrays": GOOD[:-2]
    + ",".join(["", *(f'"{k:06}":{{"shape":[0],"type":"float64","data":""}}' for k in range(FULL // 60))])
    + "}}",
    "many axes": GOOD.replace('"shape":[20,3]', f'"shape":[{"9," * (FULL // 4)}1]', 1),
    "huge shape": GOOD.replace('"shape":[20,3]', '"shape":[1000000000000,3]', 1),
    "negative shape": GOOD.replace('"shape":[20,3]', '"shape":[-1,3]', 1),
    "huge integer": GOOD.replace('"arm_rollout":0', f'"arm_rollout":{"9" * 250_000}', 1),
    "huge number": GOOD.replace('"warp":1.0', '"warp":1e308', 1),
    "many digits": GOOD.replace('"warp":1.0', f'"warp":7.{"1" * 250_000}', 1),
    "long text": GOOD.replace("arc 0", "a" * 250_000, 1),
    "long text, escaped": GOOD.replace("arc 0", "\\u0061" * 40_000, 1),
    "many findings": GOOD.replace('"moves":[', '"seen":[' + '"",' * 95_000 + '""],"moves":[', 1),
    "twice": GOOD.replace('"version":2', '"version":2,"version":1,"version":9', 1),
    "many points": with_points(np.random.default_rng(0).uniform(-0.1, 0.1, (400_000, 3))),
    "many triangles": GOOD.replace("AAAA", "AAAAAAAA" * (FULL // 8), 1),
    "too large": GOOD + " " * MAX_BYTES,
}


@pytest.mark.long
@pytest.mark.parametrize("text", BOMBS.values(), ids=BOMBS)
def test_a_bomb_for_a_scenario_is_refused_at_once_in_little_memory(text, program):
    assert len(text) <= 3 * MAX_BYTES
    outcome = program.read("scenario", "a.json", text.encode())
    check(outcome, "a.json")
    assert outcome.message and outcome.growth < MAX_SCENARIO_GROWTH and outcome.seconds < MAX_SCENARIO_SECONDS


@pytest.mark.long
def test_five_hundred_damaged_scenarios_are_refused_by_a_field_or_read_exactly(program):
    outcomes = [program.read("scenario", "a.json", hostile_scenario(number)) for number in range(500)]
    for outcome in outcomes:
        check(outcome, "a.json")
        assert outcome.growth < MAX_SCENARIO_GROWTH and outcome.seconds < MAX_SCENARIO_SECONDS, outcome
    num_read = sum(not outcome.message for outcome in outcomes)
    assert 10 < num_read < 400
