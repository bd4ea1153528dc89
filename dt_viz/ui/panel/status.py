"""The status line of the panel, as HTML: figures and warnings of a frame."""

from __future__ import annotations

import html

from dt_viz.arm.collision import SELF_REACH, CollisionReport
from dt_viz.engine.frame import Frame, Stage
from dt_viz.engine.session import Pace
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.ui.scene.palette import css
from dt_viz.ui.scene.picture import Colour
from dt_viz.warning import ARM, Kind

COMPUTING = "Computing the motion…"
CHANGED = "The scene is changed. “Reset” brings it back as it was."
WARP_HINT = "warp at {:.2f}: each flow has run for that part of its time, so nothing is expected to be clear yet"
HAND_ONLY = ": only the path of the hand gives way"
OF_MESHES = frozenset({Kind.ARM_ENTERS, Kind.ARM_HITS_ITSELF, Kind.ARM_BELOW_TABLE})
"""Kinds of warnings about collisions of the arm's meshes."""
BLUE = ((29, 79, 124), (232, 241, 250))
GREEN = ((0, 92, 66), (230, 245, 239))
AMBER = ((138, 75, 0), (255, 244, 224))
RED = ((179, 38, 30), (253, 236, 234))
PALE = "opacity:0.3;filter:grayscale(1)"
TWO_LINES, _WARNING = "2.7em", "2.6em"
SMALL = "font-size:0.8em;line-height:1.35;padding:0.1em 0.9em 0.35em;opacity:0.85"


def hint(frame: Frame) -> str:
    """Return what to try in the task, or what to see in the scene of the paper."""
    scene = SCENES.get(frame.scenario.scene)
    if scene is None:
        return frame.task.hint
    return CHANGED if scene.is_changed(frame.scenario, frame.task) else scene.line


def status_html(frame: Frame, pace: Pace) -> str:
    """Return the status line: speed, clearance, certificates, and every warning."""
    known, scenario = frame.certificates, frame.scenario
    hides_arm = not (scenario.view.arm or scenario.view.onion)
    # figures that are missing after the last stage will not come
    unknown = "–" if frame.blocked or frame.stage is Stage.CERTIFIED else "…"
    off = "–" if frame.blocked else "off"
    whole_arm = scenario.arm_avoidance is not None
    rows = (
        ("Rebuild", _rebuild(pace)),
        ("Clearance", off if frame.blocked else clearance_text(known.clearance, whole_arm=whole_arm)),
        *(collision_rows(None, "arm hidden") if hides_arm else collision_rows(known.collision, unknown)),
        *_duration_rows(frame, off),
        ("Smallest det J", unknown if known.min_det_jacobian is None else f"{known.min_det_jacobian:.2g}"),
        ("There and back", unknown if known.round_trip_error is None else _tiny(known.round_trip_error)),
        ("Lyapunov value", {None: unknown, True: "falls", False: "does not fall"}[known.lyapunov_falls]),
    )
    cells = "".join(
        f"<tr style='vertical-align:top'><td style='opacity:0.65;padding-right:0.9em;white-space:nowrap'>{name}</td>"
        f"<td style='font-weight:600;overflow-wrap:anywhere'>{html.escape(value)}</td></tr>"
        for name, value in rows
    )
    seen = [warning for warning in known.warnings if not (hides_arm and warning.source == ARM)]
    hand_only = scenario.avoids and not whole_arm
    warnings = [f"{w}{HAND_ONLY}" if hand_only and w.kind is Kind.ARM_ENTERS else str(w) for w in seen]
    of_motion = any(warning.kind not in OF_MESHES for warning in seen)
    if known.clearance < 0 and scenario.avoids and scenario.warp == 1 and not (of_motion or frame.blocked):
        warnings.insert(0, "the motions go through the obstacle at this flow time")
    blocked = ""
    if frame.blocked:
        blocked = alarm(f"no motion: {'; '.join(map(str, frame.blocked))}. What is shown is the last good one.", *RED)
    warp = "" if scenario.warp == 1 or frame.blocked else alarm(WARP_HINT.format(scenario.warp), *BLUE)
    said = warp + "".join(alarm(warning, *AMBER) for warning in warnings)
    if not (said or blocked) and frame.stage is Stage.CERTIFIED:
        said = alarm("every check holds", *GREEN)
    # the room for warnings stays during checks, so that controls below do not jump under the pointer
    return f"{blocked}<table style='{SMALL}'>{cells}</table><div style='min-height:{_WARNING}'>{said}</div>"


def _rebuild(pace: Pace) -> str:
    """Describe the speed of rebuilding."""
    rate = f" · {pace.rate:.0f} frames/s" if pace.rate > 1 else ""
    return f"{1e3 * pace.latency:.0f} ms{rate} · {pace.num_skipped} skipped"


def _tiny(length: float) -> str:
    """Format a length, metres, that should be close to zero."""
    return f"{1e3 * length:.0e} mm" if 0 < length < 1e-4 else f"{1e3 * length:.1f} mm"


def clearance_text(clearance: float, *, whole_arm: bool) -> str:
    """Format a clearance, metres, and whose it is."""
    whose = "body points" if whole_arm else "end effector"
    return "no obstacle" if clearance == float("inf") else f"{1e3 * clearance:.1f} mm, {whose}"


def _duration_rows(frame: Frame, off: str) -> tuple[tuple[str, str], ...]:
    """Return the rows with t of the flows: of the avoidance, and of the transforms that call it otherwise."""
    hand, strengths = None, []
    for layer, duration in zip(frame.scenario.stack, frame.durations, strict=False):
        if duration is None:
            continue
        if layer.transform.most == 1:
            hand = duration
        else:
            strengths.append(f"{duration:.2f} {layer.name}")
    both = hand is not None and frame.arm_duration is not None
    parts = ((hand, " hand" if both else ""), (frame.arm_duration, " arm"))
    flow_time = " · ".join(f"{t:.2f}{whose}" for t, whose in parts if t is not None)
    times = (("Flow time t", flow_time or off),) if flow_time or not strengths else ()
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


def alarm(text: str, colour: Colour, background: Colour) -> str:
    """Return a text in a coloured box."""
    return (
        "<div style='font-size:0.8em;margin:0.2em 0.9em 0.5em;padding:0.35em 0.6em;"
        f"border-left:3px solid {css(colour)};color:{css(colour)};background:{css(background)}'>"
        f"{html.escape(sentence(text))}</div>"
    )
