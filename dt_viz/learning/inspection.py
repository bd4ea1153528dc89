"""Inspection of demonstrations: what is odd about a take, take by take, and what is done about it.

Takes without findings stay as they are, to the last bit. What is measured is scale-free: an outlier is a jump and back,
far longer than the take's steps; jitter makes a take longer than it is when what is faster than a hand means to move is
taken out; a pause is a run of hundredths of the duration in which hardly anything moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Slerp

from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.flows.rotations import quaternions, rotation
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.metrics import arc_length, interpolate
from dt_viz.scheduler import checkpoint
from dt_viz.warning import in_millimetres

FindingKind = Literal["units", "outliers", "gap", "jitter", "pause", "still", "elsewhere", "end", "start", "turn"]
"""Kind of a finding: another unit, single samples far off, a time without samples, trembling, standing still, never
moving, an end that is not the others' goal, one beside it, a start at the goal, and more than half a turn, or an end
turned away from the others."""


@dataclass(frozen=True)
class PreparationSettings:
    """Settings of the preparation. Lengths are in spreads, the RMS distance of all points from their mean."""

    same_goal: float = 1e-3
    """Distance from the goal up to which an end is at the goal."""
    max_moved_end: float = 0.3
    """Distance from the goal up to which an end is moved there; farther ones are left out."""
    max_turned_end: float = 0.6
    """Angle, rad, from the goal's orientation, a mean, up to which an end counts in it and is turned without a word."""
    at_goal: float = 0.05
    """Distance from the goal up to which a start is at the goal."""
    standing_step: float = 1e-3
    """Length of a step, lasting 1 % of the motion, below which the motion stands still."""
    standing_turn: float = 5e-3
    """Turn of the hand in 1 % of the motion, rad, below which it does not turn."""
    long_stand: float = 0.1
    """Part of the duration from which standing still is reported."""
    goal: tuple[float, ...] | None = None
    """(d,) the goal, metres; None is where most takes end."""
    convert_units: bool = True
    """Whether a take in millimetres among others in metres is converted."""
    drop_outliers: bool = True
    """Whether single samples far off are left out."""
    bridge_gaps: bool = True
    """Whether times without samples are bridged by a curve; otherwise by a straight line."""
    smooth_jitter: bool = True
    """Whether jitter is smoothed."""
    cut_pauses: bool = True
    """Whether pauses are cut."""
    move_ends: bool = True
    """Whether ends beside the goal are moved there; otherwise these takes are left out."""
    leave_out: bool = True
    """Whether takes that end elsewhere are left out; otherwise their ends are moved, however far."""
    outlier: float = 3.0
    """Least length of jumps to an outlier and back, in long steps (75 % quantile) of the take; clean ones have 2.2."""
    smallest_outlier: float = 0.03
    """Least length of these jumps, relative to the take's size, twice the median distance from its middle."""
    jitter: float = 1.05
    """Least factor by which jitter makes a take longer. Clean takes get shorter by 1.1 % when they are smoothed."""
    turn_jitter: float = 0.01
    """RMS jitter of the hand's orientation up to which it is as good as none, rad."""
    cutoff: float = 5.0
    """Frequency above which motion is jitter, Hz; tremor begins at 6 Hz."""
    cycles: float = 20.0
    """Least cut-off frequency for short takes, in oscillations a take."""
    gap: float = 0.1
    """Shortest time without samples that is a gap, seconds, if it is also longer than 2.5 usual intervals."""
    widest_gap: float = 0.25
    """Longest gap that is bridged by a curve, relative to the duration."""
    noisy_step: float = 0.15
    """`standing_step` of a take that jitters, relative to the jitter, in the mean of five steps."""


@dataclass(frozen=True)
class Finding:
    """One oddity of a take."""

    kind: FindingKind
    text: str
    """Predicate of a sentence about the take, such as "stands still for 1.2 s"."""
    remedy: str = ""
    """What is done about it, such as "the pause is cut"; empty where nothing is."""
    amount: str = ""
    """How large it is, such as "1.2 s"; empty where that is no size."""


@dataclass(frozen=True)
class Inspection:
    """What was found out about one take."""

    name: str
    duration: float
    """Seconds."""
    num_samples: int
    kept: bool
    """Whether it is learned from."""
    findings: tuple[Finding, ...] = ()

    @property
    def rate(self) -> float:
        """Mean number of samples a second, Hz."""
        return (self.num_samples - 1) / self.duration

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each finding, with the take's name."""
        return tuple(
            f"'{self.name}' {found.text}{'; ' if found.remedy else ''}{found.remedy}" for found in self.findings
        )

    def __str__(self) -> str:
        rate = f"{self.rate:.3g} Hz"
        found = "; ".join(f"{each.text} ({each.remedy or 'nothing is done'})" for each in self.findings)
        return f"'{self.name}': {self.duration:.3g} s, {self.num_samples} samples, {rate}: {found or 'as it should be'}"


