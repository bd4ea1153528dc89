"""Initial guess of a fit: the mean demonstration is straightened in stages, each learned by linear regression.

Descent from the identity map cannot find a motion that turns through large angles: the direction in which space bends
must be known first. The mean demonstration's tangent turns along the motion; scaling that turning by τ from 1
to 0 unbends it into a straight line. The other demonstrations are carried along in the moving frame of the mean.

A motion that winds around an axis along which it advances all the way, a helix, would swing its ends around far from
the data. It is pushed onto a straight line instead, across that axis: y ↦ y − m(y∥), a shear, folds no space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.learning.flow_chain import FlowChain, FlowLayer
from dt_viz.numerics import unit

SMOOTHING = 0.04  # width of the filter for tangents, as a fraction of the motion; half of it to find what winds
BLUNT = 0.1  # rounding, rad, of the geometric median of all turning
MIN_ADVANCE = 0.1  # advance along the axis, in parts of its way, that each step of what is sheared makes
APART = 0.8  # mean distance, in spreads, below which motions belong to one group


def unbending(motions: Array, num_stages: int, longest: float, max_stages: int) -> list[Array]:
    """Return shapes of the motions from rays (first) to themselves (last), about equally far from each other.

    Motions that come to the goal in several ways are unbent group by group. Then each group keeps its direction at the
    goal, so that the groups stay side by side in the order in which they arrive.

    Args:
        motions: (R, n, d) with a common goal, points of one index corresponding to each other, and a spread of about 1.
        num_stages: smallest number of maps that bend; one more before them spreads the rays, so that there are at least
            two more shapes (R, n, d), in each of which every motion ends at the goal.
        longest: largest distance by which a map may move a point; it decides the number of maps.
        max_stages: largest number of maps.
    """
    groups = groups_of(motions)
    members = [groups == group for group in range(groups.max() + 1)]
    shapes_of = [_unbent(motions[member], keep_arrival=len(members) > 1) for member in members]
    if len(members) == 1 and (axis := _axis(motions.mean(axis=0))) is not None:
        shapes_of = [_sheared(motions, axis)]

    def shape(tau: float) -> Array:
        result = np.empty_like(motions)
        for member, shape_of in zip(members, shapes_of, strict=True):
            result[member] = shape_of(tau)
        return result

    taus = np.linspace(0.0, 1.0, 17)
    moves = [np.linalg.norm(b - a, axis=-1).max() for a, b in pairwise([shape(tau) for tau in taus])]
    travelled = np.concatenate([[0.0], np.cumsum(moves)])
    num = int(np.clip(np.ceil(travelled[-1] / longest), num_stages, max_stages))
    shapes = [shape(tau) for tau in np.interp(np.linspace(0.0, travelled[-1], num + 1), travelled, taus)]
    fraction = np.linspace(0.0, 1.0, motions.shape[1])[:, None]
    rays = shapes[0][:, :1] * (1 - fraction) + shapes[0][:, -1:] * fraction
    return [rays, *shapes]


def groups_of(motions: Array, num: int | None = None) -> NDArray[np.integer[Any]]:
    """Number the groups of the motions, (R,), from 0: `num` of them at most; None decides by how far they are apart."""
    if len(motions) == 1:
        return np.zeros(1, dtype=int)
    distance = np.linalg.norm(motions[:, None] - motions[None], axis=-1).mean(axis=-1)
    tree = linkage(distance[np.triu_indices(len(motions), 1)], "average")
    return (fcluster(tree, APART, "distance") if num is None else fcluster(tree, num, "maxclust")) - 1


def _unbent(motions: Array, *, keep_arrival: bool) -> Callable[[float], Array]:
    """The motions (R, n, d) of one group with their turning scaled by τ: 1 keeps them, 0 straightens their mean."""
    solid = _solid(motions)
    mean = solid.mean(axis=0)
    turned, frames = _turned(_tangents(mean, SMOOTHING))
    # The turning that is kept: of the arrival, or the middle of all turning, so that no end turns too far.
    fixed = len(turned) - 1 if keep_arrival else len(turned) // 2
    from_kept = turned[fixed] - (turned[-1] if keep_arrival else _middle(turned))

    def shape(tau: float) -> Array:
        start = frames[fixed] * Rotation.from_rotvec((tau - 1) * from_kept)
        rotation = _chain_rotations(tau * np.diff(turned, axis=0), fixed, start) * frames.inv()
        segments = rotation[:-1].apply(np.diff(mean, axis=0))
        curve = mean[-1] - np.concatenate([np.cumsum(segments[::-1], axis=0)[::-1], np.zeros((1, 3))])
        carried = np.stack([rotation.apply(offset) for offset in solid - mean])
        return (curve + carried)[..., : motions.shape[-1]]

    return shape


def _sheared(motions: Array, axis: Array) -> Callable[[float], Array]:
    """The motions (R, n, d) with their mean's offset from a straight line, across an axis, scaled by τ."""
    mean = motions.mean(axis=0)
    part = ((mean - mean[0]) @ axis / ((mean[-1] - mean[0]) @ axis))[:, None]
    offset = mean - (1 - part) * mean[0] - part * mean[-1]
    return lambda tau: motions - (1 - tau) * offset


