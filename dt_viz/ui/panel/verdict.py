"""Verdict on a frame: a line of figures, and the one reason against it that matters most."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from dt_viz.scenario.scenario import Scenario, View
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.session import Pace
from dt_viz.warning import ARM, Kind, MotionWarning

COMPUTING = "computing …"
HOLDS = (
    "Every check holds: the motions clear the obstacles, space does not fold (det J > 0), the inverse is exact, and "
    "the Lyapunov value falls along every motion."
)
WARP_HINT = "at warp {:.2f} each flow has run for that part of its time, so nothing is expected to be clear yet"
HAND_ONLY = ": only the path of the hand gives way"
NOT_AVOIDED = "the motions go through the obstacle: nothing avoids it"
TOO_SHORT = "the motions go through the obstacle at this flow time"
OF_MESHES = frozenset({Kind.ARM_ENTERS, Kind.ARM_HITS_ITSELF, Kind.ARM_BELOW_TABLE})
"""Kinds of warnings about collisions of the arm's meshes."""


class Level(Enum):
    """Gravity of a verdict."""

    GOOD = auto()
    """Every check is made, and holds."""
    NOTE = auto()
    """The warp is on its way, so that the checks say nothing."""
    WARNING = auto()
    """Something is not as it should be."""
    ALARM = auto()
    """There is a collision, or no motion."""


@dataclass(frozen=True)
class _Concern:
    """Kinds of warnings that are told alike."""

    head: str
    level: Level
    kinds: frozenset[Kind] = frozenset()


CONCERNS = (
    _Concern(
        "✕ collision",
        Level.ALARM,
        frozenset({Kind.STAYS_INSIDE, Kind.ENTERS, Kind.ROLLOUT_ENTERS, Kind.ARM_ENTERS, Kind.ARM_BELOW_TABLE}),
    ),
    _Concern(
        "⚠ not exact",
        Level.WARNING,
        frozenset(
            {
                Kind.FOLDS,
                Kind.INEXACT_INVERSE,
                Kind.NO_DIFFEOMORPHISM,
                Kind.ROUND_TRIP,
                Kind.NOT_FALLING,
                Kind.OFF_MOTION,
                Kind.UNSAMPLED,
            }
        ),
    ),
    _Concern("⚠ too close", Level.WARNING, frozenset({Kind.TOO_NEAR, Kind.ARM_TOO_NEAR, Kind.ARM_HITS_ITSELF})),
    _Concern("⚠ caution", Level.WARNING),
)
"""Concerns, the gravest first; the last one takes all other kinds."""


@dataclass(frozen=True)
class Verdict:
    """What the status says of a frame."""

    line: str
    """One line of figures, such as "✓ safe · 9 mm · stable · 12 ms"."""
    level: Level = Level.GOOD
    reason: str = ""
    """The one reason that matters most, or that every check holds; empty while that is not known."""
    busy: bool = False
    """Whether something is being computed, so that the level is not the last word."""


BUSY = Verdict(COMPUTING, busy=True)
"""Verdict while nothing is known yet."""
FAILED = Verdict("✕ not computed", Level.ALARM)
"""Verdict where something has failed before all was known."""


def verdict(frame: Frame, pace: Pace, adopted: Scenario) -> Verdict:
    """Return the verdict on a frame.

    Args:
        frame: the newest frame.
        pace: how rebuilding goes.
        adopted: the scenario that is wanted now. Its view says whether the arm is shown; where it asks for more than
            the frame has, the figures are those of a moment ago.
    """
    known, settled = frame.certificates, frame.stage is Stage.CERTIFIED and adopted.computes_like(frame.scenario)
    figures = () if frame.blocked else (_clearance_text(frame, adopted.view),)
    if known.lyapunov_falls is not None:
        figures += ("stable" if known.lyapunov_falls else "not stable",)
    figures += (f"{1e3 * pace.latency:.0f} ms" if pace.latency < 1 else f"{pace.latency:.1f} s",)
    told = concerns(frame, adopted.view)
    if frame.blocked:
        head, level = "✕ no motion", Level.ALARM
        reason = f"{'; '.join(map(str, frame.blocked))}. What is shown is the last good motion."
    elif frame.scenario.warp < 1:
        head, level, reason = f"warp {frame.scenario.warp:.2f}", Level.NOTE, WARP_HINT.format(frame.scenario.warp)
    elif told:
        concern = CONCERNS[_gravity(told[0])]
        head, level, reason = concern.head, concern.level, str(told[0])
        more = len(told) - 1
        reason += f" (and {more} more: see Details)" if more else ""
    else:
        head, level, reason = "✓ safe", Level.GOOD, HOLDS
    if not settled:
        # a warning that is known stays in view; whether all checks hold is not known
        head, reason = COMPUTING, "" if level is Level.GOOD else reason
    return Verdict(" · ".join((head, *figures)), level, reason, busy=not settled)


def concerns(frame: Frame, view: View) -> tuple[MotionWarning, ...]:
    """Return what is to be told of a frame without saying anything about an arm that is hidden, the gravest first."""
    known, scenario = frame.certificates, frame.scenario
    hidden = not shows_arm(view)
    told = [warning for warning in known.warnings if not (hidden and warning.source == ARM)]
    of_motion = any(warning.kind not in OF_MESHES for warning in told)
    if known.clearance < 0 and scenario.warp == 1 and not (of_motion or frame.blocked):
        kind = Kind.ENTERS if clearance(frame, view) < 0 else Kind.TOO_NEAR
        told.append(MotionWarning(kind, TOO_SHORT if scenario.avoids else NOT_AVOIDED))
    if scenario.avoids and scenario.arm_avoidance is None:
        told = [_of_hand(warning) if warning.kind is Kind.ARM_ENTERS else warning for warning in told]
    return tuple(sorted(told, key=_gravity))


def shows_arm(view: View) -> bool:
    """Return whether an arm is drawn, so that something is to be said about it."""
    return view.arm or view.onion


def clearance(frame: Frame, view: View) -> float:
    """Return the clearance of what is shown, metres: of the arm's meshes where it is known, or else of what avoids."""
    known = frame.certificates
    meshes = known.collision if shows_arm(view) else None
    return known.clearance if meshes is None else meshes.obstacle.distance


def _clearance_text(frame: Frame, view: View) -> str:
    distance = clearance(frame, view)
    return "no obstacle" if distance == float("inf") else f"{1e3 * distance:.0f} mm".replace("-", "−")


def _gravity(warning: MotionWarning) -> int:
    """Return the index of the warning's concern."""
    return next((k for k, concern in enumerate(CONCERNS) if warning.kind in concern.kinds), len(CONCERNS) - 1)


def _of_hand(warning: MotionWarning) -> MotionWarning:
    return MotionWarning(warning.kind, warning.text + HAND_ONLY, warning.source)
