"""Why a result is not to be trusted: values, so that what follows from them is decided by their kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

ARM = "Arm"
"""Source of warnings about the arm that is shown, which concern nobody who hides it."""


class Kind(Enum):
    """What is wrong."""

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
    """A transform is where it cannot do what it is for."""
    OFF_PLANE = auto()
    """A bias point of a drawing lies before or behind the drawing's plane."""
    UNREACHED = auto()
    """A transform does not lead every motion where it is to."""
    TARGET_MISSED = auto()
    """A motion gives way to an obstacle and passes beside a bias point."""
    UNSAMPLED = auto()
    """The motions are stretched too far to be drawn exactly."""
    START_LEFT_OUT = auto()
    """The arm cannot begin an added motion."""
    OUT_OF_REACH = auto()
    """The arm cannot reach a place."""
    PATH_MISSED = auto()
    """The joints do not lead the hand along its path."""
    ARM_BLOCKED = auto()
    """The arm finds no way around an obstacle."""
    ROLLOUT_ENTERS = auto()
    """On some rollout the arm, which avoids as a whole, enters an obstacle."""
    ARM_TOO_NEAR = auto()
    """On some rollout the arm, which avoids as a whole, keeps less than the margin from an obstacle."""
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
    """Certificate: what is shown is no image of the base motion."""
    OTHER_ENDS = auto()
    """Certificate: motions do not begin or end where they are to."""
    OTHER_TIMES = auto()
    """Certificate: times are not those of the motion."""
    OTHER_CLEARANCE = auto()
    """Certificate: the clearance is not the one that is said."""
    HAND_BESIDE = auto()
    """Certificate: the hand of the arm is not on its rollout."""
    OTHER_DELAY = auto()
    """Certificate: the arm does not keep its times and velocity limits."""


CONSEQUENCES: Mapping[Kind, frozenset[Kind]] = {
    Kind.GOAL_COVERED: frozenset({Kind.GOAL_MISSED}),
    Kind.STAYS_INSIDE: frozenset({Kind.ENTERS}),
    Kind.FOLDS: frozenset({Kind.NO_DIFFEOMORPHISM, Kind.NOT_FALLING}),
    Kind.INEXACT_INVERSE: frozenset({Kind.ROUND_TRIP}),
    Kind.PATH_MISSED: frozenset({Kind.HAND_BESIDE}),
    Kind.ROLLOUT_ENTERS: frozenset({Kind.ARM_ENTERS}),
}
"""Kinds of warnings that say no more once their cause is said."""


@dataclass(frozen=True)
class MotionWarning:
    """One reason why a result is not to be trusted."""

    kind: Kind
    text: str
    """A whole sentence without capital letter and full stop."""
    source: str = ""
    """Name of the transform that it is about, or `ARM`; empty if it is about the motion as a whole."""

    def __str__(self) -> str:
        return self.text


def told(warnings: Iterable[MotionWarning]) -> tuple[MotionWarning, ...]:
    """The warnings that are to be told: each once, and none that is a consequence of another.

    A consequence is about what its cause is about, or about the motion as a whole.
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
    """A length in metres, in words."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"
