"""Plots and small texts of the panel: joint angles and speeds over time, and what is told along the path."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import Profiles
from dt_viz.robot.robot import Robot
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.palette import Colour, css
from dt_viz.ui.scene.picture import Following

SAVE = "Save data"  # label of the buttons that save them


def table_csv(table: Mapping[str, Sequence[object] | Array]) -> bytes:
    """Return a table as CSV: columns (N,) of numbers or texts by their heads, numbers with nine digits."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*table.values(), strict=True):
        writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])
    return file.getvalue().encode()


def joints_table(motion: ArmMotion, robot: Robot) -> dict[str, Array]:
    """Return the angles and the speeds of a motion's joints, at its own samples; speeds are those until the next."""
    speeds = np.diff(motion.q, axis=0) / np.maximum(np.diff(motion.times), 1e-9)[:, None]
    columns: dict[str, Array] = {"time_s": motion.times}
    columns |= {f"{name}_deg": angles for name, angles in zip(robot.joint_names, np.degrees(motion.q).T, strict=True)}
    used = 100 * np.vstack([np.abs(speeds) / robot.velocity_limits, np.zeros((1, robot.num_joints))])
    return columns | {f"{name}_speed_percent": speed for name, speed in zip(robot.joint_names, used.T, strict=True)}


def path_table(profiles: Profiles) -> dict[str, Array]:
    """Return how the shown motion, and the one without behaviours, fare along the path, from 0 to 1."""
    columns: dict[str, Array] = {"path": profiles.along}
    for suffix, profile in (("", profiles.shown), ("_without", profiles.undisturbed)):
        columns[f"lyapunov{suffix}"] = profile.lyapunov
        columns[f"distance_mm{suffix}"] = 1e3 * profile.distance
        columns[f"clearance_mm{suffix}"] = 1e3 * profile.clearance
    return columns


NUM_SAMPLES, RATE = 80, 10
"""Number of samples of a curve over time, few enough to be sent during a drag, and of a long one for each second."""
LARGE = 1.4  # factor by which plots in windows of their own are higher
WIDTH, BESIDE = 560.0, -350.0
"""Width of these windows, and their place from the right, where the panel is, CSS pixels."""
LEFT, RIGHT = 42, 12  # room beside the curves of a plot, CSS pixels
Axis = Literal["time", "path"]
ACROSS: Mapping[Axis, str] = {"time": "t [s]", "path": "path"}  # names of what is across the plots
MAX_SPEED = 200
"""Largest speed in the plot, percent of the joint's limit: a joint that leaps would flatten all other curves."""


def small(text: str, *, tight: bool = False) -> str:
    """Return HTML as small text, with the margins of the controls, or `tight` above what it is about."""
    room = (
        "0.75em;line-height:1.3;padding:0.2em 0.9em 0" if tight else "0.8em;line-height:1.4;padding:0.1em 0.9em 0.4em"
    )
    return f"<div style='font-size:{room};opacity:0.85'>{text}</div>"


def add_plot(
    gui: viser.GuiApi, title: str, axis: Axis, curves: Sequence[uplot.Series], height: float
) -> viser.GuiUplotHandle:
    """Add an empty plot of curves below its title, which is HTML, where the panel is being built.

    It is marked at the moment that `cursor_html` tells.
    """
    if title:
        gui.add_html(small(title, tight=True))
    place = f"visibility:var(--dt-{axis}-seen,hidden);left:calc({LEFT}px + (100% - {LEFT + RIGHT}px)*var(--dt-{axis}))"
    line = f"position:absolute;{place};top:16px;height:{height - 32}px;border-left:2px solid {css(palette.LIGHT.way)}"
    gui.add_html(f"<div style='position:relative;z-index:1;height:0'><div style='{line}'></div></div>")
    font = "11px sans-serif"
    return gui.add_uplot(
        (np.zeros(2),) * (1 + len(curves)),
        (uplot.Series(label=ACROSS[axis]), *curves),
        scales={"x": {"time": False}},
        axes=({"size": 26, "space": 40, "font": font}, {"size": LEFT, "space": 24, "font": font}),
        legend={"show": False},
        cursor={"drag": {"x": False, "y": False}},
        height=round(height),
        padding=(6, RIGHT, 0, 0),
    )


