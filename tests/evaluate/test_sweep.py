"""Items computed beside each other: the same results to the last bit, also where workers are lost."""

import os
import re
import signal
import threading
import time
from argparse import Namespace
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from dt_viz.errors import FormatError
from dt_viz.evaluate import sweep as module
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.sweep import sweep

TIMES = ("fit_seconds", "start_seconds", "seconds")


def options(jobs=1, dask=None):
    return Namespace(jobs=jobs, dask=dask)


def written(folder):
    """Every array that a command wrote, as bytes, except times."""
    found = {}
    for path in sorted(folder.rglob("*.npz")):
        with np.load(path) as arrays:
            found |= {(path.name, name): arrays[name].tobytes() for name in arrays if name not in TIMES}
    return found


@pytest.fixture
def commands(lasa):
    """Arguments of a small run of each command."""
    task = f"--task Hook --lasa {lasa}"
    return {
        "around": f"around {task} --count 2 --size 0.1 --shape any --out OUT/a.npz",
        "reactive": f"reactive {task} --speed 1 --runs 2 --out OUT/a.npz",
        "imitation": f"imitation {lasa / 'Hook.mat'} --leave-one-out --out OUT",
        "table1": "table1 --tasks push_box --count 2 --perturbed 2 --methods linear ours-no-avoidance --out OUT",
    }


def run(command, folder, more=""):
    folder.mkdir()
    assert main(f"{command} {more}".replace("OUT", str(folder)).split()) == 0
    return written(folder)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["around", "reactive", "imitation", "table1"])
def test_two_processes_write_what_one_does(commands, name, tmp_path):
    pytest.importorskip("joblib")
    alone = run(commands[name], tmp_path / "alone")
    assert alone and run(commands[name], tmp_path / "two", "--jobs 2") == alone


@pytest.fixture
def cluster(tmp_path):
    """A Dask cluster of two workers on this machine."""
    distributed = pytest.importorskip("distributed")
    pytest.importorskip("joblib")
    kind = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**kind, local_directory=str(tmp_path / "dask")) as cluster:
        yield cluster


