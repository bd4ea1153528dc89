"""The status: a line of figures, the one reason against it that matters most, what mends that, and all details."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import viser

from dt_viz.avoidance.registry import entry_of
from dt_viz.robot.collision import SELF_REACH, CollisionReport
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import (
    WHOLE_ARM,
    avoidance_layer,
    avoiding_with,
    transform_of,
    with_avoidance,
    with_transform,
)
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import Message, Pace, Progress
from dt_viz.session.session import Session
from dt_viz.ui import patches
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.scene.palette import Colour, ink, paper
from dt_viz.ui.tabs.plots import small
from dt_viz.warning import ARM, Kind, Mend, MotionWarning, Severity, in_millimetres

CHANGED = "The scene is changed. “Reset” brings it back as it was."
COLOURS: Mapping[Severity | None, tuple[Colour, Colour]] = {
    None: ((84, 88, 96), (240, 242, 245)),
    Severity.GOOD: ((0, 92, 66), (230, 245, 239)),
    Severity.NOTE: ((29, 79, 124), (232, 241, 250)),
    Severity.WARNING: ((138, 75, 0), (255, 244, 224)),
    Severity.ALARM: ((179, 38, 30), (253, 236, 234)),
}
"""Ink and paper of each severity, and those of what is not known yet."""
PALE = "opacity:0.3;filter:grayscale(1)"
LEADING = 1.35 * 0.8  # height of a line of small text, em
HINT, REASON, BUTTON = 3.3, 4.5, 2.25
"""Heights of the places of the hint and of the reason, and of a button in the latter, em."""
DETAILS = 11  # largest height of the details, em: on a laptop the tabs below them stay in sight
ROWS: Mapping[str, str] = {
    "Rebuild": "Time from the last change until its motion was shown. Changes that a newer one overtook are skipped.",
    "Clearance": "Smallest distance from the obstacles of what gives way to them: the end effector, or the body points "
    "(spheres that cover the arm).",
    "Arm to obstacle": "Smallest distance of the arm’s surface from the obstacles, and which part of the arm it is.",
    "Arm to itself": "Smallest distance between two parts of the arm that are not neighbours.",
    "Arm to table": "Smallest height of the moving parts of the arm above the table.",
    "Hand turned": "Angle of the arm’s hand from the orientations of the motion: the median along it, and the largest.",
    "Flow time t": "How long the flow of the avoidance runs: the longer, the more the motions give way.",
    "Strength": "How long the flow of each bias point runs: the longer, the more the motions are pulled to it.",
    "Smallest det J": "Volume that the transforms leave of a piece of space where they squeeze it most. Above 0, space "
    "is not folded: the map is a diffeomorphism.",
    "Round trip": "How far a place of the motions is missed by the transforms and then their inverses, at most.",
    "Lyapunov value": "A value like the height in a valley whose lowest point is the goal. While it falls, the motion "
    "is stable.",
}
"""Rows of the details, with their tooltips."""
COMPUTING = "computing …"
HOLDS = (
    "Every check holds: the motions clear the obstacles, space does not fold (det J > 0), the inverse is exact, and "
    "the Lyapunov value falls along every motion."
)
WARP_HINT = "at warp {:.2f} each flow has run for that part of its time, so nothing is expected to be clear yet"


@dataclass(frozen=True)
class Verdict:
    """What the status says."""

    line: str  # one line of figures, such as "✓ safe · 9 mm · stable · 12 ms"
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
    if progress.wanted == progress.restored:
        figures += ("as saved",)
    elif latency > 0:
        figures += (f"{1e3 * latency:.0f} ms" if latency < 1 else f"{latency:.1f} s",)
    head, severity, reason = _judged(frame, concerns(frame, view))
    if not progress.complete:
        # a warning that is known stays in view; whether all checks hold is not known
        head, reason = COMPUTING, "" if severity is Severity.GOOD else reason
    return Verdict(" · ".join((head, *figures)), severity, reason, busy=not progress.complete)


def _judged(frame: Frame, found: tuple[MotionWarning, ...]) -> tuple[str, Severity, str]:
    if frame.blocked:
        why = "; ".join(map(str, frame.blocked))
        return "✕ no motion", Severity.ALARM, f"{why}. What is shown is the last good motion."
    if frame.scenario.warp < 1:
        return f"warp {frame.scenario.warp:.2f}", Severity.NOTE, WARP_HINT.format(frame.scenario.warp)
    if not found:
        return "✓ safe", Severity.GOOD, HOLDS
    concern = found[0].kind.concern
    more = f" (and {len(found) - 2} more: see Details)" if len(found) > 2 else ""
    mark = "✕" if concern.severity is Severity.ALARM else "⚠"
    return f"{mark} {concern.value}", concern.severity, f"{'; '.join(map(str, found[:2]))}{more}"


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

    label: str  # label of its button
    changes: Mapping[str, Any] | None
    """Fields of the scenario that it replaces; None where it takes the last step back."""


UNDO = Remedy("Undo the last change", None)


def remedy(frame: Frame, progress: Progress) -> Remedy | None:
    """Return what mends the gravest problem of the newest frame; None if nothing does, or other motions are wanted."""
    wanted = progress.wanted
    if frame.scenario.choices != wanted.choices:
        return None
    if wanted.warp < 1 and not frame.blocked:
        return Remedy("Complete the warp", {"warp": 1.0})
    found = concerns(frame, wanted.view)
    mends = None if frame.blocked or not found else _against(found[0].kind.mend, found[0].source, wanted)
    if mends is not None or progress.beside is not None or not (frame.blocked or found):
        return mends
    if progress.steps[0]:
        return UNDO
    blocks = frame.blocked and wanted.avoidance.obstacles  # after a reload there is no step back
    return Remedy("Take the obstacles away", {"stack": with_avoidance(wanted, obstacles=())}) if blocks else None


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


def hint(frame: Frame) -> str:
    """Return what to try in the task, or what to see in the scene of the paper."""
    scene = SCENES.get(frame.scenario.scene)
    if scene is None:
        return frame.task.hint
    return CHANGED if scene.is_changed(frame.scenario, frame.task) else scene.line


def line_html(verdict: Verdict) -> str:
    """Return the one line of figures, in the colour of its gravity."""
    text, pale = COLOURS[None if verdict.busy else verdict.severity]
    return (
        f"<div role='status' style='margin:0.2em 0.7em 0.3em;padding:0 0.6em;height:2em;line-height:2em;"
        f"font-size:0.85em;font-weight:600;white-space:nowrap;overflow:hidden;text-overflow:ellipsis;"
        f"border-left:3px solid {ink(text)};color:{ink(text)};background:{paper(pale, text)}'>"
        f"{html.escape(verdict.line)}</div>"
    )


def place_html(text: str, colour: Colour, height: float, below: str = "") -> str:
    """Return a text in a place of a fixed height, em, with HTML below it; a tooltip has all of a text that is long."""
    said = html.escape(sentence(text))
    clamp = f"display:-webkit-box;-webkit-box-orient:vertical;-webkit-line-clamp:{int(height / LEADING) or 1}"
    return (
        f"<div style='height:{height:.3f}em;overflow:hidden;margin:0 0.9em'>"
        f"<div title='{html.escape(text)}' style='font-size:0.8em;line-height:1.35;color:{ink(colour)};overflow:hidden;"
        f"{clamp}'>{said}</div>{below}</div>"
    )


def hint_html(text: str) -> str:
    """Return the hint in its place."""
    return place_html(text, (40, 44, 52), HINT)


def progress_html(fraction: float) -> str:
    """Return a bar of progress, from 0 to 1."""
    full, pale = COLOURS[Severity.NOTE]
    return (
        f"<div style='height:0.35em;margin-top:0.25em;border-radius:2px;background:{paper(pale, full)}'>"
        f"<div style='height:100%;width:{100 * fraction:.0f}%;border-radius:2px;background:{ink(full)}'></div></div>"
    )


def details_html(frame: Frame, pace: Pace, view: View) -> str:
    """Return all figures and warnings of a frame: a table whose rows explain themselves, above all that is told."""
    cells = "".join(
        f"<tr style='vertical-align:top' title='{html.escape(ROWS[name])}'>"
        f"<td style='opacity:0.65;padding-right:0.9em;white-space:nowrap'>{name}</td>"
        f"<td style='font-weight:600;overflow-wrap:anywhere'>{html.escape(value)}</td></tr>"
        for name, value in _rows(frame, pace, view)
    )
    # a place of its own height: warnings that come and go move nothing below them
    warnings = _boxes(frame.blocked, Severity.ALARM) + _boxes(concerns(frame, view), Severity.WARNING)
    return small(f"<table>{cells}</table>") + f"<div style='height:5.2em;overflow-y:auto'>{warnings}</div>"


def _boxes(warnings: tuple[MotionWarning, ...], severity: Severity) -> str:
    colour, background = COLOURS[severity]
    return "".join(
        "<div style='font-size:0.8em;margin:0.2em 0.9em 0.5em;padding:0.35em 0.6em;"
        f"border-left:3px solid {ink(colour)};color:{ink(colour)};background:{paper(background, colour)}'>"
        f"{html.escape(sentence(str(warning)))}</div>"
        for warning in warnings
    )


def _rows(frame: Frame, pace: Pace, view: View) -> Iterator[tuple[str, str]]:
    known = frame.certificates
    # figures that are missing after the last stage will not come
    unknown = "–" if frame.blocked or frame.stage is Stage.CERTIFIED else "…"
    off = "–" if frame.blocked else "off"
    whole_arm = frame.scenario.arm_avoidance is not None
    rate = f" · {pace.rate:.0f} frames/s" if pace.rate > 1 else ""
    yield "Rebuild", f"{1e3 * pace.latency:.0f} ms{rate} · {pace.num_skipped} skipped"
    clearance = f"{1e3 * known.clearance:.1f} mm, {'body points' if whole_arm else 'end effector'}, all motions"
    yield "Clearance", off if frame.blocked else "no obstacle" if known.clearance == float("inf") else clearance
    if shows_arm(view):
        yield from collision_rows(known.collision, unknown)
        if frame.has_orientation:
            turn = known.turn
            yield "Hand turned", unknown if turn is None else f"{turn.median:.1f}°, at most {turn.largest:.0f}°"
    yield from _duration_rows(frame, off)
    yield "Smallest det J", unknown if known.min_det_jacobian is None else f"{known.min_det_jacobian:.2g}"
    yield "Round trip", unknown if known.round_trip_error is None else error_text(known.round_trip_error)
    yield "Lyapunov value", {None: unknown, True: "falls", False: "does not fall"}[known.lyapunov_falls]


def error_text(length: float) -> str:
    """Format a length, metres, that should be zero: rounding is exact."""
    if length < 1e-12:  # metres
        return "exact"
    return "< 0.001 mm" if length < 1e-6 else in_millimetres(length)


def _duration_rows(frame: Frame, off: str) -> Iterator[tuple[str, str]]:
    """Yield the rows with t of the flows: of the avoidance, and of the transforms that call it otherwise."""
    strengths, times, flow_time = [], frame.durations, frame.durations.get(WHOLE_ARM)
    for layer in frame.scenario.stack:
        if layer.name in times and entry_of(layer.transform).most > 1:
            strengths.append(f"{times[layer.name]:.2f} {layer.name}")
        elif flow_time is None:
            flow_time = times.get(layer.name)
    if flow_time is not None or not strengths:
        yield "Flow time t", off if flow_time is None else f"{flow_time:.2f}"
    if strengths:
        yield "Strength", " · ".join(strengths)


def collision_rows(report: CollisionReport | None, unknown: str) -> tuple[tuple[str, str], ...]:
    """Return the rows about the collisions of the arm's meshes."""
    if report is None:
        obstacle = itself = table = unknown
    else:
        obstacle = "no obstacle"
        if report.obstacle.links:
            obstacle = _distance(report.obstacle.distance, "enters by", report.obstacle.links)
        itself = f"over {1e3 * SELF_REACH:.0f} mm"
        if report.itself is not None:
            itself = _distance(report.itself.distance, "touches", report.itself.links)
        table = _distance(report.table.distance, "below by", report.table.links)
    return ("Arm to obstacle", obstacle), ("Arm to itself", itself), ("Arm to table", table)


