"""Plain or augmented: which state a motion is learned in.

``plain``
    one vector field of places, as in the paper: it needs no memory, and no two of its motions cross;
``augmented``
    it remembers its phase and where it began (see `dt_viz.learning.augmented`): it crosses, comes back and winds, and
    draws the figure from other starts, too;
``auto``
    plain, unless the demonstrations conflict, or a plain fit with the default settings misses one. So the settings of
    the plain fit do not change the state: who chooses few basis functions sees what they make of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.learning.augmented import AugmentedImitation, fit_augmented
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit
from dt_viz.learning.preparation import ImitationError, Motions, prepare
from dt_viz.metrics import discrete_frechet, resample_by_arc_length

State = Literal["auto", "plain", "augmented"]
"""State that a motion is learned in."""
STATES: tuple[State, ...] = get_args(State)
AnyImitation = Imitation | AugmentedImitation

NUM_COMPARED = 120
"""Number of points of a demonstration, evenly by arc length, at which conflicts are looked for."""
NEAR, ANGLE, APART = 0.1, 45.0, 0.1
"""Distance in spreads, angle of directions in degrees, and difference of phases, from which on two passages of a place
are in conflict."""
MOST_CONFLICTING = 0.03
"""Largest share of the way on which demonstrations may conflict for the plain state."""
MOST_MISSED = 0.05
"""Largest Fréchet distance of a plain motion from its demonstration, relative to the extent."""


@dataclass(frozen=True)
class Conflicts:
    """How much of the demonstrations' way passes a place in different directions, from 0 to 1."""

    phase: float
    """At different phases: what an augmented state resolves."""
    label: float
    """Of two demonstrations at about the same phase: what only a label resolves."""


def learn(
    demonstrations: Sequence[Demonstration],
    settings: ImitationSettings | None = None,
    state: State = "auto",
    labels: Sequence[float] | None = None,
    progress: Progress | None = None,
    plain: Callable[[ImitationSettings | None], Imitation] | None = None,
) -> AnyImitation:
    """Learn a stable motion in the state that is asked for.

    Args:
        demonstrations: at least one, all ending at (about) the same place.
        settings: of the plain fit; None takes the defaults.
        state: see the module.
        labels: a number for each demonstration; only of the augmented state.
        progress: see `dt_viz.learning.imitation.fit`.
        plain: gives the plain fit with these settings; None fits it here.

    Raises:
        ImitationError: nothing can be learned, there is no such state, or the plain state is to have labels.
    """
    if state not in STATES:
        raise ImitationError(f"state: found {state!r}; accepted: {', '.join(STATES)}")
    if state == "plain" and labels is not None:
        raise ImitationError("labels: found some; accepted: none in the plain state")
    plain = plain or (lambda settings: fit(demonstrations, settings, progress))
    if state == "plain":
        return plain(settings)
    if state == "augmented" or labels is not None:
        return fit_augmented(demonstrations, labels)
    motions = prepare(demonstrations)
    share = conflicts(motions).phase
    if share > MOST_CONFLICTING:
        reason = f"on {100 * share:.0f} % of their way the demonstrations pass a place in different directions"
        return replace(fit_augmented(demonstrations), reason=reason)
    try:
        usual = plain(None)
    except ImitationError as error:
        return replace(fit_augmented(demonstrations), reason=f"the plain state fails: {error}")
    off = missed(usual, motions)
    if off <= MOST_MISSED:
        return usual if settings in (None, ImitationSettings()) else plain(settings)
    reason = f"the plain state misses a demonstration by {100 * off:.0f} % of the extent"
    return replace(fit_augmented(demonstrations), reason=reason)


def conflicts(motions: Motions) -> Conflicts:
    """Measure how much of the way of motions is in conflict; near the goal, where all meet, nothing is."""
    points = motions.resampled(NUM_COMPARED) / motions.spread
    directions = np.gradient(points, axis=1)
    directions /= np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-12)
    num = len(points)
    phase, whose = np.tile(np.linspace(0, 1, NUM_COMPARED), num), np.repeat(np.arange(num), NUM_COMPARED)
    at, along = (values.reshape(num * NUM_COMPARED, -1) for values in (points, directions))
    close = ((at[:, None] - at) ** 2).sum(axis=-1) < NEAR**2
    close &= (np.linalg.norm(at - motions.goal / motions.spread, axis=1) > 2 * NEAR)[:, None]
    against = close & (along @ along.T < np.cos(np.radians(ANGLE)))
    far = np.abs(phase[:, None] - phase) > APART
    other = whose[:, None] != whose
    return Conflicts(float((against & far).any(axis=1).mean()), float((against & ~far & other).any(axis=1).mean()))


def missed(imitation: Imitation, motions: Motions) -> float:
    """Largest discrete Fréchet distance of a learned motion from its demonstration, relative to the extent."""
    extent = float(np.ptp(np.concatenate(motions.positions), axis=0).max())
    return max(_missed(imitation, path) for path in motions.positions) / extent


def _missed(imitation: Imitation, path: Array) -> float:
    transform, base = imitation.transform, imitation.base
    left = np.linspace(1, 0, NUM_COMPARED)
    drawn = transform.inverse(base.at_fraction(transform.forward(path[0]), left))
    a, b = (resample_by_arc_length(p, NUM_COMPARED) for p in (drawn, path))
    return float(discrete_frechet(a, b))