def kill_a_busy_worker(address, killed):
    """Kill one of two workers as soon as both compute."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        pids: Any = client.run(os.getpid)
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:
            processing: Any = client.processing()
            busy = [worker for worker, keys in processing.items() if keys]
            if len(busy) == 2:
                killed.append(pids[busy[0]])
                os.kill(pids[busy[0]], signal.SIGKILL)
                return
            time.sleep(0.01)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_writes_what_one_process_does(commands, cluster, tmp_path):
    alone, killed = run(commands["around"], tmp_path / "alone"), []
    killer = threading.Thread(target=kill_a_busy_worker, args=(cluster.scheduler_address, killed))
    killer.start()
    found = run(commands["around"], tmp_path / "lost", f"--dask {cluster.scheduler_address}")
    killer.join()
    assert found == alone
    assert len(killed) == 1


@pytest.mark.long
def test_an_item_that_ends_its_worker_is_computed_again_as_one_process_does(cluster, tmp_path):
    matrices = [np.random.default_rng(k).normal(size=(90, 90)) for k in range(5)]

    def product(_, matrix):
        if matrix[0, 0] == matrices[1][0, 0] and not (tmp_path / "ended").exists():
            (tmp_path / "ended").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid(), (matrix @ matrix).tobytes()

    with sweep(options(dask=cluster.scheduler_address), lambda: None) as (_, swept):
        pids, products = zip(*swept(product, matrices), strict=True)
    assert (tmp_path / "ended").exists() and os.getpid() not in pids
    assert [*products] == [(matrix @ matrix).tobytes() for matrix in matrices]


@pytest.mark.slow
def test_an_item_that_ends_each_worker_is_given_up_and_workers_with_other_threads_are_refused(cluster, monkeypatch):
    def always(_, k):
        os.kill(os.getpid(), signal.SIGKILL)

    with (
        sweep(options(dask=cluster.scheduler_address), lambda: None) as (_, swept),
        pytest.raises(FormatError, match="--dask: found a cluster that gave up"),
    ):
        list(swept(always, range(1)))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")  # which would round otherwise
    with (
        sweep(options(dask=cluster.scheduler_address), lambda: None) as (_, swept),
        pytest.raises(FormatError, match=r"a worker with .* as OMP_NUM_THREADS, OPENBLAS"),
    ):
        list(swept(lambda _, k: k, range(2)))


@pytest.mark.long
def test_each_worker_computes_what_one_process_does_keeps_what_items_share_and_its_errors_and_its_end_are_told():
    pytest.importorskip("joblib")

    def product(_, k):
        matrix = np.random.default_rng(k).normal(size=(90, 90))
        return (matrix @ matrix).tobytes()

    def end(_, k):
        os.kill(os.getpid(), signal.SIGKILL)

    def fail(_, k):
        raise FormatError("--x", "2", "1")

    with sweep(options(jobs=2), lambda: (os.getpid(), np.random.default_rng().random())) as (own, swept):
        found = [each for _ in range(2) for each in swept(lambda shared, k: (k, shared), range(6))]
        assert [k for k, _ in found] == 2 * [*range(6)]
        shared = {shared for _, shared in found}
        assert [*swept(product, range(4))] == [product(None, k) for k in range(4)]
        assert own not in shared and len(shared) == len({pid for pid, _ in shared}) <= 2
        with pytest.raises(FormatError, match="--x: found 2; accepted: 1"):
            list(swept(fail, range(2)))
        with pytest.raises(FormatError, match="--jobs: found a process that was ended"):
            list(swept(end, range(2)))


@pytest.mark.long
def test_what_is_told_late_of_items_that_were_given_up_does_not_end_the_next_ones(monkeypatch):
    parallel = pytest.importorskip("joblib.parallel")
    failed, before, begin = Future(), [], parallel.Parallel._initialize_backend
    failed.set_exception(FormatError("--x", "2", "1"))

    def begin_late(one):  # joblib has forgotten that the call before was aborted, and has not yet named this one
        for other in before:
            parallel.BatchCompletionCallBack(0.0, 1, other)(failed)
        before.append(one)
        return begin(one)

    monkeypatch.setattr(parallel.Parallel, "_initialize_backend", begin_late)
    with sweep(options(jobs=2), lambda: None) as (_, swept):
        for _ in range(2):
            assert [*swept(lambda _, k: k, range(3))] == [0, 1, 2]


@pytest.mark.long
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--jobs 0", "--jobs: found '0'; accepted: a whole number, 1 to "),
        ("--jobs -1", "--jobs: found '-1'; accepted: a whole number, 1 to "),
        ("--jobs 100000", "--jobs: found '100000'; accepted: a whole number, 1 to "),
        ("--jobs 2 --dask tcp://127.0.0.1:1", "not allowed with argument --jobs"),
        ("--dask tcp://127.0.0.1:1", "--dask: found 'tcp://127.0.0.1:1', where no scheduler answers"),
        ("--dask tcp://127.0.0.1", "--dask: found 'tcp://127.0.0.1', where no scheduler answers"),
        ("--dask nonsense://", "--dask: found 'nonsense://', where no scheduler answers"),
    ],
)
def test_what_cannot_be_used_is_named_in_one_line(given, message, tmp_path, capsys):
    if "answers" in message:
        pytest.importorskip("distributed")
        pytest.importorskip("joblib")
    status: object = None
    try:
        status = main(["around", "--task", "draw_s", "--out", str(tmp_path / "a.npz"), *given.split()])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("given", "missing"), [("--jobs 2", "joblib"), ("--dask tcp://a:1", "distributed")])
def test_what_is_not_installed_is_said(given, missing, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(module, "find_spec", lambda name: None if name == missing else name)
    assert main(["around", "--task", "draw_s", "--out", str(tmp_path / "a.npz"), *given.split()]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(rf"{given.split()[0]}: found {missing} not installed; accepted: .*dt-viz\[sweeps\]", line)
