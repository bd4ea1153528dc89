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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.baselines.base import INSTALL, NotFittedError, Problem
from dt_viz.baselines.registry import TRAINED, problem_of
from dt_viz.baselines.weights import save_weights, weights_file
from dt_viz.errors import FormatError
from dt_viz.evaluate.held_out import folds_of, frechet
from dt_viz.evaluate.options import FOLDER, add_lasa, report, whole_number
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS, Task, known_tasks

OUT = FOLDER


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--method", choices=tuple(TRAINED), nargs="+", default=list(TRAINED), help="(default: all)")
    parser.add_argument("--task", nargs="+", metavar="TASK", help="(default: all that ship)")
    add_lasa(parser)
    parser.add_argument("--epochs", type=whole_number(1), help="(default: the method's)")
    parser.add_argument("--folds", type=whole_number(2), metavar="N", help="hold out in so many folds (default: none)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of what is random (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if something is not installed, or one of the tasks cannot be trained."""
    tasks, names = known_tasks(options.lasa), options.task or list(TASKS)
    for name in names:
        if name not in tasks:
            raise FormatError("--task", repr(name), ", ".join(tasks))
    alone = [name for name in names if len(tasks[name]().demonstrations) == 1]
    if options.folds and alone:
        raise FormatError("--folds", f"one demonstration only in {', '.join(alone)}", "two or more in each")
    fits, follower = FitStore(default_cache_folder()), Follower(load_jaco())
    rows: list[dict[str, Any]] = []
    for name in names:
        task = tasks[name]()
        every, splits = range(len(task.demonstrations)), {options.out: range(len(task.demonstrations))}
        if options.folds:
            folds = folds_of(len(every), min(options.folds, len(every)))
            splits = {options.out / f"fold_{k}": held for k, held in enumerate(folds)}
        problems = []
        for held in splits.values():
            learned = [i for i in every if i not in held] if options.folds else every
            part = replace(task, demonstrations=tuple(task.demonstrations[i] for i in learned))
            imitated = Learned.of(part, fits.get(part.demonstrations), imitates=True)
            problems.append(problem_of(imitated, follower))
        for method in options.method:
            try:
                rows.append(_row(task, method, splits, problems, options))
            except ModuleNotFoundError as error:
                print(f"{method} is trained with {error.name}, which is not installed: {INSTALL}", file=sys.stderr)
                return 1
            except NotFittedError as error:
                print(f"{method}, {name}: {error}", file=sys.stderr)
    report(rows)
    compared = "held out" if options.folds else "in-sample"
    for method in dict.fromkeys(row["method"] for row in rows):
        mean = np.mean([row["frechet_mm"] for row in rows if row["method"] == method])
        print(f"{method}: Fréchet mean {mean:.2f} mm {compared}")
    return 0 if len(rows) == len(names) * len(options.method) else 1


def _row(
    task: Task, method: str, splits: Mapping[Path, range], problems: Sequence[Problem], options: argparse.Namespace
) -> dict[str, Any]:
    """Train a method on each problem, and follow the demonstrations that its folder stands for with what was written.

    Returns:
        Row of the table: processor time of the longest training, mean distance, and size of the largest file.
    """
    trained = TRAINED[method]
    num_epochs = options.epochs or trained.num_epochs
    train = import_module(trained.training).train
    tell = partial(print, f"{method}, {task.name}:", flush=True)
    seconds, sizes, distances = [], [], []
    for (folder, compared), problem in zip(splits.items(), problems, strict=True):
        began = time.process_time()
        arrays = train(problem, num_epochs, tell, options.seed)
        seconds.append(time.process_time() - began)
        folder.mkdir(exist_ok=True)
        path = weights_file(folder, method, task)
        save_weights(path, method, trained.version, problem.task, arrays)
        sizes.append(path.stat().st_size)
        plan = trained.fit(problem, folder=folder)(Union(), task.starts[compared])
        distances.extend(1e3 * frechet(plan.paths, [task.paths[i] for i in compared]) / task.scale)
    return {
        "method": method,
        "task": task.name,
        "num_epochs": num_epochs,
        "seconds": max(seconds),
        "frechet_mm": float(np.mean(distances)),
        "num_bytes": max(sizes),
    }
