"""Start a learned motion from many random places and look whether all arrive.

Starts are spread evenly over the demonstrations' box grown by half its size on every side; a drawing's stay in its
plane. The npz file, if one is asked for, holds ``starts`` and ``ends`` (N, 3) in metres, ``min_det_jacobian`` (N,), the
smallest det J on each rollout, and ``goal`` (3,).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dt_viz.evaluate.options import add_task, chosen_task, print_table, ready_to_write, whole_number
from dt_viz.fits import FitStore, default_cache_folder

AT_GOAL = 5e-5
"""Metres from the goal at which a rollout ends."""
NUM_SAMPLES = 50
"""Of each rollout, where det J is looked at."""
CHUNK = 500
"""Rollouts at a time."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--count", type=whole_number(1), default=10_000, help="of starts (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of their places (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="for starts, ends and det J")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    _, task = chosen_task(options)
    out = None if options.out is None else ready_to_write(options.out, ".npz")
    imitation = FitStore(default_cache_folder()).get(task.demonstrations)
    system, goal = task.system(imitation), task.to_world(imitation.goal)
    points = np.concatenate([d.positions for d in task.demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = (upper - lower) / 2
    uniform = np.random.default_rng(options.seed).uniform(size=(options.count, points.shape[1]))
    starts = task.to_world(lower - margin + uniform * (upper - lower + 2 * margin))

    stretch = np.linalg.norm(system.transform.inverse_jacobian(system.base.goal)[1], 2)
    ends, det, missed = np.empty_like(starts), np.empty(len(starts)), 0.0
    for first in range(0, len(starts), CHUNK):
        chunk = slice(first, first + CHUNK)
        z0 = system.transform.forward(starts[chunk])
        arrival = system.base.arrival_time(z0, float(AT_GOAL / max(stretch, 1.0)))
        z = system.base.flow(z0, arrival[:, None] * np.linspace(0.0, 1.0, NUM_SAMPLES))
        paths, J_inverse = system.transform.inverse_jacobian(z)
        missed = max(missed, float(np.linalg.norm(paths[:, 0] - starts[chunk], axis=1).max()))
        ends[chunk] = paths[:, -1]
        det[chunk] = (1 / np.linalg.det(J_inverse)).min(axis=1)
    if out is not None:
        with out.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, starts=starts, ends=ends, min_det_jacobian=det, goal=goal)

    distance = np.linalg.norm(ends - goal, axis=1)
    arrived = int((distance < 1e-4).sum())
    print_table(
        (f"{task.name}, {options.count} starts (seed {options.seed})", ""),
        [
            ("largest distance from the goal at the end, mm", f"{1e3 * distance.max():.4f}"),
            ("arrived within 0.1 mm", f"{arrived} of {options.count}"),
            ("smallest det J on the rollouts", f"{det.min():.4g}"),
            ("largest miss of a start (round trip), mm", f"{1e3 * missed:.1e}"),
        ],
    )
    return 0
