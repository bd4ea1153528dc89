"""Which demonstrations are of one pattern: by the shapes of their motions, and by where they begin."""

from __future__ import annotations

import numpy as np

from dt_viz.flows.fields import Array, Indices
from dt_viz.learning.initial_guess import groups_of


def patterns_of(points: Array, num: int) -> Indices:
    """Tell motions apart by their shapes, wherever they begin.

    Args:
        points: (R, n, d) of them, evenly along each.
        num: largest number of patterns.

    Returns:
        (R,) index of the pattern of each, in the order in which patterns come first.
    """
    groups = groups_of(_without_start(points), num)
    first = list(dict.fromkeys(groups))
    return np.array([first.index(group) for group in groups])


def set_apart(points: Array, of: Indices, least: float) -> bool:
    """Whether different patterns differ `least` times as much as what is of one pattern does, wherever motions begin.

    Args:
        points: (R, n, d), evenly along each.
        of: (R,) index of the pattern of each.
        least: see `AugmentedSettings.apart`.
    """
    shapes = _without_start(points)
    apart, same = np.linalg.norm(shapes[:, None] - shapes, axis=-1).mean(axis=-1), of[:, None] == of
    return bool(apart[~same].min(initial=np.inf) >= least * apart[same].max())


def _without_start(points: Array) -> Array:
    """Motions (R, n, d) without an offset of their starts that fades."""
    return points - np.linspace(1.0, 0.0, points.shape[1])[:, None] * points[:, :1]


def told_by_starts(starts: Array, of: Indices, least: float) -> bool:
    """Whether motions from `starts` (R, d) begin nearest to one of their own pattern, if it has several.

    Args:
        starts: metres.
        of: (R,) index of the pattern of each.
        least: least distance of starts of different patterns, metres.
    """
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1) + np.diag(np.full(len(starts), np.inf))
    several = np.bincount(of)[of] > 1
    own = (of[apart.argmin(axis=1)] == of)[several]
    return bool(own.all() and apart[of[:, None] != of].min(initial=np.inf) >= least)
