"""Compiled fields of the hand and their flows: the same numbers as plain formulas, for random fields and points."""

import numpy as np
import pytest
from oracles import carried_by_arrays
from scipy.special import eval_hermite, expit

from dt_viz.avoidance.bias import RegionField, Shift
from dt_viz.avoidance.sideways import Sideways
from dt_viz.flows.fields import GaussianGrid, GridRBF, PlacedField, PointField, Projected, Sum
from dt_viz.flows.integrators import DORMAND_PRINCE, EULER, IMPLICIT_EULER, RK4, carried
from dt_viz.kernels.fields import LANES, exponential
from dt_viz.obstacles.occupancy import GENERATORS, AvoidanceField, OccupancyMap

COUNTS = [1, 2, 5, LANES, 2 * LANES + 7]


def random_grid(rng, dim, sigma=0.4):
    """A grid with a different number of points on each axis, about one unit wide."""
    return GaussianGrid(tuple(np.linspace(-0.6 - 0.1 * j, 0.7, 3 + 2 * j) for j in range(dim)), 0.5 / sigma**2)


def derivatives(grid, weights, s, order):
    """A partial derivative (N, k) of the sum: those of a Gaussian are Hermite polynomials times it."""
    width = np.sqrt(grid.ell)
    offset = width * (s[:, None] - grid.inducing_points)
    factors = [(-width) ** n * eval_hermite(n, offset[..., j]) for j, n in enumerate(order)]
    return np.prod(factors, axis=0) * np.exp(-(offset**2).sum(axis=2)) @ weights


class PlainGrid:
    def __init__(self, grid, weights):
        self.grid, self.weights, self.dim = grid, weights, grid.dim

    def __call__(self, s):
        return derivatives(self.grid, self.weights, s, [0] * self.dim)

    def with_jacobian(self, s):
        return self(s), np.stack([derivatives(self.grid, self.weights, s, n) for n in np.eye(self.dim, dtype=int)], -1)


class PlainOccupancy:
    def __init__(self, field):
        self.grid, self.field, self.dim = field.occupancy.grid, field, field.dim

    def __call__(self, s):
        return self.with_jacobian(s)[0]

    def with_jacobian(self, s):
        unit, weights = np.eye(self.dim, dtype=int), self.field.occupancy.weights
        logit = derivatives(self.grid, weights, s, 0 * unit[0]) + self.field.occupancy.bias
        gradient = np.stack([derivatives(self.grid, weights, s, order) for order in unit], axis=-1)
        hessian = np.stack([np.stack([derivatives(self.grid, weights, s, a + b) for a in unit], -1) for b in unit], -1)
        if self.field.generator == "probability":
            p = expit(logit)
            weight, slope = p * (1 - p), p * (1 - p) * (1 - 2 * p)
        else:
            T = self.field.temperature
            p = expit(logit / T)
            weight = np.maximum(p - expit(self.field.occupancy.bias / T), 0)
            slope = (weight > 0) * p * (1 - p) / T
        DV = weight[:, None, None] * hessian + slope[:, None, None] * gradient[:, :, None] * gradient[:, None]
        return weight[:, None] * gradient * 0.5 / self.grid.ell, DV * 0.5 / self.grid.ell


def unit_vector(rng):
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def faded(u):
    """(1 − ‖u‖²)³ (N,) at points u (N, k), 0 beyond ‖u‖ = 1, and its derivative (N, k)."""
    room = np.maximum(1 - (u * u).sum(axis=1), 0)
    return room**3, -6 * room[:, None] ** 2 * u


class PlainRegion:
    dim = 3

    def __init__(self, field):
        self.inner = PlainGrid(field.directions.grid, field.directions.weights)

    def __call__(self, s):
        return self.with_jacobian(s)[0]

    def with_jacobian(self, s):
        k = self.inner.dim
        u, (window, slope) = s[:, :k], faded(s[:, :k])
        V, DV = np.zeros_like(s), np.zeros((*s.shape, 3))
        fit, D_fit = self.inner.with_jacobian(u)
        V[:, :k] = window[:, None] * fit
        DV[:, :k, :k] = window[:, None, None] * D_fit + fit[:, :, None] * slope[:, None]
        return V, DV


