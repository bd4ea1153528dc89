"""Joint angles and speeds over time, with their limits, in the panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import NUM_JOINTS, Robot
from dt_viz.session.engine import ArmMotion
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.palette import css
from dt_viz.ui.scene.picture import Following

NUM_SAMPLES = 80
"""Number of samples of a curve, few enough to be sent during a drag."""
MAX_SPEED = 200
"""Largest speed in the plot, percent of the joint's limit: a joint that leaps would flatten all other curves."""
HEIGHT = 170
"""Height of a plot, pixels."""
SMALL = "font-size:0.75em;line-height:1.3;padding:0.2em 0.9em 0"


@dataclass(frozen=True)
class JointCurves:
    """Curves of the plots."""

    times: Array
    """(N,) even times, seconds."""
    angles: Array
    """(N, 6) joint angles, degrees, unwrapped."""
    speeds: Array
    """(N, 6) joint speeds, percent of the velocity limits."""


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
    """A folder with both plots."""

    def __init__(self, gui: viser.GuiApi, robot: Robot) -> None:
        """Make the folder, hidden."""
        self._robot = robot
        limited = [j for j in range(NUM_JOINTS) if np.isfinite(robot.lower[j])]
        self._limits = np.degrees(np.stack([robot.lower[limited], robot.upper[limited]], axis=1)).ravel()
        bounded = [css(palette.LIGHT.joints[j]) for j in limited for _ in range(2)]
        blank = (np.zeros(2),)
        folder = gui.add_folder("Joints", visible=False)
        super().__init__(folder)
        with folder:
            gui.add_html(_legend())
            gui.add_html(f"<div style='{SMALL}'>Angle [°]; dashed: limits</div>")
            self.angles = gui.add_uplot(
                blank * (1 + NUM_JOINTS + len(bounded)),
                (uplot.Series(label="t [s]"), *_curves(), *_dashed(bounded)),
                **LOOK,
            )
            gui.add_html(f"<div style='{SMALL}'>Speed [% of its limit], up to {MAX_SPEED}; time [s]</div>")
            self.speeds = gui.add_uplot(
                blank * (2 + NUM_JOINTS),
                (uplot.Series(label="t [s]"), *_curves(), *_dashed([css(palette.LIGHT.arm_ring)])),
                **LOOK,
            )

    def _show(self, motion: ArmMotion) -> None:
        curves = joint_curves(motion, self._robot)
        limits = np.tile(self._limits, (NUM_SAMPLES, 1))
        self.angles.data = columns(curves.times, curves.angles, limits)
        speeds, limit = np.minimum(curves.speeds, MAX_SPEED), np.full((NUM_SAMPLES, 1), 100.0)
        self.speeds.data = columns(curves.times, speeds, limit)


def columns(*arrays: Array) -> tuple[NDArray[np.float64], ...]:
    """Split arrays (N,) and (N, k) into the columns that uPlot takes."""
    return tuple(np.column_stack(arrays).T.astype(np.float64))


def _curves() -> list[uplot.Series]:
    return [
        uplot.Series(label=f"{j + 1}", stroke=css(colour), width=2, points={"show": False})
        for j, colour in enumerate(palette.LIGHT.joints)
    ]


def _dashed(colours: Sequence[str]) -> list[uplot.Series]:
    return [
        uplot.Series(label="limit", stroke=colour, width=1, dash=(5, 4), points={"show": False}) for colour in colours
    ]


def _legend() -> str:
    marks = "".join(
        "<span style='white-space:nowrap;margin-right:0.8em'><span style='display:inline-block;width:0.9em;"
        f"height:0.3em;vertical-align:middle;margin-right:0.3em;background:{css(colour)}'></span>{j}</span>"
        for j, colour in enumerate(palette.LIGHT.joints, start=1)
    )
    return f"<div style='{SMALL}'><span style='opacity:0.65;margin-right:0.8em'>Joint</span>{marks}</div>"


_FONT = "11px sans-serif"
LOOK = {
    "scales": {"x": {"time": False}},
    "axes": ({"size": 26, "space": 40, "font": _FONT}, {"size": 42, "space": 24, "font": _FONT}),
    "legend": {"show": False},
    "cursor": {"drag": {"x": False, "y": False}},
    "height": HEIGHT,
    "padding": (6, 12, 0, 0),
}
