"""The command that trains: weights that the method reads, and a clear end where something is missing."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plans import eflow_weights as weights

from dt_viz.baselines import registry
from dt_viz.baselines.base import INSTALL, NotFittedError
from dt_viz.baselines.eflow import VERSION, load_system
from dt_viz.baselines.weights import load_weights
from dt_viz.evaluate import train
from dt_viz.evaluate.__main__ import main
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS

COMMAND = ["train", "--method", "eflow", "--task", "draw_s", "--epochs", "3"]


@pytest.fixture(autouse=True)
def _cached(cache, monkeypatch, engine):
    engine.task("draw_s")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


def trained_by(monkeypatch, training):
    """Have another training in the place of the one that needs torch."""
    monkeypatch.setattr(train, "import_module", lambda name: SimpleNamespace(train=training))


def test_weights_are_written_for_the_method_to_read_and_the_table_says_how_near_it_comes(monkeypatch, tmp_path, capsys):
    def training(problem, num_epochs, report, seed):
        report(f"{num_epochs} epochs, seed {seed}")
        return weights(problem.task)

    trained_by(monkeypatch, training)
    assert main([*COMMAND, "--seed", "4", "--out", str(tmp_path)]) == 0
    assert load_weights("eflow", VERSION, TASKS["draw_s"](), tmp_path)["phases"].shape == (10, 2, 200)
    printed = capsys.readouterr().out
    assert "eflow, draw_s: 3 epochs, seed 4" in printed
    assert "Fréchet mean" in printed.splitlines()[-1]
    assert load_system(TASKS["draw_s"](), tmp_path).goal.shape == (3,)


@pytest.mark.long
def test_in_folds_each_demonstration_is_compared_with_what_was_learned_from_others(monkeypatch, tmp_path, capsys):
    learned, compared = [], []
    monkeypatch.setattr(train, "frechet", lambda paths, references: compared.append(references) or np.ones(len(paths)))
    trained_by(monkeypatch, lambda problem, *_: learned.append(problem.task.paths) or weights(problem.task))
    assert main([*COMMAND, "--folds", "3", "--out", str(tmp_path)]) == 0
    paths = TASKS["draw_s"]().paths
    assert len(learned) == len(compared) == 3
    for others, held in zip(learned, compared, strict=True):
        assert {path.tobytes() for path in (*others, *held)} == {path.tobytes() for path in paths}
    assert len({path[0].tobytes() for held in compared for path in held}) == len(paths)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["fold_0", "fold_1", "fold_2"]
    assert "held out" in capsys.readouterr().out.splitlines()[-1]


def test_a_single_demonstration_cannot_be_held_out(monkeypatch, tmp_path, capsys):
    task = TASKS["draw_s"]()
    alone = replace(task, demonstrations=task.demonstrations[:1])
    monkeypatch.setattr(train, "known_tasks", lambda _: {"draw_s": lambda: alone})
    assert main([*COMMAND, "--folds", "3", "--out", str(tmp_path)]) == 2
    assert "--folds: found one demonstration only in draw_s" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ModuleNotFoundError("No module", name="torch"), f"torch, which is not installed: {INSTALL}"),
        (NotFittedError("found no common goal"), "eflow, draw_s: found no common goal"),
    ],
)
def test_what_cannot_be_trained_is_said_and_the_exit_status_is_1(monkeypatch, tmp_path, capsys, error, words):
    def training(*_):
        raise error

    trained_by(monkeypatch, training)
    assert main([*COMMAND, "--out", str(tmp_path)]) == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_task_that_does_not_exist_is_refused_by_name(tmp_path, capsys):
    assert main(["train", "--task", "none", "--out", str(tmp_path)]) == 2
    assert "--task: found 'none'; accepted: draw_s" in capsys.readouterr().err


@pytest.mark.parametrize("trained", registry.TRAINED.values(), ids=registry.TRAINED.keys())
def test_a_method_that_is_trained_refuses_a_folder_without_its_weights(trained, tmp_path, engine):
    problem = registry.problem_of(engine.nominal(Scenario("draw_s")).learned, engine.follower)
    with pytest.raises(NotFittedError, match=r"has not been trained.*train --method \w+ --task draw_s"):
        trained.fit(problem, folder=tmp_path)


@pytest.mark.parametrize("num", [1, 7])
def test_training_lowers_the_loss_also_with_a_single_demonstration(num):
    pytest.importorskip("torch")
    from dt_viz.baselines.eflow_training import train as train_eflow

    losses, task = [], SimpleNamespace(demonstrations=TASKS["draw_j"]().demonstrations[:num])
    problem: Any = SimpleNamespace(task=task)
    arrays = train_eflow(problem, 50, lambda line: losses.append(float(line.rsplit(" ", 1)[1])))
    assert losses[-1] < losses[0]
    assert (arrays["weights"] != 0).any()


def test_what_is_learned_from_never_turns_back_where_a_motion_stands_at_first_and_last(monkeypatch):
    pytest.importorskip("torch")
    from dt_viz.baselines import eflow_training

    times = np.linspace(0, 4, 200)
    along = np.clip((times - 0.15) / 3.7, 0, 1)
    motion = Demonstration(times, np.outer(along, [0.3, -0.2]), "straight")
    turned_back = []
    for learned in (eflow_training.SETTINGS.learned, slice(None)):
        monkeypatch.setattr(eflow_training, "SETTINGS", eflow_training.TrainingSettings(learned=learned))
        _, velocities, normalisation, _ = eflow_training.samples((motion,))
        turned_back.append(np.mean((velocities / normalisation[0]) @ [0.3, -0.2] < 0))
    assert turned_back[0] == 0 and turned_back[1] > 0.01


def test_demonstrations_without_a_common_goal_are_refused():
    pytest.importorskip("torch")
    from dt_viz.baselines.eflow_training import samples

    first, second = TASKS["draw_j"]().demonstrations[:2]
    with pytest.raises(NotFittedError, match="common goal"):
        samples((first, Demonstration(second.times, second.positions + 5.0, "moved")))