@dataclass
class Repaired:
    """A take on its way through the inspection; `times` and `positions` are what has been made of it."""

    demonstration: Demonstration
    times: Array
    positions: Array
    findings: list[Finding] = field(default_factory=list)
    kept: bool = True
    jitter: float = 0.0  # RMS of what was smoothed, metres

    def __post_init__(self) -> None:
        self._given = self.times, self.positions
        self._moments = self.times  # those of the demonstration at which the samples are now

    def replace(self, times: Array, positions: Array, moments: Array) -> None:
        """Take other samples; `moments` are their times before, the first of `times` is to be 0 afterwards."""
        self._moments = np.interp(moments, self.times, self._moments)
        self.times, self.positions = times - times[0], positions

    def find(self, kind: FindingKind, text: str, remedy: str = "", amount: str = "") -> None:
        """Note a finding: text where the amount is put in for "{}", what is done about it, and the amount."""
        self.findings.append(Finding(kind, text.format(amount), remedy, amount))

    def leave_out(self, kind: FindingKind, text: str, amount: str = "") -> None:
        """Note why it is left out."""
        self.find(kind, text, "it is left out", amount)
        self.kept = False

    @property
    def repaired(self) -> Demonstration:
        """The demonstration as it is now; the same one where nothing was changed."""
        if self.times is self._given[0] and self.positions is self._given[1]:
            return self.demonstration
        changes: dict[str, Any] = {"times": self.times, "positions": self.positions}
        if self.demonstration.orientations is not None:
            changes["orientations"] = self.orientations_at(self.times)
        return replace(self.demonstration, **changes)

    def orientations_at(self, times: Array) -> Array:
        """Orientations (N, 4), wxyz, at times (N,), seconds, of a take that has some."""
        turns = self.demonstration.orientations
        assert turns is not None
        at = np.interp(np.interp(times, self.times, self._moments), self._given[0], np.arange(len(turns)))
        return quaternions(Slerp(np.arange(len(turns)), rotation(turns))(at))

    @property
    def inspection(self) -> Inspection:
        """What was found out."""
        own = self.demonstration
        times = np.asarray(own.times, float)
        return Inspection(own.name, float(times[-1] - times[0]), len(times), self.kept, tuple(self.findings))


def repair(takes: Sequence[Repaired], settings: PreparationSettings) -> None:
    """Look for other units, outliers, gaps, jitter and pauses, in this order, and repair them."""
    _find_units(takes, settings)
    for take in takes:
        checkpoint()
        _find_outliers(take, settings)
        _smooth(take, settings)
    _find_pauses(takes, settings)


def _find_units(takes: Sequence[Repaired], settings: PreparationSettings) -> None:
    """Look for takes in millimetres among takes in metres."""
    sizes = np.array([np.ptp(take.positions, axis=0).max() for take in takes])
    others = np.quantile(sizes, 0.5, method="lower")
    for take, size in zip(takes, sizes, strict=True):
        if others > 0 and 300 < size / others < 3000:  # a thousand times, where takes differ by a factor of three
            text = f"spans {size:.3g} m, the others {others:.3g} m: it is in millimetres, as it seems"
            take.find("units", text, "it is converted to metres" if settings.convert_units else "")
            take.positions = take.positions / 1e3 if settings.convert_units else take.positions
        elif size > 10:  # no arm reaches that far
            take.find("units", f"spans {size:.3g} m; if it is in millimetres, divide positions by 1,000")


def _find_outliers(take: Repaired, settings: PreparationSettings) -> None:
    steps = np.linalg.norm(np.diff(take.positions, axis=0), axis=1)
    if len(steps) < 4 or not steps.any():
        return
    usual = np.quantile(steps[steps > 1e-6 * steps.max()], 0.75)
    size = 2 * np.median(np.linalg.norm(take.positions - np.median(take.positions, axis=0), axis=1))
    least = max(settings.outlier * usual, settings.smallest_outlier * size)
    off = np.zeros(len(take.positions), bool)
    for num in (1, 2, 3):  # of successive outliers
        jump = np.minimum(steps[:-num], steps[num:])
        across = np.linalg.norm(take.positions[num + 1 :] - take.positions[: -num - 1], axis=1)
        for first in np.flatnonzero((jump > least) & (across < 0.8 * jump)):  # there and back
            off[first + 1 : first + 1 + num] = True
    off[0] |= steps[0] > least > 2 * steps[1]
    off[-1] |= steps[-1] > least > 2 * steps[-2]
    if off.any() and (~off).sum() >= 2:
        amount = in_millimetres(steps.max()) if off.sum() == 1 else f"{off.sum()}"
        text = "has a sample up to {} off" if off.sum() == 1 else "has {} samples far off"
        take.find("outliers", text, "left out" if settings.drop_outliers else "", amount)
        if settings.drop_outliers:
            take.replace(take.times[~off], take.positions[~off], take.times[~off])