def cursor_html(**places: float | None) -> str:
    """Return the style that marks plots at a part of each `Axis`, from 0 to 1, or not where that is None."""
    marks = (
        f"--dt-{axis}:{place:.4f};--dt-{axis}-seen:visible;" for axis, place in places.items() if place is not None
    )
    return f"<style>:root{{{''.join(marks)}}}</style>"


def add_container(gui: viser.GuiApi, title: str, *, large: bool) -> tuple[Any, Any]:
    """Add a folder, or a window over the scene, hidden; return what shows it, and what its content is built in."""
    if not large:
        folder = gui.add_folder(title, visible=False)
        return folder, folder
    panel = gui.add_panel(visible=False)
    panel.float(x=BESIDE, y=15, width=WIDTH)
    return panel, panel.add_tab(title)


def curve(label: str, colour: Colour, *, width: float = 2, dashed: bool = False) -> uplot.Series:
    """Return a curve of a plot."""
    dash: dict[str, Any] = {"dash": (5, 4)} if dashed else {}
    return uplot.Series(label=label, stroke=css(colour), width=width, points={"show": False}, **dash)


def columns(*arrays: Array) -> tuple[NDArray[np.float64], ...]:
    """Split arrays (N,) and (N, k) into the columns that uPlot takes."""
    return tuple(np.column_stack(arrays).T.astype(np.float64))


def legend(marks: Mapping[str, str], height: str, heading: str = "", note: str = "") -> str:
    """Return a legend in one row: texts, each with the style of its mark, which is as high as a style says."""
    mark = f"<span style='display:inline-block;width:1.2em;height:{height};vertical-align:middle;margin-right:0.3em"
    items = "".join(
        f"<span style='white-space:nowrap;margin-right:0.8em'>{mark};{style}'></span>{text}</span>"
        for text, style in marks.items()
    )
    return small(f"{heading and _pale(heading + ' ')}{items}{note and '<br/>' + _pale(note)}", tight=True)


def _pale(text: str) -> str:
    return f"<span style='opacity:0.65'>{text}</span>"


@dataclass(frozen=True)
class JointCurves:
    """Curves of the plots of the joints."""

    times: Array  # (N,) even times, seconds
    angles: Array  # (N, n) joint angles, degrees, unwrapped
    speeds: Array  # (N, n) joint speeds, percent of the velocity limits


def joint_curves(motion: ArmMotion, robot: Robot) -> JointCurves:
    """Compute the curves; a speed is the largest around its moment, so that no peak is lost between two samples."""
    num = max(NUM_SAMPLES, round(RATE * float(motion.times[-1] - motion.times[0])))
    times = np.linspace(motion.times[0], motion.times[-1], num)
    angles = np.stack([np.interp(times, motion.times, angle) for angle in np.degrees(motion.q).T], axis=1)
    steps = np.maximum(np.diff(motion.times), 1e-9)
    used = 100 * np.abs(np.diff(motion.q, axis=0)) / steps[:, None] / robot.velocity_limits
    middles = (motion.times[:-1] + motion.times[1:]) / 2
    speeds = np.stack([np.interp(times, middles, speed) for speed in used.T], axis=1)
    np.maximum.at(speeds, np.abs(times[:, None] - middles).argmin(axis=0), used)
    return JointCurves(times, angles, speeds)


