"""The process that reads uploads: its limits, its end, and what the server makes of its answers."""

import io
import sys
import textwrap
import threading
import time
from dataclasses import astuple
from pathlib import Path
from typing import cast

import leftovers
import numpy as np
import pytest
import trimesh
from pages import PATIENCE, wait_until

from dt_viz.accounts import Account, QuotaSettings, charged
from dt_viz.errors import FormatError, UnwantedError
from dt_viz.files import triangles, uploads, worker
from dt_viz.files.shapes import Triangles
from dt_viz.files.uploads import read_upload
from dt_viz.obstacles import solids
from dt_viz.obstacles.files import ShapeError, read_cloud, read_mesh

BOX = cast(bytes, trimesh.creation.box((0.15, 0.1, 0.05)).export(file_type="stl"))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them")


@pytest.fixture(autouse=True)
def _ready(monkeypatch):
    """Nobody else's process is ready."""
    monkeypatch.setattr(uploads, "_ready", uploads._Ready())


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Replaces what reads by a program; its last expression may be an answer."""

    def replace(text: str, *, begins: bool = True) -> None:
        name = f"reader_{tmp_path.name.strip('0123456789_')}"
        begin = "import json, os, sys, time\nimport numpy as np\nfrom dt_viz.files import worker\n"
        body = textwrap.indent(textwrap.dedent(text), "    ")
        program = f"def read(kind, files):\n{body}\n    return {{}}, []\nworker.answer = read\nworker.main()\n"
        (tmp_path / f"{name}.py").write_text(begin + program if begins else text)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr(worker, "__name__", name)

    return replace


@pytest.fixture
def kept():
    """One process reads all the test's files, unless it is ended."""
    uploads.keep_ready(user := object())
    yield
    uploads.let_go(user)


@pytest.mark.usefixtures("kept")
def test_what_is_refused_says_why_in_one_line():
    with pytest.raises(FormatError, match="faces: found none"):
        read_upload(Triangles, [("a.obj", b"v 0 0 0\n")])
    with pytest.raises(FormatError, match="something that cannot be read"):
        read_upload(Triangles, [("a.3mf", b"no archive")])


@pytest.mark.long
@LINUX
@pytest.mark.usefixtures("kept")
def test_the_readers_processor_time_is_charged_to_whoever_sent_the_file(reader):
    # it has used some milliseconds before the file came, which nobody is charged for
    reader(
        "end = time.process_time() + 0.5\nwhile time.process_time() < end: pass\nif files[0][1] == b'end': os.abort()"
    )
    account = Account(None, QuotaSettings(rate=1e-9, saved=0.0))
    for number, content in enumerate((b"", b"end", b""), 1):  # the last one by another process
        with charged(account), pytest.raises((FormatError, KeyError)):
            read_upload(Triangles, [("a.stl", content)])
        assert 0.5 * number <= account.debt < 0.5 * number + 0.4


@pytest.mark.long
@LINUX
@pytest.mark.parametrize(
    "hostile",
    [
        "x = bytearray(2 * 10**9)",
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\nwhile True: pass",
        "open(os.path.join(os.environ['TMPDIR'], 'x'), 'wb').write(bytes(2 * 10**8))",
        "os.abort()",
        "sockets = [__import__('socket').socket() for _ in range(100)]",
    ],
)
def test_what_it_does_beyond_its_limits_ends_it_and_nothing_else(reader, hostile):
    reader(hostile)
    with pytest.raises(ShapeError, match="ended its reader"):
        read_mesh(BOX, "a.stl")


@pytest.mark.long
@LINUX
def test_a_reader_that_ends_its_parent_is_ended_with_it(reader, tmp_path):
    reader("""
        open(__file__ + ".pid", "w").write(str(os.getpid()))
        os.kill(os.getppid(), 9)
        time.sleep(60)
    """)
    with pytest.raises(ShapeError, match="ended its reader"):
        read_mesh(BOX, "a.stl")
    (file,) = tmp_path.glob("*.pid")
    wait_until(lambda: not leftovers._read(leftovers.PROC / file.read_text() / "cmdline"))


@pytest.mark.long
@pytest.mark.usefixtures("kept")
def test_distances_are_computed_by_that_process_to_the_last_bit(monkeypatch):
    monkeypatch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=20**3, num_samples=6000))
    solids._distances.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(triangles, "inside_of_grid", None)  # not here
        mesh, _ = read_mesh(BOX, "a.stl")
        cloud, _ = read_cloud("\n".join(["x,y,z", *(f"{x},{y},{z}" for x, y, z in POINTS)]).encode(), "a.csv")
        read = mesh.distances, cloud.solid.distances
    solids._distances.cache_clear()
    for found, here in zip(read, (mesh.distances, cloud.solid.distances), strict=True):
        assert found is not here
        assert [np.asarray(part).tobytes() for part in astuple(found)] == [
            np.asarray(part).tobytes() for part in astuple(here)
        ]


@pytest.mark.usefixtures("kept")
def test_any_other_answer_is_one_line_for_the_page(reader):
    reader("return eval(files[0][1])")
    for answer in (
        b"print(3, flush=True), []",
        b"[], []",
        b"{}, []",
        b"{'refused': 3}, []",
        b"{'value': {}, 'arrays': []}, []",
        b"{'value': {}, 'arrays': ['a']}, []",
    ):
        with pytest.raises(ShapeError) as info:
            read_mesh(answer, "a.stl")
        assert str(info.value).startswith("a.stl: file: found "), answer


