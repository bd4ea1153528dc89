"""The tab "Compare": other methods beside ours, around the obstacle under the hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import numpy as np
import viser
from viser import uplot

from dt_viz.baselines.base import INSTALL, ONLY_SHIPPED, Method
from dt_viz.motion.profiles import NUM_SAMPLES
from dt_viz.scenario.scenario import Scenario
from dt_viz.session.comparison import OTHERS, OURS, chosen, is_offered
from dt_viz.session.frame import Compared
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.comparison import COLOURS
from dt_viz.ui.scene.palette import css
from dt_viz.ui.tabs.plots import (
    LARGE,
    SAVE,
    add_container,
    add_plot,
    columns,
    curve,
    curves_table,
    legend,
    scores_table,
    small,
    table_csv,
)

NONE = "–"
DEEP = 0.001  # maximum collision distance from which on it is marked, metres
COLUMNS = (
    ("to demo", "mean discrete Fréchet distance to the demonstrations"),
    ("hand in", "maximum collision distance of the end effector"),
    ("arm in", "maximum collision distance of the arm’s meshes, once all of it rests"),
    ("off goal", "largest distance of a motion’s end from the goal"),
)
"""Heads of the table, each with what it means; all are in millimetres."""
NOTE = "Lower is better. All motions are scored; the plots below follow the one that the arm follows."
TITLES = ("Distance to the demonstration [mm]", "Depth of the hand in the obstacle [mm]")


class ComparePanel:
    """Controls of the comparison, its table, and figure 6 of the paper for one motion."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, send: Callable[[str, bytes], None]) -> None:
        """Build the controls where the panel is being built; `send` gets the end of a file's name, and its content."""
        self._send = send
        self._comparison: Sequence[Compared] = ()
        self._drawn: list[Sequence[Method]] = [(), ()]
        """Methods in the plots below the table, and in those in a window."""
        with gui.add_folder("Methods"):  # closed by a click, so that the table is seen at once on a small screen
            for method in OTHERS:
                bindings.input(
                    gui.add_checkbox(method.title, False, disabled=bool(method.missing), hint=hint(method)),
                    lambda s, method=method: method in chosen(s.view, s.task),
                    partial(_compare, method.name),
                    disabled=lambda s, method=method: bool(method.missing) or not is_offered(method, s.task),
                )
            trained = [method for method in OTHERS if method.weights]
            text = f"{', '.join(method.title for method in trained)}: {ONLY_SHIPPED}."
            self.note = bindings.properties(
                gui.add_html(small(text), visible=False),
                visible=lambda s: not all(is_offered(method, s.task) for method in trained),
            )
            """Says why methods are off."""
        self.table = gui.add_html("", visible=False)
        titles = {method.title: method.name for method in OTHERS if not method.missing}
        offered = lambda s: [m for m in OTHERS if not m.missing and is_offered(m, s.task)]  # noqa: E731
        bindings.input(
            gui.add_dropdown(
                "Their arm", (NONE, *titles), hint="a second arm, which follows the motion of this method"
            ),
            lambda s: next((method.title for method in offered(s) if method.name == s.view.their_arm), NONE),
            lambda s, title: _with_their_arm(s, titles.get(title, "")),
            options=lambda s: (NONE, *(method.title for method in offered(s))),
        )
        compares = lambda s: bool(chosen(s.view, s.task))  # noqa: E731
        self.plots: list[tuple[viser.GuiUplotHandle, ...]] = []
        """One for each of `TITLES`, below the table and in a window."""
        self.keys: list[viser.GuiHtmlHandle] = []  # names of the curves, above both
        for large in (False, True):
            node, content = add_container(gui, "Along the path (fig. 6)", large=large)
            with content:
                self.keys.append(gui.add_html(""))
                height = 130 * (LARGE if large else 1)
                self.plots.append(tuple(add_plot(gui, title, "path", _curves(()), height) for title in TITLES))
            bindings.properties(node, visible=lambda s, large=large: compares(s) and s.view.large_plots == large)
        bindings.checkbox(gui, "large_plots", visible=compares)
        what = "the table, and the curves of the plots, as CSV"
        save = gui.add_button(SAVE, icon=viser.Icon.DOWNLOAD, hint=what, visible=False)
        bindings.later(save, self._save, visible=compares)
        bindings.properties(self.table, visible=compares)
        bindings.show(partial(_shown, bindings), lambda shown: self.draw(*shown))

    def draw(self, comparison: Sequence[Compared], large: bool) -> None:
        """Show how methods fare, with the plots below the table, or the `large` ones in a window."""
        self._comparison = comparison
        self.table.content = table_html(comparison)
        plotted = [(compared.method, 1e3 * compared.curves) for compared in comparison if compared.curves is not None]
        methods, curves = tuple(method for method, _ in plotted), [curve for _, curve in plotted]
        along = np.linspace(0, 1, NUM_SAMPLES)
        marks = {method.title: f"background:{css(_colour(method.name))}" for method in methods}
        self.keys[large].content = legend(marks, "0.3em")
        for k, plot in enumerate(self.plots[large]):
            if methods != self._drawn[large]:
                plot.series = (uplot.Series(label="path"), *_curves(methods))
            plot.data = columns(along, *(curve[:, k] for curve in curves)) if curves else (np.zeros(2),) * 2
        self._drawn[large] = methods

    def _save(self, _session: Session, _pressed: bool) -> None:
        self._send("-methods.csv", table_csv(scores_table(self._comparison)))
        self._send("-methods-path.csv", table_csv(curves_table(self._comparison)))


