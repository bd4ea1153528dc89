"""Covers of links with spheres that stick out of them by little, and the tree of these that body points are.

A sphere around a place at the depth d in a link sticks out of it by no more than its radius less d. So many places in a
link and on its surface are candidates, each with the sphere that sticks out by `CoverSettings.protrusion`, and the one
that covers most of what is left of the surface is taken, again and again. Each then gets the radius that it needs.

Bounding spheres of clusters make a tree of them: the outermost ones are the body points, found as in k-means, with a
handicap for balls that were large; their number grows until none is larger than wanted. Below, clusters are halved.
Lengths are metres, positions those of the joint's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from dt_viz.files.triangles import grid_nodes, inside_of_grid, surface_samples
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.kernels.proximity import step_to_the_farthest
from dt_viz.obstacles.shapes import golden_spiral
from dt_viz.robot.urdf import LinkMesh, cells

Progress = Callable[[float], object]  # called with the fraction that is done, in [0, 1]


@dataclass(frozen=True)
class CoverSettings:
    """Settings of a cover. Those of the file that ships with the JACO are in ``assets/make_body_points.py``."""

    protrusion: float = 5.5e-3  # distance by which the smallest spheres stick out of a link, metres
    spacing: float = 3e-3  # spacing of the points on the surface that spheres are chosen for, metres
    fine_spacing: float = 1.5e-3  # spacing of the points on the surface that their radii hold, metres
    inner_spacing: float = 4.5e-3  # spacing of the candidates in a link, metres
    closing: float = 6e-3
    """Radius of balls that do not enter a link's hollows, metres: these count as solid, as what is open to
    one side alone. 0 leaves all hollows, and all candidates."""
    num_starts: int = 1  # number of beginnings of the clustering, the best of which is taken
    rounds: int = 12  # rounds of the clustering


OUTER_SPACING = 3e-3  # spacing of the candidates on the surface, metres
ROUNDING = 1.4  # largest radius of a body point, in halves of its link's thickness
ACROSS = 1.15  # least such radius, in that of a ball which holds the link across
RADII = (0.03, 0.085)  # least and largest value of that radius, in the arm's reach
MOST = 16  # largest number of body points of a link, whatever their radius
EVENING = 0.5  # part of a difference in radius by which a ball yields spheres in the next round
NUM_LEAVES = 4  # largest number of spheres that are not parted any more
GROUP = 0.02  # size of the cells in which points are compared with spheres, metres
NEARLY = 0.9
"""Part of the distance of two places by which one is deeper whose sphere holds most of the other's."""
Spheres = np.ndarray  # (N, 4): centre and radius, metres


def covering_tree(
    meshes: Sequence[LinkMesh],
    largest: Callable[[LinkMesh], float],
    settings: CoverSettings = CoverSettings(),
    progress: Progress = float,
) -> NDArray[np.void]:
    """Cover links with the spheres of `dt_viz.robot.body_points.BodyPoints`: (N,) of dtype `BODY_POINT`, by joint.

    `largest` gives the radius of a link's body points at most, metres.
    """
    meshes = sorted(meshes, key=lambda mesh: mesh.joint)
    work = np.cumsum([0.0, *(_area(mesh) for mesh in meshes)])
    parts = []
    for mesh, done in zip(meshes, work[1:] / work[-1], strict=True):
        for cluster in _clusters(cover(mesh, settings), largest(mesh), settings):
            nodes, sizes = _tree(cluster)
            part = np.zeros(len(nodes), BODY_POINT)
            part["joint"], part["offset"] = mesh.joint, nodes[:, :3].round(5)
            part["radius"] = np.ceil(1e5 * (nodes[:, 3] + 1e-5)) / 1e5  # what rounding the centres costs
            part["end"] = sum(map(len, parts)) + np.arange(len(nodes)) + sizes
            parts.append(part)
        progress(float(done))
    return np.concatenate(parts)


def protrusion(tree: NDArray[np.void], meshes: Sequence[LinkMesh], spacing: float = 2e-3) -> tuple[float, float]:
    """Measure how far spheres of a `covering_tree` stick out of links, by points at a spacing on their surfaces.

    Returns the mean over the outside of all spheres that move, and the largest such distance, metres.
    """
    found = [np.zeros(1)]
    for joint in np.unique([mesh.joint for mesh in meshes if mesh.joint >= 0]):
        spheres = tree[(tree["joint"] == joint) & (tree["end"] == np.arange(len(tree)) + 1)]
        surface = KDTree(np.concatenate([_on_surface(mesh, spacing) for mesh in meshes if mesh.joint == joint]))
        centres, radii = spheres["offset"], spheres["radius"]
        around = KDTree(centres)
        for centre, radius in zip(centres, radii, strict=True):
            num = int(4 * np.pi * (radius / (2 * spacing)) ** 2) + 8
            points = centre + radius * golden_spiral(num) * [1, 1, -1]
            others = around.query_ball_point(centre, radius + radii.max())
            apart, square = points - centre, centres[others] - centre  # products of small numbers keep their digits
            beyond = (square**2).sum(axis=1) - 2 * apart @ square.T - (radii[others] - 1e-9) ** 2
            found.append(surface.query(points[beyond.min(axis=1) >= -(radius**2)])[0])
    away = np.concatenate(found)
    return float(away.mean()), float(away.max())


