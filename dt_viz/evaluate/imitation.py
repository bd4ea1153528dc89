"""Fit demonstrations and compare each rollout with its own demonstration, in-sample or left out.

For each file the folder gets an npz, all lengths in the file's own unit (LASA: millimetres, others: metres):

``rollout_i`` (T, d), ``times_i`` (T,)
    the motion learned, from the first point of demonstration i until it is at the goal; seconds from 0.
``goal`` (d,)
    common end of the motions.
``fit_seconds``
    the whole of `dt_viz.learning.imitation.fit`, certificates included, never from a cache.
``start_seconds``
    until the motion from a new start is known, its image in base space included; median.
``min_det_jacobian``, ``round_trip_error``
    smallest det J and largest ‖ψ⁻¹(ψ(x)) − x‖ on a grid over the demonstrations' box grown by half its size on every
    side, computed here, not taken from the fit.

With ``--leave-one-out`` each demonstration is also followed by the motion learned from the others, and by two ways that
need no learning (see `dt_viz.evaluate.held_out`): SHAPE-held-out.npz holds ``learned_i``, ``mean_i`` and ``nearest_i``
(T, d) for each demonstration i, and ``learned_times_i`` … (T,); and the motion is followed from starts far away and
after pushes (see `dt_viz.evaluate.off_course`). ``worst.svg`` shows the held-out demonstrations of all files that are
met worst, relative to the extent of their shape. ``--crossings`` adds synthetic demonstrations that cross, come back
or wind (see `dt_viz.evaluate.crossings`).

``--choose SEED`` chooses the constants of the augmented state on one half of the files and measures them on the other,
both ways round (see `dt_viz.evaluate.choose`); ``choices.json`` holds what it prints.

``figures.json`` holds what the table shows, and ``shapes.png`` all shapes: the paper's fig. 5.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.evaluate.choose import GRIDS, Choice, choose, measure
from dt_viz.evaluate.crossings import crossings
from dt_viz.evaluate.held_out import (
    WAYS,
    HeldOut,
    Learn,
    Learned,
    begun,
    follow,
    frechet,
    path_from,
    rollouts_from,
    summed_up,
)
from dt_viz.evaluate.off_course import AWAY, OffCourse, off_course
from dt_viz.evaluate.options import (
    InputError,
    positive_number,
    print_table,
    ready_folder,
    whole_number,
    write_json,
    write_npz,
)
from dt_viz.evaluate.picture import Panel, draw_panels
from dt_viz.evaluate.worst import Case, cases_of, draw_worst, worst_of
from dt_viz.flows.diffeomorphisms import min_det_jacobian, round_trip_error
from dt_viz.flows.fields import Array
from dt_viz.learning.augmented import AugmentedImitation, fit_augmented
from dt_viz.learning.choice import learn as learn_in_state
from dt_viz.learning.demonstrations import METRES_PER_LASA_UNIT, Demonstration, load_demonstrations
from dt_viz.learning.imitation import OBJECTIVES, ImitationError, ImitationSettings, fit, grown_grid
from dt_viz.metrics import rms_at_equal_times

GRID = {2: 101, 3: 25}
"""Number of points on each side of the certificates' grid, by dimension."""
NUM_PHASES = 7
"""Number of phases at which the certificates of augmented motions are computed."""
STATES = ("plain", "augmented")
learn_augmented = partial(learn_in_state, state="augmented")


@dataclass(frozen=True)
class Source:
    """The demonstrations of one file."""

    path: Path
    demonstrations: tuple[Demonstration, ...]
    """Demonstrations in metres."""
    unit: float
    """Length of one unit of the file, metres."""


