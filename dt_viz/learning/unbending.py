"""Initial guess of a fit: the mean demonstration is straightened in stages, each learned by linear regression.

Descent from the identity map cannot find a motion that turns through large angles: the direction in which space bends
must be known first. The mean demonstration's tangent turns along the motion; scaling that turning by τ from 1
to 0 unbends it into a straight line. The other demonstrations are carried along in the moving frame of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.learning.flow_chain import Layer, Stack

SMOOTHING = 0.04  # width of the filter for tangents, as a fraction of the motion
APART = 0.8  # mean distance, in spreads, below which motions belong to one group


def unbending(motions: Array, num_stages: int, longest: float, max_stages: int) -> list[Array]:
    """Return shapes of the motions from rays (first) to themselves (last), about equally far from each other.

    Motions that come to the goal in several ways are unbent group by group. Then each group keeps its direction at the
    goal, so that the groups stay side by side in the order in which they arrive.

    Args:
        motions: (R, n, d) motions with a common goal, points of one index corresponding to each other; d is 2 or 3.
            Their spread (RMS distance from the mean) is about 1.
        num_stages: smallest number of maps that bend; one more before them spreads the rays.
        longest: largest distance by which a map may move a point; it decides the number of maps.
        max_stages: largest number of maps.

    Returns:
        At least `num_stages` + 2 arrays (R, n, d). In each, every motion ends at the goal.
    """
    groups = groups_of(motions)
    members = [groups == group for group in range(groups.max() + 1)]
    unbendings = [_Unbending(motions[member], keep_arrival=len(members) > 1) for member in members]

    def shape(tau: float) -> Array:
        result = np.empty_like(motions)
        for member, part in zip(members, unbendings, strict=True):
            result[member] = part.shape(tau)
        return result

    taus = np.linspace(0.0, 1.0, 17)
    moves = [np.linalg.norm(b - a, axis=-1).max() for a, b in pairwise([shape(tau) for tau in taus])]
    travelled = np.concatenate([[0.0], np.cumsum(moves)])
    num = int(np.clip(np.ceil(travelled[-1] / longest), num_stages, max_stages))
    shapes = [shape(tau) for tau in np.interp(np.linspace(0.0, travelled[-1], num + 1), travelled, taus)]
    fraction = np.linspace(0.0, 1.0, motions.shape[1])[:, None]
    rays = shapes[0][:, :1] * (1 - fraction) + shapes[0][:, -1:] * fraction
    return [rays, *shapes]


def groups_of(motions: Array) -> NDArray[np.integer[Any]]:
    """Number the groups of the motions, (R,), from 0."""
    if len(motions) == 1:
        return np.zeros(1, dtype=int)
    distance = np.linalg.norm(motions[:, None] - motions[None], axis=-1).mean(axis=-1)
    tree = linkage(distance[np.triu_indices(len(motions), 1)], "average")
    return fcluster(tree, APART, "distance") - 1


class _Unbending:
    """The motions of one group as a function of the remaining part of their turning."""

    def __init__(self, motions: Array, *, keep_arrival: bool) -> None:
        solid = _solid(motions)
        self._mean = solid.mean(axis=0)
        self._offsets = solid - self._mean
        self._dim = motions.shape[-1]
        turned, self._frames = _turned(self._mean)
        self._increments = np.diff(turned, axis=0)
        # The element whose direction is kept: the last, or the middle one of all turning, so that no end turns too far.
        middle = np.linalg.norm(turned[:, None] - turned[None], axis=-1).sum(axis=1)
        self._kept = len(turned) - 1 if keep_arrival else int(np.argmin(middle))

    def shape(self, tau: float) -> Array:
        """Return the motions (R, n, d) with their turning scaled by `tau`: 1 keeps them, 0 straightens their mean."""
        rotation = _chain_rotations(tau * self._increments, self._kept, self._frames[self._kept]) * self._frames.inv()
        segments = rotation[:-1].apply(np.diff(self._mean, axis=0))
        curve = self._mean[-1] - np.concatenate([np.cumsum(segments[::-1], axis=0)[::-1], np.zeros((1, 3))])
        carried = np.stack([rotation.apply(offset) for offset in self._offsets])
        return (curve + carried)[..., : self._dim]


def _solid(motions: Array) -> Array:
    """Return motions in the plane as motions in space."""
    return np.concatenate([motions, np.zeros((*motions.shape[:-1], 3 - motions.shape[-1]))], axis=-1)


def _turned(mean: Array) -> tuple[Array, Rotation]:
    """Compute the tangent's turning (n, 3) up to each point, in the rotation-minimising frame, and that frame."""
    tangents = np.gradient(gaussian_filter1d(mean, SMOOTHING * len(mean), axis=0, mode="nearest"), axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
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


def regress(stack: Stack, shapes: Sequence[Array], regularisation: float, iterations: int = 5) -> list[Array]:
    """Fit each layer, one after the other, to carry its shape to the next one.

    Args:
        stack: L layers.
        shapes: L + 1 arrays (R, n, d).
        regularisation: weight of the squared RKHS norm against the mean squared distance.
        iterations: number of fixed-point iterations for the path through the layer's Euler steps.

    Returns:
        The coefficients (m_l, d) of each layer.
    """
    h = 1.0 / stack.steps
    current = shapes[0].reshape(-1, stack.dim)
    thetas = []
    for layer, shape in zip(stack.layers, shapes[1:], strict=True):
        target = shape.reshape(-1, stack.dim)
        theta = np.zeros((layer.num_features, stack.dim))
        for _ in range(iterations):
            s, jacobian = current, np.zeros((len(current), layer.num_features))
            for _ in range(stack.steps):
                features = layer.features(s)
                jacobian += h * features
                s = s + h * (features @ theta)
            normal = jacobian.T @ jacobian / len(s) + regularisation * np.eye(len(theta))
            theta += cho_solve(cho_factor(normal), jacobian.T @ (target - s) / len(s) - regularisation * theta)
        for _ in range(stack.steps):
            current = current + h * (layer.features(current) @ theta)
        thetas.append(theta)
    return thetas


def layers_along(shapes: Sequence[Array], sigma: float, *, spacing: float, reach: float) -> tuple[Layer, ...]:
    """Make a layer for each pair of neighbouring shapes (R, n, d), with Gaussians near the two only."""
    d = shapes[0].shape[-1]
    return tuple(
        Layer.near(np.concatenate([a, b]).reshape(-1, d), sigma, spacing=spacing, reach=reach)
        for a, b in pairwise(shapes)
    )
