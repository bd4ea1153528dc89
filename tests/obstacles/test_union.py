"""Unions of obstacles beside the laws (tests/laws)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union


@pytest.mark.long
@given(st.integers(0, 2**32 - 1), st.integers(2, 4))
def test_it_is_moved_hardly_farther_than_to_the_nearest_place(seed, num):
    """Also where two spheres hardly overlap, and where leaving one leads deeper into the next."""
    rng = np.random.default_rng(seed)
    spheres = [Sphere(as_point(rng.normal(0, 0.05, 3)), float(rng.uniform(0.08, 0.2))) for _ in range(num)]
    together, directions = Union(tuple(spheres)), rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surfaces = np.concatenate([sphere.position + sphere.radius * directions for sphere in spheres])
    surface = surfaces[together.signed_distance(surfaces) >= -1e-6]
    points = rng.normal(0, 0.05, (50, 3))
    points = points[together.signed_distance(points) < 0]
    free = together.nearest_free(points)
    assert (together.signed_distance(free) >= -1e-6).all()
    moved = np.linalg.norm(free - points, axis=1)
    nearest = np.linalg.norm(surface - points[:, None], axis=-1).min(axis=1)
    assert (moved < 1.1 * nearest + 0.002).all()
