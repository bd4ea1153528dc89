"""Lyapunov value, distance to the demonstration and clearance along the chosen rollout, in the panel."""

from __future__ import annotations

import numpy as np
import viser
from viser import uplot

from dt_viz.flows.fields import Array
from dt_viz.motion.profiles import Profiles
from dt_viz.ui.panel.plots import LOOK, SMALL, columns
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.palette import css
from dt_viz.ui.scene.picture import Shown

HEIGHT = 130
"""Height of a plot, pixels."""
_MILLIMETRES = 1e3


class HealthPlots(Shown):
    """A folder with three plots and a table: the shown motion beside the one without avoidance and biases."""

    def __init__(self, gui: viser.GuiApi) -> None:
        """Make the folder, hidden."""
        self._drawn: Profiles | None = None
        folder = gui.add_folder("Along the path", visible=False)
        super().__init__(folder)
        with folder:
            self.table = gui.add_html("")
            gui.add_html(_legend())
            self.lyapunov = _plot(gui, "Lyapunov value, relative to that of the start", palette.LIGHT.level)
            self._to = gui.add_html("")
            self.distance = _plot(gui, "", palette.LIGHT.rollout)
            self._whose = gui.add_html("")
            self.clearance = _plot(gui, "", palette.LIGHT.goal, zero=True)

    def draw(self, profiles: Profiles | None) -> None:
        """Show these profiles; None leaves what is there."""
        if profiles is None or profiles is self._drawn:
            return
        self._drawn = profiles
        along, shown, without = profiles.along, profiles.shown, profiles.undisturbed
        self.lyapunov.data = columns(along, shown.lyapunov, without.lyapunov)
        self.distance.data = columns(along, _MILLIMETRES * shown.distance, _MILLIMETRES * without.distance)
        which = "mean demonstration" if profiles.of_mean else "demonstration"
        self._to.content = _title(f"Distance to the {which} [mm]")
        bounded = bool(np.isfinite(shown.clearance).all())
        whose = "body points" if profiles.of_body else "end effector"
        self._whose.content = _title(f"Clearance of the {whose} [mm]" if bounded else "Clearance: no obstacle")
        self.clearance.visible = bounded
        if bounded:
            clearances: list[Array] = [_MILLIMETRES * shown.clearance, _MILLIMETRES * without.clearance]
            self.clearance.data = columns(along, *clearances, np.zeros(len(along)))
        self.table.content = table_html(profiles)


def table_html(profiles: Profiles) -> str:
    """Return a table of the Fréchet distance and M.C.D. of both motions."""
    shown, without = profiles.shown, profiles.undisturbed
    bounded = bool(np.isfinite(shown.clearance).all())
    rows = (
        ("Fréchet distance", shown.frechet, without.frechet),
        ("M.C.D.", shown.depth if bounded else None, without.depth if bounded else None),
    )
    cells = "".join(
        f"<tr><td style='opacity:0.65;padding-right:0.9em'>{name}</td>"
        + "".join(f"<td style='font-weight:600;padding-right:0.9em'>{_length(value)}</td>" for value in values)
        + "</tr>"
        for name, *values in rows
    )
    head = "".join(f"<td style='opacity:0.65;padding-right:0.9em'>{name}</td>" for name in ("", "with", "without"))
    return f"<table style='{SMALL};padding-bottom:0.5em'><tr>{head}</tr>{cells}</table>"


def _length(metres: float | None) -> str:
    return "–" if metres is None else f"{_MILLIMETRES * metres:.1f} mm"


def _plot(gui: viser.GuiApi, title: str, colour: tuple[int, int, int], *, zero: bool = False) -> viser.GuiUplotHandle:
    """Add a plot of a pair of curves along the path, below its title."""
    if title:
        gui.add_html(_title(title))
    series = [
        uplot.Series(label="path"),
        uplot.Series(label="shown", stroke=css(colour), width=2, points={"show": False}),
        uplot.Series(label="without", stroke=css(colour), width=1.5, dash=(5, 4), points={"show": False}),
    ]
    if zero:
        series.append(
            uplot.Series(label="contact", stroke=css(palette.LIGHT.arm_ring), width=1, points={"show": False})
        )
    return gui.add_uplot((np.zeros(2),) * len(series), tuple(series), **{**LOOK, "height": HEIGHT})


def _title(text: str) -> str:
    return f"<div style='{SMALL}'>{text}</div>"


def _legend() -> str:
    mark = (
        "<span style='display:inline-block;width:1.6em;vertical-align:middle;margin-right:0.4em;"
        "border-top:{} {}'></span>{}"
    )
    both = (("2px solid", "with avoidance and biases"), ("2px dashed", "without"))
    grey = css(palette.LIGHT.arm_ring)
    marks = "".join(
        f"<span style='white-space:nowrap;margin-right:1em'>{mark.format(line, grey, name)}</span>"
        for line, name in both
    )
    return f"<div style='{SMALL}'>{marks}<br/><span style='opacity:0.65'>along the path, 0: start, 1: goal</span></div>"