@dataclass(frozen=True)
class Figures:
    """Row of the table: distances of a shape's rollouts from the demonstrations they were learned from."""

    name: str
    demonstrations: int
    frechet_mean_mm: float
    frechet_max_mm: float
    rms_mm: float
    """Root mean square distance at the demonstration's own times; mean over demonstrations."""
    fit_seconds: float
    start_seconds: float
    """Time until the motion from a new start is known; median over demonstrations."""
    end_error_mm: float
    """Largest distance of a rollout's last point from the goal."""
    round_trip_of_extent: float
    """Round trip error over the larger side of the demonstrations' box."""
    min_det_jacobian: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    parser.add_argument("files", type=Path, nargs="*", metavar="SHAPE", help="LASA .mat, .npz, .csv or folder of .csv")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for arrays and picture")
    parser.add_argument("--objective", choices=OBJECTIVES, default=OBJECTIVES[0], help="default: %(default)s")
    parser.add_argument(
        "--regularisation", type=positive_number("weight", 1.0), metavar="R", help="of the plain fit (default: its own)"
    )
    parser.add_argument("--state", choices=STATES, default=STATES[0], help="default: %(default)s")
    parser.add_argument("--crossings", action="store_true", help="also what crosses itself, comes back or winds")
    parser.add_argument("--leave-one-out", action="store_true", help="also follow each by what the others teach")
    parser.add_argument(
        "--folds", type=whole_number(2), metavar="N", help="hold out in so many folds (default: one for each)"
    )
    parser.add_argument(
        "--choose", type=whole_number(0), metavar="SEED", help="also choose constants on half of the files"
    )


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 2 if one of the shapes could not be fitted."""
    learn = partial(fit, settings=_settings(options)) if options.state == "plain" else learn_augmented
    sources = _sources(options.files)
    _check(options, sources)
    folder = ready_folder(options.out)
    results: list[Figures] = []
    held_out: list[HeldOut] = []
    beside: list[OffCourse] = []
    cases: list[Case] = []
    panels: list[Panel] = []
    for source in sources:
        began = time.perf_counter()
        try:
            imitation = learn(source.demonstrations)
            seconds = time.perf_counter() - began
            if options.leave_one_out:
                row, of_source = _held_out(source, learn, options.folds, folder)
                held_out.append(row)
                cases += of_source
                beside.append(off_course(source.path.stem, source.demonstrations, imitation))
        except ImitationError as error:
            print(f"{source.path}: {error}", file=sys.stderr)
            continue
        for warning in imitation.warnings:
            print(f"{source.path}: {warning}", file=sys.stderr)
        arrays = measured(imitation, source, seconds)
        write_npz(folder / f"{source.path.stem}.npz", **arrays)
        results.append(compared(arrays, source))
        demonstrations = [d.positions / source.unit for d in source.demonstrations]
        panels.append(Panel(source.path.stem, demonstrations, _rollouts(arrays, len(demonstrations))))
    if results:
        _report(results)
        shapes = [asdict(figures) for figures in results]
        if held_out:
            _report_held_out(results, held_out)
            _report_off_course(beside)
            draw_worst(folder / "worst.svg", worst_of(cases))
        written = {"held_out": [asdict(row) for row in held_out], "off_course": [asdict(row) for row in beside]}
        chosen = {"state": options.state, "objective": options.objective}
        write_json(folder / "figures.json", {**chosen, "shapes": shapes, **written})
        draw_panels(folder / "shapes.png", panels)
    if options.choose is not None:
        _report_choices(sources, options.choose, folder)
    if options.crossings:
        _report_crossings(options.state, learn, folder)
    return 0 if len(results) == len(sources) else 2


def _settings(options: argparse.Namespace) -> ImitationSettings:
    """Settings of the plain fit."""
    settings = ImitationSettings(options.objective)
    return replace(settings, regularisation=options.regularisation) if options.regularisation else settings


def _check(options: argparse.Namespace, sources: Sequence[Source]) -> None:
    """Refuse options that do not go together, or with these files."""
    if not (sources or options.crossings):
        raise InputError("SHAPE", "no file", "files, or --crossings")
    if options.state == "augmented" and options.objective != OBJECTIVES[0]:
        raise InputError("--objective", options.objective, "none with --state augmented, whose fit has no objective")
    if options.state == "augmented" and options.regularisation:
        raise InputError("--regularisation", f"{options.regularisation:g}", "none with --state augmented")
    if options.folds and not options.leave_one_out:
        raise InputError("--folds", str(options.folds), "it together with --leave-one-out")
    alone = ", ".join(str(source.path) for source in sources if len(source.demonstrations) == 1)
    if options.leave_one_out and alone:
        raise InputError("--leave-one-out", f"one demonstration only in {alone}", "two or more in each")
    if options.choose is not None and (options.state != "augmented" or len(sources) < 2 or alone):
        accepted = "it with --state augmented and two or more files, each of two or more demonstrations"
        raise InputError("--choose", str(options.choose), accepted)


def measured(imitation: Learned, source: Source, fit_seconds: float) -> dict[str, Any]:
    """Compute the arrays of the file's npz; see the module's docstring."""
    rollouts, times = rollouts_from(imitation, np.stack([d.positions[0] for d in source.demonstrations]))
    grid = grown_grid(np.concatenate([d.positions for d in source.demonstrations]), GRID[len(imitation.goal)])
    if isinstance(imitation, AugmentedImitation):
        states = np.tile(imitation.states(imitation.starts[0]), (NUM_PHASES * len(grid), 1))
        states[:, : imitation.dim] = np.tile(grid, (NUM_PHASES, 1))
        states[:, imitation.dim] = np.repeat(np.linspace(0, imitation.top, NUM_PHASES), len(grid))
        grid = states
    transform = imitation.system.transform
    arrays: dict[str, Any] = {
        "fit_seconds": fit_seconds,
        "start_seconds": float(np.median([_seconds_for(imitation, d.positions[0]) for d in source.demonstrations])),
        "min_det_jacobian": min_det_jacobian(transform.jacobian, grid),
        "round_trip_error": round_trip_error(transform, grid) / source.unit,
        "goal": imitation.goal / source.unit,
    }
    for i in range(len(rollouts)):
        arrays[f"rollout_{i}"] = rollouts[i] / source.unit
        arrays[f"times_{i}"] = times[i]
    return arrays


def _seconds_for(imitation: Learned, start: Array) -> float:
    """Measure how long the motion from a start (d,) takes to be known, by one that has kept nothing."""
    began = time.perf_counter()
    system, state = begun(replace(imitation), start)
    system.base.velocity(system.transform.forward(state))
    return time.perf_counter() - began


def compared(arrays: dict[str, Any], source: Source) -> Figures:
    """Compute the figures from the arrays of a file's npz."""
    demonstrations = [d.positions / source.unit for d in source.demonstrations]
    rollouts = _rollouts(arrays, len(demonstrations))
    distances = frechet(rollouts, demonstrations)
    rms = [
        rms_at_equal_times(arrays[f"times_{i}"], rollouts[i], demonstration.times, demonstrations[i])
        for i, demonstration in enumerate(source.demonstrations)
    ]
    end_error = max(float(np.linalg.norm(path[-1] - arrays["goal"])) for path in rollouts)
    millimetres = 1e3 * source.unit
    return Figures(
        name=source.path.stem,
        demonstrations=len(demonstrations),
        frechet_mean_mm=millimetres * float(distances.mean()),
        frechet_max_mm=millimetres * float(distances.max()),
        rms_mm=millimetres * float(np.mean(rms)),
        fit_seconds=arrays["fit_seconds"],
        start_seconds=arrays["start_seconds"],
        end_error_mm=millimetres * end_error,
        round_trip_of_extent=arrays["round_trip_error"] / float(np.ptp(np.concatenate(demonstrations), axis=0).max()),
        min_det_jacobian=arrays["min_det_jacobian"],
    )