def _shown(bindings: Bindings, scenario: Scenario) -> Any:  # noqa: ANN401 - or KEEP
    """The methods whose table and plots are shown, and whether the plots are large."""
    comparison, view = () if bindings.frame is None else bindings.frame.comparison, scenario.view
    return (comparison, view.large_plots) if comparison and view.compared else KEEP


def hint(method: Method) -> str:
    """Return what a method promises, when it plans, and what it lacks."""
    if method.missing:
        return f"{method.title} needs {', '.join(method.missing)}: {INSTALL}"
    stable = "Stable" if method.stable else "Not stable"
    reach = "whole arm" if method.whole_arm else "end effector only"
    when = "follows a drag" if method.live else "plans when the obstacle rests"
    return f"{method.title}. {method.promise} {stable}, {reach}; {when}."


def table_html(comparison: Sequence[Compared]) -> str:
    """Return a table of how the methods fare, each with its promise or what keeps it from moving."""
    pale = f"{_CELL};opacity:0.65"
    heads = "".join(f"<th title='{escape(why)}' style='{pale};white-space:normal'>{name}</th>" for name, why in COLUMNS)
    head = f"<tr><th style='{pale};text-align:left'>mm</th>{heads}</tr>"
    rows = "".join(_row(compared) for compared in comparison)
    table = f"<table style='border-collapse:collapse;width:100%'>{head}{rows}</table>"
    return small(f"{table}<div style='opacity:0.65;padding-top:0.5em'>{NOTE}</div>", tight=True)


_CELL = "font-weight:600;text-align:right;padding:0 0 0 0.4em;white-space:nowrap"


def _row(compared: Compared) -> str:
    scores, method = compared.scores, compared.method
    name = (
        f"<td style='padding-top:0.35em'><span style='display:inline-block;width:0.8em;height:0.8em;"
        f"border-radius:0.2em;margin-right:0.4em;vertical-align:-0.08em;background:{css(_colour(method.name))}'></span>"
        f"{escape(method.title)}</td>"
    )
    values = scores and (scores.frechet, scores.hand_depth, scores.arm_depth, scores.goal_error)
    cells = "".join(_cell(v, bad=k in (1, 2) and (v or 0) > DEEP) for k, v in enumerate(values or (None,) * 4))
    said = compared.note or method.promise
    below = f"<td colspan=5 style='opacity:0.65;padding-left:1.2em;white-space:normal'>{escape(said)}</td>"
    return f"<tr style='vertical-align:baseline'>{name}{cells}</tr><tr>{below}</tr>"


def _cell(metres: float | None, *, bad: bool) -> str:
    text = NONE if metres is None else f"{1e3 * metres:.0f}"
    colour = f";color:{palette.ink(palette.LIGHT.folded)}" if bad else ""
    return f"<td style='{_CELL}{colour}'>{text}</td>"


def _colour(name: str) -> tuple[int, int, int]:
    return COLOURS.get(name, palette.LIGHT.rollout)


def _curves(methods: Sequence[Method]) -> tuple[uplot.Series, ...]:
    return tuple(curve(method.title, _colour(method.name)) for method in (methods or (OURS,)))


def _compare(name: str, scenario: Scenario, shown: bool) -> dict[str, Any]:
    others = [known for known in scenario.view.compared if known != name]
    their_arm = scenario.view.their_arm if shown or scenario.view.their_arm != name else ""
    return {"view": replace(scenario.view, compared=_ordered([*others, *([name] * shown)]), their_arm=their_arm)}


def _with_their_arm(scenario: Scenario, name: str) -> dict[str, Any]:
    """The view with the arm of this method, which is compared then, too; of none if empty."""
    compared = _ordered([*scenario.view.compared, name]) if name else scenario.view.compared
    return {"view": replace(scenario.view, compared=compared, their_arm=name)}


def _ordered(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(method.name for method in OTHERS if method.name in names)
