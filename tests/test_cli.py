"""The command line of the demo, as a process of its own."""

import asyncio
import re
import signal
import subprocess
import sys
from contextlib import AsyncExitStack
from dataclasses import replace

import numpy as np
import pytest
from demo import PATIENCE, address, started
from protocol_client import LostError, ProtocolClient

from dt_viz.cli import main
from dt_viz.learning import store
from dt_viz.scenario.own import Own
from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN, TASKS, own_task
from dt_viz.ui import server
from dt_viz.ui.patches import GateError
from dt_viz.ui.server import CLOSING


def assert_ends_cleanly(process):
    _, errors = process.communicate(timeout=PATIENCE)
    assert (process.returncode, errors) == (0, "")


async def visit_and_stop(process, url, number):
    """Send the signal while two visitors drag."""
    async with AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(ProtocolClient(url)) for _ in range(2)]
        for client in clients:
            await client.look()
        for client in clients:
            assert await client.wait_for(lambda client=client: client.has_picture, PATIENCE)
            await client.grab()
        for k in range(5):
            for client in clients:
                await client.move([0.1, -0.5, 0.3 + 0.01 * k])
            await asyncio.sleep(0.02)
        process.send_signal(number)
        for client in clients:
            with pytest.raises(LostError):
                await client.wait_for(lambda: False, PATIENCE)
            assert CLOSING in client.notices


@pytest.mark.long
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)], ids=["SIGTERM", "Ctrl-C"]
)
def test_a_signal_ends_it_cleanly_while_visitors_drag(cache, number):
    with started(cache, "--processes", "1") as process:
        asyncio.run(visit_and_stop(process, address(process), number))
        assert_ends_cleanly(process)


@pytest.mark.long
def test_a_signal_ends_it_cleanly_while_it_learns(tmp_path):
    with started(tmp_path, "--processes", "1") as process:
        address(process)  # it answers meanwhile
        assert process.stdout is not None
        assert "Learn" in process.stdout.read(8)
        process.terminate()
        assert_ends_cleanly(process)


def test_every_task_is_learned_before_it_is_ready_if_asked_with_a_line_for_each(monkeypatch, capsys):
    learned = []

    class Fits:
        def __init__(self, _folder):
            pass

        def get(self, demonstrations, progress):
            learned.append(demonstrations)
            progress(1.0, "done")

    def serve(*_what, **_how):
        assert learned == [entry().demonstrations for entry in TASKS.values()]
        raise GateError("it would be ready")

    monkeypatch.setattr(store, "FitStore", Fits)
    monkeypatch.setattr(server, "Server", serve)
    assert main(["--prepare-all", "--port", "0", "--processes", "1"]) == 2
    printed, errors = capsys.readouterr()
    assert re.findall("Ready: (.*)", printed) == [entry.title for entry in TASKS.values()]
    assert "it would be ready" in errors
    learned.clear()
    assert main(["--prepare-only"]) == 0
    assert len(learned) == len(TASKS)


def test_own_files_are_the_task_that_the_page_begins_with(monkeypatch, tmp_path, capsys):
    s = np.linspace(0, 1, 60)
    for k in range(2):
        path = np.stack([300 * s, 100 * s**2 + 10 * k, 200 - 50 * s], axis=1)
        np.savetxt(tmp_path / f"{k}.csv", path, delimiter=",", header="x,y,z", comments="")

    given, said = served(monkeypatch, capsys, tmp_path, "--rate", 30, "--unit", "mm", "--max-of-address", 40)
    assert "it would be ready" in said and given["max_of_address"] == 40 and {*TASKS} < {*given["tasks"]}
    shown = given["tasks"][given["task"]]()
    assert (given["task"], shown.title, len(shown.paths)) == ("own_data", "Own data", 2)
    np.testing.assert_allclose(shown.paths[0][-1], [0.3, 0.1, 0.15])
    assert shown.demonstrations[0].duration == pytest.approx(59 / 30)
    assert main([str(tmp_path), "--columns", "x,y"]) == 2
    assert "0.csv: columns: found 2 names for 3 columns; accepted: 3 names" in capsys.readouterr().err


def served(monkeypatch, capsys, *arguments):
    """What the server would be given, and what is printed."""
    given = {}

    def serve(tasks, *_what, **how):
        given.update(how, tasks=tasks)
        raise GateError("it would be ready")

    monkeypatch.setattr(server, "Server", serve)
    assert main([*map(str, arguments), "--port", "0", "--processes", "1"]) == 2
    return given, capsys.readouterr().err


OWN_SAVED = Saved(Scenario(OWN, (), warp=0.5), own=Own.of(own_task(TASKS["push_box"]().demonstrations)))


def test_a_saved_scenario_is_what_each_page_begins_with(monkeypatch, tmp_path, capsys):
    path = tmp_path / "mine.json"
    path.write_text(encode(Saved(Scenario("draw_j", (), warp=0.5))))
    given, _ = served(monkeypatch, capsys, path)
    assert (given["task"], given["begins"]) == ("draw_j", Saved(Scenario("draw_j", (), warp=0.5)))
    path.write_text(encode(OWN_SAVED))
    given, _ = served(monkeypatch, capsys, path)
    task = given["tasks"][OWN]()
    assert (given["task"], task.name, len(task.paths)) == (OWN, OWN, len(TASKS["push_box"]().paths))
    assert given["begins"] == Saved(Scenario(OWN, (), warp=0.5))
    path.write_text(encode(replace(OWN_SAVED, scenario=replace(OWN_SAVED.scenario, arm="panda"))))
    given, _ = served(monkeypatch, capsys, path)  # its arm brings it, where it is placed for that
    assert given["task"] == "draw_s" and OWN not in given["tasks"] and given["begins"].own is not None


