"""Train the methods that ours is compared with: the weights that ship, or those of other drawings.

    python -m assets.train_baselines --out assets/baselines                 # all weights that ship
    python -m assets.train_baselines --lasa DIR --task Sshape Angle --method eflow --epochs 500 --out DIR

A file METHOD_TASK.npz is written for each. The table shows the discrete Fréchet distances of the undisturbed motions
from the demonstrations that they were learned from, in millimetres of the demonstrations' own unit. With ``--folds N``
they are those from demonstrations held out, each followed by what was learned from the other folds, as `dt-viz evaluate
imitation --folds N` does it; weights of fold k are in DIR/fold_k.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", "1")  # read when numpy and torch are imported

import numpy as np

from dt_viz.arguments import Parser
from dt_viz.baselines import eflow, mpnet
from dt_viz.baselines.base import NotFittedError, Planner, stamp, weights_file
from dt_viz.baselines.registry import problem_of
from dt_viz.errors import DataError, FormatError
from dt_viz.evaluate.held_out import folds_of, frechet
from dt_viz.evaluate.options import output, report, whole_number
from dt_viz.files.npz import npz_bytes, write_whole
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS, Task, known_tasks

PROG = "python -m assets.train_baselines"
HALF_FROM = 100  # numbers of an array from which on it is stored in half precision; goals and scales need more digits


@dataclass(frozen=True)
class Trained:
    """A method whose weights are made in advance."""

    version: int  # of its weights
    training: str  # module with `train(problem, num_epochs, report, seed)`, which gives the arrays of the weights
    num_epochs: int  # by default
    fit: Callable[..., Planner]  # fits the method by the weights of a `folder`


TRAINED: Mapping[str, Trained] = {
    "eflow": Trained(eflow.VERSION, "assets.eflow_training", 2000, eflow.fit),
    "mpnet": Trained(mpnet.VERSION, "assets.mpnet_training", 1500, mpnet.fit),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Train; returns 1 if something is not installed, or one of the tasks cannot be trained."""
    parser = Parser(prog=PROG, description="Train the methods that ours is compared with.")
    parser.add_argument("--method", choices=tuple(TRAINED), nargs="+", default=list(TRAINED), help="(default: all)")
    parser.add_argument("--task", nargs="+", metavar="TASK", default=list(TASKS), help="(default: all that ship)")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument("--epochs", type=whole_number(1), help="(default: the method's)")
    parser.add_argument("--folds", type=whole_number(2), metavar="N", help="hold out in so many folds (default: none)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of what is random (default: %(default)s)")
    parser.add_argument("--out", type=output(), required=True, metavar="DIR", help="folder of the weights")
    options = parser.parse_args(arguments)
    fits, follower, rows = FitStore(default_cache_folder()), Follower(load_jaco()), []
    try:
        tasks = known_tasks(options.lasa)
        if unknown := [name for name in options.task if name not in tasks]:
            raise FormatError("--task", repr(unknown[0]), ", ".join(tasks))
        for name in options.task:
            for method in options.method:
                try:
                    rows.append(_trained(method, tasks[name](), fits, follower, options))
                except NotFittedError as error:
                    print(f"{method}, {name}: {error}", file=sys.stderr)
    except ModuleNotFoundError as error:
        print(f"{PROG}: found {error.name} not installed; accepted: pip install {error.name}", file=sys.stderr)
        return 1
    except (DataError, FormatError) as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2
    report(rows)
    compared = "held out" if options.folds else "in-sample"
    for method in dict.fromkeys(row["method"] for row in rows):
        mean = np.mean([row["frechet_mm"] for row in rows if row["method"] == method])
        print(f"{method}: Fréchet mean {mean:.2f} mm {compared}")
    return 0 if len(rows) == len(options.task) * len(options.method) else 1


def _trained(
    method: str, task: Task, fits: FitStore, follower: Follower, options: argparse.Namespace
) -> dict[str, Any]:
    """Train a method on a task, or on all folds but one, and follow demonstrations with the weights that are written.

    Returns:
        Row of the table: processor time of the longest training, mean distance, and size of the largest file.
    """
    trained, num, out, folds = TRAINED[method], len(task.demonstrations), options.out, options.folds
    if folds and num == 1:
        raise FormatError("--folds", f"one demonstration only in {task.name}", "two or more in each")
    splits = [(out, range(num), range(0))]  # folder, demonstrations that are compared, and those that are held out
    if folds:
        splits = [(out / f"fold_{k}", held, held) for k, held in enumerate(folds_of(num, min(folds, num)))]
    num_epochs, train = options.epochs or trained.num_epochs, import_module(trained.training).train
    tell = partial(print, f"{method}, {task.name}:", flush=True)
    seconds, sizes, distances = [], [], []
    for folder, compared, held in splits:
        part = replace(task, demonstrations=tuple(d for i, d in enumerate(task.demonstrations) if i not in held))
        problem = problem_of(Learned.of(part, fits.get(part.demonstrations), imitates=True), follower)
        began = time.process_time()
        arrays = train(problem, num_epochs, tell, options.seed)
        seconds.append(time.process_time() - began)
        path = weights_file(folder, method, task.name)
        save_weights(path, method, trained.version, part, arrays)
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


def save_weights(path: Path, method: str, version: int, task: Task, arrays: Mapping[str, Array]) -> None:
    """Write the weights of a method for a task, floats in single precision, large arrays of them in half.

    Numbers are finite, and no array's name begins with an underscore; `weights_file` names the path that is read again.
    """
    stored = {
        name: array.astype(np.float32 if array.size < HALF_FROM else np.float16) if array.dtype.kind == "f" else array
        for name, array in arrays.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, npz_bytes({**stamp(method, version, task), **stored}))


if __name__ == "__main__":
    raise SystemExit(main())
