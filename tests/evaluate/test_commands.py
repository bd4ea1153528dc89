"""The command line of the measurements: its names, former and present, and what it cannot use."""

import json

import pytest
from hook import write_mat

from dt_viz.evaluate import options
from dt_viz.evaluate.__main__ import main
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
        ("imitation Hook.mat --out file/below", "--out: found 'file/below', which cannot be written"),
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
        ("around --task draw_s --obstacle 0,0,0 --out file/a.npz", "'file/a.npz', which cannot be wri"),
        ("around --task draw_s --obstacle 0,0,0 --out folder.npz", "'folder.npz', which cannot be wri"),
        ("around --task draw_s --obstacle 0,0", "--obstacle: found '0,0'; accepted: "),
        ("around --task draw_s --obstacle -0,inf,0", "--obstacle: found '-0,inf,0'"),
        ("around --task draw_s --obstacle 0,0,0 --count 2", "not allowed with argument --obstacle"),
        ("around --task draw_s --size -1", "--size: found '-1'; accepted: a number"),
        ("around --task draw_s --size 0.2,0.1", "--size: found '0.2,0.1'; accepted: a number"),
        ("around --task draw_s --along 0,1.1", "--along: found '0,1.1'; accepted: a number"),
        ("around --task draw_s --spread -1", "--spread: found '-1'; accepted: metres, at"),
        ("around --task draw_s --count many", "--count: found 'many'; accepted: a whole number, 0 or more"),
        ("around --task draw_s --out a.npz --tables file/b.json", "'file/b.json', which cannot be written"),
        ("load --seconds 0", "--seconds: found '0'; accepted: seconds, more than 0"),
        ("load --seconds nan", "--seconds: found 'nan'"),
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
        ("latency --task draw_s --seconds 0 --out a.json", "--seconds: found '0'; accepted: seconds, "),
        ("latency --task draw_s --seconds 1 --obstacles 0 --out a.json", "--obstacles: found 0; accepted: 1 or more"),
        ("drag --task none --out a.npz", "--task: found 'none'; accepted: draw_s,"),
        ("scenes --only nothing --out a.json", "invalid choice: 'nothing'"),
        ("--only nothing --out out", "--only: invalid choice: 'nothing'"),
        ("", "the following arguments are required: --out"),
    ],
)
def test_what_a_benchmark_cannot_use_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert status_of(benchmarks, arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", ["arms", "latency", "drag", "scenes", "pictures", "rollouts", "velocity", "starts"])
def test_a_command_that_moved_names_a_benchmark_that_there_is(capsys, name):
    assert main([name, "--task", "draw_s"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    benchmark = name if name in NAMES else "exactness"
    assert line.endswith(f": {name} is now, in a checkout: python -m tests.benchmarks {benchmark}")
    assert benchmark in NAMES


@pytest.mark.parametrize("name", ["avoidance", "places", "hand"])
def test_a_command_with_another_name_says_so_and_runs(capsys, name):
    assert main([name, "--task", "nothing", "--out", "a.npz"]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(f"python -m dt_viz.evaluate: {name} is now: around")
    assert second.startswith("python -m dt_viz.evaluate around: --task: found 'nothing'")


def test_printed_tables_are_written_with_all_digits_and_null_for_nan(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(options, "PRINTED", [])
    options.report([{"name": "a", "mm": 1.23456}, {"name": "b", "mm": float("nan")}, {"name": "c"}])
    options.report([{"name": "d", "mm": "2"}])
    options.write_tables(tmp_path / "tables.json")
    written = json.loads((tmp_path / "tables.json").read_text())["tables"]
    rows = [{"name": "a", "mm": 1.23456}, {"name": "b", "mm": None}, {"name": "c", "mm": None}]
    assert written == [rows, [{"name": "d", "mm": "2"}]]
    assert capsys.readouterr().out.splitlines()[:4] == ["name    mm", "a     1.23", "b        –", "c        –"]
