"""Train the methods that ours is compared with: the weights that ship, or those of other drawings.

    python -m dt_viz.evaluate train --out assets/baselines                  # all weights that ship
    python -m dt_viz.evaluate train --lasa DIR --task Sshape Angle --method eflow --epochs 500 --out DIR

A file METHOD_TASK.npz is written for each. The table shows the discrete Fréchet distances of the undisturbed motions
from the demonstrations that they were learned from, in millimetres of the demonstrations' own unit. With ``--folds N``
they are those from demonstrations held out, each followed by what was learned from the other folds, as `imitation
--leave-one-out --folds N` does it; weights of fold k are in DIR/fold_k.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import INSTALL, NotFittedError, Problem
from dt_viz.baselines.registry import TRAINED, problem_of
from dt_viz.baselines.weights import save_weights, weights_file
from dt_viz.evaluate.held_out import folds_of, frechet
from dt_viz.evaluate.options import FOLDER, InputError, report, whole_number
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS, Task, lasa_tasks

OUT = FOLDER


@dataclass(frozen=True)
class FitRow:
    """Row of the table."""

    method: str
    task: str
    num_epochs: int
    seconds: float
    """Processor time of a training, the longest."""
    frechet_mm: float
    """Mean over the demonstrations."""
    num_bytes: int
    """Size of a file of weights, the largest."""


@dataclass(frozen=True)
class Split:
    """Demonstrations of a task, by number from 0, to learn from, and those to compare with what was learned."""

    learned: Sequence[int]
    compared: Sequence[int]
    folder: Path
    """Folder for the weights."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--method", choices=tuple(TRAINED), nargs="+", default=list(TRAINED), help="(default: all)")
    parser.add_argument("--task", nargs="+", metavar="TASK", help="(default: all that ship)")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument("--epochs", type=whole_number(1), help="(default: the method's)")
    parser.add_argument("--folds", type=whole_number(2), metavar="N", help="hold out in so many folds (default: none)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of what is random (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if something is not installed, or one of the tasks cannot be trained."""
    tasks = {**TASKS, **(lasa_tasks(options.lasa) if options.lasa is not None else {})}
    names = options.task or list(TASKS)
    for name in names:
        if name not in tasks:
            raise InputError("--task", repr(name), ", ".join(tasks))
    alone = [name for name in names if len(tasks[name]().demonstrations) == 1]
    if options.folds and alone:
        raise InputError("--folds", f"one demonstration only in {', '.join(alone)}", "two or more in each")
    folder = options.out
    fits, follower = FitStore(default_cache_folder()), Follower(load_jaco())
    rows: list[FitRow] = []
    for name in names:
        task = tasks[name]()
        splits = _splits(len(task.demonstrations), options.folds, folder)
        problems = [_problem(task, split, fits, follower) for split in splits]
        for method in options.method:
            try:
                rows.append(_row(task, method, splits, problems, options))
            except ModuleNotFoundError as error:
                print(f"{method} is trained with {error.name}, which is not installed: {INSTALL}", file=sys.stderr)
                return 1
            except NotFittedError as error:
                print(f"{method}, {name}: {error}", file=sys.stderr)
    report([asdict(row) for row in rows])
    compared = "held out" if options.folds else "in-sample"
    for method in dict.fromkeys(row.method for row in rows):
        mean = np.mean([row.frechet_mm for row in rows if row.method == method])
        print(f"{method}: Fréchet mean {mean:.2f} mm {compared}")
    return 0 if len(rows) == len(names) * len(options.method) else 1


def _splits(num: int, folds: int | None, folder: Path) -> list[Split]:
    """All of `num` demonstrations twice; or what each fold leaves and what it holds out."""
    if folds is None:
        return [Split(range(num), range(num), folder)]
    return [
        Split([i for i in range(num) if i not in held], held, folder / f"fold_{k}")
        for k, held in enumerate(folds_of(num, min(folds, num)))
    ]


def _problem(task: Task, split: Split, fits: FitStore, follower: Follower) -> Problem:
    part = replace(task, demonstrations=tuple(task.demonstrations[i] for i in split.learned))
    return problem_of(Learned.of(part, fits.get(part.demonstrations), imitates=True), follower)


def _row(
    task: Task, method: str, splits: Sequence[Split], problems: Sequence[Problem], options: argparse.Namespace
) -> FitRow:
    """Train a method on each split, write the weights, and follow the demonstrations with what was written."""
    trained = TRAINED[method]
    num_epochs = options.epochs or trained.num_epochs
    train = import_module(trained.training).train
    seconds, sizes, distances = [], [], []
    for split, problem in zip(splits, problems, strict=True):
        split.folder.mkdir(exist_ok=True)
        began = time.process_time()
        arrays = train(
            problem, num_epochs, lambda line: print(f"{method}, {task.name}: {line}", flush=True), options.seed
        )
        seconds.append(time.process_time() - began)
        path = weights_file(split.folder, method, task)
        save_weights(path, method, trained.version, problem.task, arrays)
        sizes.append(path.stat().st_size)
        plan = trained.from_folder(split.folder).fit(problem).plan(Union(), task.starts[split.compared])
        distances.extend(1e3 * frechet(plan.paths, [task.paths[i] for i in split.compared]) / task.scale)
    return FitRow(method, task.name, num_epochs, max(seconds), float(np.mean(distances)), max(sizes))
