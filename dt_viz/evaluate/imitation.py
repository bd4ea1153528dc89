"""Fit demonstrations and compare each rollout with its own demonstration, in-sample or left out.

    python -m dt_viz.evaluate imitation DIR/*.mat --leave-one-out --out DIR

For each file the folder gets an npz, all lengths in the file's own unit (LASA: millimetres, others: metres):

``rollout_i`` (T, d), ``times_i`` (T,)
    the motion learned, from the first point of demonstration i until it is at the goal; seconds from 0.
``goal`` (d,)
    common end of the motions.
``fit_seconds``, ``start_seconds``
    time of the fit, certificates included, never from a cache; and until the motion from a new start is known, median.
``min_det_jacobian``, ``round_trip_error``
    smallest det J and largest ‖ψ⁻¹(ψ(x)) − x‖ on a grid over the demonstrations' box grown by half its size on every
    side, computed here, not taken from the fit.

With ``--leave-one-out`` each demonstration is also followed by the motion learned from the others, and by two ways that
need no learning (see `dt_viz.evaluate.held_out`): SHAPE-held-out.npz holds ``learned_i``, ``mean_i`` and ``nearest_i``
(T, d) for each demonstration i, and ``learned_times_i`` … (T,); of demonstrations with the hand's orientation also
``learned_degrees_i`` and ``mean_degrees_i`` (N,), its angles from the demonstration's. ``figures.json`` holds what the
tables show, ``shapes.png`` all shapes (the paper's fig. 5), and ``worst.png`` the held-out demonstrations that are met
worst for the extent of their shape.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.evaluate.held_out import (
    WAYS,
    Followed,
    Learn,
    degrees_off,
    folds_of,
    follow_held,
    frechet,
    in_order,
    rollouts_from,
)
from dt_viz.evaluate.options import FOLDER, report, whole_number, write_json, write_npz
from dt_viz.evaluate.sweep import add_workers, sweep
from dt_viz.files.archives import LASA_UNITS
from dt_viz.flows.diffeomorphisms import min_det_jacobian, round_trip_error
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration, load_demonstrations
from dt_viz.learning.imitation import OBJECTIVES, ImitationError, ImitationSettings, grown_grid
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.state import learn as learn_in_state
from dt_viz.metrics import rms_at_equal_times
from dt_viz.pictures import figures
from dt_viz.pictures.figures import FigurePanel

OUT = FOLDER
STATES = ("plain", "augmented", "auto")


@dataclass(frozen=True)
class Source:
    """The demonstrations of one file."""

    path: Path
    demonstrations: tuple[Demonstration, ...]
    """Demonstrations in metres."""
    unit: float
    """Length of one unit of the file, metres."""

    @property
    def paths(self) -> list[Array]:
        """Each demonstration's places (T_i, d), metres."""
        return [d.positions for d in self.demonstrations]

    @property
    def extent(self) -> float:
        """Larger side of the demonstrations' box, metres."""
        return float(np.ptp(np.concatenate(self.paths), axis=0).max())


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("files", type=Path, nargs="+", metavar="SHAPE", help="file or folder of demonstrations")
    parser.add_argument("--rate", type=float, metavar="HZ", help="samples per second of files without times")
    parser.add_argument("--unit", metavar="UNIT", help="units of the files, such as mm or cm,ms, if not recognised")
    parser.add_argument("--objective", choices=OBJECTIVES, default=OBJECTIVES[0], help="default: %(default)s")
    parser.add_argument("--state", choices=STATES, default=STATES[0], help="default: %(default)s")
    parser.add_argument("--leave-one-out", action="store_true", help="also follow each by what the others teach")
    folds = "the same, but hold out in so many folds"
    parser.add_argument("--folds", type=whole_number(2), metavar="N", help=folds)
    add_workers(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command; 2 if one of the shapes could not be fitted."""
    if options.state == "augmented" and options.objective != OBJECTIVES[0]:
        raise FormatError("--objective", options.objective, "none with --state augmented, whose fit has no objective")
    sources = _sources(options.files, options.rate, options.unit)
    holds_out = options.leave_one_out or options.folds is not None
    alone = ", ".join(str(source.path) for source in sources if len(source.demonstrations) == 1)
    if holds_out and alone:
        raise FormatError("--leave-one-out", f"one demonstration only in {alone}", "two or more in each")
    folder = options.out
    shapes: list[dict[str, Any]] = []
    held_out: list[dict[str, Any]] = []
    turns: list[dict[str, Any]] = []
    panels: list[FigurePanel] = []
    cases: list[tuple[float, FigurePanel]] = []
    for source, folds, in_sample, parts in _learned(sources, holds_out, options):
        name = source.path.stem
        if error := next((part for part in (in_sample, *parts) if isinstance(part, ImitationError)), None):
            print(f"{source.path}: {error}", file=sys.stderr)
            continue
        followed = in_order(parts)
        if in_sample.choice:
            print(f"{name}: {in_sample.choice}")
        for warning in in_sample.warnings:
            print(f"{source.path}: {warning}", file=sys.stderr)
        shapes.append(in_sample.row)
        write_npz(folder / f"{name}.npz", **in_sample.arrays)
        panels.append(FigurePanel(name, {"demonstration": source.paths, "learned": in_sample.rollouts}))
        if in_sample.degrees:
            turns.append(turn_row(name, in_sample.degrees, followed))
        if holds_out:
            write_npz(folder / f"{name}-held-out.npz", **_arrays(followed, source.unit))
            held_out.append(summed_up(name, folds, followed))
            cases += cases_of(source, followed)
    if shapes:
        _report(shapes, held_out, turns)
        chosen = {"state": options.state, "objective": options.objective}
        write_json(folder / "figures.json", {**chosen, "shapes": shapes, "held_out": held_out, "turns": turns})
    if shapes and figures.can_draw():
        figures.save(figures.panels(panels), folder / "shapes.png")
        if worst := worst_of(cases):
            figures.save(figures.panels([panel for _, panel in worst], columns=3), folder / "worst.png")
    return 0 if len(shapes) == len(sources) else 2


def _learned(
    sources: Sequence[Source], holds_out: bool, options: argparse.Namespace
) -> Iterator[tuple[Source, int, Any, Sequence[Any]]]:
    """Each source with its number of folds, its `InSample`, and what each fold has followed; or the errors of these."""
    folds = [min(options.folds or num, num) for num in (len(source.demonstrations) for source in sources)]
    held = [folds_of(len(s.demonstrations), of) if holds_out else [] for s, of in zip(sources, folds, strict=True)]
    cases = [(source, part) for source, parts in zip(sources, held, strict=True) for part in (None, *parts)]
    learn: Learn = partial(learn_in_state, settings=ImitationSettings(options.objective), state=options.state)
    with sweep(options, lambda: learn) as (_, swept):
        found = swept(_measured, cases)
        for source, of, parts in zip(sources, folds, held, strict=True):
            yield source, of, next(found), [*islice(found, len(parts))]


def _measured(learn: Learn, case: tuple[Source, range | None]) -> InSample | dict[int, Followed] | ImitationError:
    """Learn from a source and follow what is learned from, or, of a fold, what is held out; an error is a result."""
    source, held = case
    try:
        if held is not None:
            return follow_held(source.demonstrations, learn, held)
        began = time.perf_counter()
        imitation = learn(source.demonstrations)
        return in_sample(imitation, source, time.perf_counter() - began)
    except ImitationError as error:
        return error


def _report(shapes: list[dict[str, Any]], held_out: list[dict[str, Any]], turns: list[dict[str, Any]]) -> None:
    """Print the rows of `in_sample`, `summed_up` and `turn_row`, and how what was learned fares beside what is not."""
    print("in-sample: each rollout against the demonstration that it was learned from")
    report(_with_means(shapes))
    print(f"fit, median: {np.median([row['fit_seconds'] for row in shapes]):.2f} s")
    if held_out:
        print("\nheld out: each demonstration against what was learned from the others")
        report(_with_means(held_out))
        better = sum(row["learned_mm"] < min(row["mean_mm"], row["nearest_mm"]) for row in held_out)
        ratios = [row["of_mean"] for row in held_out]
        print(f"nearer than both without learning: {better} of {len(held_out)}")
        print(
            f"relative to the mean, shifted: {geometric_mean(ratios):.3f} (geometric mean), {max(ratios):.3f} at worst"
        )
    if turns:
        print("\nthe hand's orientation, degrees from the demonstration's at equal parts of the way")
        report(_with_means(turns))


@dataclass(frozen=True)
class InSample:
    """What was learned from all demonstrations of a source, followed."""

    row: dict[str, Any]
    """Row of the table."""
    arrays: dict[str, Any]
    """Arrays of the file."""
    rollouts: tuple[Array, ...]
    """(T, d) from each demonstration's start, metres."""
    degrees: Sequence[Array]
    """Angles from the orientation of each demonstration, see `degrees_off`; empty without orientations."""
    choice: str
    """State that was chosen, and why; empty where it was asked for."""
    warnings: Sequence[str]


def in_sample(imitation: AnyImitation, source: Source, fit_seconds: float) -> InSample:
    """Follow all demonstrations."""
    paths, unit = source.paths, source.unit
    rollouts, times = rollouts_from(imitation, np.stack([path[0] for path in paths]))
    distances = 1e3 * frechet(list(rollouts), paths)
    at_times = zip(times, rollouts, source.demonstrations, strict=True)
    rms = [1e3 * rms_at_equal_times(t, rollout, d.times, d.positions) for t, rollout, d in at_times]
    grid, transform = _states(imitation, paths), imitation.system.transform
    round_trip, det = round_trip_error(transform, grid), min_det_jacobian(transform.jacobian, grid)
    start_seconds = float(np.median([_seconds_for(imitation, path[0]) for path in paths]))
    row = {
        "name": source.path.stem,
        "demonstrations": len(paths),
        "frechet_mean_mm": float(distances.mean()),
        "frechet_max_mm": float(distances.max()),
        "rms_mm": float(np.mean(rms)),
        "fit_seconds": fit_seconds,
        "start_seconds": start_seconds,
        "end_error_mm": 1e3 * float(np.linalg.norm(rollouts[:, -1] - imitation.goal, axis=1).max()),
        "round_trip_of_extent": round_trip / source.extent,
        "min_det_jacobian": det,
    }
    arrays = {
        "fit_seconds": fit_seconds,
        "start_seconds": start_seconds,
        "min_det_jacobian": det,
        "round_trip_error": round_trip / unit,
        "goal": imitation.goal / unit,
        **{f"rollout_{i}": rollout / unit for i, rollout in enumerate(rollouts)},
        **{f"times_{i}": moments for i, moments in enumerate(times)},
    }
    demonstrations, turned = source.demonstrations, imitation.has_orientation
    degrees = [degrees_off(imitation, demonstrations, each)["learned"] for each in demonstrations] if turned else []
    choice = "" if imitation.choice is None else f"{imitation.state}. {imitation.choice}"
    return InSample(row, arrays, tuple(rollouts), degrees, choice, imitation.warnings)


def turn_row(name: str, degrees: Sequence[Array], followed: Sequence[Followed]) -> dict[str, float | str]:
    """Row of the table of orientations: medians and largest angles in-sample, held out, and of the mean of the others.

    All over the samples of all demonstrations, degrees.
    """
    angles = {"in_sample": degrees}
    if followed:
        angles |= {"held_out": [f.degrees["learned"] for f in followed]}
        angles |= {"mean_of_others": [f.degrees["mean"] for f in followed]}
    over = {"median": np.median, "largest": np.max}
    values = {f"{title}_{name}": float(of(off)) for title, off in angles.items() for name, of in over.items()}
    return {"name": name, **values}


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
    """Measure how long the motion from a start (d,) takes to be known, by one that has kept nothing."""
    began = time.perf_counter()
    system = replace(imitation).system
    system.base.velocity(system.transform.forward(system.base.states(start)))
    return time.perf_counter() - began


def _arrays(followed: Sequence[Followed], unit: float) -> dict[str, Array]:
    """Arrays of the file of what was held out; lengths in so many metres."""
    arrays = {f"{way}_degrees_{i}": off for i, f in enumerate(followed) for way, off in f.degrees.items()}
    for i, f in enumerate(followed):
        for way, (path, times) in f.motions.items():
            arrays |= {f"{way}_{i}": path / unit, f"{way}_times_{i}": times}
    return arrays


def summed_up(name: str, folds: int, followed: Sequence[Followed]) -> dict[str, Any]:
    """Means over the held-out demonstrations of a shape, mm: Fréchet distance and distance at equal times.

    ``of_mean`` is the Fréchet distance of what was learned relative to that of the mean, shifted, and ``plain`` the
    part of the demonstrations that was followed in the plain state.
    """
    distances = {f"{way}_mm": 1e3 * float(np.mean([f.frechet(way) for f in followed])) for way in WAYS}
    rms = {f"{way}_rms_mm": 1e3 * float(np.mean([f.rms(way) for f in followed])) for way in WAYS}
    plain = float(np.mean([f.state == "plain" for f in followed]))
    of_mean = distances["learned_mm"] / distances["mean_mm"]
    return {"name": name, "folds": folds, **distances, "of_mean": of_mean, "plain": plain, **rms}


def cases_of(source: Source, followed: Sequence[Followed]) -> list[tuple[float, FigurePanel]]:
    """The panel of each held-out demonstration, and how far off what was learned is, relative to the extent."""
    cases, paths = [], source.paths
    for i, f in enumerate(followed):
        learned, mean, nearest = (1e3 * f.frechet(way) for way in WAYS)
        kinds = {
            "learned from": [*paths[:i], *paths[i + 1 :]],
            "demonstration": [paths[i]],
            "learned": [f.motions["learned"][0]],
            "mean, shifted": [f.motions["mean"][0]],
            "nearest start, shifted": [f.motions["nearest"][0]],
        }
        title = f"{source.path.stem} {i + 1}  {learned:.1f} mm\nmean {mean:.1f}, nearest {nearest:.1f} mm"
        cases.append((learned / source.extent, FigurePanel(title, kinds)))
    return cases


def worst_of(cases: Sequence[tuple[float, FigurePanel]], num: int = 9) -> list[tuple[float, FigurePanel]]:
    """The cases in which what was learned is farthest off, the worst first."""
    return sorted(cases, key=lambda case: -case[0])[:num]


def _sources(paths: Sequence[Path], rate: float | None, unit: str | None) -> list[Source]:
    """Read all files."""
    sources: dict[str, Source] = {}
    for path in paths:
        if path.stem in sources:
            found = f"{str(sources[path.stem].path)!r} and {str(path)!r}, which would both become {path.stem}.npz"
            raise FormatError("SHAPE", found, "files of different names")
        size = LASA_UNITS["length"] if path.suffix.lower() == ".mat" else 1.0
        sources[path.stem] = Source(path, load_demonstrations(path, rate=rate, unit=unit), size)
    return list(sources.values())


def _with_means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a table, and below them the mean, smallest and largest of each column of numbers."""
    numbers = {column: [row[column] for row in rows] for column in rows[0] if column != "name"}
    below = {"mean": np.mean, "smallest": np.min, "largest": np.max}
    over = [{"name": name, **{column: float(of(numbers[column])) for column in numbers}} for name, of in below.items()]
    return [*rows, *over]
