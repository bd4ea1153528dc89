"""The tab "Compare": other methods beside ours, around the obstacle under the hand."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np
import viser
from viser import uplot

from dt_viz.baselines.base import INSTALL, ONLY_SHIPPED, Method
from dt_viz.baselines.registry import others
from dt_viz.flows.fields import Array
from dt_viz.motion.profiles import NUM_SAMPLES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.session.comparison import chosen
from dt_viz.session.frame import Compared
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.comparison import colour_of
from dt_viz.ui.scene.palette import css
from dt_viz.ui.scene.picture import Following
from dt_viz.ui.tabs.plots import ACROSS, LARGE, SAVE, add_container, add_plot, columns, curve, legend, small, table_csv

NONE = "–"
DEEP = 1.0  # maximum collision distance from which on it is marked, millimetres
COLUMNS: Mapping[str, tuple[str, str]] = {
    "to demo": ("frechet", "mean discrete Fréchet distance to the demonstrations"),
    "hand in": ("hand_depth", "maximum collision distance of the end effector"),
    "arm in": ("arm_depth", "maximum collision distance of the arm’s meshes, once all of it rests"),
    "off goal": ("goal_error", "largest distance of a motion’s end from the goal"),
}
"""Heads of the table, each with its field of `Scores`, and what it means; all are in millimetres."""
DEPTHS = ("hand in", "arm in")
NOTE = "Lower is better. All motions are scored; the plots below follow the one that the arm follows."
TITLES = ("Distance to the demonstration [mm]", "Depth of the hand in the obstacle [mm]")


class ComparePanel:
    """Controls of the comparison, its table, and figure 6 of the paper for one motion."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, send: Callable[[str, bytes], None]) -> None:
        """Build the controls where the panel is being built; `send` gets the end of a file's name, and its content."""
        self._send = send
        self._comparison: Sequence[Compared] = ()
        with gui.add_folder("Methods"):  # closed by a click, so that the table is seen at once on a small screen
            for method in others():
                bindings.input(
                    gui.add_checkbox(method.title, False, disabled=bool(method.missing), hint=hint(method)),
                    lambda s, method=method: method in chosen(s.view, s.task),
                    lambda s, shown, name=method.name: _with_method(s.view, name, shown=shown),
                    disabled=lambda s, method=method: bool(method.missing) or not method.is_offered(s.task),
                )
            trained = [method for method in others() if method.weights]
            text = f"{', '.join(method.title for method in trained)}: {ONLY_SHIPPED}."
            self.note = bindings.properties(
                gui.add_html(small(text), visible=False),
                visible=lambda s: not all(method.is_offered(s.task) for method in trained),
            )
            """Says why methods are off."""
        self.table = gui.add_html("", visible=False)
        bindings.input(
            gui.add_dropdown("Their arm", (NONE,), hint="a second arm, which follows the motion of this method"),
            lambda s: next((title for title, name in _arms(s).items() if name == s.view.their_arm), NONE),
            lambda s, title: _with_arm(s.view, _arms(s).get(title, "")),
            options=lambda s: tuple(_arms(s)),
        )
        compares = lambda s: bool(chosen(s.view, s.task))  # noqa: E731
        self.plots: list[CurvePlots] = []  # below the table, and in a window
        for large in (False, True):
            shown = lambda s, large=large: compares(s) and s.view.large_plots == large  # noqa: E731
            self.plots.append(bindings.properties(CurvePlots(gui, large=large), visible=shown))
        bindings.checkbox(gui, "large_plots", visible=compares)
        what = "the table, and the curves of the plots, as CSV"
        save = gui.add_button(SAVE, icon=viser.Icon.DOWNLOAD, hint=what, visible=False)
        bindings.later(save, self._save, visible=compares)
        bindings.properties(self.table, visible=compares)
        bindings.show(lambda _: (bindings.frame and bindings.frame.comparison) or KEEP, self.draw)

    def draw(self, comparison: Sequence[Compared]) -> None:
        """Show how methods fare."""
        self._comparison = comparison
        self.table.content = table_html(comparison)
        for plots in self.plots:
            plots.follow(comparison)

    def _save(self, _session: Session, _pressed: bool) -> None:
        self._send("-methods.csv", table_csv(scores_table(self._comparison)))
        self._send("-methods-path.csv", table_csv(curves_table(self._comparison)))


class CurvePlots(Following[Sequence[Compared]]):
    """A folder, or a window, with the curves of figure 6, and their names above them."""

    def __init__(self, gui: viser.GuiApi, *, large: bool = False) -> None:
        """Make it, hidden, without curves."""
        node, content = add_container(gui, "Along the path (fig. 6)", large=large)
        super().__init__(node)
        height, none = 130 * (LARGE if large else 1), (curve("", palette.LIGHT.rollout),)
        with content:
            self.key = gui.add_html("")
            self.plots = tuple(add_plot(gui, title, "path", none, height) for title in TITLES)

    def _show(self, newest: Sequence[Compared]) -> None:
        colours = {each.method.title: colour_of(each.method) for each in newest if each.curves is not None}
        self.key.content = legend({title: f"background:{css(colour)}" for title, colour in colours.items()}, "0.3em")
        drawn = [1e3 * each.curves for each in newest if each.curves is not None] or [np.zeros((NUM_SAMPLES, 2))]
        lines = [curve(title, colour) for title, colour in colours.items()] or [curve("", palette.LIGHT.rollout)]
        series = uplot.Series(label=ACROSS["path"]), *lines
        for k, plot in enumerate(self.plots):
            if plot.series != series:  # which would build the plot anew
                plot.series = series
            plot.data = columns(np.linspace(0, 1, NUM_SAMPLES), *(curves[:, k] for curves in drawn))


