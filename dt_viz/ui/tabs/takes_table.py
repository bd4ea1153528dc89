"""The table of takes that are seen before they are learned: a row for each, a column for each kind of finding."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

from dt_viz.learning.inspection import FindingKind
from dt_viz.session.opening import Preview, SeenTake
from dt_viz.ui.scene.palette import LIGHT, css, ink
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.status import COLOURS, sentence
from dt_viz.warning import Severity

HEADS: Mapping[FindingKind, tuple[str, str]] = {
    "units": ("<br>unit", "another unit than the others’"),
    "outliers": ("jump<br>mm", "distance of a single sample far off; of several their number"),
    "gap": ("gap<br>s", "longest time without samples"),
    "jitter": ("jitter<br>mm", "how far it trembles"),
    "pause": ("pause<br>s", "how long it stands still"),
    "end": ("end<br>mm", "distance of its end from the goal"),
    "start": ("start<br>s", "how long it stays at the goal at first"),
}
"""Heads of the table's columns, and what they mean."""


def seen_html(seen: Preview, number: int) -> str:
    """Return a table of what was found of each take, the chosen one marked, and what else is to be known."""
    alarms = [text for text in (seen.problem, seen.reach) if text]
    if seen.goals:
        goal = f"learned are {seen.goals[seen.goal_number]}; “Goal” chooses others"
        alarms.append(f"the takes end at {len(seen.goals)} places, none of them that of most: {goal}")
    colours = [ink(COLOURS[Severity.WARNING][0])] * len(alarms) + ["inherit"] * len(seen.notes)
    said = zip(colours, (*alarms, *seen.notes), strict=True)
    told = [f"<div style='color:{colour}'>{html.escape(sentence(text))}</div>" for colour, text in said]
    found = {finding.kind for take in seen.takes if take.learned is not None for finding in take.inspection.findings}
    heads: list[FindingKind] = [kind for kind in HEADS if kind in found]
    if not seen.takes:
        return small("".join(told))
    rows = "".join(_row(k, take, heads, chosen=k == number) for k, take in enumerate(seen.takes))
    named = [("time<br>s", "duration"), ("<br>n", "samples"), ("rate<br>Hz", "samples a second")]
    titles = "".join(
        f"<td style='text-align:right;opacity:0.65;padding-left:0.35em' title='{hint}'>{title}</td>"
        for title, hint in (*named, *(HEADS[kind] for kind in heads))
    )
    table = f"<table style='width:100%;font-size:0.85em;line-height:1.3'><tr><td></td>{titles}</tr>{rows}</table>"
    return small("".join(told)) * bool(told) + small(
        f"<div style='max-height:21em;overflow:auto;margin:0 -0.6em'>{table}</div>"
    )


def _row(number: int, take: SeenTake, heads: Sequence[FindingKind], *, chosen: bool) -> str:
    """Return the row of a take: how large what was found is, or why it is left out; tooltips have all of it."""
    own, left = take.inspection, take.learned is None
    colour = LIGHT.stale if left else LIGHT.takes[number % len(LIGHT.takes)]
    said = [f"{each.text}: {each.remedy or 'nothing is done'}" for each in own.findings]
    said += ["out of the arm's reach"] * take.is_far + ["left out by you"] * (not take.is_chosen)
    mark = f"display:inline-block;width:0.8em;border-top:0.28em {'dashed' if left else 'solid'} {css(colour)}"
    cells = [("", f"{own.duration:.3g}", False), ("", f"{own.num_samples}", False), ("", f"{own.rate:.3g}", False)]
    for kind in heads:
        of_kind = [each for each in own.findings if each.kind == kind]
        amounts = ", ".join(_figure(each.amount) for each in of_kind)
        cells.append(("; ".join(each.text for each in of_kind), amounts, any(not each.remedy for each in of_kind)))
    warned = f";font-weight:700;color:{ink(COLOURS[Severity.WARNING][0])}"
    figures = "".join(
        f"<td style='text-align:right;padding-left:0.35em{warned if is_left else ''}' title='{html.escape(title)}'>"
        f"{html.escape(text)}</td>"
        for title, text, is_left in (cells[:3] if left else cells)
    )
    why = html.escape(said[-1] if said else "left out")
    far = f"<td style='{warned[1:]}'>out of reach</td>" if take.is_far else ""
    reason = f"<td colspan='{len(heads)}' style='padding-left:0.35em'>{why}</td>" if left else far
    return (
        f"<tr style='{'opacity:0.6' if left else ''}' title='{html.escape('; '.join(said))}'>"
        f"<td style='font-weight:{700 if chosen else 400};max-width:7em;overflow:hidden;"
        f"white-space:nowrap;text-overflow:ellipsis'>"
        f"<span style='{mark};vertical-align:0.2em;margin-right:0.4em'></span>{html.escape(own.name)}</td>"
        f"{figures}{reason}</tr>"
    )


def _figure(amount: str) -> str:
    """The figure of an amount, whose unit is in the column's head; a number of samples is marked as such."""
    figure, _, unit = amount.partition(" ")
    return figure if unit else f"{figure} ×" if figure else "✓"
