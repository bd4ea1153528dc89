"""Verdict on what is shown: a line of figures, the one reason against it that matters most, and what mends that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import avoidance_layer, avoiding_with, transform_of, with_avoidance, with_transform
from dt_viz.session.frame import Frame
from dt_viz.session.progress import Progress
from dt_viz.warning import ARM, Kind, Mend, MotionWarning, Severity

COMPUTING = "computing …"
HOLDS = (
    "Every check holds: the motions clear the obstacles, space does not fold (det J > 0), the inverse is exact, and "
    "the Lyapunov value falls along every motion."
)
WARP_HINT = "at warp {:.2f} each flow has run for that part of its time, so nothing is expected to be clear yet"


@dataclass(frozen=True)
class Verdict:
    """What the status says."""

    line: str
    """One line of figures, such as "✓ safe · 9 mm · stable · 12 ms"."""
    severity: Severity = Severity.GOOD
    reason: str = ""
    """The one reason that matters most, or that every check holds; empty while that is not known."""
    busy: bool = False
    """Whether something is being computed, so that the severity is not the last word."""


FAILED = Verdict("✕ not computed", Severity.ALARM)
"""Verdict where something has failed before all was known."""


def verdict(progress: Progress) -> Verdict:
    """Return the verdict on what is shown, as far as it is what is wanted."""
    if progress.learning is not None:
        return Verdict(f"learning the motion … {100 * progress.learning[0]:.0f} %", busy=True)
    if progress.failed and not progress.complete:
        return FAILED
    frame, view = progress.shown, progress.wanted.view
    if frame is None or progress.stale:
        return Verdict(COMPUTING, busy=True)
    known, latency = frame.certificates, progress.pace.latency
    figures = () if frame.blocked else (_clearance_text(frame, view),)
    if known.lyapunov_falls is not None:
        figures += ("stable" if known.lyapunov_falls else "not stable",)
    figures += (f"{1e3 * latency:.0f} ms" if latency < 1 else f"{latency:.1f} s",)
    head, severity, reason = _judged(frame, concerns(frame, view))
    if not progress.complete:
        # a warning that is known stays in view; whether all checks hold is not known
        head, reason = COMPUTING, "" if severity is Severity.GOOD else reason
    return Verdict(" · ".join((head, *figures)), severity, reason, busy=not progress.complete)


def _judged(frame: Frame, found: tuple[MotionWarning, ...]) -> tuple[str, Severity, str]:
    """Return the head of the line, the severity, and the reason."""
    if frame.blocked:
        why = "; ".join(map(str, frame.blocked))
        return "✕ no motion", Severity.ALARM, f"{why}. What is shown is the last good motion."
    if frame.scenario.warp < 1:
        return f"warp {frame.scenario.warp:.2f}", Severity.NOTE, WARP_HINT.format(frame.scenario.warp)
    if not found:
        return "✓ safe", Severity.GOOD, HOLDS
    gravest, *others = found
    concern = gravest.kind.concern
    more = f" (and {len(others)} more: see Details)" if others else ""
    mark = "✕" if concern.severity is Severity.ALARM else "⚠"
    return f"{mark} {concern.value}", concern.severity, f"{gravest}{more}"


def concerns(frame: Frame, view: View) -> tuple[MotionWarning, ...]:
    """Return the warnings about a frame, the gravest first, without those about an arm that is hidden."""
    known, scenario = frame.certificates, frame.scenario
    hidden = not shows_arm(view)
    found = [warning for warning in known.warnings if not (hidden and warning.source == ARM)]
    of_motion = any(not warning.kind.of_meshes for warning in found)
    if known.clearance < 0 and scenario.warp == 1 and not (of_motion or frame.blocked):
        kind = Kind.ENTERS if clearance(frame, view) < 0 else Kind.TOO_NEAR
        why = " at this flow time" if scenario.avoids else ": nothing avoids it"
        found.append(MotionWarning(kind, f"the motions go through the obstacle{why}"))
    if scenario.avoids and scenario.arm_avoidance is None:
        hand = "only the path of the hand gives way"
        found = [replace(w, text=f"{w.text}: {hand}") if w.kind is Kind.ARM_ENTERS else w for w in found]
    return tuple(sorted(found, key=lambda warning: warning.kind.concern.gravity))


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


@dataclass(frozen=True)
class Remedy:
    """An edit that mends something."""

    label: str
    """Label of its button."""
    changes: Mapping[str, Any]
    """Fields of the scenario that it replaces."""


def remedy(frame: Frame, wanted: Scenario) -> Remedy | None:
    """Return what mends the gravest problem of the newest frame; None if nothing does, or other motions are wanted."""
    if frame.blocked or frame.scenario.choices != wanted.choices:
        return None
    if wanted.warp < 1:
        return Remedy("Complete the warp", {"warp": 1.0})
    found = concerns(frame, wanted.view)
    return _against(found[0].kind.mend, found[0].source, wanted) if found else None


def _against(mend: Mend | None, source: str, scenario: Scenario) -> Remedy | None:
    whole, avoidance = scenario.view.arm, scenario.avoidance
    enters = mend is Mend.WHOLE_ARM and scenario.arm_avoidance is None and whole
    if enters or (mend is Mend.FLOW and not avoidance_layer(scenario).on):
        label = "Let the whole arm avoid" if whole else "Let the hand avoid"
        return Remedy(label, {"stack": avoiding_with(scenario, "cspace" if whole else "task")})
    # what was chosen by hand is left to the automatic choice
    if mend is Mend.FLOW and avoidance.duration is not None:
        return Remedy("Choose the flow time automatically", {"stack": with_avoidance(scenario, duration=None)})
    if mend is Mend.INTEGRATION or (mend is Mend.FLOW and avoidance.integration.by_hand):
        name = source if mend is Mend.INTEGRATION else avoidance_layer(scenario).name
        transform: Any = transform_of(scenario, name)
        automatic = replace(transform, integration=replace(transform.integration, method="auto"))
        return Remedy("Integrate automatically", {"stack": with_transform(scenario, name, automatic)})
    if mend is Mend.FLOW and avoidance.generator == "probability":
        return Remedy("Use the free-space generator", {"stack": with_avoidance(scenario, generator="free-space")})
    return None
