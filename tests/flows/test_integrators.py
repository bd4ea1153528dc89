"""Methods by their order of convergence, and tangents as the derivative of the numerical step."""

import numpy as np
import pytest
from laws.registry import bent
from scipy.integrate import solve_ivp

from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import DORMAND_PRINCE, EULER, IMPLICIT_EULER, RK4, carried
from dt_viz.obstacles.shapes import Sphere


def tangents(*arguments):
    """Only the tangents of a result, which are there where tangents were given."""
    _, V = carried(*arguments)
    assert V is not None
    return V


def adaptively(field, s, duration, tolerance, steps=1000):
    """Only the points, carried along in adaptive steps."""
    return carried(field, s, None, DORMAND_PRINCE, duration, steps, tolerance)[0]


def exact(field, s, duration):
    """An independent integrator at its finest."""
    velocity = lambda _t, y: field(y[None])[0]  # noqa: E731
    finest = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    return np.stack([solve_ivp(velocity, (0, duration), point, **finest).y[:, -1] for point in s])


@pytest.mark.parametrize(("step", "order"), [(EULER, 1), (IMPLICIT_EULER, 1), (RK4, 4)])
def test_points_and_tangents_converge_with_the_order_of_the_step(step, order):
    rng = np.random.default_rng(5)
    field, s, counts = bent(2, 5, 0.5), rng.uniform(-1, 1, (6, 2)), [32, 64, 128]
    U = np.broadcast_to(np.eye(2), (6, 2, 2))
    references = exact(field, s, 1.0), tangents(field, s, U, RK4, 1.0, 1000)
    found = [carried(field, s, U, step, 1.0, num) for num in counts]
    for values, reference in zip(zip(*found, strict=True), references, strict=True):
        errors = [np.linalg.norm(value - reference) for value in values]
        assert np.polyfit(np.log(counts), -np.log(errors), 1)[0] == pytest.approx(order, abs=0.2)


@pytest.mark.parametrize("duration", [0.7, -0.7])
def test_adaptive_error_falls_with_its_tolerance(duration):
    rng = np.random.default_rng(1)
    field, s = bent(2, 1, 1.5), rng.uniform(-1, 1, (10, 2))
    reference = exact(field, s, duration)
    errors = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        errors.append(np.abs(adaptively(field, s, duration, tolerance) - reference).max())
        assert errors[-1] < 30 * tolerance
    assert errors[3] < errors[2] < errors[1] < errors[0]


SLOW = pytest.mark.slow


@pytest.mark.parametrize("duration", [-0.9, pytest.param(-0.6, marks=SLOW), pytest.param(-0.3, marks=SLOW), 0.9])
def test_adaptive_is_not_deceived_by_a_first_step_that_is_far_too_long(duration):
    """In several times the time in which a field turns motions around, some error estimate is small by chance."""
    s = np.random.default_rng(0).normal(size=(500, 3))
    s *= np.linspace(0.001, 0.08, 500)[:, None] / np.linalg.norm(s, axis=1, keepdims=True)
    for temperature in (3.0, 9.0):
        field = Sphere((0.0, 0.0, 0.0), 0.15).field("free-space", temperature)
        reference, _ = carried(field, s, None, RK4, duration, 300)
        for tolerance, largest in ((2e-5, 1e-3), (2e-9, 1e-7)):
            assert np.abs(adaptively(field, s, duration, tolerance) - reference).max() < largest


def test_adaptive_takes_no_points_and_no_time_and_leaves_its_arguments_alone():
    field, U = bent(2, 3), np.broadcast_to(np.eye(2), (3, 2, 2))
    assert adaptively(field, np.empty((0, 2)), 1.0, 1e-6).shape == (0, 2)
    s = np.ones((3, 2))
    s.setflags(write=False)
    np.testing.assert_array_equal(adaptively(field, s, 0.0, 1e-6), s)
    assert (carried(field, s, U, DORMAND_PRINCE, 1.0, 1000, 1e-6)[0] != s).all()


