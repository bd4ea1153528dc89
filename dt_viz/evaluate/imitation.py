"""Fit demonstrations and compare each rollout with its own demonstration, in-sample or left out."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import geometric_mean
from typing import Any, NamedTuple

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.evaluate.held_out import WAYS, Followed, Learn, folds_of, follow
from dt_viz.evaluate.options import add_output, computed, report, whole_number, write_json, write_npz
from dt_viz.files.archives import LASA_UNITS
from dt_viz.flows.diffeomorphisms import min_det_jacobian, round_trip_error
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration, load_demonstrations
from dt_viz.learning.imitation import OBJECTIVES, ImitationError, ImitationSettings, grown_grid
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.state import learn as learn_in_state
from dt_viz.pictures import figures
from dt_viz.pictures.figures import FigurePanel

STATES = ("plain", "augmented", "auto")
NUM_WORST = 9  # of the held-out demonstrations are drawn


class Source(NamedTuple):
    """The demonstrations of one file."""

    path: Path
    demonstrations: tuple[Demonstration, ...]  # in metres
    unit: float  # length of one unit of the file, metres
    folds: Sequence[range]  # numbers of the demonstrations that each fold holds out

    @property
    def paths(self) -> list[Array]:
        """Each demonstration's places (T_i, d), metres."""
        return [d.positions for d in self.demonstrations]

    @property
    def extent(self) -> float:
        """Larger side of the demonstrations' box, metres."""
        return float(np.ptp(np.concatenate(self.paths), axis=0).max())


