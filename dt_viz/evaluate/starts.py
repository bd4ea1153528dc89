"""Start a learned motion from many random places and check that all arrive at the goal.

Starts are spread evenly over the demonstrations' box grown by half its size on every side; a drawing's stay in its
plane. Rollouts in closed form end at the goal by construction, if only ψ⁻¹ is the inverse of ψ. So the first of the
starts are stepped, too: ẏ = J⁻¹ f(ψ(y)), eq. (1), uses neither the closed form nor ψ⁻¹, and must lead along the same
rollouts to the same goal.

The npz file, if one is asked for, holds ``starts`` and ``ends`` (N, 3) in metres, ``min_det_jacobian`` (N,), the
smallest det J on each rollout, ``goal`` (3,), and of the M stepped ones ``stepped`` (M, K, 3), K places at even times
up to arrival, and ``departures`` (M,), their largest distances from the exact rollouts, metres.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dt_viz.evaluate.held_out import arrival_times
from dt_viz.evaluate.options import add_task, chosen_task, print_table, ready_to_write, whole_number, write_npz
from dt_viz.flows.fields import Array
from dt_viz.flows.integrators import integrate_adaptive
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore

NUM_SAMPLES = 50
"""Number of samples of a rollout at which det J is computed."""
CHUNK = 500
"""Number of rollouts that are computed together."""
NUM_STEPPED_PLACES = 5
"""Number of places, evenly in time, at which a stepped motion is compared with the exact rollout."""
STEP_TOLERANCE = 1e-6
"""Largest estimated error of a step, metres."""
ARRIVED = 1e-4
"""Distance from the goal within which a motion has arrived, metres."""
MAX_DEPARTURE = 1e-3
"""Largest accepted distance of a stepped motion from the exact rollout, metres: where space is compressed, errors of
steps grow a hundredfold."""
FAILED = 1
"""Exit status if a motion does not arrive, or departs from the exact one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--count", type=whole_number(1), default=10_000, help="of starts (default: %(default)s)")
    parser.add_argument(
        "--stepped", type=whole_number(0), default=500, help="starts that are stepped, too (default: %(default)s)"
    )
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of their places (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE.npz", help="for starts, ends and det J")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 1 if a motion does not arrive, or if stepping leads elsewhere."""
    _, task = chosen_task(options)
    out = None if options.out is None else ready_to_write(options.out, ".npz")
    imitation = FitStore(default_cache_folder()).get(task.demonstrations)
    system, goal = task.system(imitation), task.to_world(imitation.goal)
    points = np.concatenate([d.positions for d in task.demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = (upper - lower) / 2
    uniform = np.random.default_rng(options.seed).uniform(size=(options.count, points.shape[1]))
    starts = task.to_world(lower - margin + uniform * (upper - lower + 2 * margin))

    ends, det, missed, durations = np.empty_like(starts), np.empty(len(starts)), 0.0, np.empty(len(starts))
    for first in range(0, len(starts), CHUNK):
        chunk = slice(first, first + CHUNK)
        z0 = system.transform.forward(starts[chunk])
        arrival = arrival_times(system, z0)
        z = system.base.flow(z0, arrival[:, None] * np.linspace(0.0, 1.0, NUM_SAMPLES))
        paths, J_inverse = system.transform.inverse_jacobian(z)
        missed = max(missed, float(np.linalg.norm(paths[:, 0] - starts[chunk], axis=1).max()))
        ends[chunk], durations[chunk] = paths[:, -1], arrival
        det[chunk] = (1 / np.linalg.det(J_inverse)).min(axis=1)
    stepped, departures = stepped_beside(system, starts[: options.stepped], durations[: options.stepped])
    if out is not None:
        arrays = {"starts": starts, "ends": ends, "min_det_jacobian": det, "goal": goal}
        write_npz(out, **arrays, stepped=stepped, departures=departures)

    distance = np.linalg.norm(ends - goal, axis=1)
    left = np.linalg.norm(stepped[:, -1] - goal, axis=1)
    arrived, num_stepped = int((distance < ARRIVED).sum()), len(departures)
    arrived_stepped = int((left < ARRIVED).sum())
    print_table(
        (f"{task.name}, {options.count} starts (seed {options.seed})", ""),
        [
            ("largest distance from the goal at the end, mm", f"{1e3 * distance.max():.4f}"),
            ("arrived within 0.1 mm", f"{arrived} of {options.count}"),
            ("smallest det J on the rollouts", f"{det.min():.4g}"),
            ("largest miss of a start (round trip), mm", f"{1e3 * missed:.1e}"),
            ("stepped by eq. (1): arrived within 0.1 mm", f"{arrived_stepped} of {num_stepped}"),
            ("largest distance from the exact rollout, mm", f"{1e3 * departures.max(initial=0.0):.3f}"),
        ],
    )
    fine = arrived == options.count and arrived_stepped == num_stepped and not (departures > MAX_DEPARTURE).any()
    return 0 if fine else FAILED


def stepped_beside(system: DiffeomorphicSystem, starts: Array, durations: Array) -> tuple[Array, Array]:
    """Step ẏ = J⁻¹ f(ψ(y)) from `starts` (M, 3), metres, for `durations` (M,), seconds, beside the exact rollouts.

    Returns:
        Places (M, K, 3) at even times, and their largest distances (M,) from the exact rollouts, metres.
    """
    fractions = np.arange(1, NUM_STEPPED_PLACES + 1) / NUM_STEPPED_PLACES
    state, places = np.concatenate([starts, durations[:, None]], axis=1), []
    for _ in fractions:
        state, _ = integrate_adaptive(_Clocked(system), state, None, 1 / NUM_STEPPED_PLACES, STEP_TOLERANCE)
        places.append(state[:, :-1])
    stepped = np.stack(places, axis=1)
    exact = system.rollout(starts, durations[:, None] * fractions)
    return stepped, np.linalg.norm(stepped - exact, axis=-1).max(axis=1)


class _Clocked:
    """The field (T·ẏ, 0) of states (y, T): each motion takes its own time T, seconds, while one unit passes."""

    def __init__(self, system: DiffeomorphicSystem) -> None:
        self._system = system
        self.dim = system.transform.dim + 1

    def __call__(self, s: Array) -> Array:
        """Velocities (N, d + 1) of the states `s` (N, d + 1)."""
        z, J = self._system.transform.jacobian(s[:, :-1])
        velocity = np.linalg.solve(J, self._system.base.velocity(z)[..., None])[..., 0]
        return np.concatenate([s[:, -1:] * velocity, np.zeros((len(s), 1))], axis=1)

    def with_jacobian(self, s: Array) -> tuple[Array, Array]:
        """No tangents are carried along such motions."""
        raise NotImplementedError
