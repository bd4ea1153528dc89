"""Slices of space: the rectangle that pictures of a vector field lie on, and lines of a function on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.learning.state import State
from dt_viz.obstacles.shapes import Point, Quaternion, as_point, as_quaternion, rotation


@dataclass(frozen=True)
class SlicePose:
    """Pose of a slice, whatever its size."""

    position: Point  # position of the centre, metres
    wxyz: Quaternion  # quaternion that turns x, y and z into its first axis, second axis and normal


@dataclass(frozen=True)
class Slice:
    """The rectangle on which a picture of the vector field is drawn."""

    centre: Array  # (3,) centre, metres
    axes: Array  # (3, 2) orthonormal columns
    half_size: tuple[float, float]  # half the sizes along the axes, metres

    @property
    def normal(self) -> Array:
        """(3,) unit vector across it."""
        return np.cross(*self.axes.T)

    @property
    def pose(self) -> SlicePose:
        """Pose of the slice."""
        frame = np.column_stack([self.axes, self.normal])
        wxyz = np.roll(Rotation.from_matrix(frame).as_quat(), 1)
        return SlicePose(as_point(self.centre), as_quaternion(wxyz))

    def posed(self, pose: SlicePose | None) -> Slice:
        """Return this rectangle at another pose; None leaves it where it is."""
        if pose is None:
            return self
        return replace(self, centre=np.array(pose.position), axes=rotation(pose.wxyz)[:, :2])

    @property
    def key(self) -> tuple[bytes, bytes, tuple[float, float]]:
        """A hashable value; equal rectangles have equal ones."""
        return self.centre.tobytes(), np.ascontiguousarray(self.axes).tobytes(), self.half_size

    def holding(self, paths: Sequence[Array]) -> Slice:
        """Return the smallest rectangle of this plane that holds this one and the feet of paths (T_i, 3), metres."""
        across = np.concatenate([self.across(self.border), *(self.across(path) for path in paths)])
        lower, upper = across.min(axis=0), across.max(axis=0)
        width, height = (upper - lower) / 2
        return replace(self, centre=self.at((lower + upper) / 2), half_size=(float(width), float(height)))

    def grid(self, spacing: float) -> Array:
        """Points (n, m, 3) at about this spacing along the first and the second axis, from corner to corner, metres."""
        u, v = (np.linspace(-h, h, max(2, round(2 * h / spacing) + 1)) for h in self.half_size)
        return self.at(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1))

    def lattice(self, spacing: float) -> Array:
        """The points of `grid`, (N, 3), metres."""
        return self.grid(spacing).reshape(-1, 3)

    def at(self, across: Array) -> Array:
        """World points (*B, 3) of coordinates (*B, 2) on the slice, metres."""
        return self.centre + across @ self.axes.T

    def across(self, points: Array) -> Array:
        """Coordinates (*B, 2) on the slice of the feet of world points (*B, 3), metres."""
        return (points - self.centre) @ self.axes

    @property
    def border(self) -> Array:
        """(5, 3) its closed outline, metres."""
        return self.at(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * self.half_size)


def level_line(points: Array, values: Array) -> Array:
    """Find the zero lines of a function that is linear between lattice points.

    Args:
        points: (n, m, 3) of the lattice.
        values: (n, m) of the function; NaN where it has none.

    Returns:
        (K, 2, 3) segments, one at most for each of the two triangles of a cell.
    """
    flat, f = points.reshape(-1, 3), values.reshape(-1)
    index = np.arange(len(f)).reshape(values.shape)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    triangles = triangles[np.isfinite(f[triangles]).all(axis=1)]
    above = f[triangles] > 0
    triangles, above = (part[above.any(axis=1) & ~above.all(axis=1)] for part in (triangles, above))
    # the corner that lies alone on its side of the line, and the two others
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), above.argmin(axis=1))
    tip = np.take_along_axis(triangles, alone[:, None], axis=1)
    others = np.take_along_axis(triangles, (alone[:, None] + [1, 2]) % 3, axis=1)
    share = (f[tip] / (f[tip] - f[others]))[..., None]
    return flat[tip] + share * (flat[others] - flat[tip])


GAP = 0.06  # distance between rectangles beside each other, metres
TITLE_ROOM = 0.07  # room for the title over each rectangle, metres


@dataclass(frozen=True)
class Panel:
    """What a panel shows: the base attractor, unless it says otherwise."""

    level: str = ""  # name of a level of the stack, from the imitation up
    generator: bool = False
    """Whether it shows the vector field that leads to this level from the one below it."""
    task: str = ""  # name of a task of which it shows the imitation
    state: State = "auto"  # state in which that is learned, whichever the scene's own is

    @property
    def shown(self) -> Panel | None:
        """The panel of all of that imitation; None where it shows the scene's own."""
        return Panel(task=self.task, state=self.state) if self.task else None


BASE_PANEL = Panel()


def offsets(area: Slice, half_size: Array, num: int, camera: tuple[Point, Point]) -> Array:
    """Return where panels stand: in reading order, with the scene's own rectangle as the last one.

    Args:
        area: the scene's rectangle.
        half_size: (2,) half the size of the largest rectangle, metres.
        num: number of panels.
        camera: position (3,) and look-at (3,) of the camera that reads them, metres.

    Returns:
        (num, 3) offsets from the scene's rectangle, metres.
    """
    columns = num + 1 if num < 4 else -(-(num + 1) // 2)  # more than four are in two rows
    row, column = np.divmod(np.arange(num + 1), columns)
    # a last row that is not full ends with the scene, too
    column = np.where(row == row[-1], column + columns - 1 - column[-1], column)
    right, up = directions(area, camera)
    width, height = 2 * half_size + (GAP, GAP + TITLE_ROOM)
    return ((column[:-1] - columns + 1) * width)[:, None] * right + ((row[-1] - row[:-1]) * height)[:, None] * up


def directions(area: Slice, camera: tuple[Point, Point]) -> tuple[Array, Array]:
    """Return the unit vectors (3,) along a rectangle that point to the right and up for a camera; see `offsets`."""
    position, look_at = (np.asarray(place) for place in camera)
    right = np.cross(look_at - position, [0.0, 0.0, 1.0])
    up = np.cross(right, look_at - position)
    first, second = area.axes.T
    return first * (1 if right @ first >= 0 else -1), second * (1 if up @ second >= 0 else -1)
