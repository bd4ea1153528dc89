"""Integrators by their order of convergence, and tangents as the derivative of the numerical step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laws.registry import bent
from oracles import central_differences
from scipy.integrate import solve_ivp

from dt_viz.flows.integrators import euler, implicit_euler, integrate, integrate_adaptive, rk4
from dt_viz.obstacles.shapes import Sphere

seeds = st.integers(0, 2**32 - 1)
STEPS = [euler, implicit_euler, rk4]


def tangents(flow, *arguments):
    """Only the tangents of a result, which are there where tangents were given."""
    _, V = flow(*arguments)
    assert V is not None
    return V


def exact(field, s, duration):
    """An independent integrator at its finest."""
    velocity = lambda _t, y: field(y[None])[0]  # noqa: E731
    finest = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    return np.stack([solve_ivp(velocity, (0, duration), point, **finest).y[:, -1] for point in s])


@pytest.mark.parametrize(("step", "order"), [(euler, 1), (implicit_euler, 1), (rk4, 4)])
def test_points_and_tangents_converge_with_the_order_of_the_step(step, order):
    rng = np.random.default_rng(5)
    field, s, counts = bent(2, 5, 0.5), rng.uniform(-1, 1, (6, 2)), [32, 64, 128]
    U = np.broadcast_to(np.eye(2), (6, 2, 2))
    references = exact(field, s, 1.0), tangents(integrate, rk4, field, s, U, 1.0, 1000)
    found = [integrate(step, field, s, U, 1.0, num) for num in counts]
    for values, reference in zip(zip(*found, strict=True), references, strict=True):
        errors = [np.linalg.norm(value - reference) for value in values]
        assert np.polyfit(np.log(counts), -np.log(errors), 1)[0] == pytest.approx(order, abs=0.2)


@given(seeds, st.sampled_from([2, 3]), st.floats(0.01, 0.15))
def test_implicit_euler_inverts_euler_to_rounding(seed, dim, h):
    rng = np.random.default_rng(seed)
    field, s = bent(dim, seed), rng.uniform(-1.5, 1.5, (12, dim))
    back, _ = implicit_euler(field, euler(field, s, None, -h)[0], None, h)
    np.testing.assert_allclose(back, s, rtol=0, atol=1e-13)
    there, _ = euler(field, implicit_euler(field, s, None, h)[0], None, -h)
    np.testing.assert_allclose(there, s, rtol=0, atol=1e-13)


@given(seeds, st.sampled_from(STEPS), st.floats(-0.15, 0.15))
def test_tangents_are_the_derivative_of_the_numerical_step(seed, step, h):
    rng = np.random.default_rng(seed)
    field, s = bent(2, seed), rng.uniform(-1, 1, (5, 2))
    U = rng.normal(size=(5, 2, 3))
    end, V = step(field, s, U, h)
    assert V is not None
    np.testing.assert_allclose(end, step(field, s, None, h)[0], rtol=0, atol=1e-13)
    slope = central_differences(lambda points: step(field, points, None, h)[0], s, 1e-4)
    np.testing.assert_allclose(V, slope @ U, rtol=0, atol=1e-6)


@pytest.mark.parametrize("duration", [0.7, -0.7])
def test_adaptive_error_falls_with_its_tolerance(duration):
    rng = np.random.default_rng(1)
    field, s = bent(2, 1, 1.5), rng.uniform(-1, 1, (10, 2))
    reference = exact(field, s, duration)
    errors = []
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        errors.append(np.abs(integrate_adaptive(field, s, None, duration, tolerance)[0] - reference).max())
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
        reference, _ = integrate(rk4, field, s, None, duration, 300)
        for tolerance, largest in ((2e-5, 1e-3), (2e-9, 1e-7)):
            end, _ = integrate_adaptive(field, s, None, duration, tolerance)
            assert np.abs(end - reference).max() < largest


@pytest.mark.parametrize("distance", [0.0, 1e-9, 1e-6, 1e-3, 1e-2])
def test_adaptive_steps_are_hardly_ever_tried_in_vain(distance):
    """The first step fits the steep core at once."""
    field = Counting(Sphere((0.0, 0.0, 0.0), 0.15).field("free-space", 6.0))
    integrate_adaptive(field, np.array([[distance, 0.0, 0.0]]), None, -1.0, 2e-5)
    assert len(field.calls) <= 2 + 6 * 9


class Counting:
    """A field that remembers how many points it was asked for."""

    def __init__(self, inner):
        self.inner, self.dim, self.calls = inner, inner.dim, []

    def __call__(self, s):
        self.calls.append(len(s))
        return self.inner(s)

    def with_jacobian(self, s):
        return self.inner.with_jacobian(s)


@settings(max_examples=8)
@given(seeds, st.floats(-1.0, 1.0))
def test_adaptive_points_do_not_depend_on_their_batch(seed, duration):
    rng = np.random.default_rng(seed)
    field, s = bent(2, seed, 1.0), rng.uniform(-1.5, 1.5, (8, 2))
    together, _ = integrate_adaptive(field, s, None, duration, 1e-7)
    alone = np.concatenate([integrate_adaptive(field, point[None], None, duration, 1e-7)[0] for point in s])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-12)


@settings(max_examples=8)
@given(seeds)
def test_adaptive_tangents_are_the_derivative_of_the_flow(seed):
    rng = np.random.default_rng(seed)
    field, s = bent(2, seed, 0.8), rng.uniform(-1, 1, (5, 2))
    U = rng.normal(size=(5, 2, 2))
    end, V = integrate_adaptive(field, s, U, 0.8, 1e-11)
    fine_end, fine = integrate(rk4, field, s, U, 0.8, 150)
    assert V is not None and fine is not None
    np.testing.assert_allclose(end, fine_end, rtol=0, atol=1e-7)
    np.testing.assert_allclose(V, fine, rtol=0, atol=2e-3 * np.abs(fine).max())


def test_adaptive_takes_no_points_and_no_time_and_leaves_its_arguments_alone():
    field, U = bent(2, 3), np.broadcast_to(np.eye(2), (3, 2, 2))
    assert integrate_adaptive(field, np.empty((0, 2)), None, 1.0, 1e-6)[0].shape == (0, 2)
    s = np.ones((3, 2))
    s.setflags(write=False)
    np.testing.assert_array_equal(integrate_adaptive(field, s, None, 0.0, 1e-6)[0], s)
    assert (integrate_adaptive(field, s, U, 1.0, 1e-6)[0] != s).all()


def test_adaptive_gives_up_with_a_reason_on_a_field_that_is_too_steep():
    field = bent(2, 4, 1e4)
    with pytest.raises(ArithmeticError, match="too steep"):
        integrate_adaptive(field, np.zeros((2, 2)), None, 1.0, 1e-9, max_rounds=20)


class Saddle:
    """ṡ = A·s, with the rest point at the origin and the flow exp(t·A) in closed form."""

    dim = 2

    def __init__(self, *rates):
        self.rates = np.array(rates)

    def __call__(self, s):
        return s * self.rates

    def with_jacobian(self, s):
        return self(s), np.broadcast_to(np.diag(self.rates), (len(s), 2, 2))


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("rates", [(7.0, 6.0), (-7.0, -6.0), (7.0, -6.0)])
def test_adaptive_tangents_are_right_at_and_near_a_rest_point(tolerance, rates):
    """Where nothing moves, tangents do: the middle of an obstacle, where det J is smallest."""
    field, t = Saddle(*rates), 0.9
    s = np.array([[0.0, 0.0], [1e-12, 0.0], [0.0, 1e-9], [1e-7, -1e-7], [1e-5, 1e-5]])
    V = tangents(integrate_adaptive, field, s, np.broadcast_to(np.eye(2), (5, 2, 2)), t, tolerance)
    expected = np.exp(t * np.array(rates))
    np.testing.assert_allclose(np.linalg.det(V), expected.prod(), rtol=0.05)
    assert (np.linalg.det(V) > 0).all()
    largest = expected.max()
    np.testing.assert_allclose(V, np.broadcast_to(np.diag(expected), (5, 2, 2)), rtol=0, atol=0.02 * largest)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("distance", [1e-10, 1e-8, 1e-6, 1e-5, 1e-4])
def test_adaptive_points_leave_an_unstable_rest_point_as_far_as_they_should(tolerance, distance):
    """An error made early grows as the motion does; it may not grow from nothing into a different motion."""
    field, t = Saddle(7.0, 6.0), 0.9
    s = np.array([[distance, 0.0], [0.0, distance]])
    end, _ = integrate_adaptive(field, s, None, t, tolerance)
    growth = np.exp(t * field.rates)
    np.testing.assert_allclose(np.diag(end), distance * growth, rtol=0.1)
