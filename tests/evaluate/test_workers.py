"""Items computed beside each other, in processes or on a Dask cluster: the same results to the last bit."""

import os
import subprocess
import sys
from argparse import Namespace

import numpy as np
import pytest

from dt_viz.errors import FormatError
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.options import Made, computed

TIMES = ("fit_seconds", "start_seconds", "seconds")


def written(folder):
    """Every array that a command wrote, as bytes, except times."""
    found = {}
    for path in sorted(folder.rglob("*.npz")):
        with np.load(path) as arrays:
            found |= {(path.name, name): arrays[name].tobytes() for name in arrays if name not in TIMES}
    return found


@pytest.fixture
def run(lasa, tmp_path):
    """Runs a small measurement: every array that it writes."""
    task = f"--task Hook --lasa {lasa}"
    commands = {
        "around": f"around {task} --count 2 --size 0.1 --shape any --out OUT/a.npz",
        "reactive": f"reactive {task} --speed 1 --runs 2 --out OUT/a.npz",
        "imitation": f"imitation {lasa / 'Hook.mat'} --leave-one-out --out OUT",
        "table1": "table1 --tasks push_box --count 2 --perturbed 2 --methods linear ours-no-avoidance --out OUT",
    }

    def run(name, more=""):
        folder = tmp_path / f"{name}{len(more)}"
        assert main(f"{commands[name]} {more}".replace("OUT", str(folder)).split()) == 0
        return written(folder)

    return run


@pytest.fixture
def processes():
    """Ends joblib's processes, which it keeps for the next call."""
    pytest.importorskip("joblib")
    yield 2
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(kill_workers=True)


@pytest.fixture
def cluster(tmp_path):
    """Address of a Dask cluster of two workers on this machine."""
    distributed = pytest.importorskip("distributed")
    pytest.importorskip("joblib")
    kind = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**kind, local_directory=str(tmp_path / "dask")) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
@pytest.mark.parametrize("name", ["around", "reactive", "imitation", "table1"])
def test_two_processes_write_what_one_does(run, name, processes):
    alone = run(name)
    assert alone and run(name, f"--jobs {processes}") == alone


def pid_and_square(made, k):
    return os.getpid(), made(), k**2


@pytest.mark.long
@pytest.mark.parametrize(("workers", "option"), [("processes", "jobs"), ("cluster", "dask")])
def test_workers_give_results_in_order_and_make_once_what_their_items_share(request, workers, option):
    options = Namespace(**{"jobs": 1, "dask": None, option: request.getfixturevalue(workers)})
    made = Made(lambda: (os.getpid(), np.random.default_rng().random()))
    own = made()
    found = [*computed(options, lambda k: pid_and_square(made, k), range(12))]
    assert [square for *_, square in found] == [k**2 for k in range(12)]
    assert all(maker == pid for pid, (maker, _), _ in found)
    assert len({value for _, value, _ in found} - {own}) == len({pid for pid, *_ in found} - {os.getpid()}) > 0


@pytest.mark.long
def test_an_error_of_an_item_is_raised_here(processes):
    def fail(k):
        raise FormatError("--x", "2", "1")

    with pytest.raises(FormatError, match="--x: found 2; accepted: 1"):
        list(computed(Namespace(jobs=processes, dask=None), fail, range(2)))


@pytest.mark.long
def test_without_a_scheduler_the_command_ends_and_says_so(tmp_path):
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "dt_viz.evaluate", "around", "--task", "draw_s", "--dask", "tcp://127.0.0.1:1"]
    done = subprocess.run([*command, "--out", tmp_path / "a.npz"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "around: --dask: found 'tcp://127.0.0.1:1', where no scheduler answers; accepted: " in done.stderr


@pytest.mark.parametrize(("given", "missing"), [("--jobs 2", "joblib"), ("--dask tcp://a:1", "distributed")])
def test_what_is_not_installed_is_said(given, missing, monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["around", "--task", "draw_s", "--out", str(tmp_path / "a.npz"), *given.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{given.split()[0]}: found {missing} not installed; accepted: " in line and "dt-viz[sweeps]" in line
