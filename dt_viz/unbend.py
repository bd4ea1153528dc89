"""The start of a fit: straighten the mean demonstration in stages, and learn each stage by linear regression.

A motion that turns through large angles cannot be found from the identity map by descent: it must first be known which
way the plane is to be bent. The mean demonstration's tangent turns along the motion; scaling that turning by τ from 1
to 0 unbends it into a straight line. The other demonstrations are carried along in the moving frame of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dt_viz.fields import Array
from dt_viz.layers import Layer, Stack


def unbending(motions: Array, num_stages: int, smoothing: float = 0.04) -> list[Array]:
    """Shapes of the motions from rays (first) to themselves (last).

    Args:
        motions: (R, n, d) motions with a common goal, points of one index belonging together; d is 2 or 3.
        num_stages: number of maps between neighbouring shapes, at least 2.
        smoothing: width of the filter before tangents are taken, as a fraction of the motion.

    Returns:
        `num_stages` + 1 arrays (R, n, d). In each, every motion ends at the goal.
    """
    num, d = motions.shape[1:]
    solid = np.concatenate([motions, np.zeros((*motions.shape[:2], 3 - d))], axis=2)
    mean, goal = solid.mean(axis=0), solid[0, -1]
    offsets = solid - mean
    increments, frames = _turning(mean, smoothing * num)
    # The element whose direction is kept: the middle one of the total turning, so that no end turns too far.
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(increments, axis=0)])
    kept = int(np.argmin(np.linalg.norm(turned[:, None] - turned[None], axis=-1).sum(axis=1)))

    shapes = []
    for tau in np.linspace(0.0, 1.0, num_stages):
        rotation = _chain_rotations(tau * increments, kept, frames[kept]) * frames.inv()
        segments = rotation[:-1].apply(np.diff(mean, axis=0))
        curve = goal - np.concatenate([np.cumsum(segments[::-1], axis=0)[::-1], np.zeros((1, 3))])
        carried = np.stack([rotation.apply(offset) for offset in offsets])
        shapes.append((curve + carried)[..., :d])
    fraction = np.linspace(0.0, 1.0, num)[:, None]
    rays = shapes[0][:, :1] * (1 - fraction) + goal[:d] * fraction
    return [rays, *shapes]


def _turning(mean: Array, width: float) -> tuple[Array, Rotation]:
    """Rotation vectors (n − 1, 3) from tangent to tangent, in the moving frame, and that rotation-minimising frame."""
    tangents = np.gradient(gaussian_filter1d(mean, width, axis=0, mode="nearest"), axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    axis = np.cross(tangents[:-1], tangents[1:])
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (tangents[:-1] * tangents[1:]).sum(axis=1, keepdims=True))
    world = axis / np.maximum(sine, 1e-12) * angle
    frames = [Rotation.identity()]
    for vector in world:
        frames.append(Rotation.from_rotvec(vector) * frames[-1])
    stacked = Rotation.concatenate(frames)
    return stacked[:-1].inv().apply(world), stacked


def _chain_rotations(increments: Array, kept: int, start: Rotation) -> Rotation:
    """Frames whose body-fixed increments are given (n − 1, 3), with the frame of index `kept` equal to `start`."""
    steps = Rotation.from_rotvec(increments)
    frames = {kept: start}
    for k in range(kept, len(increments)):
        frames[k + 1] = frames[k] * steps[k]
    for k in range(kept - 1, -1, -1):
        frames[k] = frames[k + 1] * steps[k].inv()
    return Rotation.concatenate([frames[k] for k in range(len(increments) + 1)])


def regress(stack: Stack, shapes: Sequence[Array], regularisation: float, iterations: int = 5) -> list[Array]:
    """Coefficients of each layer such that it carries its shape to the next one, layer after layer.

    Args:
        stack: L layers.
        shapes: L + 1 arrays (R, n, d).
        regularisation: weight of the squared RKHS norm against the mean squared distance.
        iterations: of the fixed-point iteration for the path through the layer's Euler steps.
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
    """One layer for each pair of neighbouring shapes (R, n, d), with Gaussians only near the two."""
    d = shapes[0].shape[-1]
    return tuple(
        Layer.near(np.concatenate([a, b]).reshape(-1, d), sigma, spacing=spacing, reach=reach)
        for a, b in pairwise(shapes)
    )
