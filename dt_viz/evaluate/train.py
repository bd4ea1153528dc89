"""Train the methods that ours is compared with: the weights that ship, or those of other drawings.

    python -m dt_viz.evaluate train --out assets/baselines                  # all weights that ship
    python -m dt_viz.evaluate train --lasa DIR --task Sshape Angle --method eflow --epochs 500 --out DIR

A file METHOD_TASK.npz is written for each. The table shows the discrete Fréchet distances of the undisturbed motions
from the demonstrations that they were learned from, in millimetres of the demonstrations' own unit.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from dt_viz.arm.robot import load_jaco
from dt_viz.baselines.base import INSTALL, NotFittedError, Problem
from dt_viz.baselines.registry import TRAINED, problem_of
from dt_viz.baselines.weights import save_weights, weights_file
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import InputError, print_table, ready_folder, whole_number
from dt_viz.learning.store import FitStore, default_cache_folder
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.scenario.tasks import TASKS, lasa_tasks

FAILED = 1
"""Exit status if something is not installed, or cannot be trained."""


@dataclass(frozen=True)
class Row:
    """Row of the table."""

    method: str
    task: str
    num_epochs: int
    seconds: float
    """Processor time of the training."""
    frechet_mm: float
    """Mean over the demonstrations."""
    num_bytes: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    parser.add_argument("--method", choices=tuple(TRAINED), nargs="+", default=list(TRAINED), help="(default: all)")
    parser.add_argument("--task", nargs="+", metavar="TASK", help="(default: all that ship)")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument("--epochs", type=whole_number(1), help="(default: the method's)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of what is random (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the weights")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 1 if something is not installed, or one of the tasks cannot be trained."""
    tasks = {**TASKS, **(lasa_tasks(options.lasa) if options.lasa is not None else {})}
    names = options.task or list(TASKS)
    for name in names:
        if name not in tasks:
            raise InputError("--task", repr(name), ", ".join(tasks))
    folder = ready_folder(options.out)
    fits, follower = FitStore(default_cache_folder()), Follower(load_jaco())
    rows: list[Row] = []
    for name in names:
        task = tasks[name]()
        problem = problem_of(Learned.of(task, fits.get(task.demonstrations), imitates=True), follower)
        for method in options.method:
            try:
                rows.append(_trained(problem, method, options, folder))
            except ModuleNotFoundError as error:
                print(f"{method} is trained with {error.name}, which is not installed: {INSTALL}", file=sys.stderr)
                return FAILED
            except NotFittedError as error:
                print(f"{method}, {name}: {error}", file=sys.stderr)
    _report(rows)
    return 0 if len(rows) == len(names) * len(options.method) else FAILED


def _trained(problem: Problem, name: str, options: argparse.Namespace, folder: Path) -> Row:
    """Train a method for a task, write its weights, and follow the demonstrations with what was written."""
    trained, task = TRAINED[name], problem.task
    num_epochs = options.epochs or trained.num_epochs
    train, began = import_module(trained.training).train, time.process_time()
    arrays = train(problem, num_epochs, lambda line: print(f"{name}, {task.name}: {line}", flush=True), options.seed)
    seconds, path = time.process_time() - began, weights_file(folder, name, task)
    save_weights(path, name, trained.version, task, arrays)
    plan = trained.from_folder(folder).fit(problem).plan(Union(), task.starts)
    distances = 1e3 * frechet(plan.paths, task.paths) / task.scale
    return Row(name, task.name, num_epochs, seconds, float(distances.mean()), path.stat().st_size)


def _report(rows: list[Row]) -> None:
    header = ("method", "task", "epochs", "seconds", "Fréchet mean mm", "kB")
    cells = [
        (r.method, r.task, str(r.num_epochs), f"{r.seconds:.0f}", f"{r.frechet_mm:.2f}", f"{r.num_bytes / 1e3:.0f}")
        for r in rows
    ]
    print_table(header, cells)
    for method in dict.fromkeys(row.method for row in rows):
        of_method = [row for row in rows if row.method == method]
        mean = np.mean([row.frechet_mm for row in of_method])
        slowest = max(row.seconds for row in of_method)
        print(f"{method}: Fréchet mean {mean:.2f} mm over {len(of_method)} task(s), at most {slowest:.0f} s a task")
