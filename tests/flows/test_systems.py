"""The base attractor and conjugate systems beside the laws (tests/laws): extremes, closed forms, controllers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laws.registry import bent
from oracles import central_differences

from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem, asinh_exp, log_sinh

seeds = st.integers(0, 2**32 - 1)


ATTRACTOR = Attractor(np.array([0.2, -0.1]), speed=0.3, smoothing=0.2)
ROUNDING = 10 * np.finfo(float).eps * ATTRACTOR.speed * ATTRACTOR.smoothing
"""Ten times what is lost of the potential near the goal, where logarithms of about 1 cancel."""
SYSTEM = DiffeomorphicSystem(Flow(bent(2, strength=0.25), 1.0, 20), ATTRACTOR)


def test_the_velocity_is_the_falling_gradient_of_the_potential_which_is_a_parabola_close_to_the_goal():
    z = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    gradient = central_differences(ATTRACTOR.potential, z, 1e-4)
    np.testing.assert_allclose(ATTRACTOR.velocity(z), -gradient, rtol=0, atol=1e-8)
    r = np.array([1e-3, 1e-5, 1e-7])
    parabola = ATTRACTOR.speed * r**2 / (2 * ATTRACTOR.smoothing)
    near = ATTRACTOR.goal + r[:, None] * np.array([1.0, 0.0])
    np.testing.assert_allclose(ATTRACTOR.potential(near), parabola, rtol=1e-4, atol=ROUNDING)


def test_far_from_the_goal_nothing_overflows_and_the_speed_is_the_chosen_one():
    far = Attractor(np.zeros(2), speed=0.1, smoothing=1e-3)  # r₀/ρ = 10⁴
    z0 = np.array([[10.0, 0.0], [0.0, -10.0]])
    motion = far.flow(z0, np.array([0.0, 10.0, 90.0, 120.0]))
    radius = np.linalg.norm(motion, axis=-1)
    np.testing.assert_allclose(motion[:, 0], z0, rtol=1e-14)
    np.testing.assert_allclose(radius[:, 1:3], [[9.0, 1.0]] * 2, rtol=1e-12)
    assert (radius[:, 3] < 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(far.velocity(z0), axis=-1), 0.1, rtol=1e-14)
    np.testing.assert_allclose(far.potential(z0), 0.1 * (10 - 1e-3 * np.log(2)), rtol=1e-12)


@given(seeds, st.floats(1e-4, 0.5))
def test_arrival_times_are_when_the_flow_is_there(seed, distance):
    z0 = np.random.default_rng(seed).uniform(-2, 2, (5, 2))
    times = ATTRACTOR.arrival_time(z0, distance)
    reached = ATTRACTOR.flow(z0, times[:, None])[:, 0]
    initial = np.linalg.norm(z0 - ATTRACTOR.goal, axis=-1)
    expected = np.minimum(initial, distance)
    np.testing.assert_allclose(np.linalg.norm(reached - ATTRACTOR.goal, axis=-1), expected, rtol=1e-9)
    assert (times >= 0).all() and (times[initial > 1.01 * distance] > 0).all()


@given(st.floats(1e-8, 300))
def test_logarithmic_hyperbolic_functions_are_inverse(a):
    assert log_sinh(np.array(a)) == pytest.approx(np.log(np.sinh(a)), abs=1e-12, rel=1e-12)
    assert asinh_exp(log_sinh(np.array(a))) == pytest.approx(a, rel=1e-12)
    assert asinh_exp(log_sinh(np.array(3e3 * a))) == pytest.approx(3e3 * a, rel=1e-12)  # where sinh overflows, too
    assert (log_sinh(np.array(0.0)), asinh_exp(np.array(-np.inf))) == (-np.inf, 0)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)])
def test_rollouts_take_any_batch(batch):
    y0 = np.random.default_rng(7).uniform(-0.5, 0.5, (*batch, 2))
    assert SYSTEM.rollout(y0, np.linspace(0, 1, 4)).shape == (*batch, 4, 2)
    assert SYSTEM.velocity(y0).shape == (*batch, 2)
    assert SYSTEM.lyapunov(y0).shape == batch


def test_each_rollout_may_have_its_own_times():
    y0 = np.random.default_rng(8).uniform(-0.5, 0.5, (3, 2))
    times = np.array([[0.0, 1.0], [0.5, 2.0], [0.1, 9.0]])
    own = SYSTEM.rollout(y0, times)
    for k in range(3):
        np.testing.assert_allclose(own[k], SYSTEM.rollout(y0[k], times[k]), rtol=0, atol=1e-12)