class InSample(NamedTuple):
    """The motions learned from all demonstrations of a source."""

    row: dict[str, Any]  # of the table
    arrays: dict[str, Any]  # of the file
    followed: Sequence[Followed]  # each demonstration
    choice: str  # state that was chosen, and why; empty where it was asked for
    warnings: Sequence[str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("files", type=Path, nargs="+", metavar="SHAPE", help="file or folder of demonstrations")
    parser.add_argument("--rate", type=float, metavar="HZ", help="samples per second of files without times")
    parser.add_argument("--unit", metavar="UNIT", help="units of the files, such as mm or cm,ms, if not recognised")
    parser.add_argument("--objective", choices=OBJECTIVES, default=OBJECTIVES[0], help="default: %(default)s")
    parser.add_argument("--state", choices=STATES, default=STATES[0], help="default: %(default)s")
    parser.add_argument("--leave-one-out", action="store_true", help="also follow each by what the others teach")
    parser.add_argument("--folds", type=whole_number(2), metavar="N", help="the same, held out in so many folds")
    add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command; 2 if one of the shapes could not be fitted."""
    if options.state == "augmented" and options.objective != OBJECTIVES[0]:
        raise FormatError("--objective", options.objective, "none with --state augmented, whose fit has no objective")
    sources, folder = _sources(options), options.out
    learn: Learn = partial(learn_in_state, settings=ImitationSettings(options.objective), state=options.state)
    cases = [(source, held) for source in sources for held in (None, *source.folds)]
    found = computed(options, partial(_measured, learn), cases)
    shapes, held_out, turns, panels, worst = [], [], [], [], []
    for source in sources:
        name, parts = source.path.stem, [*islice(found, 1 + len(source.folds))]
        if error := next((part for part in parts if isinstance(part, ImitationError)), None):
            print(f"{source.path}: {error}", file=sys.stderr)
            continue
        own, followed = parts[0], sorted((f for part in parts[1:] for f in part), key=lambda f: f.number)
        if own.choice:
            print(f"{name}: {own.choice}")
        for warning in own.warnings:
            print(f"{source.path}: {warning}", file=sys.stderr)
        shapes.append(own.row)
        write_npz(folder / f"{name}.npz", own.arrays)
        learned = [f.motions["learned"][0] for f in own.followed]
        panels.append(FigurePanel(name, {"demonstration": source.paths, "learned": learned}))
        if any(f.degrees for f in own.followed):
            turns.append(turn_row(name, own.followed, followed))
        if followed:
            write_npz(folder / f"{name}-held-out.npz", _arrays(followed, source.unit))
            held_out.append(summed_up(name, len(source.folds), followed))
            worst += [_panel(source, one) for one in followed]
    if shapes:
        _report(shapes, held_out, turns)
        written = {"state": options.state, "objective": options.objective, "shapes": shapes}
        write_json(folder / "figures.json", written | {"held_out": held_out, "turns": turns})
    if shapes and figures.can_draw():
        figures.save(figures.panels(panels), folder / "shapes.png")
        worst = [panel for _, panel in sorted(worst, key=lambda case: -case[0])[:NUM_WORST]]
        if worst:
            figures.save(figures.panels(worst, columns=3), folder / "worst.png")
    return 0 if len(shapes) == len(sources) else 2


def _sources(options: argparse.Namespace) -> list[Source]:
    sources: dict[str, Source] = {}
    for path in options.files:
        if path.stem in sources:
            found = f"{str(sources[path.stem].path)!r} and {str(path)!r}, which would both become {path.stem}.npz"
            raise FormatError("SHAPE", found, "files of different names")
        demonstrations = load_demonstrations(path, rate=options.rate, unit=options.unit)
        num = len(demonstrations) if options.leave_one_out or options.folds else 0
        if num == 1:
            raise FormatError("--leave-one-out", f"one demonstration only in {path}", "two or more in each")
        folds = folds_of(num, min(options.folds or num, num))
        unit = LASA_UNITS["length"] if path.suffix.lower() == ".mat" else 1.0
        sources[path.stem] = Source(path, demonstrations, unit, folds)
    return list(sources.values())


def _measured(learn: Learn, case: tuple[Source, range | None]) -> Any:  # noqa: ANN401 - one of three
    """Learn from a source; return its `InSample`, or of a fold what it has `Followed`; or an ImitationError."""
    source, held = case
    try:
        if held is not None:
            return follow(source.demonstrations, learn, held)
        began = time.perf_counter()
        imitation = learn(source.demonstrations)
        return in_sample(imitation, source, time.perf_counter() - began)
    except ImitationError as error:
        return error


def in_sample(imitation: AnyImitation, source: Source, fit_seconds: float) -> InSample:
    """Follow all demonstrations."""
    followed = follow(source.demonstrations, lambda _: imitation, range(0))
    distances, rollouts = [1e3 * f.frechet("learned") for f in followed], [f.motions["learned"] for f in followed]
    grid, transform, unit = _states(imitation, source.paths), imitation.system.transform, source.unit
    round_trip = round_trip_error(transform, grid)
    row = {
        "name": source.path.stem,
        "demonstrations": len(followed),
        "frechet_mean_mm": float(np.mean(distances)),
        "frechet_max_mm": max(distances),
        "rms_mm": float(np.mean([1e3 * f.rms("learned") for f in followed])),
        "fit_seconds": fit_seconds,
        "start_seconds": float(np.median([_seconds_for(imitation, path[0]) for path in source.paths])),
        "end_error_mm": 1e3 * max(float(np.linalg.norm(path[-1] - imitation.goal)) for path, _ in rollouts),
        "round_trip_of_extent": round_trip / source.extent,
        "min_det_jacobian": min_det_jacobian(transform.jacobian, grid),
    }
    arrays = {name: row[name] for name in ("fit_seconds", "start_seconds", "min_det_jacobian")}
    arrays |= {"round_trip_error": round_trip / unit, "goal": imitation.goal / unit}
    for i, (path, times) in enumerate(rollouts):
        arrays |= {f"rollout_{i}": path / unit, f"times_{i}": times}
    choice = "" if imitation.choice is None else f"{imitation.state}. {imitation.choice}"
    return InSample(row, arrays, followed, choice, imitation.warnings)


def _states(imitation: AnyImitation, paths: Sequence[Array]) -> Array:
    """States (N, d) of the certificates' grid; augmented ones at each of several phases."""
    dim = len(imitation.goal)
    grid = grown_grid(np.concatenate(paths), 101 if dim == 2 else 25)
    begin = imitation.system.base.states(imitation.starts[0])
    num = 7 if len(begin) > dim else 1
    states = np.tile(begin, (num * len(grid), 1))
    states[:, :dim] = np.tile(grid, (num, 1))
    states[:, dim : dim + 1] *= np.repeat(np.linspace(0, 1, num), len(grid))[:, None]
    return states


def _seconds_for(imitation: AnyImitation, start: Array) -> float:
    """Measure how long the motion from a start (d,) takes to be known, by a copy that has kept nothing."""
    began = time.perf_counter()
    system = replace(imitation).system
    system.base.velocity(system.transform.forward(system.base.states(start)))
    return time.perf_counter() - began


def _arrays(followed: Sequence[Followed], unit: float) -> dict[str, Array]:
    """Arrays of the file of held-out demonstrations; lengths in units of so many metres."""
    arrays: dict[str, Array] = {}
    for f in followed:
        arrays |= {f"{way}_degrees_{f.number}": off for way, off in f.degrees.items()}
        arrays |= {f"{way}_{f.number}": path / unit for way, (path, _) in f.motions.items()}
        arrays |= {f"{way}_times_{f.number}": times for way, (_, times) in f.motions.items()}
    return arrays


def turn_row(name: str, own: Sequence[Followed], held_out: Sequence[Followed]) -> dict[str, float | str]:
    """Row of the table of orientations: median and largest angles over all samples of all demonstrations, degrees."""
    angles = {"in_sample": (own, "learned"), "held_out": (held_out, "learned"), "mean_of_others": (held_out, "mean")}
    row: dict[str, float | str] = {"name": name}
    for title, (followed, way) in angles.items():
        if followed:
            off = [f.degrees[way] for f in followed]
            row |= {f"{title}_median": float(np.median(off)), f"{title}_largest": float(np.max(off))}
    return row


def summed_up(name: str, folds: int, followed: Sequence[Followed]) -> dict[str, Any]:
    """Means over the held-out demonstrations of a shape, mm: Fréchet distance and distance at equal times.

    ``of_mean`` is the Fréchet distance of the learned motion relative to that of the mean, shifted, and ``plain`` the
    part of the demonstrations that was followed in the plain state.
    """
    distances = {f"{way}_mm": 1e3 * float(np.mean([f.frechet(way) for f in followed])) for way in WAYS}
    rms = {f"{way}_rms_mm": 1e3 * float(np.mean([f.rms(way) for f in followed])) for way in WAYS}
    plain = float(np.mean([f.state == "plain" for f in followed]))
    of_mean = distances["learned_mm"] / distances["mean_mm"]
    return {"name": name, "folds": folds, **distances, "of_mean": of_mean, "plain": plain, **rms}


def _panel(source: Source, f: Followed) -> tuple[float, FigurePanel]:
    """The panel of a held-out demonstration, and how far off the learned motion is, relative to the extent."""
    learned, mean, nearest = (1e3 * f.frechet(way) for way in WAYS)
    kinds = {
        "learned from": [path for i, path in enumerate(source.paths) if i != f.number],
        "demonstration": [f.demonstration.positions],
        "learned": [f.motions["learned"][0]],
        "mean, shifted": [f.motions["mean"][0]],
        "nearest start, shifted": [f.motions["nearest"][0]],
    }
    title = f"{source.path.stem} {f.number + 1}  {learned:.1f} mm\nmean {mean:.1f}, nearest {nearest:.1f} mm"
    return learned / source.extent, FigurePanel(title, kinds)


def _report(shapes: list[dict[str, Any]], held_out: list[dict[str, Any]], turns: list[dict[str, Any]]) -> None:
    """Print the rows of `in_sample`, `summed_up` and `turn_row`, and how the learned motions fare beside the others."""
    print("in-sample: each rollout against the demonstration that it was learned from")
    report(_with_means(shapes))
    print(f"fit, median: {np.median([row['fit_seconds'] for row in shapes]):.2f} s")
    if held_out:
        print("\nheld out: each demonstration against what was learned from the others")
        report(_with_means(held_out))
        better = sum(row["learned_mm"] < min(row["mean_mm"], row["nearest_mm"]) for row in held_out)
        ratios = [row["of_mean"] for row in held_out]
        mean, worst = geometric_mean(ratios), max(ratios)
        print(f"nearer than both without learning: {better} of {len(held_out)}")
        print(f"relative to the mean, shifted: {mean:.3f} (geometric mean), {worst:.3f} at worst")
    if turns:
        print("\nthe hand's orientation, degrees from the demonstration's at equal parts of the way")
        report(_with_means(turns))


def _with_means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a table, and below them the mean, smallest and largest of each column of numbers."""
    numbers = {column: [row[column] for row in rows] for column in rows[0] if column != "name"}
    below = {"mean": np.mean, "smallest": np.min, "largest": np.max}
    over = [{"name": name, **{column: float(of(numbers[column])) for column in numbers}} for name, of in below.items()]
    return [*rows, *over]
