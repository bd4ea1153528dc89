"""Plots and small texts of the panel: joint angles and speeds over time, and what is told along the path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from dt_viz.flows.fields import Array
from dt_viz.motion.profiles import Profiles
from dt_viz.robot.robot import Robot
from dt_viz.session.engine import ArmMotion
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.palette import Colour, css
from dt_viz.ui.scene.picture import Following, Shown

NUM_SAMPLES = 80
"""Number of samples of a curve over time, few enough to be sent during a drag."""
MAX_SPEED = 200
"""Largest speed in the plot, percent of the joint's limit: a joint that leaps would flatten all other curves."""


def small(text: str, *, tight: bool = False) -> str:
    """Return HTML as small text, with the margins of the controls, or `tight` above what it is about."""
    room = (
        "0.75em;line-height:1.3;padding:0.2em 0.9em 0" if tight else "0.8em;line-height:1.4;padding:0.1em 0.9em 0.4em"
    )
    return f"<div style='font-size:{room};opacity:0.85'>{text}</div>"


def add_plot(
    gui: viser.GuiApi, title: str, across: str, curves: Sequence[uplot.Series], height: int
) -> viser.GuiUplotHandle:
    """Add an empty plot of curves below its title, which is HTML, where the panel is being built."""
    if title:
        gui.add_html(small(title, tight=True))
    font = "11px sans-serif"
    return gui.add_uplot(
        (np.zeros(2),) * (1 + len(curves)),
        (uplot.Series(label=across), *curves),
        scales={"x": {"time": False}},
        axes=({"size": 26, "space": 40, "font": font}, {"size": 42, "space": 24, "font": font}),
        legend={"show": False},
        cursor={"drag": {"x": False, "y": False}},
        height=height,
        padding=(6, 12, 0, 0),
    )


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

    times: Array
    """(N,) even times, seconds."""
    angles: Array
    """(N, n) joint angles, degrees, unwrapped."""
    speeds: Array
    """(N, n) joint speeds, percent of the velocity limits."""


def joint_curves(motion: ArmMotion, robot: Robot, num: int = NUM_SAMPLES) -> JointCurves:
    """Compute the curves; a speed is the largest around its moment, so that no peak is lost between two samples."""
    times = np.linspace(motion.times[0], motion.times[-1], num)
    angles = np.stack([np.interp(times, motion.times, angle) for angle in np.degrees(motion.q).T], axis=1)
    steps = np.maximum(np.diff(motion.times), 1e-9)
    used = 100 * np.abs(np.diff(motion.q, axis=0)) / steps[:, None] / robot.velocity_limits
    middles = (motion.times[:-1] + motion.times[1:]) / 2
    speeds = np.stack([np.interp(times, middles, speed) for speed in used.T], axis=1)
    np.maximum.at(speeds, np.abs(times[:, None] - middles).argmin(axis=0), used)
    return JointCurves(times, angles, speeds)


class JointPlots(Following):
    """A folder with the plots of the joints."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Make the folder, hidden, without curves until it takes a robot."""
        folder = gui.add_folder("Joints", visible=False)
        super().__init__(folder)
        with folder:
            self._key = gui.add_html("")
            self.angles = add_plot(gui, "Angle [°]; dashed: limits", "t [s]", (curve("", palette.LIGHT.arm_ring),), 170)
            title = f"Speed [% of its limit], up to {MAX_SPEED}; time [s]"
            self.speeds = add_plot(gui, title, "t [s]", (curve("", palette.LIGHT.arm_ring),), 170)

    def take(self, robot: Robot) -> None:
        """Show a robot's motions from now on."""
        self._robot, self._motion = robot, None
        limited = [j for j in range(robot.num_joints) if np.isfinite(robot.lower[j])]
        self._limits = np.degrees(np.stack([robot.lower[limited], robot.upper[limited]], axis=1)).ravel()
        colours = [colour for colour, _ in zip(cycle(palette.LIGHT.joints), robot.joint_names, strict=False)]
        joints = [curve(f"{j}", colour) for j, colour in enumerate(colours, start=1)]
        limits = [curve("limit", colours[j], width=1, dashed=True) for j in limited for _ in range(2)]
        limit = curve("limit", palette.LIGHT.arm_ring, width=1, dashed=True)
        marks = {f"{j}": f"background:{css(colour)}" for j, colour in enumerate(colours, start=1)}
        self._key.content = legend(marks, "0.3em", "Joint")
        for plot, curves in ((self.angles, (*joints, *limits)), (self.speeds, (*joints, limit))):
            plot.series = (uplot.Series(label="t [s]"), *curves)
            plot.data = (np.zeros(2),) * (1 + len(curves))

    def _show(self, motion: ArmMotion) -> None:
        curves = joint_curves(motion, self._robot)
        limits = np.tile(self._limits, (NUM_SAMPLES, 1))
        self.angles.data = columns(curves.times, curves.angles, limits)
        speeds, limit = np.minimum(curves.speeds, MAX_SPEED), np.full((NUM_SAMPLES, 1), 100.0)
        self.speeds.data = columns(curves.times, speeds, limit)


class HealthPlots(Shown):
    """A folder with three plots and a table: the shown motion beside the one without avoidance and biases."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._drawn: Profiles | None = None
        folder = gui.add_folder("Along the path", visible=False)
        super().__init__(folder)
        with folder:
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
        return add_plot(gui, title, "path", (curve("shown", colour), without, *more), 130)

    def draw(self, profiles: Profiles | None) -> None:
        """Show these profiles; None leaves what is there."""
        if profiles is None or profiles is self._drawn:
            return
        self._drawn = profiles
        along, shown, without = profiles.along, profiles.shown, profiles.undisturbed
        self.lyapunov.data = columns(along, shown.lyapunov, without.lyapunov)
        self.distance.data = columns(along, 1e3 * shown.distance, 1e3 * without.distance)
        which = "mean demonstration" if profiles.of_mean else "demonstration"
        self._to.content = small(f"Distance to the {which} [mm]", tight=True)
        bounded = bool(np.isfinite(shown.clearance).all())
        whose = "body points" if profiles.of_body else "end effector"
        self._whose.content = small(
            f"Clearance of the {whose} [mm]" if bounded else "Clearance: no obstacle", tight=True
        )
        self.clearance.visible = bounded
        if bounded:
            clearances = 1e3 * shown.clearance, 1e3 * without.clearance
            self.clearance.data = columns(along, *clearances, np.zeros(len(along)))
        self.table.content = table_html(profiles)


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