class JointPlots(Following[ArmMotion]):
    """A folder, or a window, with the plots of the joints."""

    def __init__(self, gui: viser.GuiApi, *, large: bool = False) -> None:
        """Make it, hidden, without curves until it takes a robot."""
        node, content = add_container(gui, "Joints", large=large)
        super().__init__(node)
        height, none = 170 * (LARGE if large else 1), (curve("", palette.LIGHT.arm_ring),)
        with content:
            self._key = gui.add_html("")
            self.angles = add_plot(gui, "Angle [°]; dashed: limits", "time", none, height)
            title = f"Speed [% of its limit], up to {MAX_SPEED}; time [s]"
            self.speeds = add_plot(gui, title, "time", none, height)

    def take(self, robot: Robot) -> None:
        """Show a robot's motions from now on."""
        self._robot, self._newest = robot, None
        limited = [j for j in range(robot.num_joints) if np.isfinite(robot.lower[j])]
        self._limits = np.degrees(np.stack([robot.lower[limited], robot.upper[limited]], axis=1)).ravel()
        colours = [colour for colour, _ in zip(cycle(palette.LIGHT.joints), robot.joint_names, strict=False)]
        joints = [curve(f"{j}", colour) for j, colour in enumerate(colours, start=1)]
        limits = [curve("limit", colours[j], width=1, dashed=True) for j in limited for _ in range(2)]
        limit = curve("limit", palette.LIGHT.arm_ring, width=1, dashed=True)
        marks = {f"{j}": f"background:{css(colour)}" for j, colour in enumerate(colours, start=1)}
        self._key.content = legend(marks, "0.3em", "Joint")
        for plot, curves in ((self.angles, (*joints, *limits)), (self.speeds, (*joints, limit))):
            plot.series = (uplot.Series(label=ACROSS["time"]), *curves)
            plot.data = (np.zeros(2),) * (1 + len(curves))

    def _show(self, newest: ArmMotion) -> None:
        curves = joint_curves(newest, self._robot)
        limits = np.tile(self._limits, (len(curves.times), 1))
        self.angles.data = columns(curves.times, curves.angles, limits)
        speeds, limit = np.minimum(curves.speeds, MAX_SPEED), np.full((len(curves.times), 1), 100.0)
        self.speeds.data = columns(curves.times, speeds, limit)


class HealthPlots(Following[Profiles]):
    """A folder, or a window, with three plots and a table: the shown motion beside the one without behaviours."""

    def __init__(self, gui: viser.GuiApi, *, large: bool = False) -> None:
        node, content = add_container(gui, "Along the path", large=large)
        super().__init__(node)
        self._height = 130 * (LARGE if large else 1)
        with content:
            self.table = gui.add_html("")
            line = f"border-top:2px {{}} {css(palette.LIGHT.arm_ring)}"
            marks = {"with avoidance and biases": line.format("solid"), "without": line.format("dashed")}
            gui.add_html(legend(marks, "0", note="along the path, 0: start, 1: goal"))
            self.lyapunov = self._plot(gui, "Lyapunov value, relative to that of the start", palette.LIGHT.level)
            self._to = gui.add_html("")
            self.distance = self._plot(gui, "", palette.LIGHT.rollout)
            self._whose = gui.add_html("")
            contact = curve("contact", palette.LIGHT.arm_ring, width=1)
            self.clearance = self._plot(gui, "", palette.LIGHT.goal, contact)

    def _plot(self, gui: viser.GuiApi, title: str, colour: Colour, *more: uplot.Series) -> viser.GuiUplotHandle:
        without = curve("without", colour, width=1.5, dashed=True)
        return add_plot(gui, title, "path", (curve("shown", colour), without, *more), self._height)

    def _show(self, newest: Profiles) -> None:
        along, shown, without = newest.along, newest.shown, newest.undisturbed
        self.lyapunov.data = columns(along, shown.lyapunov, without.lyapunov)
        self.distance.data = columns(along, 1e3 * shown.distance, 1e3 * without.distance)
        which = "mean demonstration" if newest.of_mean else "demonstration"
        self._to.content = small(f"Distance to the {which} [mm]", tight=True)
        bounded = bool(np.isfinite(shown.clearance).all())
        whose = "body points" if newest.of_body else "end effector"
        self._whose.content = small(
            f"Clearance of the {whose} [mm]" if bounded else "Clearance: no obstacle", tight=True
        )
        self.clearance.visible = bounded
        if bounded:
            clearances = 1e3 * shown.clearance, 1e3 * without.clearance
            self.clearance.data = columns(along, *clearances, np.zeros(len(along)))
        self.table.content = table_html(newest)


