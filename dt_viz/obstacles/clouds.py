"""Point clouds as solids: the occupied space between the points, and its surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_least, check_at_most, check_finite
from dt_viz.files.triangles import grid_nodes
from dt_viz.flows.fields import Array, Indices
from dt_viz.obstacles.occupancy import fit_occupancy
from dt_viz.obstacles.solids import ByContent, Solid

MIN_POINTS, MAX_POINTS = 50, 100_000  # smallest and largest number of points of a cloud


@dataclass(frozen=True)
class CloudSettings:
    """How the space that a cloud occupies is found."""

    num_nodes: int = 44**3  # approximate number of nodes of the grid on which the surface is found
    reach: float = 1.2
    """Radius of the occupied ball around an unlabelled point, in units of the ninth decile of the distance from the
    sixth nearest point: random points on a surface then leave no hole."""
    fewest_cells: float = 1.2
    """Smallest such radius in cells of the grid: thinner walls would have holes."""
    kernels_across: float = 5
    """Number of kernel widths along the largest side of the occupied points, where they are labelled."""
    num_samples: int = 2000  # largest number of labelled points that the map is learned from
    regularisation: float = 0.1  # weight of ½‖w‖² of that map


SETTINGS = CloudSettings()


def check_points(points: Array, labels: Array | None) -> None:
    """Raise FormatError unless these are enough finite points (K, 3), with labels (K,) of both kinds or none."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise FormatError("array 'points'", f"shape {points.shape}", "shape (K, 3)")
    check_at_least("points", len(points), MIN_POINTS)
    check_finite(points, "points", lambda row: f"in point {row + 1}")
    if labels is None:
        return
    if labels.shape != (len(points),):
        raise FormatError("array 'labels'", f"shape {labels.shape}", f"shape ({len(points)},)")
    wrong = np.flatnonzero((labels != 0) & (labels != 1))
    if len(wrong):
        found = f"{labels[wrong[0]]:g} for point {wrong[0] + 1}"
        raise FormatError("labels", found, "1 for occupied and 0 for free")
    if (labels == labels[0]).all():
        kind = "occupied" if labels[0] else "free"
        raise FormatError("labels", f"all {len(labels)} points {kind}", "both kinds, or no labels")
    check_at_least("labels", int(labels.sum()), MIN_POINTS, "occupied points")


@dataclass(frozen=True, eq=False)
class Cloud(ByContent):
    """Points on or in a solid, or labelled points; compared and hashed by content.

    Raises:
        FormatError: they are too few or too many, or, without labels, the same; or not finite, or wrongly labelled.
    """

    points: Array  # (K, 3) metres, in the cloud's own frame
    labels: Array | None = None  # (K,) 1 occupied and 0 free; None where all are occupied

    def __post_init__(self) -> None:
        self._keep(points=float, labels=float)
        check_at_most("points", len(self.points), MAX_POINTS)
        check_points(self.points, self.labels)
        if self.labels is None:  # a search among very many points in one place takes the square of their number
            check_at_least("points", len(np.unique(self.points, axis=0)), MIN_POINTS, "different ones")

    @property
    def solid(self) -> Solid:
        """Solid that it occupies; computed once for all equal clouds.

        With labels it is where the occupancy map learned from them (sec. 4.4) has p > 1/2. Without, it is the space
        near the points, and the space enclosed by that: a scan of a surface is filled.

        Raises:
            ValueError: nothing is occupied.
        """
        return _solid(self)


@lru_cache(maxsize=16)
def _solid(cloud: Cloud) -> Solid:
    occupied = cloud.points if cloud.labels is None else cloud.points[cloud.labels > 0.5]
    lower, upper = occupied.min(axis=0), occupied.max(axis=0)
    largest = float((upper - lower).max())
    if cloud.labels is None:
        tree = KDTree(occupied)
        spacing = float(np.quantile(tree.query(occupied, k=7)[0][:, 6], 0.9))
        cell = _cell(upper - lower + 4 * SETTINGS.reach * spacing)
        reach = max(SETTINGS.reach * spacing, SETTINGS.fewest_cells * cell)
        origin, nodes, shape = _grid(lower - reach, upper + reach, cell)
        level = (tree.query(nodes)[0] - reach).reshape(shape)
        enclosed = np.asarray(ndimage.binary_fill_holes(level < 0))
        level = np.where(enclosed, -np.abs(level), level)
    else:
        some = np.random.default_rng(0).permutation(len(cloud.points))[: SETTINGS.num_samples]
        width = largest / SETTINGS.kernels_across
        occupancy = fit_occupancy(cloud.points[some], cloud.labels[some], width, regularisation=SETTINGS.regularisation)
        cell = _cell(upper - lower + 2 * width)
        origin, nodes, shape = _grid(lower - width, upper + width, cell)
        level = -occupancy.logit(nodes).reshape(shape)
    for axis in range(3):  # the border of the grid is free
        ends = np.moveaxis(level, axis, 0)
        ends[[0, -1]] = np.maximum(ends[[0, -1]], np.abs(level).max() * 1e-3)
    if not (level < 0).any():
        raise ValueError("the occupancy map learned from the labels is nowhere occupied")
    vertices, faces = zero_level(level)
    return Solid(origin + cell * vertices, faces)


def _cell(sizes: Array) -> float:
    return float(np.cbrt(np.prod(np.maximum(sizes, 0.05 * sizes.max())) / SETTINGS.num_nodes))


def _grid(lower: Array, upper: Array, cell: float) -> tuple[Array, Array, tuple[int, int, int]]:
    """Return a grid's first node, all its nodes (N, 3), and their number per axis; two cells more on each side."""
    x, y, z = (int(num) for num in np.ceil((upper - lower) / cell) + 5)
    origin = (lower + upper) / 2 - cell * (np.array([x, y, z]) - 1) / 2
    return origin, grid_nodes(origin, cell, (x, y, z)), (x, y, z)


def zero_level(level: Array) -> tuple[Array, Indices]:
    """Find the closed surface between negative and positive nodes of a grid (n_x, n_y, n_z), outward (surface nets).

    Each cell with nodes of both signs has one vertex, the mean of its edges' crossings with the level; each edge that
    crosses the level has a quadrilateral, whose corners are the vertices of the four cells around it.

    Returns:
        Vertices (V, 3), counted in cells from the first node, and faces (F, 3).
    """
    inside = level < 0
    cells = tuple(n - 1 for n in level.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells, dtype=np.intp)
    edges = []
    for axis in range(3):
        first = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        at = np.argwhere(inside[first] != inside[second])
        a, b = level[first][tuple(at.T)], level[second][tuple(at.T)]
        crossing = at + (a / (a - b))[:, None] * np.eye(3)[axis]
        others = (axis + 1) % 3, (axis + 2) % 3
        around = []
        for back in ((1, 1), (0, 1), (0, 0), (1, 0)):
            cell = at.copy()
            cell[:, others] -= back
            around.append(np.ravel_multi_index(tuple(cell.T), cells))
            np.add.at(total.reshape(-1, 3), around[-1], crossing)
            np.add.at(count.reshape(-1), around[-1], 1)
        quads = np.stack(around, axis=1)
        edges.append(np.where((a < 0)[:, None], quads, quads[:, ::-1]))
    used = np.flatnonzero(count)
    number = np.full(count.size, -1)
    number[used] = np.arange(len(used))
    quads = number[np.concatenate(edges)]
    return total.reshape(-1, 3)[used] / count.reshape(-1)[used, None], quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
