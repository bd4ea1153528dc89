"""Union obstacles as one, and the fields that add up to theirs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.obstacles.shapes import Box, Sphere, as_point
from dt_viz.obstacles.union import ROUNDING, Union

PARTS = (
    Sphere((0.0, 0.0, 0.0), 0.15),
    Sphere((0.12, 0.05, -0.02), 0.08),
    Box((-0.1, 0.1, 0.05), (0.1, 0.06, 0.08), (0.8, 0.6, 0.0, 0.0)),
)


@pytest.fixture(name="points")
def _points():
    return np.random.default_rng(0).uniform(-0.25, 0.25, (300, 3))


def test_the_distance_is_that_of_the_nearest_part(points):
    apart = np.stack([part.signed_distance(points) for part in PARTS])
    np.testing.assert_array_equal(Union(PARTS).signed_distance(points), apart.min(axis=0))
    assert np.isinf(Union().signed_distance(points)).all()


def test_balls_cover_all_parts(points):
    centres, radii = Union(PARTS).cover()
    apart = np.linalg.norm(points[:, None] - centres, axis=2) - radii
    assert apart[Union(PARTS).signed_distance(points) < 0].min(axis=1).max() <= ROUNDING


def test_what_is_moved_out_is_outside_of_all(points):
    free = Union(PARTS).nearest_free(points)
    assert Union(PARTS).signed_distance(free).min() >= -ROUNDING
    outside = Union(PARTS).signed_distance(points) > 0
    np.testing.assert_array_equal(free[outside], points[outside])


@given(st.integers(0, 2**32 - 1), st.integers(2, 4))
def test_it_is_moved_hardly_farther_than_to_the_nearest_place(seed, num):
    """Also where two spheres hardly overlap, and where leaving one leads deeper into the next."""
    rng = np.random.default_rng(seed)
    spheres = [Sphere(as_point(rng.normal(0, 0.05, 3)), float(rng.uniform(0.08, 0.2))) for _ in range(num)]
    together, directions = Union(tuple(spheres)), rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surfaces = np.concatenate([sphere.position + sphere.radius * directions for sphere in spheres])
    surface = surfaces[together.signed_distance(surfaces) >= -ROUNDING]
    points = rng.normal(0, 0.05, (50, 3))
    points = points[together.signed_distance(points) < 0]
    free = together.nearest_free(points)
    assert (together.signed_distance(free) >= -ROUNDING).all()
    moved = np.linalg.norm(free - points, axis=1)
    nearest = np.linalg.norm(surface - points[:, None], axis=-1).min(axis=1)
    assert (moved < 1.1 * nearest + 0.002).all()


@pytest.mark.parametrize("parts", [PARTS, PARTS[:2], PARTS[2:], PARTS[:1]])
def test_the_fields_add_up(points, parts):
    together = Union(parts).field("free-space", 6.0)
    apart = [part.field("free-space", 6.0) for part in parts]
    np.testing.assert_allclose(together(points), sum(field(points) for field in apart), rtol=0, atol=1e-12)
    value, derivative = together.with_jacobian(points)
    np.testing.assert_allclose(value, together(points), rtol=0, atol=1e-12)
    expected = sum(field.with_jacobian(points)[1] for field in apart)
    np.testing.assert_allclose(derivative, expected, rtol=0, atol=1e-12)
