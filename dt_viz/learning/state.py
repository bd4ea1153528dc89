"""Plain or augmented: which state a motion is learned in.

``plain``
    one vector field of places, as in the paper: it needs no memory, and no two of its motions cross;
``augmented``
    it remembers its phase and where it began (see `dt_viz.learning.augmented`): it crosses, comes back and winds, and
    draws the figure from other starts, too;
``auto``
    plain, unless a plain fit with the default settings fails or misses a demonstration. Other settings do not change
    the state: who chooses fewer layers, or another objective, sees what these make of the plain motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, Progress, fit
from dt_viz.learning.interface import STATES, AnyImitation, State
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import ImitationError, PreparationSettings, prepare


def learn(
    demonstrations: Sequence[Demonstration],
    settings: ImitationSettings | None = None,
    state: State = "auto",
    labels: Sequence[float] | None = None,
    progress: Progress | None = None,
    plain: Callable[[ImitationSettings], Imitation] | None = None,
    augmented: AugmentedSettings | None = None,
) -> AnyImitation:
    """Learn a stable motion in the state that is asked for.

    Args:
        demonstrations: at least one, all ending at (about) the same place.
        settings: of the plain fit; None takes the defaults.
        state: see the module.
        labels: a number for each demonstration, which makes the state augmented; see `fit_augmented`.
        progress: see `dt_viz.learning.imitation.fit`.
        plain: gives the plain fit with these settings; None fits it here.
        augmented: settings of the augmented state; None takes the defaults.

    Raises:
        ImitationError: nothing can be learned, there is no such state, or the plain state is to have labels.
    """
    if state not in STATES:
        raise ImitationError(f"state: found {state!r}; accepted: {', '.join(STATES)}")
    if state == "plain" and labels is not None:
        raise ImitationError("labels: found some; accepted: none in the plain state")
    settings = settings or ImitationSettings()
    plain = cache(plain or (lambda settings: fit(demonstrations, settings, progress)))
    if state == "plain":
        return plain(settings)
    reason = ""
    if state == "auto" and labels is None:
        reason = why_augmented(demonstrations, plain, settings.preparation)
        if not reason:
            return plain(settings)
    return fit_augmented(demonstrations, labels, augmented, reason)


def why_augmented(
    demonstrations: Sequence[Demonstration],
    plain: Callable[[ImitationSettings], Imitation],
    preparation: PreparationSettings | None = None,
) -> str:
    """Why demonstrations are to be learned in the augmented state; empty where the plain one draws them.

    Args:
        demonstrations: as of `learn`.
        plain: gives the plain fit with these settings.
        preparation: settings of the preparation; None takes the defaults.

    Raises:
        ImitationError: nothing can be learned from the demonstrations, in whichever state.
    """
    settings = ImitationSettings(preparation=preparation or PreparationSettings())
    motions = prepare(demonstrations, settings.preparation)
    try:
        off = motions.missed_by(plain(settings).system, motions.starts)
    except ImitationError as error:
        return f"the plain state fails: {error}"
    return (
        f"the plain state misses a demonstration by {100 * off:.0f} % of the extent"
        if off > settings.max_missed
        else ""
    )
