"""Warnings about results, as values: their kind decides which warning hides which."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

ARM = "Arm"
"""Source of warnings about the shown arm, which are left out while it is hidden."""


class Kind(Enum):
    """Kind of a problem."""

    IMITATION = auto()
    """The demonstrations were not learned as they are."""
    START_COVERED = auto()
    """A motion starts inside an obstacle."""
    GOAL_COVERED = auto()
    """The goal lies inside an obstacle."""
    STAYS_INSIDE = auto()
    """No flow time leads a motion out of an obstacle."""
    ENTERS = auto()
    """A motion enters an obstacle."""
    TOO_NEAR = auto()
    """A motion keeps less than the margin from an obstacle."""
    GOAL_MISSED = auto()
    """The motions end beside the goal."""
    MISPLACED = auto()
    """A transform stands at a place where it has no effect."""
    OFF_PLANE = auto()
    """A bias point of a drawing lies before or behind the drawing's plane."""
    UNREACHED = auto()
    """A transform does not lead every motion to its place."""
    TARGET_MISSED = auto()
    """A motion gives way to an obstacle and passes beside a bias point."""
    UNSAMPLED = auto()
    """The motions are stretched too far to be drawn exactly."""
    OUT_OF_REACH = auto()
    """The arm cannot reach a place."""
    PATH_MISSED = auto()
    """The joints do not lead the hand along its path."""
    NO_WAY = auto()
    """The arm, free at its ends, finds no motion between them that does not touch an obstacle."""
    ARM_BLOCKED = auto()
    """The arm finds no way around an obstacle."""
    ROLLOUT_ENTERS = auto()
    """The arm, avoiding as a whole, enters an obstacle on some rollout."""
    ARM_TOO_NEAR = auto()
    """The arm, avoiding as a whole, keeps less than the margin from an obstacle on some rollout."""
    ARM_ENTERS = auto()
    """The arm that is shown enters an obstacle."""
    ARM_HITS_ITSELF = auto()
    """The arm that is shown touches itself, nearly or indeed."""
    ARM_BELOW_TABLE = auto()
    """The arm that is shown goes through the table."""
    DAMPED = auto()
    """The pseudo-inverse of the arm's Jacobian is damped."""
    FOLDS = auto()
    """A step of an integrator that was chosen by hand folds space."""
    INEXACT_INVERSE = auto()
    """An integrator that was chosen by hand does not come back to where it began."""
    NO_DIFFEOMORPHISM = auto()
    """Certificate: det J is not positive."""
    ROUND_TRIP = auto()
    """Certificate: ψ⁻¹(ψ(y)) is not y."""
    NOT_FALLING = auto()
    """Certificate: the Lyapunov value does not fall."""
    OFF_MOTION = auto()
    """Certificate: the shown motion is no image of the base motion."""


CONSEQUENCES: Mapping[Kind, frozenset[Kind]] = {
    Kind.GOAL_COVERED: frozenset({Kind.GOAL_MISSED}),
    Kind.STAYS_INSIDE: frozenset({Kind.ENTERS}),
    Kind.FOLDS: frozenset({Kind.NO_DIFFEOMORPHISM, Kind.NOT_FALLING}),
    Kind.INEXACT_INVERSE: frozenset({Kind.ROUND_TRIP}),
    Kind.ROLLOUT_ENTERS: frozenset({Kind.ARM_ENTERS}),
}
"""Kinds of warnings that are hidden by a warning of their cause."""


@dataclass(frozen=True)
class MotionWarning:
    """One problem of a result."""

    kind: Kind
    text: str
    """Sentence without capital letter and full stop."""
    source: str = ""
    """Name of the transform concerned, or `ARM`; empty for the motion as a whole."""

    def __str__(self) -> str:
        return self.text


def told(warnings: Iterable[MotionWarning]) -> tuple[MotionWarning, ...]:
    """Return the warnings without repetitions and without consequences of others.

    A consequence has the source of its cause, or concerns the motion as a whole.
    """
    unique = tuple(dict.fromkeys(warnings))
    return tuple(
        warning
        for warning in unique
        if not any(
            warning.kind in CONSEQUENCES.get(cause.kind, ()) and warning.source in {"", cause.source}
            for cause in unique
        )
    )


def in_millimetres(length: float) -> str:
    """Format a length, metres."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"