def _smooth(take: Repaired, settings: PreparationSettings) -> None:
    if len(take.times) < 8:
        return
    gaps, curved = _gaps(take, settings)
    grid = _Grid(take, gaps[~curved])
    smooth = _without_jitter(take, grid, settings)
    if smooth is not None:
        take.replace(grid.nodes, smooth, grid.nodes)
    elif curved.any():
        times, (curve, _) = take.times, grid.smoothed(1 / np.median(np.diff(take.times)))
        inside = np.any([grid.within(times[k : k + 2]) for k in gaps[curved]], axis=0)
        moments = np.concatenate([times, grid.nodes[inside]])
        order = np.argsort(moments, kind="stable")
        take.replace(moments[order], np.concatenate([take.positions, curve[inside]])[order], moments[order])


def _gaps(take: Repaired, settings: PreparationSettings) -> tuple[Indices, Mask]:
    """Find gaps (G,), the samples before them, and which of them (G,) a curve is to bridge."""
    intervals = np.diff(take.times)
    gaps = np.flatnonzero(intervals > max(settings.gap, 2.5 * np.median(intervals)))
    curved = (intervals[gaps] <= settings.widest_gap * take.times[-1]) & settings.bridge_gaps
    if len(gaps):
        several = f", {len(gaps)} gaps" if len(gaps) > 1 else ""
        how = "a curve" if curved.all() else "a straight line" if not curved.any() else "curves and straight lines"
        take.find("gap", f"has no samples for {{}}{several}", f"bridged by {how}", f"{intervals[gaps].max():.2g} s")
    return gaps, curved


def _without_jitter(take: Repaired, grid: _Grid, settings: PreparationSettings) -> Array | None:
    """Positions at the nodes of a take that jitters, smoothed as far as what is taken out is noise."""
    duration = take.times[-1]
    cutoff = max(settings.cutoff, settings.cycles / duration)
    if 4 * cutoff * np.median(np.diff(take.times)) > 1:  # at a lower rate, jitter cannot be told from motion
        return None
    smooth, noise = grid.smoothed(cutoff)
    if arc_length(take.positions)[-1] <= settings.jitter * arc_length(smooth)[-1]:
        return None
    take.jitter = noise
    take.find("jitter", "jitters by {}", "smoothed" if settings.smooth_jitter else "", in_millimetres(take.jitter))
    while cutoff * duration > 2:  # oscillations of the whole take
        smoother, more = grid.smoothed(cutoff / 1.5)
        left = 2.22 * cutoff * duration / len(take.times)  # part of the variance that passes, ∫ 1/(1 + (f/cutoff)⁴)
        if (more / noise) ** 2 > 1 + min(left, 0.1):  # more motion would be taken out than noise is left
            break
        smooth, cutoff, noise = smoother, cutoff / 1.5, max(noise, more)
    return smooth if settings.smooth_jitter else None


def smoothed_turns(take: Repaired, vectors: Array, settings: PreparationSettings) -> Array:
    """Rotation vectors (T, 3), rad, of the hand along a take, smoothed as positions are where they jitter."""
    if len(take.times) < 8:
        return vectors
    turning = Repaired(take.demonstration, take.times, vectors)
    grid = _Grid(turning, np.zeros(0, int))
    smooth = _without_jitter(turning, grid, settings)
    if turning.jitter <= settings.turn_jitter:
        return vectors
    remedy = "" if smooth is None else "smoothed"
    take.find("jitter", f"turns with a jitter of {np.rad2deg(turning.jitter):.1f}°", remedy)
    return vectors if smooth is None else interpolate(take.times, grid.nodes, smooth)