class PlainShift:
    dim = 3

    def __init__(self, field):
        self.direction, self.k = field.direction, field.dim_of_region

    def __call__(self, s):
        return self.with_jacobian(s)[0]

    def with_jacobian(self, s):
        window, slope = faded(s[:, : self.k])
        DV = np.zeros((*s.shape, 3))
        DV[:, :, : self.k] = self.direction[:, None] * slope[:, None]
        return window[:, None] * self.direction, DV


class PlainSideways:
    dim = 3

    def __init__(self, field):
        self.field = field

    def __call__(self, s):
        return self.with_jacobian(s)[0]

    def with_jacobian(self, s):
        u = (s - self.field.centre) @ self.field.inverse.T
        weight = np.exp(-0.5 * (u * u).sum(axis=1))
        slope = -weight[:, None] * (u @ self.field.inverse)
        for end, radius in zip(self.field.ends, self.field.radii, strict=True):
            offset = (s - end) / radius
            lost = np.exp(-0.5 * (offset * offset).sum(axis=1))
            kept = -np.expm1(-0.5 * (offset * offset).sum(axis=1))
            slope = kept[:, None] * slope + (weight * lost / radius)[:, None] * offset
            weight = weight * kept
        return weight[:, None] * -self.field.velocity, -self.field.velocity[:, None] * slope[:, None]


def plain_implicit_euler(field, s, U, h, max_iterations=200):
    """Implicit Euler: the y with y − h·V(y) = s. First order, and the exact inverse of `EULER` with −h.

    Newton's method, point by point going back half the way where the residual has grown. While I − h·DV is regular
    everywhere, which is also when the step is invertible, that leads to the one solution from everywhere.
    """
    identity = np.eye(field.dim)
    scale = 1.0 + np.abs(s).max(initial=0.0)
    y = best = s + h * field(s)
    direction = np.zeros_like(s)
    smallest = np.full(len(s), np.inf)  # residual at `best`
    length = np.ones((len(s), 1))
    for _ in range(max_iterations):
        v, DV = field.with_jacobian(y)
        residual = y - h * v - s
        size = np.abs(residual).max(axis=1)
        if size.max(initial=0.0) <= 1e-15 * scale:
            break
        update = np.linalg.solve(identity - h * DV, residual[..., None])[..., 0]
        worse = (size > smallest) & (size > 1e-13 * scale)
        length = np.where(worse[:, None], 0.5 * length, 1.0)
        best = np.where(worse[:, None], best, y)
        direction = np.where(worse[:, None], direction, update)
        smallest = np.where(worse, smallest, size)
        y = best - length * direction
        if not worse.any() and np.abs(update).max(initial=0.0) <= 1e-8 * scale:
            break  # quadratic convergence: the next correction would be far below rounding
    if U is None:
        return y, None
    return y, np.linalg.solve(identity - h * field.with_jacobian(y)[1], U)


def carried_implicitly(field, s, U, _method, duration, steps):
    for _ in range(steps):
        s, U = plain_implicit_euler(field, s, U, duration / steps)
    return s, U


def cases():
    rng = np.random.default_rng(0)
    for dim in (2, 3):
        grid = random_grid(rng, dim)
        weights = 0.3 * rng.normal(size=(grid.num_points, dim))
        yield f"grid {dim}", GridRBF(grid, weights), PlainGrid(grid, weights)
        for generator in GENERATORS:
            occupancy = OccupancyMap(grid, 3 * rng.normal(size=grid.num_points), -2.0)
            field = AvoidanceField(occupancy, generator, 2.5)
            yield f"{generator} {dim}", field, PlainOccupancy(field)
        unit = GaussianGrid(tuple(np.linspace(-1, 1, 5) for _ in range(dim)), 3.0)
        region = RegionField(GridRBF(unit, rng.normal(size=(unit.num_points, dim))))
        yield f"region {dim}", region, PlainRegion(region)
        shift = Shift(unit_vector(rng), dim)
        yield f"shift {dim}", shift, PlainShift(shift)
    ends, radii = rng.uniform(-0.5, 0.5, (3, 3)), np.array([0.2, 0.3, 1e-3])
    aside = Sideways(rng.normal(size=3), rng.normal(size=(3, 3)), rng.normal(size=3), ends, radii)
    yield "sideways", aside, PlainSideways(aside)


CASES = {name: (field, plain) for name, field, plain in cases()}


