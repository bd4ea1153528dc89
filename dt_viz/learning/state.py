"""Plain or augmented: which state a motion is learned in.

``plain``
    one vector field of places, as in the paper: it needs no memory, and no two of its motions cross;
``augmented``
    it remembers its phase and where it began (see `dt_viz.learning.augmented`): it crosses, comes back and winds, and
    draws the figure from other starts, too;
``auto``
    plain where that draws the demonstrations, and those that are left out about as well as the augmented one does: in
    a few folds some are held out, and followed by what the others teach. One or two are too few to leave some out.
    The choice is made by fits with the default settings: who chooses fewer layers, or another objective, sees what
    these make of the plain motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning.augmented import fit_augmented, with_found_patterns
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit, fit_transform
from dt_viz.learning.interface import STATES, AnyImitation, State, StateChoice
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import ImitationError, Motions, prepare
from dt_viz.metrics import arc_length, discrete_frechet

LearnPlain = Callable[[ImitationSettings, Progress], Imitation]


@dataclass(frozen=True)
class ChoiceSettings:
    """Settings of the choice between the states."""

    fewest: int = 3  # least number of demonstrations of which some are left out
    folds: int = 5  # largest number of folds in which that is done
    iterations: int = 5
    """Largest number of iterations of a plain fit to those of a fold; what is left out gains little by more."""
    alike: float = 1.05
    """Ratio of plain motions' distance from what was left out to augmented ones', up to which they are as good."""
    close: float = 0.005
    """The same distance, relative to the extent, up to which they are good however good augmented ones are."""
    hopeless: float = 1.25  # the same ratio from which no more folds are asked
    part: float = 0.5
    """Part of the time that the folds take of all that is learned, for those who wait."""


def learn(
    demonstrations: Sequence[Demonstration],
    settings: ImitationSettings | None = None,
    state: State = "auto",
    labels: Sequence[float] | None = None,
    progress: Progress | None = None,
    plain: LearnPlain | None = None,
    augmented: AugmentedSettings | None = None,
    choice: ChoiceSettings | None = None,
) -> AnyImitation:
    """Learn a stable motion in the state that is asked for, from demonstrations that end at (about) the same place.

    Labels, a number for each demonstration, make the state augmented; see `fit_augmented`. None takes default settings,
    for the augmented state with the preparation of the plain fit. `plain` gives the plain fit with some settings; None
    fits it here, telling the progress, see `dt_viz.learning.imitation.fit`.

    Raises:
        ImitationError: nothing can be learned, there is no such state, or the plain state is to have labels.
    """
    if state not in STATES:
        raise ImitationError(f"state: found {state!r}; accepted: {', '.join(STATES)}")
    if state == "plain" and labels is not None:
        raise ImitationError("labels: found some; accepted: none in the plain state")
    settings, progress = settings or ImitationSettings(), progress or (lambda _fraction, _message: None)
    augmented = augmented or AugmentedSettings(preparation=settings.preparation)
    given = plain or (lambda settings, progress: fit(demonstrations, settings, progress))
    if state == "plain":
        return given(settings, progress)
    if state == "augmented" or labels is not None:
        return fit_augmented(demonstrations, labels, augmented)
    if has_orientations(demonstrations):
        return fit_augmented(demonstrations, None, augmented, "the hand's orientation is learned, too")
    choice = choice or ChoiceSettings()
    motions, found, begun = prepare(demonstrations, settings.preparation), None, 0.0
    if len(motions.numbers) >= choice.fewest:
        begun = choice.part
        found = leaving_out(motions, choice, augmented, lambda done, message: progress(begun * done, message))
    if found and found.plain > max(choice.alike * found.augmented, choice.close * motions.extent):
        reason = f"it is nearer to what it has not learned from ({found})"
    else:
        plain = cache(lambda settings: given(settings, lambda d, message: progress(begun + (1 - begun) * d, message)))
        reason = _why_not(motions, plain, ImitationSettings(preparation=settings.preparation))
        if not reason:
            return replace(plain(settings), choice=found)
    progress(1.0, "done")
    return replace(fit_augmented(demonstrations, None, augmented, reason), choice=found)


def has_orientations(demonstrations: Sequence[Demonstration]) -> bool:
    """Whether demonstrations have what a motion of the hand's orientation is learned from: in space, all of them."""
    return all(one.orientations is not None and one.dimension == 3 for one in demonstrations)


def leaving_out(
    motions: Motions, choice: ChoiceSettings, augmented: AugmentedSettings, progress: Progress
) -> StateChoice:
    """Follow motions by what the others teach in both states, in a few folds or until the plain one is clearly worse.

    Motions of all lengths are in each fold, in whichever order they come; there must be two at least. Goal and size are
    those of all motions, in both states and for the mean alike.
    """
    off, folds = np.empty((3, 0)), min(choice.folds, len(motions.numbers))
    by_length = np.argsort([arc_length(path)[-1] for path in motions.positions], kind="stable")
    for fold in range(folds):
        held = by_length[fold::folds]
        others, known = motions.only(np.setdiff1d(by_length, held)), motions.only(held)
        part = lambda done, message, fold=fold: progress((fold + done) / folds, f"some are left out: {message}")  # noqa: E731
        distances = _plain(others, known, choice.iterations, part), _augmented(others, known, augmented)
        off = np.concatenate([off, [*distances, _mean(others, known)]], axis=1)
        if off[0].mean() > choice.hopeless * off[1].mean():
            break
    plain, remembering, shifted = (float(distance) for distance in off.mean(axis=1))
    return StateChoice(plain, remembering, shifted, off.shape[1])


def _plain(others: Motions, known: Motions, iterations: int, progress: Progress) -> Array:
    """Distances (R,) of plain motions, learned from others, from known ones."""
    try:
        transform = fit_transform(others, ImitationSettings(max_iterations=iterations), progress)
    except ImitationError:
        return np.full(len(known.numbers), np.inf)
    base = Attractor(transform.forward(others.goal[None])[0])  # rays are the same in whichever time
    return known.distances(DiffeomorphicSystem(transform, base), known.starts)


def _augmented(others: Motions, known: Motions, settings: AugmentedSettings) -> Array:
    """The same of augmented motions."""
    imitation, _ = with_found_patterns(others, settings)
    return known.distances(imitation.system, imitation.states(known.starts))


def _mean(others: Motions, known: Motions) -> Array:
    """The same of the mean of the others, shifted."""
    wanted, mean = known.resampled(), others.resampled().mean(axis=0)
    left = np.linspace(1.0, 0.0, len(mean))[:, None]
    return discrete_frechet(mean + left * (wanted[:, :1] - mean[0]), wanted)


def _why_not(motions: Motions, plain: Callable[[ImitationSettings], Imitation], settings: ImitationSettings) -> str:
    """Why a plain fit with these settings does not do; empty where it draws the motions."""
    try:
        off = motions.missed_by(plain(settings).system, motions.starts)
    except ImitationError as error:
        return f"the plain state fails: {error}"
    missed = f"the plain state misses a demonstration by {100 * off:.0f} % of the extent"
    return missed if off > settings.max_missed else ""