class Plots:
    """All plots of one visitor: each below its checkbox, or, large, in a window."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, send: Callable[[str, bytes], None]) -> None:
        """Build them with their checkboxes where the panel is being built; `send` gets a name's end, and a content."""
        self._send = send
        self.joints: list[JointPlots] = []
        self.health: list[HealthPlots] = []
        self._robot: Robot | None = None
        self._motion: ArmMotion | None = None
        self._path: Array | None = None
        """Path of the hand (T, 3) along which the health is plotted, metres."""
        self._past: ArmMotion | None = None  # what the robot did, while that is shown
        self._profiles: Profiles | None = None
        for name, kind, made in (("joint_plots", JointPlots, self.joints), ("health_plots", HealthPlots, self.health)):
            bindings.checkbox(gui, name)
            for large in (False, True):
                shown = lambda s, name=name, large=large: getattr(s.view, name) and s.view.large_plots == large  # noqa: E731
                made.append(bindings.properties(kind(gui, large=large), visible=shown))
        any_shown = lambda s: s.view.joint_plots or s.view.health_plots  # noqa: E731
        bindings.checkbox(gui, "large_plots", visible=any_shown)
        hint = "of the shown plots, as CSV: joints at the motion’s own samples, and what is told along the path"
        save = gui.add_button(SAVE, icon=viser.Icon.DOWNLOAD, hint=hint, visible=False)
        bindings.later(save, self._save, visible=any_shown)

    def take(self, robot: Robot) -> None:
        """Show a robot's motions from now on."""
        self._robot, self._motion, self._path, self._past, self._profiles = robot, None, None, None, None
        for plots in self.joints:
            plots.take(robot)

    def draw(self, frame: Frame) -> None:
        """Show a frame."""
        self._motion = frame.arm or self._motion
        path = frame.rollouts[frame.chosen] if frame.chosen is not None and len(frame.rollouts) else ()
        self._path = path if len(path) > 1 else None
        self._draw_joints()
        self._profiles = frame.profiles or self._profiles
        for plots in self.health:
            plots.follow(frame.profiles)

    def mark(self, player: Replay | None, *, past: bool = False) -> str:
        """Show what the robot did, if it is that which is played, on the joints' plots.

        Returns:
            HTML that marks the plots at the moment that is played.
        """
        motion = None if player is None else player.motion
        before, self._past = self._past, motion if past else None
        if before is not self._past:
            self._draw_joints()
        q, path, robot = None if player is None else player.q, self._path, self._robot
        if player is None or q is None or robot is None:
            return cursor_html()
        place = place_along(path, robot.end_effector(q)) if path is not None and player.seeks else None
        return cursor_html(time=player.moment / max(player.duration, 1e-9), path=place)

    def _draw_joints(self) -> None:
        for plots in self.joints:
            plots.follow(self._past or self._motion)

    def _save(self, session: Session, _pressed: bool) -> None:
        motion, view = self._past or self._motion, session.scenario.view
        if view.joint_plots and motion is not None and self._robot is not None:
            self._send("-joints.csv", table_csv(joints_table(motion, self._robot)))
        if view.health_plots and self._profiles is not None:
            self._send("-path.csv", table_csv(path_table(self._profiles)))


def place_along(path: Array, place: Array) -> float:
    """Return the part of a path (T, 3), from 0 to 1, at whose end is what is nearest to a place (3,), metres."""
    length = arc_length(path)
    return float(length[np.linalg.norm(path - place, axis=1).argmin()] / max(length[-1], 1e-9))


def table_html(profiles: Profiles) -> str:
    """Return a table of the Fréchet distance and the maximum collision distance of both motions."""
    shown, without = profiles.shown, profiles.undisturbed
    bounded = bool(np.isfinite(shown.clearance).all())
    depths = (shown.depth, without.depth) if bounded else (None, None)
    rows = (("Fréchet distance", shown.frechet, without.frechet), ("Depth in obstacle", *depths))
    cells = "".join(
        f"<tr><td style='opacity:0.65;padding-right:0.9em'>{name}</td>"
        + "".join(f"<td style='font-weight:600;padding-right:0.9em'>{_length(value)}</td>" for value in values)
        + "</tr>"
        for name, *values in rows
    )
    head = "".join(f"<td style='opacity:0.65;padding-right:0.9em'>{name}</td>" for name in ("", "with", "without"))
    note = "<div style='opacity:0.65'>Of the motion that the arm follows; Details and Compare take all motions.</div>"
    return small(f"<table><tr>{head}</tr>{cells}</table>{note}")


def _length(metres: float | None) -> str:
    return "–" if metres is None else f"{1e3 * metres:.1f} mm"