def _held_out(source: Source, learn: Learn, folds: int | None, folder: Path) -> tuple[HeldOut, list[Case]]:
    """Follow each demonstration without having learned from it, and write the paths to the folder."""
    row, cases, arrays = _followed(source, learn, folds)
    write_npz(folder / f"{source.path.stem}-held-out.npz", **arrays)
    return row, cases


def _followed(source: Source, learn: Learn, folds: int | None) -> tuple[HeldOut, list[Case], dict[str, Array]]:
    """Follow each demonstration without having learned from it; the figures, the cases and the paths."""
    num = len(source.demonstrations)
    folds = min(folds or num, num)
    arrays = {
        f"{name}_{i}": values if name.endswith("_times") else values / source.unit
        for i, followed in enumerate(follow(source.demonstrations, learn, folds))
        for name, values in followed.items()
    }
    demonstrations = [d.positions / source.unit for d in source.demonstrations]
    times = [d.times for d in source.demonstrations]
    name, millimetres = source.path.stem, 1e3 * source.unit
    row = summed_up(name, folds, arrays, demonstrations, times, millimetres)
    return row, cases_of(name, arrays, demonstrations, millimetres), arrays


def _sources(paths: Sequence[Path]) -> list[Source]:
    """Read all files."""
    sources: dict[str, Source] = {}
    for path in paths:
        if path.stem in sources:
            found = f"{str(sources[path.stem].path)!r} and {str(path)!r}, which would both become {path.stem}.npz"
            raise InputError("SHAPE", found, "files of different names")
        unit = METRES_PER_LASA_UNIT if path.suffix.lower() == ".mat" else 1.0
        sources[path.stem] = Source(path, load_demonstrations(path), unit)
    return list(sources.values())


