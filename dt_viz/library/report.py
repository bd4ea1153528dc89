"""Words about library values: one line for each, and the report on what was learned from demonstrations."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.inspection import Inspection
from dt_viz.learning.interface import AnyImitation
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length
from dt_viz.warning import in_millimetres


def many(num: int, what: str) -> str:
    """A number of things, such as "1 take" or "2 takes"."""
    return f"{num} {what}{'' if num == 1 else 's'}"


def sampled(positions: Array, times: Array) -> str:
    """Samples of a motion: their number, its length and duration."""
    return f"{len(times)} samples, {arc_length(positions)[-1]:.3g} m in {times[-1]:.3g} s"


def summaries(inspections: Sequence[Inspection]) -> list[str]:
    """One sentence for each kind of finding and remedy, about its first take and the number of others."""
    alike: dict[tuple[str, str], list[str]] = defaultdict(list)
    for inspection in inspections:
        for found, text in zip(inspection.findings, inspection.warnings, strict=True):
            alike[found.kind, found.remedy].append(text)
    more = "{} (and {} alike; see Motion.report())"
    return [more.format(first, many(len(rest), "more take")) if rest else first for first, *rest in alike.values()]


def orientation_line(imitation: AnyImitation, demonstrations: Sequence[Demonstration]) -> str:
    """What became of the orientations of demonstrations; empty where these have none."""
    without = [one.name for one in demonstrations if one.orientations is None]
    if imitation.has_orientation or len(without) == len(demonstrations):
        return ""
    why = "in the plain state" if imitation.state == "plain" else "of motions in the plane"
    return f"the hand's orientation is not learned {why if not without else f': {without[0]!r} has none'}"


def missed(path: Array, demonstration: Array) -> str:
    """Discrete Fréchet distance of a learned motion (T, d) from its demonstration (S, d)."""
    off = discrete_frechet(resample_by_arc_length(path, 200), resample_by_arc_length(demonstration, 200))
    return in_millimetres(float(off))