@pytest.mark.parametrize(
    ("change", "arguments", "said"),
    [
        (('"warp":0.5', '"warp":7.0'), (), "mine.json: warp: found 7; accepted: 0 to 1"),
        (('"arm":""', '"arm":"pr2"'), (), "mine.json: arm: found 'pr2'"),
        (('"arm":""', '"arm":""' + 300_000 * " "), (), "mine.json: "),
        (
            ("", ""),
            ("--task", "draw_s"),
            "mine.json: --task: found an option beside a saved scenario; accepted: the sc",
        ),
        (
            ("", ""),
            ("mine.json",),
            "mine.json: files: found a saved scenario among 2 files; accepted: it alone, or --scenarios",
        ),
        (("", ""), ("takes.csv",), "mine.json: files: found a saved scenario among 2 files; accepted: it alone"),
    ],
)
def test_a_scenario_that_cannot_be_opened_is_one_line(monkeypatch, tmp_path, capsys, change, arguments, said):
    monkeypatch.chdir(tmp_path)
    old, new = change
    (tmp_path / "mine.json").write_text(encode(OWN_SAVED).replace(old, new, 1))
    given, error = served(monkeypatch, capsys, "mine.json", *arguments)
    assert not given and error.startswith(f"dt-viz: {said}") and error.count("\n") == 1


def test_scenarios_of_a_folder_are_offered_by_their_names_and_each_that_is_refused_is_a_line(
    monkeypatch, tmp_path, capsys
):
    text = encode(OWN_SAVED)
    for name in ("lesson-1", "Lesson_2", "a b", "ä", "x" * 61):
        (tmp_path / f"{name}.json").write_text(text)
    (tmp_path / "damaged.json").write_text(text.replace('"warp":0.5', '"warp":7.0'))
    (tmp_path / "other.json").write_text("[1, 2]")
    (tmp_path / "takes.csv").write_text("no scenario")
    given, error = served(monkeypatch, capsys, "--scenarios", tmp_path)
    assert [*given["scenarios"]] == ["Lesson_2", "lesson-1"] and given["begins"] is None
    assert given["scenarios"]["lesson-1"].scenario == OWN_SAVED.scenario
    *refused, _served = error.splitlines()
    assert len(refused) == 5 and all(": found " in line for line in refused)
    assert any("damaged.json: warp: found 7; accepted: 0 to 1" in line for line in refused)
    assert sum(": name: found " in line for line in refused) == 3


@pytest.mark.parametrize(("num", "said"), [(0, "found 0 .json files; accepted: 1 to 100"), (101, "found 101 .json")])
def test_a_folder_without_scenarios_or_with_very_many_is_refused(tmp_path, capsys, num, said):
    for k in range(num):
        (tmp_path / f"{k}.json").touch()
    assert main(["--scenarios", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_the_key_of_the_presenter_is_printed_and_another_one_each_time(monkeypatch, capsys):
    one, other, private = (served(monkeypatch, capsys, *given)[0] for given in (["--present"], ["--present"], []))
    assert len(one["key"]) > 20 and one["key"] != other["key"] and private["key"] is None
    assert (one["max_sessions"], private["max_sessions"]) == (50, 8)


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ("--help", 0, "dt-viz evaluate --help"),
        ("evaluate around --task nothing --out a.npz", 2, "dt-viz evaluate around: --task: found 'nothing'"),
        ("--task nothing", 2, "found 'nothing'"),
        ("--arm pr2", 2, "name: found 'pr2'; accepted: jaco, panda, ur3"),
        ("--urdf nowhere.urdf", 2, "nowhere.urdf: file: found No such file"),
        ("--arm panda --home=0,1 --srdf x", 2, "--home, --srdf: found without --urdf; accepted: with --urdf"),
        ("--rate 20", 2, "--rate: found without FILE"),
        ("--home 1,a", 2, "--home: found '1,a'; accepted: angles in rad"),
        ("--arm panda --urdf arm.urdf", 2, "--urdf: not allowed with argument --arm"),
        *(
            (f"--processes {number}", 2, f"--processes: found '{number}'; accepted: 1 to 64")
            for number in ("0", "-1", "1000", "two")
        ),
        ("--present --processes 2", 2, "--processes: found 2; accepted: 1 with --present"),
        ("--allow-origin demo.org", 2, "--allow-origin: found 'demo.org'; accepted: http://"),
    ],
)
def test_it_explains_itself_and_what_is_wrong_and_measurements_are_a_subcommand(capsys, arguments, status, words):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        ended = main(arguments.split())
    except SystemExit as exit:
        ended = exit.code
    assert ended == status
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers  # as before
    written = capsys.readouterr()
    assert words in written.out + written.err
    assert written.err.count("\n") <= 1  # what is accepted, not all that there is


def test_numpy_is_not_imported_before_its_threads_are_limited():
    program = "import sys, dt_viz.cli; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