def _rollouts(arrays: dict[str, Any], num: int) -> list[Array]:
    return [arrays[f"rollout_{i}"] for i in range(num)]


def _report(results: Sequence[Figures]) -> None:
    print("in-sample: each rollout against the demonstration that it was learned from")
    header = ("shape", "demos", "Fréchet mean mm", "max mm", "RMS mm", "fit s", "end mm", "round trip/extent", "det J")
    rows = [
        (
            r.name,
            str(r.demonstrations),
            f"{r.frechet_mean_mm:.2f}",
            f"{r.frechet_max_mm:.2f}",
            f"{r.rms_mm:.2f}",
            f"{r.fit_seconds:.2f}",
            f"{r.end_error_mm:.3f}",
            f"{r.round_trip_of_extent:.1e}",
            f"{r.min_det_jacobian:.2g}",
        )
        for r in results
    ]
    print_table(header, rows)
    worst = max(results, key=lambda r: r.frechet_mean_mm)
    slowest = max(results, key=lambda r: r.fit_seconds)
    tightest = min(results, key=lambda r: r.min_det_jacobian)
    print(f"\nmeans over {len(results)} shape(s), each the mean over its demonstrations:")
    mean = np.mean([r.frechet_mean_mm for r in results])
    largest = max(r.frechet_max_mm for r in results)
    print(f"Fréchet distance {mean:.2f} mm; worst shape {worst.frechet_mean_mm:.2f} mm ({worst.name})")
    print(f"largest of a rollout {largest:.2f} mm; RMS at equal times {np.mean([r.rms_mm for r in results]):.2f} mm")
    median = np.median([r.fit_seconds for r in results])
    print(f"fit: median {median:.2f} s, worst {slowest.fit_seconds:.2f} s ({slowest.name})")
    print(f"new start: median {1e3 * np.median([r.start_seconds for r in results]):.2f} ms")
    print(f"largest distance from the goal at the end {max(r.end_error_mm for r in results):.3f} mm")
    print(f"largest round trip error {max(r.round_trip_of_extent for r in results):.1e} of the extent")
    print(f"smallest det J {tightest.min_det_jacobian:.2g} ({tightest.name})")


def _report_held_out(results: Sequence[Figures], held_out: Sequence[HeldOut]) -> None:
    for title, attribute, in_sample in (
        ("Fréchet mean", "mm", [r.frechet_mean_mm for r in results]),
        ("RMS at equal times", "rms_mm", [r.rms_mm for r in results]),
    ):
        columns = [in_sample, *([getattr(h, f"{way}_{attribute}") for h in held_out] for way in WAYS)]
        print(f"\nheld out: each demonstration against what was learned from others; {title}, mm")
        rows = [
            (h.name, str(h.folds), *(f"{value:.2f}" for value in values))
            for h, *values in zip(held_out, *columns, strict=True)
        ]
        means = ("mean", "", *(f"{np.mean(column):.2f}" for column in columns))
        print_table(("shape", "folds", "in-sample", "held out", "mean of others", "nearest start"), [*rows, means])
        better = sum(learned < min(others) for _, learned, *others in zip(*columns, strict=True))
        print(f"nearer than both without learning: {better} of {len(rows)}")


