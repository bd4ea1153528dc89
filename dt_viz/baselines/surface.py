"""Distance from obstacles, and the direction in which it grows."""

from __future__ import annotations

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.numerics import unit
from dt_viz.obstacles.union import Union

STEP = 1e-20
"""Imaginary step of the derivatives, metres: signed distances are analytic."""


def distance_and_normal(obstacle: Union, y: Array) -> tuple[Array, Array]:
    """Signed distance (N,), metres, of points `y` (N, 3), and the unit vectors (N, 3) away from the nearest surface.

    A vector is zero where the distance has no slope; without an obstacle the distance is infinite and all are.
    """
    places: Array = y + 1j * STEP * np.eye(3)[:, None]  # pyright: ignore[reportAssignmentType]
    ahead = obstacle.signed_distance(places)  # (3, N)
    slope = ahead.imag.T / STEP
    return ahead[0].real, unit(slope)
