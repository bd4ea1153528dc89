"""Picture of the held-out demonstrations that are met worst, of all files: an SVG with a panel for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from dt_viz.evaluate.held_out import WAYS, frechet
from dt_viz.evaluate.picture import BORDER, DEMONSTRATION, GENERATED, GOAL, INK, LABEL, PANEL, widest_directions
from dt_viz.flows.fields import Array
from dt_viz.metrics import resample_by_arc_length

NUM_WORST, COLUMNS = 9, 3
LEGEND = 34
"""Height of the legend, pixels."""
NUM_DRAWN = 120
"""Number of points of a line."""
OTHER, MEAN, NEAREST = (222, 222, 222), (36, 96, 200), (230, 150, 40)
"""Colours of the demonstrations that were learned from and of the two ways without learning."""
STYLES = {"learned": (GENERATED, 2.2, ""), "mean": (MEAN, 1.6, "7 4"), "nearest": (NEAREST, 1.6, "2 4")}
"""Colour, width and dashes of a way, pixels."""
WORDS = {"learned": "learned from the others", "mean": "their mean, shifted", "nearest": "nearest start, shifted"}


@dataclass(frozen=True)
class Case:
    """A demonstration that was held out, and what it was followed by."""

    name: str
    """Name of the shape, and number of the demonstration, from 1."""
    demonstration: Array
    """(T, d)."""
    others: Sequence[Array]
    """(T_i, d) those that were learned from, or more of the shape."""
    ways: Mapping[str, Array]
    """Path (T, d) of each of `WAYS`."""
    millimetres: float
    """Length of one unit of the paths."""

    @property
    def distances(self) -> Array:
        """(3,) discrete Fréchet distance of each of `WAYS`, mm."""
        return self.millimetres * frechet([self.ways[way] for way in WAYS], [self.demonstration] * len(WAYS))

    @property
    def share(self) -> float:
        """Distance of what was learned, relative to the extent of the shape."""
        extent = np.ptp(np.concatenate([self.demonstration, *self.others]), axis=0).max()
        return float(self.distances[0] / (self.millimetres * extent))


def cases_of(name: str, arrays: Mapping[str, Array], demonstrations: Sequence[Array], millimetres: float) -> list[Case]:
    """Make the cases of a shape from the arrays of `dt_viz.evaluate.held_out` and its demonstrations (T_i, d)."""
    return [
        Case(
            f"{name} {i + 1}",
            demonstration,
            [other for j, other in enumerate(demonstrations) if j != i],
            {way: arrays[f"{way}_{i}"] for way in WAYS},
            millimetres,
        )
        for i, demonstration in enumerate(demonstrations)
    ]


def worst_of(cases: Sequence[Case], num: int = NUM_WORST) -> list[Case]:
    """Return the cases in which what was learned is farthest off, relative to the extent, the worst first."""
    return sorted(cases, key=lambda case: -case.share)[:num]


def draw_worst(path: Path, cases: Sequence[Case]) -> None:
    """Write an SVG with a panel for each case, motions in space from their broadest side."""
    columns = min(COLUMNS, len(cases))
    rows = -(-len(cases) // columns)
    width, height = max(columns, 2) * PANEL, LEGEND + rows * (PANEL + LABEL)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{width}" height="{height}" fill="white"/>',
        *_legend(width),
    ]
    for k, case in enumerate(cases):
        corner = np.array([k % columns * PANEL, LEGEND + k // columns * (PANEL + LABEL)])
        parts += [f'<g transform="translate({corner[0]} {corner[1]})">', *_panel(case), "</g>"]
    path.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def _panel(case: Case) -> list[str]:
    learned, mean, nearest = case.distances
    figures = f"{learned:.1f} mm; mean {mean:.1f}, nearest {nearest:.1f}"
    flat = np.concatenate([case.demonstration, *case.others, *case.ways.values()])
    axes = widest_directions(np.concatenate([case.demonstration, *case.others]))
    lower, upper = (flat @ axes).min(axis=0), (flat @ axes).max(axis=0)
    scale = (PANEL - 2 * BORDER) / float((upper - lower).max())

    middle = np.array([PANEL / 2, LABEL + PANEL / 2])

    def pixels(path: Array) -> Array:
        return middle + (path @ axes - (lower + upper) / 2) * scale * [1, -1]

    lines = [_line(pixels(other), OTHER, 1.2) for other in case.others]
    lines.append(_line(pixels(case.demonstration), DEMONSTRATION, 5.0))
    lines += [_line(pixels(case.ways[way]), *STYLES[way]) for way in reversed(WAYS)]
    start, goal = pixels(case.demonstration[[0, -1]])
    return [
        f'<text x="{BORDER}" y="{0.7 * LABEL:g}" fill="{_rgb(INK)}"><tspan font-weight="bold">{escape(case.name)}'
        f"</tspan>  {figures}</text>",
        *lines,
        _disc(start, GENERATED, 3.5),
        _disc(goal, GOAL, 5.0),
    ]


def _legend(width: float) -> list[str]:
    lines = {"held out": (DEMONSTRATION, 5.0, ""), **{WORDS[way]: STYLES[way] for way in WAYS}}
    parts, step, y = [], (width - BORDER) / len(lines), LEGEND / 2
    for k, (words, style) in enumerate(lines.items()):
        x = BORDER + k * step
        parts.append(_line(np.array([[x, y], [x + 24, y]]), *style))
        parts.append(f'<text x="{x + 30:g}" y="{y + 4:g}" fill="{_rgb(INK)}">{words}</text>')
    return parts


def _line(points: Array, colour: tuple[int, int, int], width: float, dashes: str = "") -> str:
    drawn = resample_by_arc_length(points, NUM_DRAWN) if len(points) > NUM_DRAWN else points
    at = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn)
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return (
        f'<polyline points="{at}" fill="none" stroke="{_rgb(colour)}" stroke-width="{width:g}" '
        f'stroke-linejoin="round"{dashed}/>'
    )


def _disc(at: Array, colour: tuple[int, int, int], radius: float) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:g}" fill="{_rgb(colour)}"/>'


def _rgb(colour: tuple[int, int, int]) -> str:
    return f"rgb{colour}".replace(" ", "")
