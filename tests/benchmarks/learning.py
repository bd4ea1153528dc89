"""Measure learned motions off their demonstrations: from starts far from theirs, and after a push on the way.

    python -m tests.benchmarks learning DIR/*.mat --state augmented --out learning.json

Directions are in the plane that the mean demonstration is nearest to.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dt_viz.evaluate.held_out import NUM_COMPARED, frechet, shifted_to
from dt_viz.evaluate.options import Row, report
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import Demonstration, load_demonstrations
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.state import learn
from dt_viz.metrics import resample_by_arc_length
from tests.benchmarks.options import add_out

AWAY = (0.25, 0.5)  # distances of starts from the mean one, relative to the extent of the demonstrations
PUSH, DRAWN = 0.2, 0.05
"""Length of a push, and distance up to which a place of the rest of a motion counts as drawn, of the extent."""


@dataclass(frozen=True)
class OffCourse:
    """Figures of one shape."""

    name: str
    shape_error: tuple[float, ...]
    """Mean discrete Fréchet distance to the shifted mean demonstration, relative to the extent, for each of `AWAY`."""
    drawn: float  # mean share of the rest of a motion that is still drawn after a push


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    parser.add_argument("files", type=Path, nargs="+", metavar="SHAPE", help="as of evaluate imitation")
    parser.add_argument("--state", choices=("plain", "augmented"), default="plain", help="default: %(default)s")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    found = []
    for path in options.files:
        demonstrations = load_demonstrations(path)
        found.append(off_course(path.stem, demonstrations, learn(demonstrations, state=options.state)))
    rows: list[Row] = [
        {
            "shape": shape.name,
            **{f"shape error at {away:.0%}": error for away, error in zip(AWAY, shape.shape_error, strict=True)},
            "drawn after a push": shape.drawn,
        }
        for shape in found
    ]
    numbers = {column: [float(row[column] or 0) for row in rows] for column in rows[0] if column != "shape"}
    for name, of in (("mean", np.mean), ("largest", np.max), ("smallest", np.min)):
        rows.append({"shape": name, **{column: float(of(values)) for column, values in numbers.items()}})
    report(rows)
    return 0


def off_course(name: str, demonstrations: Sequence[Demonstration], imitation: AnyImitation) -> OffCourse:
    """Measure a motion off its demonstrations."""
    paths = [d.positions for d in demonstrations]
    extent = float(np.ptp(np.concatenate(paths), axis=0).max())
    mean = np.mean([resample_by_arc_length(path, 200) for path in paths], axis=0)
    errors = []
    across = np.linalg.svd(mean - mean.mean(axis=0))[2][:2]  # in space: in the plane that the mean is nearest to
    for away in AWAY:
        found = []
        for direction in _directions(12):
            start = mean[0] + away * extent * direction @ across
            system, state = imitation.system, imitation.system.base.states(start)
            (error,) = frechet([path_from(system, state, len(start))], [shifted_to(start, mean)])
            found.append(error / extent)
        errors.append(float(np.mean(found)))
    drawn = [_drawn(imitation, d.positions[0], extent, across) for d in demonstrations[:3]]
    return OffCourse(name, tuple(errors), float(np.mean(drawn)))


def path_from(system: DiffeomorphicSystem, state: Array, dim: int, num: int = NUM_COMPARED) -> Array:
    """Places (num, dim), metres, of the motion from a state to the goal, evenly in base space."""
    z = system.base.at_fraction(system.transform.forward(state), np.linspace(1, 0, num))
    return system.transform.inverse(z)[:, :dim]


def _directions(num: int) -> Array:
    """Unit vectors (num, 2) all around."""
    turn = np.linspace(0, 2 * np.pi, num, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _drawn(imitation: AnyImitation, start: Array, extent: float, across: Array) -> float:
    """Share of the rest of a motion that is still drawn after pushes from it, over places and directions."""
    system, state = imitation.system, imitation.system.base.states(start)
    z0, dim, shares = system.transform.forward(state), len(start), []
    for left in (0.65, 0.5, 0.35):  # part of the way
        here = system.transform.inverse(system.base.at_fraction(z0, np.array([left])))[0]
        rest = path_from(system, here, dim)
        for direction in _directions(8):
            pushed = here.copy()
            pushed[:dim] += PUSH * extent * direction @ across
            pushed = system.base.caught(pushed, pushed[:dim])
            after = path_from(system, pushed, dim)
            near = np.linalg.norm(rest[:, None] - after, axis=2).min(axis=1) < DRAWN * extent
            shares.append(near.mean())
    return float(np.mean(shares))