def usual_radius(mesh: LinkMesh, reach: float) -> float:
    """Compute the largest radius of a link's body points, metres, from its thickness: no less than holds it across."""
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    along = points @ np.linalg.svd(points, full_matrices=False)[2].T  # principal axes, the longest first
    sides = np.sort(np.ptp(along, axis=0))
    across = min(np.linalg.norm(along[:, 1:], axis=1).max(), np.hypot(*sides[:2]) / 2) + CoverSettings.protrusion
    low, high = (part * reach for part in RADII)
    return float(np.clip(max(ROUNDING * sides[1] / 2, ACROSS * across), low, high))


def cover(mesh: LinkMesh, settings: CoverSettings) -> Spheres:
    """Find spheres that cover a link."""
    fine = _on_surface(mesh, settings.fine_spacing)
    surface, spacing = fine, settings.spacing
    if spacing > settings.fine_spacing:
        surface = fine[np.unique(cells(fine, spacing), return_index=True)[1]]
    inner, outline = _solid(mesh, fine, settings)
    outer = surface[:: max(1, round((OUTER_SPACING / spacing) ** 2))]
    centres = np.concatenate([inner, outer])
    radii = KDTree(outline).query(centres)[0] + settings.protrusion - settings.fine_spacing / 4
    # reduced so that what lies between points is covered, too
    taken = _greedy(surface, centres, radii - settings.fine_spacing / 2)
    return _fitted(centres[taken], radii[taken], fine, settings.fine_spacing / 2)


def _greedy(points: Array, centres: Array, radii: Array) -> Indices:
    """Choose spheres that hold all points (N, 3), always the one that holds most of what is left."""
    found = KDTree(points).query_ball_point(centres, radii)
    counts = np.fromiter(map(len, found), np.int64, len(found))
    held = np.fromiter(chain.from_iterable(found), np.int32, counts.sum())
    holds = csr_array((np.ones(len(held), np.int8), held, np.r_[0, np.cumsum(counts)]), (len(centres), len(points)))
    holders = holds.tocsc()
    left, gains, taken = np.ones(len(points), bool), counts.copy(), []
    while left.any():
        k = int(gains.argmax())
        taken.append(k)
        own = held[holds.indptr[k] : holds.indptr[k + 1]]
        own = own[left[own]]
        left[own] = False
        losing = np.concatenate([holders.indices[holders.indptr[p] : holders.indptr[p + 1]] for p in own])
        gains -= np.bincount(losing, minlength=len(gains))
    return np.array(taken)


def _fitted(centres: Array, radii: Array, points: Array, slack: float) -> Spheres:
    """Give each sphere the radius for those of the points (N, 3) that are deepest in it, or nearest to it."""
    needed = np.zeros(len(radii))
    _, member = np.unique(cells(points, GROUP), return_inverse=True)
    for some in np.split(points[np.argsort(member)], np.cumsum(np.bincount(member))[:-1]):
        middle = some.mean(axis=0)
        about = np.linalg.norm(centres - middle, axis=1) - radii
        near = np.flatnonzero(about <= about.min() + 2 * np.linalg.norm(some - middle, axis=1).max() + 1e-9)
        away = np.linalg.norm(some[:, None] - centres[near], axis=2)
        own = (away - radii[near]).argmin(axis=1)
        np.maximum.at(needed, near[own], away[np.arange(len(some)), own])
    kept = needed > 0
    return np.column_stack([centres, needed + slack])[kept]


def _on_surface(mesh: LinkMesh, spacing: float) -> Array:
    return np.concatenate([mesh.vertices, surface_samples(mesh.vertices[mesh.faces], spacing)[0]])