@pytest.fixture(params=CASES, name="pair")
def _pair(request):
    return CASES[request.param]


def points(dim, num=60):
    return np.random.default_rng(1).uniform(-1.2, 1.2, (num, dim))


def test_exponentials_are_those_of_numpy_and_0_where_these_are_next_to_nothing():
    x = -np.concatenate([np.geomspace(1e-18, 699, 1000), np.linspace(0, 699, 1000)])
    np.testing.assert_allclose([exponential(value) for value in x], np.exp(x), rtol=1e-15)
    assert exponential(-701.0) == exponential(-np.inf) == 0


def test_values_and_derivatives_are_those_of_plain_formulas(pair):
    field, plain = pair
    s = points(field.dim)
    for found, expected in zip(field.with_jacobian(s), plain.with_jacobian(s), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1, np.abs(expected).max()))
    np.testing.assert_allclose(field(s), plain(s), rtol=0, atol=1e-12)


@pytest.mark.parametrize("num", COUNTS)
def test_any_number_of_points_gives_what_each_gives_alone(pair, num):
    field, _ = pair
    s = points(field.dim, num)
    alone = [field.with_jacobian(point[None]) for point in s]
    for found, expected in zip(field.with_jacobian(s), zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(found, np.concatenate(expected), rtol=0, atol=1e-12)
    ends = carried(field, s, None, DORMAND_PRINCE, -0.4, 1000, 1e-6)[0]
    expected = np.concatenate([carried(field, point[None], None, DORMAND_PRINCE, -0.4, 1000, 1e-6)[0] for point in s])
    np.testing.assert_allclose(ends, expected, rtol=0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("step", [EULER, IMPLICIT_EULER, RK4])
def test_steps_are_those_of_array_operations(pair, step):
    field, plain = pair
    s, U = points(field.dim), np.random.default_rng(2).normal(size=(60, field.dim, 2))
    for tangents in (None, U):
        end, V = carried(field, s, tangents, step, 0.2, 5)
        by_arrays = carried_implicitly if step == IMPLICIT_EULER else carried_by_arrays
        expected, W = by_arrays(plain, s, tangents, step, 0.2, 5)
        np.testing.assert_allclose(end, expected, rtol=0, atol=1e-12)
        if V is not None and W is not None:
            np.testing.assert_allclose(V, W, rtol=0, atol=1e-10 * np.abs(W).max())


@pytest.mark.parametrize("duration", [-0.6, 0.4])
def test_adaptive_steps_are_as_exact_as_those_of_array_operations(pair, duration):
    field, plain = pair
    s, U = points(field.dim, 20), np.random.default_rng(2).normal(size=(20, field.dim, 2))
    before = s.copy()
    expected, W = carried_by_arrays(plain, s, U, RK4, duration, 60)
    for tangents in (None, U):
        end, V = carried(field, s, tangents, DORMAND_PRINCE, duration, 1000, 1e-6)
        np.testing.assert_allclose(end, expected, rtol=0, atol=1e-5)
        if V is not None and W is not None:
            np.testing.assert_allclose(V, W, rtol=0, atol=1e-2 * np.abs(W).max())
    np.testing.assert_array_equal(s, before)


@pytest.mark.parametrize("name", ["grid 3", "free-space 3", "region 3", "sideways"])
def test_placed_cut_and_summed_fields_are_those_of_plain_formulas(name):
    rng = np.random.default_rng(5)
    field, plain = CASES[name]
    o, M, along = rng.normal(size=3), rng.normal(size=(3, 3)), np.linalg.qr(rng.normal(size=(3, 2)))[0]
    other: PointField = CASES["probability 3"][0]
    s = points(3)
    made = Sum((Projected(PlacedField(field, o, M), along @ along.T), other))
    V, DV = plain.with_jacobian((s - o) @ np.linalg.inv(M).T)
    expected = V @ M.T @ along @ along.T + other(s)
    np.testing.assert_allclose(made(s), expected, rtol=0, atol=1e-11 * max(1, np.abs(expected).max()))
    slope = along @ along.T @ M @ DV @ np.linalg.inv(M) + other.with_jacobian(s)[1]
    np.testing.assert_allclose(made.with_jacobian(s)[1], slope, rtol=0, atol=1e-11 * max(1, np.abs(slope).max()))
