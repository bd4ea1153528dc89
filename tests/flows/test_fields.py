"""The separable Gaussian basis against its dense definition, and derivatives against finite differences."""

import numpy as np
import pytest
from checkpoints import asked_at_checkpoints
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.errors import UnwantedError
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import DORMAND_PRINCE, EULER, IMPLICIT_EULER

seeds = st.integers(0, 2**32 - 1)
dims = st.sampled_from([2, 3])


def random_grid(rng, dim, sigma=0.4):
    """A grid with a different number of points on each axis, about one unit wide."""
    return GaussianGrid(tuple(np.linspace(-0.6 - 0.1 * j, 0.7, 3 + j) for j in range(dim)), 0.5 / sigma**2)


def random_field(rng, dim):
    grid = random_grid(rng, dim)
    return GridRBF(grid, rng.normal(size=(grid.num_points, dim)))


@given(seeds, dims)
def test_features_are_gaussians_of_the_distance_and_the_separable_field_is_the_dense_one(seed, dim):
    rng = np.random.default_rng(seed)
    field, s = random_field(rng, dim), rng.uniform(-1.5, 1.5, (11, dim))
    grid = field.grid
    squared = ((s[:, None] - grid.inducing_points) ** 2).sum(axis=-1)
    assert grid.inducing_points.shape == (grid.num_points, dim)
    np.testing.assert_allclose(grid.features(s), np.exp(-grid.ell * squared), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(field(s), grid.features(s) @ field.weights, rtol=0, atol=1e-13)


@given(seeds, dims, st.floats(0.05, 0.5), st.floats(0.5, 1.5), st.floats(0, 3))
def test_a_covering_grid_covers_its_points_no_coarser_than_asked(seed, dim, sigma, spacing, pad):
    points = np.random.default_rng(seed).uniform(-1, 1, (20, dim))
    grid = GaussianGrid.covering(points, sigma, spacing=spacing, pad=pad)
    assert grid.ell == pytest.approx(0.5 / sigma**2)
    for axis, coordinates in zip(grid.axes, points.T, strict=True):
        assert axis[0] == pytest.approx(coordinates.min() - pad * sigma)
        assert axis[-1] == pytest.approx(coordinates.max() + pad * sigma)
        assert np.diff(axis).max() <= spacing * sigma * (1 + 1e-6)


@pytest.mark.parametrize("method", [EULER, IMPLICIT_EULER, DORMAND_PRINCE])
def test_a_long_flow_has_checkpoints_at_which_it_may_end_and_they_change_nothing(monkeypatch, method):
    rng = np.random.default_rng(0)
    field, s, U, asked = random_field(rng, 2), rng.uniform(-1, 1, (300, 2)), rng.normal(size=(300, 2, 2)), []
    flow = lambda: field.carried(s, U, method, 0.1, 5, 1e-6)  # noqa: E731
    with asked_at_checkpoints(lambda: asked.append(True)):
        whole, tangents = flow()
        assert not asked
        monkeypatch.setattr("dt_viz.flows.fields.MOST_AT_ONCE", 130 * field.weights.size)
        again, again_tangents = flow()
    assert len(asked) == (5 if method != DORMAND_PRINCE else 3)  # 64 points at a time at least, or 128
    np.testing.assert_allclose(again, whole, rtol=0, atol=1e-14)
    assert tangents is not None and again_tangents is not None
    np.testing.assert_allclose(again_tangents, tangents, rtol=0, atol=1e-13)

    def end():
        raise UnwantedError

    with asked_at_checkpoints(end), pytest.raises(UnwantedError):
        flow()


def test_weights_of_another_shape_are_refused():
    grid = random_grid(np.random.default_rng(0), 2)
    with pytest.raises(ValueError, match=r"weights have shape \(12, 3\); the grid needs \(12, 2\)"):
        GridRBF(grid, np.zeros((grid.num_points, 3)))