class _Grid:
    """Even times over a take, at most 2,000, and positions there with a small second difference.

    f = argmin Σ_i ‖x_i − f(node of t_i)‖² + λ Σ ‖second difference of f‖² passes frequencies far below the cut-off
    1/(2π) (c/λ)^¼ / h, for c samples at each node and a distance h of the nodes; where no samples are, it is a cubic.
    """

    def __init__(self, take: Repaired, straight: Indices) -> None:
        """Take a take, and the indices of the gaps that are bridged by a straight line."""
        times, x = take.times, take.positions
        spacing = max(float(np.median(np.diff(times))), times[-1] / 2000)
        self.nodes = np.linspace(0.0, times[-1], int(np.rint(times[-1] / spacing)) + 1)
        between = [self.nodes[self.within(times[k : k + 2])] for k in straight]
        x = np.concatenate([x, *(interpolate(at, times, x) for at in between)])
        times = np.concatenate([times, *between])
        self._times, self._x, self._mean = times, x, x.mean(axis=0)
        at = np.rint(times / times.max() * (len(self.nodes) - 1)).astype(int)
        self._counts = np.bincount(at, minlength=len(self.nodes)).astype(float)
        centred = (x - self._mean).T
        self._sums = np.stack([np.bincount(at, row, minlength=len(self.nodes)) for row in centred], axis=1)

    def within(self, gap: Array) -> Mask:
        """Nodes between the two moments (2,) of a gap, seconds, by more than half of the distance of nodes."""
        half = self.nodes[1] / 2
        return (self.nodes > gap[0] + half) & (self.nodes < gap[1] - half)

    def smoothed(self, cutoff: float) -> tuple[Array, float]:
        """Positions at the nodes with a cut-off frequency, Hz, and the RMS noise of the samples, metres.

        The curve follows a part of white noise, too, by its response 1/(1 + λ/c (2 sin(ω/2))⁴).
        """
        num = len(self.nodes)
        density = np.median(self._counts[self._counts > 0])
        band = np.array([[1.0], [-4.0], [6.0]]) * np.ones(num)
        band[2, [0, -1]], band[2, [1, -2]], band[1, [1, -1]] = 1.0, 5.0, -2.0
        relative = (2 * np.pi * cutoff * (self.nodes[1] - self.nodes[0])) ** -4
        band *= relative * density
        band[2] += self._counts
        found = solveh_banded(band, self._sums) + self._mean
        away = self._x - interpolate(self._times, self.nodes, found)
        response = 1 / (1 + relative * (2 * np.sin(np.linspace(0, np.pi / 2, 100))) ** 4)
        missed = 1 - (2 * response - response**2).mean() / density
        return found, float(np.sqrt((away**2).sum(axis=1).mean() / missed))


def _find_pauses(takes: Sequence[Repaired], settings: PreparationSettings) -> None:
    """Look for pauses, and cut them. On the way they stay where most takes have one: these belong to the motion."""
    found = [_pauses(take, settings) for take in takes]
    for take, pauses in zip(takes, found, strict=True):
        usual = [
            0 < place < 1 and 2 * sum(any(abs(other[2] - place) < 0.1 for other in each) for each in found) > len(takes)
            for _, _, place in pauses
        ]
        cut = [pause[:2] for pause, kept in zip(pauses, usual, strict=True) if not kept and settings.cut_pauses]
        if pauses:
            remedy = "as most takes do: the pause is kept" if any(usual) else "the learned motion only slows down there"
            amount = f"{sum(last - first for first, last, _ in pauses):.2g} s"
            take.find("pause", "stands still for {}", "the pause is cut" if cut else remedy, amount)
        if cut:
            _cut(take, np.array(cut))


def _pauses(take: Repaired, settings: PreparationSettings) -> list[tuple[float, float, float]]:
    """Find where a take stands still for long: first and last moments, seconds, and the part of the way behind."""
    even = np.linspace(0.0, take.times[-1], 101)
    places = interpolate(even, take.times, take.positions)
    width = 5 if take.jitter else 1
    steps = np.linalg.norm(places[width:] - places[:-width], axis=1) / width
    spread = float(np.sqrt(take.positions.var(axis=0).sum()))
    standing = steps < max(settings.standing_step * spread, settings.noisy_step * take.jitter)
    if take.demonstration.orientations is not None:
        turned = rotation(take.orientations_at(even))
        standing &= (turned[:-width].inv() * turned[width:]).magnitude() / width < settings.standing_turn
    slow = np.convolve(standing, np.ones(width)) > 0
    if slow[1:-1].mean() <= settings.long_stand or slow.all():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], slow, [False]]).astype(int))).reshape(-1, 2)
    way = arc_length(places) / arc_length(places)[-1]
    return [
        (even[first], even[last], 0.0 if first == 0 else 1.0 if last == 100 else way[first])
        for first, last in edges
        if last - first > 2
    ]


def _cut(take: Repaired, pauses: Array) -> None:
    """Cut pauses (N, 2), their first and last moments, seconds; one interval remains of each."""
    times, keep, earlier = take.times, np.ones(len(take.times), bool), np.zeros(len(take.times))
    interval = float(np.median(np.diff(times)))
    for first, last in pauses:
        before, after = np.searchsorted(times, first, "right") - 1, np.searchsorted(times, last)
        keep[before + 1 : after] = False
        earlier[after:] += max(times[after] - times[before] - interval, 0.0)
    take.replace((times - earlier)[keep], take.positions[keep], times[keep])
