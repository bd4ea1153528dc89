"""Warnings about results, as values: their kind says how grave they are, what mends them and which ones they hide."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto

ARM = "Arm"  # source of warnings about the shown arm, which are left out while it is hidden


class Severity(Enum):
    """Gravity of a result, or of a message."""

    GOOD = auto()  # every check is made, and holds
    NOTE = auto()  # the warp is on its way, so that the checks say nothing
    WARNING = auto()  # something is not as it should be
    ALARM = auto()  # there is a collision, or no motion


class Concern(Enum):
    """Subject of a problem, with its severity; the gravest first."""

    severity: Severity

    def __new__(cls, words: str, severity: Severity) -> Concern:
        """Take the words alone as the value."""
        concern = object.__new__(cls)
        concern._value_ = words
        concern.severity = severity
        return concern

    COLLISION = "collision", Severity.ALARM
    INEXACT = "not exact", Severity.WARNING
    TOO_CLOSE = "too close", Severity.WARNING
    CAUTION = "caution", Severity.WARNING

    @property
    def gravity(self) -> int:
        """Place among all concerns, 0 for the gravest."""
        return list(Concern).index(self)


class Mend(Enum):
    """Remedy of a problem."""

    INTEGRATION = auto()  # the automatic choice of the integrator, instead of one by hand
    FLOW = auto()  # another flow of the avoidance, or its being switched on
    WHOLE_ARM = auto()  # avoidance by the whole arm


class Kind(Enum):
    """Kind of a problem, with its concern, its remedy if there is one, and the name of the kind that is its cause.

    A warning is hidden by one of its cause. Kinds of the motion come first, then those of the arm, then certificates.
    """

    concern: Concern
    mend: Mend | None
    cause: str

    def __new__(cls, concern: Concern, mend: Mend | None = None, cause: str = "") -> Kind:
        """Number the kinds in their order: several are alike."""
        kind = object.__new__(cls)
        kind._value_ = len(cls.__members__)
        kind.concern, kind.mend, kind.cause = concern, mend, cause
        return kind

    @property
    def of_meshes(self) -> bool:
        """Whether it is about collisions of the meshes of the arm that is shown."""
        return self in {Kind.ARM_ENTERS, Kind.ARM_HITS_ITSELF, Kind.ARM_BELOW_TABLE}

    IMITATION = Concern.CAUTION  # the demonstrations were not learned as they are
    START_COVERED = Concern.CAUTION
    GOAL_COVERED = Concern.CAUTION
    STAYS_INSIDE = Concern.COLLISION, Mend.FLOW  # no flow time leads a motion out of an obstacle
    ENTERS = Concern.COLLISION, Mend.FLOW, "STAYS_INSIDE"
    TOO_NEAR = Concern.TOO_CLOSE, Mend.FLOW  # a motion keeps less than the margin from an obstacle
    GOAL_MISSED = Concern.CAUTION, None, "GOAL_COVERED"
    MISPLACED = Concern.CAUTION  # a transform stands at a place where it has no effect
    OFF_PLANE = Concern.CAUTION
    """A bias point of a drawing lies before or behind the drawing's plane."""
    UNREACHED = Concern.CAUTION  # a transform does not lead every motion to its place
    TARGET_MISSED = Concern.CAUTION
    """A motion gives way to an obstacle and passes beside a bias point."""
    UNSAMPLED = Concern.INEXACT  # the motions are stretched too far to be drawn exactly
    OUT_OF_REACH = Concern.CAUTION
    PATH_MISSED = Concern.CAUTION  # the joints do not lead the hand along its path
    HAND_TURNED = Concern.CAUTION  # the joints do not turn the hand as the motion does
    NO_WAY = Concern.CAUTION
    """The arm, free at its ends, finds no motion between them that does not touch an obstacle."""
    ARM_BLOCKED = Concern.CAUTION  # the arm finds no way around an obstacle
    ROLLOUT_ENTERS = Concern.COLLISION, Mend.FLOW
    """The arm, avoiding as a whole, enters an obstacle on some rollout."""
    ARM_TOO_NEAR = Concern.TOO_CLOSE, Mend.FLOW
    """The arm, avoiding as a whole, keeps less than the margin from an obstacle on some rollout."""
    ARM_ENTERS = Concern.COLLISION, Mend.WHOLE_ARM, "ROLLOUT_ENTERS"
    """The arm that is shown enters an obstacle."""
    ARM_HITS_ITSELF = Concern.TOO_CLOSE
    ARM_BELOW_TABLE = Concern.COLLISION
    DAMPED = Concern.CAUTION  # the pseudo-inverse of the arm's Jacobian is damped
    FOLDS = Concern.INEXACT, Mend.INTEGRATION
    """A step of an integrator that was chosen by hand folds space."""
    INEXACT_INVERSE = Concern.INEXACT, Mend.INTEGRATION
    """An integrator that was chosen by hand does not come back to where it began."""
    NO_DIFFEOMORPHISM = Concern.INEXACT, None, "FOLDS"  # det J is not positive
    ROUND_TRIP = Concern.INEXACT, None, "INEXACT_INVERSE"  # ψ⁻¹(ψ(y)) is not y
    NOT_FALLING = Concern.INEXACT, None, "FOLDS"  # the Lyapunov value does not fall
    OFF_MOTION = Concern.INEXACT  # the shown motion is no image of the base motion


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
        if not any(warning.kind.cause == cause.kind.name and warning.source in {"", cause.source} for cause in unique)
    )


def in_millimetres(length: float) -> str:
    """Format a length, metres."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"


def in_metres(point: Iterable[float]) -> str:
    """Format a place, metres, such as "(0.1, -0.53, 0.15) m"."""
    return f"({', '.join(f'{round(float(x), 6) + 0.0:.3g}' for x in point)}) m"