def _axis(mean: Array) -> Array | None:
    """Find the axis (d,) that a motion (n, d) winds around and along which it always advances; None if there is none.

    It is the direction of the shortest convex combination of the tangents, whose length is the smallest advance.
    """
    tangents = _tangents(_solid(mean), SMOOTHING / 2)  # smoothed as much as usual, four turns would hardly be left
    turned, _ = _turned(tangents)
    if np.linalg.norm(turned - _middle(turned), axis=1).max() < np.pi:  # what always advances in the plane turns less
        return None
    weights, _ = nnls(np.vstack([tangents.T, np.ones(len(tangents))]), np.array([0.0, 0.0, 0.0, 1.0]))
    axis = tangents.T @ weights / weights.sum()
    advance = float(np.linalg.norm(axis))
    return axis[: mean.shape[1]] / advance if advance > MIN_ADVANCE else None


def _tangents(mean: Array, smoothing: float) -> Array:
    """Compute unit tangents (n, d) of a motion, smoothed over a part of it."""
    return unit(np.gradient(gaussian_filter1d(mean, smoothing * len(mean), axis=0, mode="nearest"), axis=0))


def _middle(turned: Array) -> Array:
    """Compute the middle (3,) of all turning (n, 3): its geometric median, rounded off by `BLUNT`.

    Minimises Σ √(‖turned_k − m‖² + BLUNT²) by Weiszfeld's iteration. Unlike the element in the middle, which two
    elements of a motion in the plane tie for, it is a continuous function of the motion.
    """
    middle = turned.mean(axis=0)
    for _ in range(50):
        weights = 1.0 / np.sqrt(((turned - middle) ** 2).sum(axis=1) + BLUNT**2)
        middle = weights @ turned / weights.sum()
    return middle


def _solid(motions: Array) -> Array:
    """Return motions in the plane as motions in space."""
    return np.concatenate([motions, np.zeros((*motions.shape[:-1], 3 - motions.shape[-1]))], axis=-1)


def _turned(tangents: Array) -> tuple[Array, Rotation]:
    """Compute the turning (n, 3) of tangents (n, 3) up to each, in the rotation-minimising frame, and that frame."""
    axis = np.cross(tangents[:-1], tangents[1:])
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (tangents[:-1] * tangents[1:]).sum(axis=1, keepdims=True))
    world = axis / np.maximum(sine, 1e-12) * angle
    frames = [Rotation.identity()]
    for vector in world:
        frames.append(Rotation.from_rotvec(vector) * frames[-1])
    stacked = Rotation.concatenate(frames)
    increments = stacked[:-1].inv().apply(world)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(increments, axis=0)]), stacked


def _chain_rotations(increments: Array, kept: int, start: Rotation) -> Rotation:
    """Chain body-fixed increments (n − 1, 3) to frames, of which the one with index `kept` equals `start`."""
    steps = Rotation.from_rotvec(increments)
    frames = {kept: start}
    for k in range(kept, len(increments)):
        frames[k + 1] = frames[k] * steps[k]
    for k in range(kept - 1, -1, -1):
        frames[k] = frames[k + 1] * steps[k].inv()
    return Rotation.concatenate([frames[k] for k in range(len(increments) + 1)])


def regress(chain: FlowChain, shapes: Sequence[Array], regularisation: float, iterations: int = 5) -> list[Array]:
    """Fit each of L layers, one after the other, to carry its shape, of L + 1 (R, n, d), to the next one.

    The regularisation weighs the squared RKHS norm against the mean squared distance; fixed-point iterations find the
    path through the layer's Euler steps. Returns the coefficients (m_l, d) of each layer.
    """
    h = 1.0 / chain.steps
    current = shapes[0].reshape(-1, chain.dim)
    thetas = []
    for layer, shape in zip(chain.layers, shapes[1:], strict=True):
        target = shape.reshape(-1, chain.dim)
        theta = np.zeros((layer.num_features, chain.dim))
        for _ in range(iterations):
            s, jacobian = current, np.zeros((len(current), layer.num_features))
            for _ in range(chain.steps):
                features = layer.features(s)
                jacobian += h * features
                s = s + h * (features @ theta)
            normal = jacobian.T @ jacobian / len(s) + regularisation * np.eye(len(theta))
            theta += cho_solve(cho_factor(normal), jacobian.T @ (target - s) / len(s) - regularisation * theta)
        for _ in range(chain.steps):
            current = current + h * (layer.features(current) @ theta)
        thetas.append(theta)
    return thetas


def layers_along(shapes: Sequence[Array], sigma: float, *, spacing: float, reach: float) -> tuple[FlowLayer, ...]:
    """Make a layer for each pair of neighbouring shapes (R, n, d), with Gaussians near the two only."""
    d = shapes[0].shape[-1]
    return tuple(
        FlowLayer.near(np.concatenate([a, b]).reshape(-1, d), sigma, spacing=spacing, reach=reach)
        for a, b in pairwise(shapes)
    )
