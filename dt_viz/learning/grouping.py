"""Which demonstrations are of one pattern: by the shapes of their motions, and by where they begin."""

from __future__ import annotations

import numpy as np

from dt_viz.flows.fields import Array, Indices
from dt_viz.learning.initial_guess import groups_of


def patterns_of(points: Array, num: int) -> Indices:
    """Tell motions (R, n, d), evenly sampled along each, apart by their shapes, wherever they begin.

    Returns the index (R,) of the pattern of each, `num` patterns at most, in the order in which they come first.
    """
    groups = groups_of(_without_start(points), num)
    first = list(dict.fromkeys(groups))
    return np.array([first.index(group) for group in groups])


def set_apart(points: Array, of: Indices, least: float) -> bool:
    """Whether motions (R, n, d) of different patterns (R,) differ `least` times as much as those of one pattern do.

    See `AugmentedSettings.apart`. It plays no part where motions begin.
    """
    shapes = _without_start(points)
    apart, same = np.linalg.norm(shapes[:, None] - shapes, axis=-1).mean(axis=-1), of[:, None] == of
    return bool(apart[~same].min(initial=np.inf) >= least * apart[same].max())


def _without_start(points: Array) -> Array:
    """Motions (R, n, d) without an offset of their starts that fades."""
    return points - np.linspace(1.0, 0.0, points.shape[1])[:, None] * points[:, :1]


def told_by_starts(starts: Array, of: Indices, least: float) -> bool:
    """Whether starts (R, d), metres, are nearest to one of their own pattern `of` (R,), if it has several.

    Those of different patterns must be at least a distance `least` apart, metres.
    """
    apart = np.linalg.norm(starts[:, None] - starts, axis=-1) + np.diag(np.full(len(starts), np.inf))
    several = np.bincount(of)[of] > 1
    own = (of[apart.argmin(axis=1)] == of)[several]
    return bool(own.all() and apart[of[:, None] != of].min(initial=np.inf) >= least)