def _report_off_course(beside: Sequence[OffCourse]) -> None:
    print("\noff the demonstrations; shape error relative to the extent, speed to the fastest demonstrated")
    heads = [f"{what} at {100 * away:.0f} %" for what in ("shape error", "speed") for away in AWAY]
    rows = [
        (b.name, *(f"{v:.3f}" for v in b.shape_error), *(f"{v:.2f}" for v in b.speed), f"{b.drawn:.2f}") for b in beside
    ]
    columns = np.array([[*b.shape_error, *b.speed, b.drawn] for b in beside])
    mean = ("mean", *(f"{value:.3f}" for value in columns.mean(axis=0)))
    worst = (*columns[:, :-1].max(axis=0), columns[:, -1].min())
    print_table(("shape", *heads, "drawn after a push"), [*rows, mean, ("worst", *(f"{value:.3f}" for value in worst))])


def _report_choices(sources: Sequence[Source], seed: int, folder: Path) -> None:
    """Choose constants of the augmented state on each half of the files, and print what they do on the other."""
    names = [source.path.stem for source in sources]
    choices: list[Choice] = []
    for grid in GRIDS:
        measured = measure(grid, lambda: [_followed(source, learn_augmented, None)[0] for source in sources])
        choices += choose(grid, measured, names, seed)
    rows = [
        (
            choice.figure,
            str(len(choice.chosen_on)),
            ", ".join(f"{name} {value:g}" for name, value in choice.chosen),
            *(f"{value:.2f}" for value in (choice.others_mm, choice.shipped_mm, choice.best_mm)),
        )
        for choice in choices
    ]
    print("\nconstants chosen on half of the files, and what they do on the others, mm")
    print_table(("figure", "files", "chosen", "others", "others, as shipped", "others, their best"), rows)
    write_json(folder / "choices.json", {"seed": seed, "choices": [asdict(choice) for choice in choices]})


def _report_crossings(state: str, learn: Learn, folder: Path) -> None:
    """Follow what crosses, comes back or winds, and print and draw it; labels are found, and given as well."""
    rows, panels = [], []
    for name, case in crossings().items():
        demonstrations = case.demonstrations
        ways: dict[str, Learn] = {name: learn}
        if case.labels and state == "augmented":
            ways = {f"{name}, labels found": learn, f"{name}, given": partial(fit_augmented, labels=case.labels)}
        extent = float(np.ptp(np.concatenate([d.positions for d in demonstrations]), axis=0).max())
        for title, way in ways.items():
            try:
                imitation = way(demonstrations)
            except ImitationError as error:
                rows.append((title, f"{1e3 * extent:.0f}", "–", "–", str(error)))
                continue
            labels = imitation.labels if isinstance(imitation, AugmentedImitation) else None
            begins = zip(demonstrations, labels or [None] * len(demonstrations), strict=True)
            states = [imitation.system.base.states(d.positions[0], label) for d, label in begins]
            paths = [path_from(imitation.system, state, len(imitation.goal)) for state in states]
            worst = float(frechet(paths, [d.positions for d in demonstrations]).max())
            rows.append((title, f"{1e3 * extent:.0f}", f"{1e3 * worst:.1f}", f"{100 * worst / extent:.1f}", ""))
            panels.append(Panel(title, [d.positions for d in demonstrations], paths))
    print(f"\nwhat crosses, comes back or winds, by the {state} state; worst of each case, in-sample")
    print_table(("case", "extent mm", "Fréchet mm", "% of the extent", ""), rows)
    draw_panels(folder / "crossings.png", panels)
