"""Orientations as unit quaternions wxyz, and in the tangent space at one of them, where motions are learned.

An orientation q is q_e·Exp(r) with the rotation vector r = Log(q_e⁻¹ q), rad: the axis times the angle, in the frame of
q_e. A turn of the world, q ↦ A q for all, leaves r as it is.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.numerics import unit

FULL = 0.02
"""Angle, rad, from a full turn, or from none, up to which noise decides about the axis: it is the one before."""


def rotation(wxyz: Array) -> Rotation:
    """Rotations of unit quaternions (N, 4) or (4,), wxyz."""
    return Rotation.from_quat(np.roll(wxyz, -1, axis=-1))


def quaternions(rotations: Rotation) -> Array:
    """Unit quaternions (N, 4) or (4,), wxyz, of rotations."""
    return np.roll(rotations.as_quat(), 1, axis=-1)


def mean_orientation(wxyz: Array) -> Array:
    """The mean (4,) of orientations (N, 4), whichever sign each has."""
    return quaternions(rotation(wxyz).mean())


def logarithm(origin: Array, wxyz: Array) -> Array:
    """Rotation vectors (T, 3), rad, of a motion's orientations (T, 4) at an origin (4,), near which it ends.

    They are continuous: where it turns by more than π away from the origin they are longer than π. The signs of the
    quaternions make no difference.
    """
    vectors = (rotation(origin).inv() * rotation(wxyz)).as_rotvec()[::-1]  # from the end
    with_axis = np.where(np.linalg.norm(vectors, axis=1) < FULL, 0, np.arange(len(vectors)))
    axes = unit(vectors)[np.maximum.accumulate(with_axis)]
    turned = np.where((axes[1:] * axes[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    sides = np.cumprod(np.concatenate([[1.0], turned]))
    short = sides * (vectors * axes).sum(axis=1)
    turns = 2 * np.pi * np.round((np.unwrap(short) - short) / (2 * np.pi))
    return (vectors + (sides * turns)[:, None] * axes)[::-1]


def exponential(origin: Array, vectors: Array) -> Array:
    """Orientations (*B, 4), wxyz, of rotation vectors (*B, 3), rad, at an origin (4,)."""
    turned = rotation(origin) * Rotation.from_rotvec(vectors.reshape(-1, 3))
    return quaternions(turned).reshape(*vectors.shape[:-1], 4)


def apart(first: Array, second: Array) -> Array:
    """Angles (N,), rad, between orientations (N, 4) and (N, 4) or (4,)."""
    return (rotation(first).inv() * rotation(second)).magnitude()


def turning(first: Array, second: Array) -> Array:
    """The rotation vector (3,), rad, in the world's frame, that turns an orientation (4,) into another one (4,)."""
    return (rotation(second) * rotation(first).inv()).as_rotvec()


def nearest(origin: Array, wxyz: Array, near: Array) -> Array:
    """The rotation vector (3,), rad, of an orientation (4,) at an origin (4,) which is nearest to another one (3,)."""
    short = (rotation(origin).inv() * rotation(wxyz)).as_rotvec()
    axis = unit(near if np.linalg.norm(short) < FULL else short)
    turns = np.round((near - short) @ axis / (2 * np.pi))
    return short + 2 * np.pi * turns * axis


def turned(axes: Array, wxyz: Array) -> Array:
    """The orientation (4,) in a world that is turned by axes (3, 3)."""
    return quaternions(Rotation.from_matrix(axes) * rotation(wxyz))
