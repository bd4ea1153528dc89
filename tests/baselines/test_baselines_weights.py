"""Files of weights: what is written, by the command that trains, too, is read; what belongs elsewhere is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from plans import eflow_weights

from assets import train_baselines
from assets.train_baselines import save_weights
from dt_viz.baselines.base import NotFittedError, load_weights, weights_file
from dt_viz.baselines.eflow import VERSION, load_system
from dt_viz.files.npz import npz_bytes
from dt_viz.scenario.tasks import TASKS

ARRAYS = {"W": np.linspace(-1, 1, 240).reshape(60, 4), "scale": np.linspace(-1, 1, 12), "count": np.array(7)}


@pytest.fixture
def saved(tmp_path):
    path = weights_file(tmp_path, "eflow", "draw_s")
    save_weights(path, "eflow", 3, TASKS["draw_s"](), ARRAYS)
    return path


def test_weights_are_read_in_double_precision_of_large_arrays_three_digits(saved):
    read = load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)
    assert read.keys() == ARRAYS.keys()
    assert read["W"].dtype == np.float64
    assert np.allclose(read["scale"], ARRAYS["scale"], rtol=1e-7, atol=0)
    assert np.allclose(read["W"], ARRAYS["W"], rtol=5e-4, atol=0)
    assert read["count"] == 7


@pytest.mark.parametrize(
    ("method", "version", "task", "message"),
    [
        ("eflow", 4, "draw_s", "version: found 3; accepted: 4"),
        ("mpnet", 3, "draw_s", "method: found 'eflow'; accepted: 'mpnet'"),
        ("eflow", 3, "draw_j", "demonstrations: found"),
    ],
)
def test_weights_of_another_version_method_or_task_are_refused(saved, method, version, task, message):
    saved.rename(weights_file(saved.parent, method, task))
    with pytest.raises(NotFittedError, match=message):
        load_weights(method, version, TASKS[task](), saved.parent)


def flipped(content):
    """The content with one byte of the first array flipped."""
    at = content.index(b"W.npy") + 80
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


UNSTAMPED = npz_bytes(ARRAYS)


@pytest.mark.parametrize(
    "damage",
    [lambda b: b[: len(b) // 2], lambda b: b"PK" + b[:-2], lambda b: b"", flipped, lambda _: UNSTAMPED],
)
def test_a_damaged_file_is_refused_by_name(saved, damage):
    saved.write_bytes(damage(saved.read_bytes()))
    with pytest.raises(NotFittedError, match=r"eflow_draw_s\.npz"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


@pytest.mark.parametrize("value", [np.array([np.nan]), np.array(["text"])])
def test_what_is_no_finite_number_is_refused(saved, value):
    save_weights(saved, "eflow", 3, TASKS["draw_s"](), {"W": value})
    with pytest.raises(NotFittedError, match="array 'W'"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


def test_the_command_writes_weights_for_the_method_to_read_and_the_table_says_how_near_it_comes(
    monkeypatch, tmp_path, capsys, cache, engine
):
    def training(problem, num_epochs, report, seed):
        report(f"{num_epochs} epochs, seed {seed}")
        return eflow_weights(problem.task)

    engine.task("draw_s")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(train_baselines, "import_module", lambda name: SimpleNamespace(train=training))
    command = ["--method", "eflow", "--task", "draw_s", "--epochs", "3", "--seed", "4", "--out", str(tmp_path)]
    assert train_baselines.main(command) == 0
    assert load_weights("eflow", VERSION, TASKS["draw_s"](), tmp_path)["phases"].shape == (10, 2, 200)
    printed = capsys.readouterr().out
    assert "eflow, draw_s: 3 epochs, seed 4" in printed and "Fréchet mean" in printed.splitlines()[-1]
    assert load_system(TASKS["draw_s"](), tmp_path).goal.shape == (3,)


@pytest.mark.parametrize("trained", train_baselines.TRAINED.values(), ids=train_baselines.TRAINED.keys())
def test_a_method_that_is_trained_refuses_a_folder_without_its_weights(trained, problem, tmp_path):
    with pytest.raises(NotFittedError, match=r"has not been trained.*train_baselines --method \w+ --task push_box"):
        trained.fit(problem, folder=tmp_path)