def hint(method: Method) -> str:
    """Return what a method promises, when it plans, and what it lacks."""
    if method.missing:
        return f"{method.title} needs {', '.join(method.missing)}: {INSTALL}"
    stable = "Stable" if method.stable else "Not stable"
    reach = "whole arm" if method.whole_arm else "end effector only"
    when = "follows a drag" if method.live else "plans when the obstacle rests"
    return f"{method.title}. {method.promise} {stable}, {reach}; {when}."


def scores_table(comparison: Sequence[Compared]) -> dict[str, list[Any]]:
    """Return the scores of compared methods, millimetres, and notes; each method is a row, an unknown score None."""
    table: dict[str, list[Any]] = {"method": [compared.method.title for compared in comparison]}
    for head, (field, _) in COLUMNS.items():
        metres = [getattr(compared.scores, field, None) for compared in comparison]
        table[f"{head.replace(' ', '_')}_mm"] = [None if value is None else 1e3 * float(value) for value in metres]
    return table | {"note": [compared.note for compared in comparison]}


def curves_table(comparison: Sequence[Compared]) -> dict[str, Array]:
    """Return the curves of compared methods along the path, from 0 to 1; of those that have some."""
    table: dict[str, Array] = {"path": np.linspace(0, 1, NUM_SAMPLES)}
    for compared in comparison:
        if compared.curves is not None:
            for name, column in zip(("distance", "depth"), 1e3 * compared.curves.T, strict=True):
                table[f"{compared.method.name}_{name}_mm"] = column
    return table


def table_html(comparison: Sequence[Compared]) -> str:
    """Return the table of scores, below each method its note, such as what keeps it from moving, or its promise."""
    pale = f"{_CELL};opacity:0.65"
    heads = "".join(
        f"<th title='{escape(why)}' style='{pale};white-space:normal'>{head}</th>" for head, (_, why) in COLUMNS.items()
    )
    box = "display:inline-block;width:0.8em;height:0.8em;border-radius:0.2em;margin-right:0.4em;vertical-align:-0.08em"
    rows = ""
    for compared, title, *scores, note in zip(comparison, *scores_table(comparison).values(), strict=True):
        mark = f"<span style='{box};background:{css(colour_of(compared.method))}'></span>"
        name = f"<td style='padding-top:0.35em'>{mark}{escape(title)}</td>"
        below = escape(note or compared.method.promise)
        rows += f"<tr style='vertical-align:baseline'>{name}{''.join(map(_cell, COLUMNS, scores))}</tr>"
        rows += f"<tr><td colspan=5 style='opacity:0.65;padding-left:1.2em;white-space:normal'>{below}</td></tr>"
    head = f"<tr><th style='{pale};text-align:left'>mm</th>{heads}</tr>"
    table = f"<table style='border-collapse:collapse;width:100%'>{head}{rows}</table>"
    return small(f"{table}<div style='opacity:0.65;padding-top:0.5em'>{NOTE}</div>", tight=True)


_CELL = "font-weight:600;text-align:right;padding:0 0 0 0.4em;white-space:nowrap"


def _cell(head: str, millimetres: float | None) -> str:
    text = NONE if millimetres is None else f"{millimetres:.0f}"
    is_deep = head in DEPTHS and (millimetres or 0) > DEEP
    return f"<td style='{_CELL}{f';color:{palette.ink(palette.LIGHT.folded)}' * is_deep}'>{text}</td>"


def _arms(scenario: Scenario) -> dict[str, str]:
    """Names of the methods whose arm can be shown, by their titles; that of none is empty."""
    offered = [method for method in others() if not method.missing and method.is_offered(scenario.task)]
    return {NONE: "", **{method.title: method.name for method in offered}}


def _with_arm(view: View, name: str) -> dict[str, Any]:
    """The view with the arm of a method, which is compared then, too; of none if the name is empty."""
    return _showing(view, {*view.compared, name}, name)


def _with_method(view: View, name: str, *, shown: bool) -> dict[str, Any]:
    """The view with a method, or without it and its arm."""
    return _showing(view, {*view.compared, name} if shown else {*view.compared} - {name}, view.their_arm)


def _showing(view: View, names: Collection[str], their_arm: str) -> dict[str, Any]:
    """The view with the methods of these names, in the order of the tables, and the arm of one of them."""
    compared = tuple(method.name for method in others() if method.name in names)
    return {"view": replace(view, compared=compared, their_arm=their_arm if their_arm in compared else "")}