def _area(mesh: LinkMesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _solid(mesh: LinkMesh, surface: Array, settings: CoverSettings) -> tuple[Array, Array]:
    """Return nodes (N, 3) of a grid in a link without hollows that no ball of the settings enters, and its outside."""
    cell, pad = settings.inner_spacing, int(np.ceil(2 * settings.closing / settings.inner_spacing))
    lower, upper = surface.min(axis=0) - pad * cell, surface.max(axis=0) + pad * cell
    shape = tuple(int(n) for n in np.ceil((upper - lower) / cell) + 1)
    nodes, inside = grid_nodes(lower, cell, shape), inside_of_grid(mesh.vertices[mesh.faces], lower, cell, shape)
    if not settings.closing:
        return nodes[inside.ravel()], surface
    at, shell = tuple(np.round((surface - lower) / cell).astype(int).T), np.zeros(shape, bool)
    shell[at] = True
    closed = _closed(inside | shell, settings.closing / cell)
    depth = np.asarray(ndimage.distance_transform_edt(closed))
    border = nodes[((depth > 0) & (depth < 1.5)).ravel()]
    bridging = border[KDTree(surface).query(border)[0] > 1.5 * cell]
    outline = np.concatenate([surface[depth[at] < 2.5], bridging])
    solid = inside | (closed & ~shell)
    return nodes[(solid & _ridges(depth)).ravel()], outline


def _closed(inside: Mask, radius: float) -> Mask:
    """Fill what no ball of a radius, in cells, reaches from outside, and what is open to one side at most."""
    grown = np.asarray(ndimage.distance_transform_edt(~inside)) <= radius
    closed = np.asarray(ndimage.distance_transform_edt(ndimage.binary_fill_holes(grown))) > radius
    walls = sum(
        np.flip(np.maximum.accumulate(np.flip(inside, axis), axis=axis), axis).astype(np.int8)
        + np.maximum.accumulate(inside, axis=axis)
        for axis in range(3)
    )
    return inside | closed | (walls >= 5)


def _ridges(depth: Array) -> Mask:
    """Find nodes that no neighbour is deeper than by nearly its distance: spheres of others are in that of one."""
    padded, kept = np.pad(depth, 1), np.ones(depth.shape, bool)
    n, m, k = depth.shape
    for step in product(range(3), repeat=3):
        x, y, z = step
        away = np.linalg.norm(np.array(step) - 1)
        if away:
            kept &= padded[x : x + n, y : y + m, z : z + k] < depth + NEARLY * away
    return kept


# --- The tree ---


def _clusters(spheres: Spheres, largest: float, settings: CoverSettings) -> list[Spheres]:
    """Part spheres so that bounding spheres are not larger than wanted, or into as many parts as there may be."""
    rng, most = np.random.default_rng(0), min(MOST, len(spheres))
    for k in range(1, most + 1):
        found = [part for _ in range(settings.num_starts) for part in _clusterings(spheres, k, rng, settings.rounds)]
        radius, best = min(found, key=lambda found: found[0])
        if radius <= largest or k == most:
            return best
    return []


def _clusterings(
    spheres: Spheres, k: int, rng: np.random.Generator, rounds: int
) -> Iterator[tuple[float, list[Spheres]]]:
    """Part spheres into at most k clusters, round by round, each after its largest radius."""
    centres, handicap = rng.choice(spheres[:, :3], k, replace=False), np.zeros(k)
    for _ in range(rounds):
        away = np.linalg.norm(spheres[:, None, :3] - centres, axis=2) + spheres[:, 3:]
        nearest = (away + handicap).argmin(axis=1)
        kept = np.unique(nearest)
        clusters = [spheres[nearest == cluster] for cluster in kept]
        around = np.array([bounding_sphere(cluster) for cluster in clusters])
        yield around[:, 3].max(), clusters
        centres, handicap = around[:, :3], handicap[kept] + EVENING * (around[:, 3] - around[:, 3].mean())


def bounding_sphere(spheres: Spheres) -> Array:
    """Find the smallest sphere (4,) around others, about: its centre steps to the farthest (Bădoiu and Clarkson)."""
    centre = spheres[:, :3].mean(axis=0)
    step_to_the_farthest(centre, np.ascontiguousarray(spheres), 98)
    return np.append(centre, (np.linalg.norm(spheres[:, :3] - centre, axis=1) + spheres[:, 3]).max())


def _tree(spheres: Spheres) -> tuple[Spheres, Indices]:
    """Return the spheres and those around halves of them, depth first, and the number (M,) in each with itself."""
    if len(spheres) == 1:
        return spheres, np.ones(1, dtype=int)
    if len(spheres) <= NUM_LEAVES:
        parts = list(spheres[:, None])
    else:
        along = np.ptp(spheres[:, :3], axis=0).argmax()
        order = spheres[:, along].argsort()
        parts = [spheres[half] for half in np.array_split(order, 2)]
    trees = [_tree(part) for part in parts]
    nodes = np.concatenate([bounding_sphere(spheres)[None], *(nodes for nodes, _ in trees)])
    return nodes, np.concatenate([[len(nodes)], *(sizes for _, sizes in trees)])
