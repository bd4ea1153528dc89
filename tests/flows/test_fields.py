"""The separable Gaussian basis against its dense definition, and derivatives against finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import eval_hermite

from dt_viz.flows.fields import BLOCK, GaussianGrid, GridRBF, PlacedField, Repeated, Sum, second_orders, unit_orders

seeds = st.integers(0, 2**32 - 1)
dims = st.sampled_from([2, 3])


def random_grid(rng, dim, sigma=0.4):
    """A grid with a different number of points on each axis, about one unit wide."""
    return GaussianGrid(tuple(np.linspace(-0.6 - 0.1 * j, 0.7, 3 + j) for j in range(dim)), 0.5 / sigma**2)


def random_field(rng, dim):
    grid = random_grid(rng, dim)
    return GridRBF(grid, rng.normal(size=(grid.num_points, dim)))


def random_rotation(rng, dim):
    q, r = np.linalg.qr(rng.normal(size=(dim, dim)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, ::-1]


@given(seeds, dims)
def test_features_are_gaussians_of_the_distance_and_the_separable_field_is_the_dense_one(seed, dim):
    rng = np.random.default_rng(seed)
    field, s = random_field(rng, dim), rng.uniform(-1.5, 1.5, (11, dim))
    grid = field.grid
    squared = ((s[:, None] - grid.inducing_points) ** 2).sum(axis=-1)
    assert grid.inducing_points.shape == (grid.num_points, dim)
    np.testing.assert_allclose(grid.features(s), np.exp(-grid.ell * squared), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(field(s), grid.features(s) @ field.weights, rtol=0, atol=1e-13)


@given(seeds, dims)
def test_contract_gives_any_partial_derivatives_in_the_order_of_the_question(seed, dim):
    rng = np.random.default_rng(seed)
    grid, s = random_grid(rng, dim), rng.uniform(-1, 1, (5, dim))
    weights = rng.normal(size=(grid.num_points, 2))
    some = rng.permutation(np.unique(rng.integers(0, 4, (4, dim)), axis=0))
    orders = (*((int(n) for n in row) for row in some), *unit_orders(dim), *second_orders(dim).values())
    orders = tuple(tuple(order) for order in orders)
    # derivatives of a Gaussian are Hermite polynomials times it
    width = np.sqrt(grid.ell)
    offset = width * (s[:, None] - grid.inducing_points)
    for order, found in zip(orders, grid.contract(s, weights, orders), strict=True):
        factors = [(-width) ** n * eval_hermite(n, offset[..., j]) for j, n in enumerate(order)]
        columns = np.prod(factors, axis=0) * grid.features(s)
        np.testing.assert_allclose(found, columns @ weights, rtol=1e-10, atol=1e-10)


def test_many_points_are_worked_out_as_few_are():
    rng = np.random.default_rng(0)
    field, s = random_field(rng, 3), rng.uniform(-1, 1, (2 * BLOCK + 7, 3))
    few = np.concatenate([field(part) for part in np.array_split(s, 50)])
    np.testing.assert_allclose(field(s), few, rtol=0, atol=1e-13)


@given(seeds, dims, st.floats(0.05, 0.5), st.floats(0.5, 1.5), st.floats(0, 3))
def test_a_covering_grid_covers_its_points_no_coarser_than_asked(seed, dim, sigma, spacing, pad):
    points = np.random.default_rng(seed).uniform(-1, 1, (20, dim))
    grid = GaussianGrid.covering(points, sigma, spacing=spacing, pad=pad)
    assert grid.ell == pytest.approx(0.5 / sigma**2)
    for axis, coordinates in zip(grid.axes, points.T, strict=True):
        assert axis[0] == pytest.approx(coordinates.min() - pad * sigma)
        assert axis[-1] == pytest.approx(coordinates.max() + pad * sigma)
        assert np.diff(axis).max() <= spacing * sigma * (1 + 1e-6)


@given(seeds, dims)
def test_the_gram_matrix_is_a_kernel_matrix(seed, dim):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, dim)
    K = grid.gram()
    np.testing.assert_allclose(K, K.T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.diag(K), 1, rtol=0, atol=1e-14)
    assert np.linalg.eigvalsh(K).min() > -1e-12


def test_weights_of_another_shape_are_refused():
    grid = random_grid(np.random.default_rng(0), 2)
    with pytest.raises(ValueError, match=r"weights have shape \(12, 3\); the grid needs \(12, 2\)"):
        GridRBF(grid, np.zeros((grid.num_points, 3)))


@given(seeds, dims, st.floats(0.05, 20))
def test_a_placed_field_is_the_field_of_the_moved_turned_and_scaled_thing(seed, dim, scale):
    rng = np.random.default_rng(seed)
    inner, R, o = random_field(rng, dim), random_rotation(rng, dim), rng.normal(size=dim)
    placed = PlacedField(inner, o, R, scale)
    u = rng.uniform(-1, 1, (8, dim))  # in the thing's own frame
    world = np.stack([o + scale * (R @ point) for point in u])
    expected = np.stack([scale * (R @ v) for v in inner(u)])
    np.testing.assert_allclose(placed(world), expected, rtol=0, atol=1e-11 * scale)
    (found, J), (_, own) = placed.with_jacobian(world), inner.with_jacobian(u)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(J, np.stack([R @ DV @ R.T for DV in own]), rtol=0, atol=1e-11)


@given(seeds, dims, st.integers(1, 4))
def test_a_field_repeated_at_several_places_is_the_sum_of_them(seed, dim, num):
    rng = np.random.default_rng(seed)
    inner, s = random_field(rng, dim), rng.uniform(-1, 1, (9, dim))
    places = tuple(
        PlacedField(inner, rng.normal(size=dim), random_rotation(rng, dim), rng.uniform(0.2, 2)) for _ in range(num)
    )
    values, derivatives = zip(*(place.with_jacobian(s) for place in places), strict=True)
    for field in (Repeated(places), Sum(places)):
        value, derivative = field.with_jacobian(s)
        np.testing.assert_allclose(field(s), sum(values), rtol=0, atol=1e-12)
        np.testing.assert_allclose(value, sum(values), rtol=0, atol=1e-12)
        np.testing.assert_allclose(derivative, sum(derivatives), rtol=0, atol=1e-12)