def test_adaptive_gives_up_with_a_reason_on_a_field_that_is_too_steep():
    field = bent(2, 4, 1e4)
    with pytest.raises(ArithmeticError, match="too steep"):
        adaptively(field, np.zeros((2, 2)), 1.0, 1e-9, steps=20)


def saddle(*rates):
    """A field that is nearly ṡ = A·s about its rest point, the origin, with these rates; its flow there is exp(t·A)."""
    grid = GaussianGrid((np.linspace(-2, 2, 9), np.linspace(-2, 2, 9)), 0.5 / 0.7**2)
    slope = GridRBF(grid, grid.inducing_points).with_jacobian(np.zeros((1, 2)))[1][0]
    return GridRBF(grid, grid.inducing_points @ np.linalg.inv(slope) * np.array(rates))


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("rates", [(7.0, 6.0), (-7.0, -6.0), (7.0, -6.0)])
def test_adaptive_tangents_are_right_at_and_near_a_rest_point(tolerance, rates):
    """Where nothing moves, tangents do: the middle of an obstacle, where det J is smallest."""
    field, t = saddle(*rates), 0.9
    s = np.array([[0.0, 0.0], [1e-12, 0.0], [0.0, 1e-9], [1e-7, -1e-7], [1e-5, 1e-5]])
    V = tangents(field, s, np.broadcast_to(np.eye(2), (5, 2, 2)), DORMAND_PRINCE, t, 1000, tolerance)
    expected = np.exp(t * np.array(rates))
    np.testing.assert_allclose(np.linalg.det(V), expected.prod(), rtol=0.05)
    assert (np.linalg.det(V) > 0).all()
    largest = expected.max()
    np.testing.assert_allclose(V, np.broadcast_to(np.diag(expected), (5, 2, 2)), rtol=0, atol=0.02 * largest)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("distance", [1e-10, 1e-8, 1e-6, 1e-5, 1e-4])
def test_adaptive_points_leave_an_unstable_rest_point_as_far_as_they_should(tolerance, distance):
    """An error made early grows as the motion does; it may not grow from nothing into a different motion."""
    rates, t = np.array([7.0, 6.0]), 0.9
    s = np.array([[distance, 0.0], [0.0, distance]])
    end = adaptively(saddle(*rates), s, t, tolerance)
    np.testing.assert_allclose(np.diag(end), distance * np.exp(t * rates), rtol=0.1)


class Plain:
    """A field of array operations alone."""

    def __init__(self, inner):
        self.inner, self.dim = inner, inner.dim

    def __call__(self, s):
        return self.inner(s)


@pytest.mark.parametrize("method", [EULER, RK4, DORMAND_PRINCE])
@pytest.mark.parametrize("duration", [-0.7, 0.5])
def test_fields_of_array_operations_are_carried_along_as_compiled_ones_are(method, duration):
    rng = np.random.default_rng(8)
    field, s, U = bent(3, 8, 1.2), rng.uniform(-1, 1, (20, 3)), rng.normal(size=(20, 3, 2))
    U[3, :, 1] = 0
    end, V = carried(field, s, U, method, duration, 200, 1e-9)
    found, W = carried(Plain(field), s, U, method, duration, 200, 1e-9)
    assert V is not None and W is not None
    np.testing.assert_allclose(found, end, rtol=0, atol=1e-8)
    np.testing.assert_allclose(W, V, rtol=0, atol=1e-3 * np.abs(V).max())
    assert carried(Plain(field), s[:0], U[:0], method, duration, 200, 1e-9)[0].shape == (0, 3)


def test_array_operations_give_up_on_a_field_that_is_too_steep_as_well():
    with pytest.raises(ArithmeticError, match="too steep"):
        carried(Plain(bent(2, 4, 1e4)), np.zeros((2, 2)), None, DORMAND_PRINCE, 1.0, 20, 1e-9)
