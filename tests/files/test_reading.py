"""The process that reads visitors' files: its limits, its end, and what the server makes of its answers."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
from dataclasses import astuple
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import pytest
import trimesh
from pages import wait_until

from dt_viz.errors import FormatError, UnwantedError
from dt_viz.files import reading, triangles
from dt_viz.files.reading import read_upload
from dt_viz.files.shapes import Triangles
from dt_viz.obstacles import solids
from dt_viz.obstacles.files import ShapeError, read_cloud, read_mesh

BOX = cast(bytes, trimesh.creation.box((0.15, 0.1, 0.05)).export(file_type="stl"))
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them")
ANSWER = """
import json, os, sys, tempfile, time
import numpy as np
folder = tempfile.gettempdir()
def answer(first, *arrays, pickled=False):
    with open(os.path.join(folder, "answer"), "wb") as file:
        file.write(json.dumps(first).encode() + b"\\n")
        for array in arrays:
            np.save(file, array, allow_pickle=pickled)
"""


@pytest.fixture
def run(monkeypatch):
    """Has the process run a program in place of a reader."""

    def run(program, cancelled=lambda: False):
        program = f"exec({ANSWER + textwrap.dedent(program)!r}, {{}})"
        kind = type(program, (Triangles,), {})  # exec is given its name
        with monkeypatch.context() as patch:
            patch.setattr(reading, "_respond", exec)
            return read_upload(kind, cast("list", {}), cancelled)

    return run


def refusal(run, program):
    with pytest.raises(FormatError) as info:
        run(program)
    return str(info.value)


@pytest.mark.long
@LINUX
@pytest.mark.parametrize(
    ("hostile", "code"),
    [
        ("import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\nwhile True: pass", -signal.SIGKILL),
        ("os.abort()", -signal.SIGABRT),
        ("os._exit(3)", 3),
        ("x = bytearray(2 * 10**9)", 1),
        ("open(os.path.join(folder, 'x'), 'wb').write(bytes(2 * 10**8))", 1),
        ("sockets = [__import__('socket').socket() for _ in range(100)]", 1),
    ],
)
def test_what_ends_it_ends_nothing_else(run, hostile, code):
    assert f"ended its reader ({code})" in refusal(run, hostile)
    assert read_upload(Triangles, [("a.stl", BOX)]).vertices.shape == (8, 3)


CONFINE = "from pathlib import Path; from dt_viz.files.confinement import confine; print(confine(Path()))"


@LINUX
def test_a_reader_opens_only_its_own_files_and_code(run, tmp_path):
    if subprocess.check_output([sys.executable, "-c", CONFINE]) != b"True\n":
        pytest.skip("this kernel has no Landlock")
    (tmp_path / "secret").write_text("secret")
    program = f"secret, code = {str(tmp_path / 'secret')!r}, {reading.__file__!r}" + textwrap.dedent("""
        said = []
        for what, *given in (
            (open, secret), (os.listdir, "/"), (open, secret + "2", "w"), (os.truncate, secret, 0), (os.remove, secret),
            (open, code, "a"), (open, code), (open, os.path.join(os.environ["TMPDIR"], "own"), "w"),
            (__import__, "sqlite3"),
        ):
            try:
                what(*given)
            except PermissionError:
                said.append("no")
            else:
                said.append("yes")
        answer({"refused": ["file", " ".join(said), "what is said"]})
    """)
    assert "found no no no no no no yes yes yes; accepted" in refusal(run, program)
    assert (tmp_path / "secret").read_text() == "secret"


def has_ended(process):
    try:
        return not Path(f"/proc/{process}/cmdline").read_text()  # that of a process that nobody has waited for is empty
    except OSError:
        return True


@pytest.mark.long
@LINUX
def test_a_reader_that_ends_its_parent_is_ended_with_it(run, monkeypatch):
    started, start = list[int](), reading._start
    monkeypatch.setattr(
        reading, "_start", lambda process, sender: (start(process, sender), started.append(process.pid))
    )
    assert "ended its reader" in refusal(run, "os.kill(os.getppid(), 9)\ntime.sleep(1000)")
    (process,) = started
    wait_until(lambda: has_ended(process))
    assert read_upload(Triangles, [("a.stl", BOX)]).faces.shape == (12, 3)


@pytest.mark.long
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


@pytest.mark.parametrize(
    "answer", ["", "answer([])", "answer({})", "answer({'refused': 3})", "answer({'value': {}, 'arrays': ['a']})"]
)
def test_any_other_answer_is_one_line_for_the_page(run, monkeypatch, answer):
    monkeypatch.setattr("dt_viz.obstacles.files.read_upload", lambda *_: run(answer))
    with pytest.raises(ShapeError, match=r"a\.stl: file: found "):
        read_mesh(BOX, "a.stl")


def test_no_array_is_unpickled_and_no_room_is_made_for_what_is_not_there(run):
    answer = "answer({'value': {}, 'arrays': ['a']}, np.array([{}]), pickled=True)"
    with pytest.raises(ValueError, match="allow_pickle"):
        run(answer)
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (10**12, 3)}"
    with pytest.raises((ValueError, MemoryError)):
        run(f"""
            answer({{"value": {{}}, "arrays": ["a"]}})
            with open(os.path.join(folder, "answer"), "ab") as file:
                np.lib.format.write_array_header_1_0(file, {header})
        """)


@pytest.mark.parametrize(
    ("limit", "words"), [("START", "reader: found none that is ready"), ("PATIENCE", "data that take more than")]
)
def test_what_hangs_is_ended(run, monkeypatch, limit, words):
    """The test fails for a process that is left behind, too."""
    monkeypatch.setattr(reading, limit, {"START": 0.0, "PATIENCE": 0.3}[limit])
    assert words in refusal(run, "time.sleep(1000)")


def test_it_ends_when_its_visitor_leaves(run):
    left = threading.Event()
    threading.Timer(0.3, left.set).start()
    with pytest.raises(UnwantedError):
        run("time.sleep(1000)", left.is_set)


SERVER = """
import signal, threading, time
from dt_viz.files import reading
if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    reading._respond, left = exec, threading.Event()
    program = "import os, time; print(os.getpid(), file=open('pid', 'w'), flush=True); time.sleep(1000)"
    kind = type(f"import os, tempfile; os.chdir(tempfile.gettempdir()); {program}", (), {})
    threading.Thread(target=lambda: reading.read_upload(kind, {}, left.is_set), daemon=True).start()
    try:
        time.sleep(1000)
    except KeyboardInterrupt:
        left.set()
"""


@pytest.mark.long
@LINUX
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_it_ends_with_the_server(end):
    path = os.pathsep.join(filter(None, sys.path))
    with TemporaryDirectory() as name:  # `tmp_path` is too long for a socket
        folder, environment = Path(name), os.environ | {"TMPDIR": name, "PYTHONPATH": path}
        (folder / "server.py").write_text(SERVER)
        command, pipe = [sys.executable, "server.py"], subprocess.PIPE
        with subprocess.Popen(command, cwd=name, env=environment, stderr=pipe, start_new_session=True) as server:
            wait_until(lambda: any(file.read_text() for file in folder.glob("*/pid")))
            (file,) = folder.glob("*/pid")
            reader = file.read_text().strip()
            os.killpg(server.pid, end) if end == signal.SIGINT else server.send_signal(end)  # as Ctrl-C does
            errors = server.communicate()[1].decode()
        wait_until(lambda: has_ended(reader))
        assert "Interrupt" not in errors
        assert end == signal.SIGKILL or not [*folder.glob("dt-viz-*")]
