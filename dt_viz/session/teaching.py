"""Takes that are taught in the page: points of a pointer, smoothed by a spline, and kept as a `Take`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh, solveh_banded

from dt_viz.errors import FormatError, naming
from dt_viz.flows.fields import Array, Mask
from dt_viz.learning.demonstrations import Demonstration, DemonstrationError
from dt_viz.metrics import arc_length, resample_by_arc_length
from dt_viz.robot.placement import REFERENCE_SHOULDER
from dt_viz.robot.robot import Robot
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import DRAWING_AXES, DRAWING_CENTRE
from dt_viz.scenario.taught import Taught


@dataclass(frozen=True)
class TeachingSettings:
    """Settings of how points become a take."""

    interval: float = 0.05
    """Time between two points that a page sends while the pointer moves, seconds."""
    closest: float = 0.002  # time in which points arrived together, seconds: the last one counts
    standing: float = 0.15  # time without a point from which on the pointer stood still, seconds
    most_points: int = 300
    """Largest number of points that a spline is fitted to; of more, evenly chosen ones are used, which is said."""
    most_recorded: int = 4096
    """Number of points at which every second one of a take that is still being made is dropped."""
    least_points: int = 5  # smallest number of points of a take
    shortest: float = 0.02  # smallest length of a take, metres
    rate: float = 50.0  # samples a second of a take that is kept, Hz
    penalty: float = 1.4
    """Weight of the degrees of freedom in generalised cross-validation; above 1 fewer splines follow noise."""
    board: tuple[float, float] = (0.32, 0.28)
    """Half the width and height of the board, metres, for an arm as large as the JACO."""

    @property
    def longest(self) -> float:
        """Duration up to which all points of a take are used, seconds."""
        return self.most_points * self.interval


SETTINGS = TeachingSettings()


@dataclass(eq=False)
class Stroke:
    """Points of one take, as they arrive; strokes that are continued count no time in between."""

    moments: list[float] = field(default_factory=list)  # times of the points, seconds
    places: list[Array] = field(default_factory=list)  # points (3,), metres
    lifted: float = 0.0  # time that has passed without the pen, seconds

    def add(self, moment: float, place: Array, *, begins: bool = False) -> None:
        """Take a point (3,), metres, at a moment, seconds; where a stroke `begins` again, the pen was up before."""
        if begins and self.moments:
            self.lifted = moment - self.moments[-1] - SETTINGS.interval
        self.moments.append(moment - self.lifted)
        self.places.append(place)
        if len(self.moments) >= SETTINGS.most_recorded:
            self.moments, self.places = self.moments[::2], self.places[::2]

    @property
    def points(self) -> Array:
        """The points (N, 3) so far, metres."""
        return np.array(self.places).reshape(-1, 3)


def board_of(robot: Robot) -> Slice:
    """Return the board of an arm: the drawing plane of the tasks, scaled about its shoulder by its size."""
    centre = robot.shoulder + robot.size * (DRAWING_CENTRE - REFERENCE_SHOULDER)
    width, height = SETTINGS.board
    return Slice(centre, DRAWING_AXES[:, :2], (robot.size * width, robot.size * height))


def out_of_reach(robot: Robot, places: Array) -> Mask:
    """Return which (*B,) of some places (*B, 3), metres, the hand does not get to, or are under the table."""
    return ~robot.reaches(places) | (places[..., 2] < 0)


def taught(name: str, stroke: Stroke, board: Slice | None = None) -> Taught:
    """Keep a stroke, drawn on a board or guided in space, as a take of a name.

    Raises:
        DemonstrationError: there are too few points, they hardly move, are not finite, or go too far or too long.
    """
    points = stroke.points
    with naming(DemonstrationError, name):
        times, kept = smoothed(np.array(stroke.moments), points if board is None else board.across(points))
        return Taught(Demonstration(times, kept, name), points, board).checked(name)


def smoothed(times: Array, points: Array, settings: TeachingSettings = SETTINGS) -> tuple[Array, Array]:
    """Fit a smoothing spline through the points of a pointer, and sample it evenly over their times.

    The spline f minimises Σ ‖x_i − f(t_i)‖² + λ ∫ ‖f″‖² dt. λ, one for all coordinates, is chosen by generalised
    cross-validation (Craven and Wahba, 1979) on the eigenvectors of the roughness.

    Args:
        times: (N,) in order, seconds.
        points: (N, d), metres.
        settings: rates and limits.

    Returns:
        Times (T,) from 0, seconds, and positions (T, d), metres.

    Raises:
        FormatError: there are too few points, they hardly move, or they are not finite.
    """
    if not (np.isfinite(times).all() and np.isfinite(points).all()):
        raise FormatError("points", "some that are not finite", "places in the scene")
    arrived = np.floor(times / settings.closest)
    last = np.append(np.diff(arrived) > 0, True)[: len(times)]
    times, points = times[last], points[last]
    length = arc_length(points)[-1] if len(points) > 1 else 0.0
    if len(points) < settings.least_points or length < settings.shortest:
        found = f"{len(points)} point{'s' * (len(points) != 1)}, {1e3 * length:.0f} mm long"
        accepted = f"at least {settings.least_points} points and {1e3 * settings.shortest:.0f} mm: press, draw, let go"
        raise FormatError("take", found, accepted)
    times, points = _with_stands(times - times[0], points, settings)
    chosen = np.unique(np.linspace(0, len(times) - 1, min(len(times), settings.most_points)).round().astype(int))
    times, points = times[chosen], points[chosen]
    even = np.linspace(0.0, times[-1], max(round(times[-1] * settings.rate), 2 * settings.least_points) + 1)
    return even, CubicSpline(times, _without_noise(times, points, settings), bc_type="natural")(even)


def _with_stands(times: Array, points: Array, settings: TeachingSettings) -> tuple[Array, Array]:
    """Points with those that a pointer does not send while it stands still, for as many as a spline is fitted to."""
    moments: list[Array] = [times]
    places: list[Array] = [points]
    for k in np.flatnonzero(np.diff(times) > settings.standing):
        pause = float(times[k + 1] - times[k])
        num = min(round(pause / settings.interval), settings.most_points)
        between = np.linspace(times[k], times[k + 1], num + 1)[1:-1]
        moments.append(between)
        places.append(np.repeat(points[k][None], len(between), axis=0))
    order = np.argsort(np.concatenate(moments), kind="stable")
    return np.concatenate(moments)[order], np.concatenate(places)[order]


def _without_noise(times: Array, points: Array, settings: TeachingSettings) -> Array:
    """Values (N, d) of the smoothing spline at its knots (N,), of which the natural cubic spline is all of it."""
    steps, num = np.diff(times) / times[-1], len(times)
    second = np.zeros((num - 2, num))  # Qᵀ: divided second differences
    rows = np.arange(num - 2)
    second[rows, rows], second[rows, rows + 2] = 1 / steps[:-1], 1 / steps[1:]
    second[rows, rows + 1] = -1 / steps[:-1] - 1 / steps[1:]
    band = np.stack([np.append(0.0, steps[1:-1] / 6), (steps[:-1] + steps[1:]) / 3])
    rough, modes = eigh(second.T @ solveh_banded(band, second))
    rough, parts = np.maximum(rough, 0.0), modes.T @ points
    kept = 1 / (1 + np.logspace(-16, 2, 145)[:, None] * rough)  # of each mode, for each λ
    left = num - settings.penalty * kept.sum(axis=1)
    misfit = ((1 - kept) ** 2 @ parts**2).sum(axis=1)
    score = np.where(left > 0, (misfit + 1e-12 * (parts**2).sum()) / np.maximum(left, 1e-9) ** 2, np.inf)
    return modes @ (kept[np.argmin(score)][:, None] * parts)


def crosses_itself(path: Array, num: int = 41) -> bool:
    """Return whether a path (N, d), of which so many points are looked at, crosses itself in the plane or in space.

    Two of its pieces cross where both are seen along their common normal; in space they are nearer to each other than
    a piece is long. Smaller loops, as of a pen that stands, are not seen.
    """
    coarse = resample_by_arc_length(np.pad(path, [(0, 0), (0, 3 - path.shape[1])]), num)
    i, j = np.triu_indices(num - 1, k=2)  # neighbours touch
    pieces, between = np.diff(coarse, axis=0), coarse[j] - coarse[i]
    normal, lengths = np.cross(pieces[i], pieces[j]), np.linalg.norm(pieces, axis=1)
    square = (normal**2).sum(axis=1)
    skew = square > 1e-12 * (lengths[i] * lengths[j]) ** 2  # parallel pieces have no common normal
    i, j, between, normal, square = (part[skew] for part in (i, j, between, normal, square))
    along_i, along_j = ((np.cross(between, pieces[k]) * normal).sum(axis=1) / square for k in (j, i))
    near = np.abs((between * normal).sum(axis=1)) < lengths.max() * np.sqrt(square)
    return bool((near & (along_i > 0) & (along_i < 1) & (along_j > 0) & (along_j < 1)).any())


def drawn_beyond(robot: Robot, paths: Sequence[Array]) -> list[Array]:
    """Return the pieces (K, 3), metres, of paths (N_i, 3) that are out of an arm's reach."""
    pieces: list[Array] = []
    for path in paths:
        beyond = out_of_reach(robot, path)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], beyond, [False]]).astype(int))).reshape(-1, 2)
        pieces += [path[max(first - 1, 0) : last + 1] for first, last in edges]
    return pieces