def _distance(distance: float, otherwise: str, links: tuple[str, ...]) -> str:
    """Format a distance, metres, and its links; `otherwise` is the word for a negative one."""
    size = f"{1e3 * abs(distance):.0f} mm"
    if distance <= 0:
        size = f"{otherwise} {size}" if distance < 0 else otherwise
    return f"{size}, {' – '.join(links)}"


def sentence(text: str) -> str:
    """Begin a text with a capital letter, unless it begins with the name of a file."""
    return text if "." in text.split(" ", 1)[0] else text[:1].upper() + text[1:]


class StatusLine:
    """The controls of the status, and the style of the buttons after them, see `patches.steps_html`.

    They keep their height whatever comes: a button takes its room from the reason's.
    """

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build the controls where the panel is being built; the buttons act on the session of the bindings."""
        self._told: Progress | None = None
        self.judgement = ""
        """What is known of what is shown, as HTML, without what only its visitor is told."""
        self.line = gui.add_html("")
        self.mend = gui.add_button("Mend", icon=viser.Icon.SHIELD_CHECK, visible=False)
        self.cancel = gui.add_button("Cancel", icon=viser.Icon.X, visible=False)
        with gui.add_folder("Details", expand_by_default=False):
            self.details = gui.add_html("")
        self.steps = gui.add_html(patches.steps_html((False, False)))
        bindings.on(self.cancel, lambda session, _pressed: session.cancel())
        bindings.on(self.mend, lambda session, _pressed: self._mend(session))

    @property
    def message(self) -> Message | None:
        """The message that was told last; None if none was, or it has passed."""
        return None if self._told is None else self._told.message

    def tell(self, progress: Progress) -> None:
        """Show what is known of what is wanted; called by one thread after the other."""
        known, below = verdict(progress), ""
        text, severity = known.reason, known.severity
        self.judgement = line_html(known) + place_html(text, COLOURS[severity][0], REASON)
        if progress.message is not None:
            text, severity = progress.message.text, progress.message.severity
        if progress.learning is not None:
            (fraction, text), severity = progress.learning, Severity.NOTE
            below = progress_html(fraction)
        self._told, frame = progress, progress.shown
        self.steps.content = patches.steps_html(progress.steps if progress.beside is None else progress.beside)
        mends = None
        if frame is not None and progress.message is None and not progress.stale:
            mends = remedy(frame, progress)
        if mends is not None:
            self.mend.label = mends.label
        self.mend.visible, self.cancel.visible = mends is not None, progress.learning is not None
        room = REASON - BUTTON if self.mend.visible or self.cancel.visible else REASON
        self.line.content = line_html(known) + place_html(text, COLOURS[severity][0], room, below)
        if frame is not None:
            details = details_html(frame, progress.pace, progress.wanted.view)
            details = f"<div style='max-height:{DETAILS}em;overflow-y:auto'>{details}</div>"
            self.details.content = f"<div style='{PALE}'>{details}</div>" if progress.stale else details

    def _mend(self, session: Session) -> None:
        told = self._told
        if told is None or told.shown is None:
            return
        found = remedy(told.shown, replace(told, wanted=session.scenario))
        if found is UNDO:
            session.undo()
        elif found is not None and found.changes is not None:
            session.step(found.label, **found.changes)
