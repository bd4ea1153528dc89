"""The status: one line, one reason in a place of a fixed height, a button that mends it, and all details."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping

import viser

from dt_viz.avoidance.registry import entry_of
from dt_viz.robot.collision import SELF_REACH, CollisionReport
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import Pace, Progress
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.scene.palette import Colour, ink, paper
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.verdict import Verdict, concerns, remedy, shows_arm, verdict
from dt_viz.warning import MotionWarning, Severity, in_millimetres

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
LEADING = 1.35 * 0.8
"""Height of a line of small text, em."""
HINT, REASON, BUTTON = 3.3, 4.5, 2.25
"""Heights of the places of the hint and of the reason, and of a button in the latter, em."""
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
    """Return warnings in boxes of their colour."""
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
    clearance = f"{1e3 * known.clearance:.1f} mm, {'body points' if whole_arm else 'end effector'}"
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


def _duration_rows(frame: Frame, off: str) -> tuple[tuple[str, str], ...]:
    """Return the rows with t of the flows: of the avoidance, and of the transforms that call it otherwise."""
    hand, strengths = None, []
    for layer, duration in zip(frame.scenario.stack, frame.durations, strict=False):
        if duration is None:
            continue
        if entry_of(layer.transform).most == 1:
            hand = duration
        else:
            strengths.append(f"{duration:.2f} {layer.name}")
    flow_time = hand if frame.arm_duration is None else frame.arm_duration
    shown = off if flow_time is None else f"{flow_time:.2f}"
    times = () if flow_time is None and strengths else (("Flow time t", shown),)
    return (*times, *((("Strength", " · ".join(strengths)),) if strengths else ()))


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
    """The controls of the status. They keep their height whatever comes: a button takes its room from the reason's."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build the controls where the panel is being built; the buttons act on the session of the bindings."""
        self._shown: Frame | None = None
        self.line = gui.add_html("")
        self.mend = gui.add_button("Mend", icon=viser.Icon.SHIELD_CHECK, visible=False)
        self.cancel = gui.add_button("Cancel", icon=viser.Icon.X, visible=False)
        with gui.add_folder("Details", expand_by_default=False):
            self.details = gui.add_html("")
        bindings.on(self.cancel, lambda session, _pressed: session.cancel())
        bindings.on(self.mend, lambda session, _pressed: self._mend(session))

    def tell(self, progress: Progress) -> None:
        """Show what is known of what is wanted; called by one thread after the other."""
        known, below = verdict(progress), ""
        text, severity = known.reason, known.severity
        if progress.message is not None:
            text, severity = progress.message.text, progress.message.severity
        if progress.learning is not None:
            (fraction, text), severity = progress.learning, Severity.NOTE
            below = progress_html(fraction)
        self._shown = frame = progress.shown
        mends = None
        if frame is not None and progress.message is None and not progress.stale:
            mends = remedy(frame, progress.wanted)
        if mends is not None:
            self.mend.label = mends.label
        self.mend.visible, self.cancel.visible = mends is not None, progress.learning is not None
        room = REASON - BUTTON if self.mend.visible or self.cancel.visible else REASON
        self.line.content = line_html(known) + place_html(text, COLOURS[severity][0], room, below)
        if frame is not None:
            details = details_html(frame, progress.pace, progress.wanted.view)
            self.details.content = f"<div style='{PALE}'>{details}</div>" if progress.stale else details

    def _mend(self, session: Session) -> None:
        found = None if self._shown is None else remedy(self._shown, session.scenario)
        if found is not None:
            session.step(found.label, **found.changes)
