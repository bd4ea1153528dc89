"""Put a sphere at the middle of the demonstrations and at random places nearby, and measure the whole arm for each.

The npz file holds the places (K, 3), metres, the middle of the mean demonstration first, and for each place and rollout
(K, R): ``arm_depth``, ``arm_clearance``, ``depth_without``, ``frechet``, ``goal_miss`` in metres, ``turn`` and
``turn_without`` in degrees, ``num_outside``; NaN where the arm touches the sphere at a start or at the goal.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dt_viz.arm.robot import load_jaco
from dt_viz.engine.engine import Engine
from dt_viz.evaluate.avoidance import Measured, measure
from dt_viz.evaluate.options import (
    add_avoidance,
    add_task,
    chosen_task,
    positive_number,
    print_table,
    ready_to_write,
    scenario_around,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.learning.store import FitStore, default_cache_folder
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import Task

WITHIN = 0.05
"""Largest distance of a random place from the middle, metres."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--count", type=whole_number(0), default=20, help="random places (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the places (default: %(default)s)")
    parser.add_argument("--diameter", type=positive_number("metres", 1), default=0.15, metavar="D", help="metres")
    add_avoidance(parser, "cspace")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    tasks, task = chosen_task(options)
    out = ready_to_write(options.out, ".npz")
    robot = load_jaco()
    engine = Engine(tasks, FitStore(default_cache_folder()), robot)
    places = _places(task, options.count, np.random.default_rng(options.seed))
    found: list[list[Measured]] = []
    rows = []
    for k, (x, y, z) in enumerate(places):
        obstacle = Sphere((x, y, z), options.diameter)
        scenario = scenario_around(obstacle, task, options)
        frame, motions = engine.arm_motions(scenario)
        pairs = zip(motions, task.paths, strict=False)
        found.append([measure(motion, path, frame.goal, obstacle, robot) for motion, path in pairs])
        rows.append((str(k), *_row(found[-1], scenario), *map(str, (frame.blocked or frame.certificates.warnings)[:1])))
    names = ("frechet", "depth_without", "turn", "turn_without", "num_outside", "goal_miss")
    arrays = {name: _table(found, len(task.paths), lambda m, name=name: getattr(m, name)) for name in names}
    arrays["arm_depth"] = _table(found, len(task.paths), lambda m: m.arm.depth)
    arrays["arm_clearance"] = _table(found, len(task.paths), lambda m: m.arm.obstacle.distance)
    write_npz(out, places=places, **arrays)
    print(f"{task.name}, sphere of {options.diameter:g} m; lengths in mm, the worst rollout of each place")
    header = (
        "place", "M.C.D. without", "M.C.D. arm", "clearance", "F.D.", "F.D./forced", "turn (without)",
        "goal missed", "outside limits", "",
    )  # fmt: skip
    print_table(header, [(*row, *[""] * (len(header) - len(row))) for row in rows])
    measured = [m for place in found for m in place]
    free = sum(bool(place) for place in found)
    print(f"\n{free} of {len(places)} places leave start and goal free; there, over all rollouts:")
    depth, clearance = max(m.arm.depth for m in measured), min(m.arm.obstacle.distance for m in measured)
    print(f"M.C.D. of the whole arm {1e3 * depth:.1f} mm, clearance {1e3 * clearance:.1f} mm")
    print(f"F.D. mean {1e3 * np.mean([m.frechet for m in measured]):.0f} mm")
    print(f"configurations outside the joint limits {sum(m.num_outside for m in measured)}")
    print(f"goal missed by {1e3 * max(m.goal_miss for m in measured):.3f} mm")
    return 0


def _places(task: Task, count: int, rng: np.random.Generator) -> Array:
    """Return the middle of the mean demonstration and random places in a ball around it, (1 + count, 3), metres."""
    middle = task.mean_path[50]
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.concatenate([[middle], middle + WITHIN * rng.uniform(size=(count, 1)) ** (1 / 3) * direction])


def _row(measured: list[Measured], scenario: Scenario) -> tuple[str, ...]:
    if not measured:
        return ("",) * 8
    worst = max(measured, key=lambda m: m.turn)
    return (
        f"{1e3 * max(m.depth_without for m in measured):.0f}",
        f"{1e3 * max(m.arm.depth for m in measured):.1f}",
        f"{1e3 * min(m.arm.obstacle.distance for m in measured):.1f}",
        f"{1e3 * max(m.frechet for m in measured):.0f}",
        f"{max(m.frechet / (m.depth_without + scenario.avoidance.margin) for m in measured):.2f}",
        f"{worst.turn:.0f}° ({worst.turn_without:.0f}°)",
        f"{1e3 * max(m.goal_miss for m in measured):.3f}",
        f"{sum(m.num_outside for m in measured)}",
    )


def _table(found: list[list[Measured]], num_rollouts: int, value: Callable[[Measured], float]) -> Array:
    table = np.full((len(found), num_rollouts), np.nan)
    for row, place in zip(table, found, strict=True):
        row[: len(place)] = [value(m) for m in place]
    return table
