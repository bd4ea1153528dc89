"""The command line of the measurements: its names, former and present, and what it cannot use."""

import json
import re
from importlib.util import find_spec

import pytest
from hook import write_mat

from dt_viz import cli
from dt_viz.evaluate import options
from dt_viz.evaluate.__main__ import MOVED, main
from tests.benchmarks.__main__ import NAMES
from tests.benchmarks.__main__ import main as benchmarks


def status_of(main, arguments):
    """The exit status, also where argparse ends it."""
    try:
        return main(arguments.split())
    except SystemExit as ended:
        return ended.code


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("imitation missing.mat --out out", "missing.mat: path: found no such file or folder; accepted: "),
        ("imitation Hook.mat Hook.csv --out out", "SHAPE: found 'Hook.mat' and 'Hook.csv'"),
        ("imitation Hook.mat --out file/below", "--out: found 'file/below'; accepted: a folder that can be written to"),
        ("imitation Hook.mat --folds 1 --out out", "--folds: found '1'; accepted: a whole number"),
        ("imitation alone.csv --folds 2 --out out", "--leave-one-out: found one demonstration only in alone.csv"),
        (
            "imitation Hook.mat --state augmented --objective velocity --out out",
            "--objective: found velocity; accepted",
        ),
        ("imitation Hook.mat", "the following arguments are required: --out"),
        ("around --task none --out a.npz", "--task: found 'none'; accepted: draw_s,"),
        ("around --task draw_s --out a.txt", "--out: found 'a.txt'; accepted: a file that ends in .npz"),
        ("around --task draw_s --lasa no --out a.npz", "no: folder: found something that cannot"),
        ("around --task draw_s --obstacle 0,0,0 --out file/a.npz", "--out: found 'file/a.npz'; accepted: a file that "),
        ("around --task draw_s --obstacle 0,0,0 --out folder.npz", "--out: found 'folder.npz'; accepted: a file that "),
        ("around --task draw_s --obstacle 0,0", "--obstacle: found '0,0'; accepted: "),
        ("around --task draw_s --obstacle -0,inf,0", "--obstacle: found '-0,inf,0'"),
        ("around --task draw_s --obstacle 0,0,0 --count 2", "not allowed with argument --obstacle"),
        ("around --task draw_s --size -1", "--size: found '-1'; accepted: a number"),
        ("around --task draw_s --along 0,1.1", "--along: found '0,1.1'; accepted: a number"),
        ("around --task draw_s --spread -1", "--spread: found '-1'; accepted: metres, 0 to 1"),
        ("around --task draw_s --count many", "--count: found 'many'; accepted: a whole number, 0 or more"),
        ("around --task draw_s --out a.npz --tables file/b.json", "--tables: found 'file/b.json'; accepted: a "),
        ("around --task draw_s --out a.npz --jobs 0", "--jobs: found '0'; accepted: a whole number, 1 or more"),
        ("around --task draw_s --out a.npz --jobs 2 --dask tcp://127.0.0.1:1", "not allowed with argument --jobs"),
        ("", "the following arguments are required: COMMAND"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    write_mat(tmp_path / "Hook.mat")
    (tmp_path / "alone.csv").write_text("t,x,y\n0,0,0\n1,0.1,0.1\n2,0.2,0.3\n")
    (tmp_path / "file").touch()
    (tmp_path / "folder.npz").mkdir()
    assert status_of(main, arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("load --url 127.0.0.1:8080", "--url: found '127.0.0.1:8080'; accepted: ws:// or wss://"),
        ("--only nothing --out out", "--only: invalid choice: 'nothing'"),
        ("", "the following arguments are required: --out"),
    ],
)
def test_what_a_benchmark_cannot_use_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert status_of(benchmarks, arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", MOVED)
def test_a_command_that_moved_says_in_one_line_where_it_is(capsys, name):
    assert cli.main(["evaluate", name, "--task", "draw_s"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"dt-viz evaluate {name}: found ")
    found = re.search(r"python -m (tests\.benchmarks (\w+)|assets\.(\w+))$|dt-viz evaluate around", line)
    assert found is not None
    assert found[2] is None or found[2] in NAMES
    assert found[3] is None or find_spec(f"assets.{found[3]}") is not None


def test_printed_tables_are_written_with_all_digits_and_null_for_nan(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(options, "PRINTED", [])
    options.report([{"name": "a", "mm": 1.23456}, {"name": "b", "mm": float("nan")}, {"name": "c"}])
    options.report([{"name": "d", "mm": "2"}])
    options.write_tables(tmp_path / "tables.json")
    written = json.loads((tmp_path / "tables.json").read_text())["tables"]
    rows = [{"name": "a", "mm": 1.23456}, {"name": "b", "mm": None}, {"name": "c", "mm": None}]
    assert written == [rows, [{"name": "d", "mm": "2"}]]
    assert capsys.readouterr().out.splitlines()[:4] == ["name    mm", "a     1.23", "b        –", "c        –"]
