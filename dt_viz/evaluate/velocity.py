"""Measure the velocity of stacks at one point on their rollouts, as a controller asks for it.

The JSON file holds for each stack, in milliseconds:

``rollouts``
    ``median_ms`` and ``p95_ms`` at the tolerance that rollouts are computed with.
``controller``
    the same at `TOLERANCE`, and ``error``, the largest difference from the velocity of ``rollouts`` relative to it.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.evaluate.options import add_task, chosen_task, print_table, ready_to_write, whole_number, write_json
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.store import FitStore, default_cache_folder
from dt_viz.motion.nominal import Learned
from dt_viz.motion.solve import FINE, solve
from dt_viz.obstacles.shapes import Box, MeshObstacle, Point, Sphere, as_point
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import plane_of
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.bias import Biasing, BiasPoint

TOLERANCE = 1e-6
"""Tolerance (m) of a controller's stack."""
BIAS_OFFSET = 0.03
"""Distance (m) of the bias point from the mean demonstration, along the second axis of the task's slice."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--points", type=whole_number(1), default=200, help="for each stack (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    _, task = chosen_task(options)
    out = ready_to_write(options.out, ".json")
    imitation = FitStore(default_cache_folder()).get(task.demonstrations)
    nominal = Learned.of(task, imitation, imitates=True).demonstrated
    figures: dict[str, Any] = {}
    for name, scenario in _scenarios(task).items():
        solution = solve(nominal, scenario, FINE)
        samples = solution.bundle.positions
        points = samples[np.linspace(0, len(samples) - 1, options.points).round().astype(int)]
        exact, rollouts = _timed(solution.system, points)
        found, controller = _timed(solution.system.at_tolerance(TOLERANCE), points)
        # at rest points, the goals, an error has nothing to be relative to
        speed = np.linalg.norm(exact, axis=1)
        error = np.linalg.norm(found - exact, axis=1) / np.maximum(speed, 1e-3 * speed.max())
        figures[name] = {"rollouts": rollouts, "controller": {**controller, "error": float(error.max())}}
    environment = {"cores": os.cpu_count(), "python": platform.python_version(), "numpy": np.__version__}
    settings = {"task": task.name, "points": options.points, "tolerance": FINE.tolerance, "controller": TOLERANCE}
    write_json(out, {"stacks": figures, "settings": settings | environment})
    print_table(
        ("velocity at one point", "median ms", "95 % ms", f"at {TOLERANCE:g} m", "95 % ms", "error"),
        [(name, *_cells(stack["rollouts"], stack["controller"])) for name, stack in figures.items()],
    )
    return 0


def _scenarios(task: Task) -> Mapping[str, Scenario]:
    """Stacks of the imitation with obstacles in its way and a bias point beside it."""

    def at(percent: int) -> Point:
        return as_point(task.mean_path[percent])

    cube = Box(at(50), (0.1, 0.1, 0.1))
    beside = as_point(task.mean_path[75] + BIAS_OFFSET * task.slice.axes[:, 1])
    layers = (Layer(Biasing(BiasPoint(beside, plane=plane_of(task))), name="Bias 1"),)
    return {
        "imitation": Scenario(task.name, ()),
        "one sphere": Scenario(task.name, (Sphere(at(50), 0.12),)),
        "three spheres": Scenario(task.name, tuple(Sphere(at(percent), 0.07) for percent in (30, 50, 70))),
        "box": Scenario(task.name, (cube,)),
        "mesh": Scenario(task.name, (MeshObstacle(at(50), Solid(*cube.surface())),)),
        "bias point": Scenario(task.name, (), layers=layers),
        "sphere and bias point": Scenario(task.name, (Sphere(at(30), 0.12),), layers=layers),
    }


def _timed(system: DiffeomorphicSystem, points: Array) -> tuple[Array, dict[str, float]]:
    """Velocities (N, 3) at `points` (N, 3), one after the other, and how long one of them took."""
    system.velocity(points[:1])  # what is computed once for each field is computed here
    velocities, seconds = [], []
    for point in points:
        began = time.perf_counter()
        velocities.append(system.velocity(point))
        seconds.append(time.perf_counter() - began)
    milliseconds = 1e3 * np.array(seconds)
    figures = {"median_ms": float(np.median(milliseconds)), "p95_ms": float(np.percentile(milliseconds, 95))}
    return np.stack(velocities), figures


def _cells(rollouts: Mapping[str, float], controller: Mapping[str, float]) -> tuple[str, ...]:
    times = (figures[name] for figures in (rollouts, controller) for name in ("median_ms", "p95_ms"))
    return (*(f"{milliseconds:.2f}" for milliseconds in times), f"{controller['error']:.0e}")