@pytest.mark.usefixtures("kept")
def test_nothing_is_unpickled_and_no_room_is_made_for_what_is_not_there(reader):
    reader("""
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)}
        def save(file, array, allow_pickle):
            np.lib.format.write_array_header_1_0(file, header) if array is None else save_pickled(file, array)
        save_pickled, np.save = np.save, save
        return {"value": {}, "arrays": ["a"]}, [None if len(files[0][1]) else np.array([{}])]
    """)
    for content in (BOX, b""):
        with pytest.raises((ValueError, MemoryError)):
            read_upload(Triangles, [("a.stl", content)])


@pytest.mark.long
def test_the_first_line_of_an_answer_may_be_as_long_as_very_many_takes_make_it(reader):
    reader("""
        value = {"class": "Triangles", "vertices": "v", "faces": "f", "notes": ["x" * 10**7]}
        return {"value": value, "arrays": ["v", "f"]}, [np.zeros((3, 3)), np.zeros((1, 3), int)]
    """)
    assert read_upload(Triangles, [("a.stl", BOX)]).notes == ("x" * 10**7,)


@pytest.mark.long
@pytest.mark.parametrize(
    ("begins", "words"), [(False, "reader: found none that is ready"), (True, "file: found data that take more than")]
)
def test_what_hangs_is_ended(reader, monkeypatch, begins, words):
    reader("time.sleep(1000)" if begins else "import time; time.sleep(1000)", begins=begins)
    monkeypatch.setattr(uploads, "PATIENCE" if begins else "START", 0.3)
    start = time.monotonic()
    with pytest.raises(FormatError, match=words):
        read_upload(Triangles, [("a.stl", bytes(10**7))])
    assert time.monotonic() - start < PATIENCE + begins * uploads.START


def test_a_line_that_comes_in_pieces_is_one_line(reader):
    """As where Python is told to buffer nothing (PYTHONUNBUFFERED)."""
    program = """
import sys, time
from pathlib import Path
from tempfile import gettempdir
def say(*pieces):
    for piece in pieces:
        time.sleep(0.1)
        print(piece, end="", flush=True)
say("\\n")
while sys.stdin.readline():
    Path(gettempdir(), "answer").write_text('{"refused": ["file", "this", "that"]}')
    say("0", " ", "0.25", "\\n")
"""
    reader(program, begins=False)
    for _ in range(2):
        with pytest.raises(FormatError, match="file: found this; accepted: that"):
            read_upload(Triangles, [("a.stl", BOX)])


def test_what_ends_before_it_begins_says_so(reader):
    reader("", begins=False)
    with pytest.raises(FormatError, match="ended its reader"):
        read_upload(Triangles, [("a.stl", BOX)])


def test_it_ends_when_its_visitor_leaves(reader):
    reader("time.sleep(1000)")
    left = threading.Event()
    threading.Timer(0.3, left.set).start()
    with pytest.raises(UnwantedError):
        read_upload(Triangles, [("a.stl", bytes(10**7))], left.is_set)


@pytest.mark.long
def test_one_is_kept_while_somebody_may_send_a_file_and_none_is_left():
    """The test fails for what it leaves behind, too."""
    users = object(), object()
    for user in users:
        uploads.keep_ready(user)
    assert uploads._ready._process is None  # before the first file
    read = read_upload(Triangles, [("a.stl", BOX)])
    assert read.vertices.shape == (8, 3) and read.faces.shape == (12, 3) and read.notes == ()
    ready = uploads._ready._process
    assert ready is not None
    assert [path.name for path in Path(str(ready._folder)).iterdir()] == ["said"]  # the file has gone
    read_upload(Triangles, [("a.stl", BOX)])
    assert uploads._ready._process is ready
    uploads.let_go(users[0])
    ready._process.kill()  # as a machine does that is short of memory
    ready._process.wait()
    read_upload(Triangles, [("a.stl", BOX)])
    assert uploads._ready._process not in {None, ready}
    uploads.let_go(users[1])
    assert uploads._ready._process is None


@pytest.mark.long
def test_it_ends_by_itself_when_the_server_has_gone():
    process = uploads._Process()
    try:
        assert process._process.stdin is not None
        process._process.stdin.close()  # as the kernel does at the end of a process
        wait_until(lambda: process._process.poll() is not None)
        assert process._process.returncode == 0
    finally:
        process.end()


def test_answers_are_refusals_or_arrays():
    assert worker.answer("Points", [("a.csv", b"x,y,z\n1,2,one\n")])[0] == {
        "refused": [
            "file",
            "something that cannot be read (could not convert string 'one' to float64 at row 0, column 3.)",
            "a .csv file",
        ]
    }
    file = io.BytesIO()
    np.savez(file, points=np.eye(3, dtype=np.float32))
    first, (points,) = worker.answer("Points", [("a.npz", file.getvalue())])
    assert first["arrays"] == ["file.points"] and first["value"]["notes"] == [] and points.dtype == np.float64
