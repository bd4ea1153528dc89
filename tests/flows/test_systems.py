"""The base attractor and conjugate systems beside the laws (tests/laws): extremes, closed forms, controllers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laws.registry import TOP, Waves, bent, bump, phased, states
from oracles import central_differences

from dt_viz.flows.augmented_systems import Shear, frozen, on_places
from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.rollouts import Rays
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


# phased systems: shears of determinant 1, what is stacked on them, frozen systems


def shear(dim, num_conditions=0):
    return Shear(Waves(dim, num_conditions))


@pytest.mark.parametrize("num_conditions", [0, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_shear_takes_the_curve_away_and_has_determinant_1(dim, num_conditions):
    psi, z = shear(dim, num_conditions), states(dim, num_conditions)(50)
    np.testing.assert_allclose(np.linalg.det(psi.jacobian(z)[1]), 1.0, atol=1e-12)
    curves = np.stack([psi.predictions.curve(row[dim + 1 :]).at(row[dim : dim + 1])[0] for row in z])
    np.testing.assert_allclose(psi.forward(z), np.column_stack([z[:, :dim] - curves, z[:, dim:]]), atol=1e-14)


def test_a_curve_goes_on_straight_beyond_its_ends():
    bent = Waves(2).curve(np.empty(0))
    ends = np.array([0.0, TOP])
    np.testing.assert_allclose(
        bent.at(ends + np.array([-0.1, 0.1])), bent.at(ends) + np.array([[-0.1], [0.1]]) * bent.slope(ends)
    )
    near = np.array([TOP - 1e-7, TOP + 1e-7])
    np.testing.assert_allclose(bent.slope(near)[0], bent.slope(near)[1], atol=1e-3)


@pytest.mark.parametrize("num_conditions", [0, 2])
@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_at_phase_0_velocities_are_the_derivatives_of_motions_too_and_conditions_stay(power, num_conditions):
    base = phased(2, num_conditions, power)
    z, h = np.array([[0.1, -0.05, 0.0, *[0.3] * num_conditions]]), 1e-5
    np.testing.assert_allclose((base.flow(z, np.array([h]))[:, 0] - z) / h, base.velocity(z), atol=2e-3)
    path = base.flow(states(2, num_conditions)(4), np.linspace(0, 2, 5))
    np.testing.assert_array_equal(path[..., 3:], np.broadcast_to(path[:, :1, 3:], path[..., 3:].shape))


def test_what_is_stacked_acts_on_places_and_leaves_phase_and_condition():
    flow, z = bump(2), states(2, 2)(40)
    (stacked,) = on_places([flow], 3)
    image, J = stacked.jacobian(z)
    np.testing.assert_array_equal(image[:, 2:], z[:, 2:])
    np.testing.assert_allclose(image[:, :2], flow.forward(z[:, :2]))
    np.testing.assert_allclose(np.linalg.det(J), np.linalg.det(flow.jacobian(z[:, :2])[1]))
    assert on_places([flow], 0) == [flow]


@pytest.mark.parametrize("stacked", [False, True], ids=["alone", "with a flow stacked on it"])
@pytest.mark.parametrize("phase", [0.0, 0.3 * TOP, TOP])
def test_a_frozen_system_moves_places_as_the_whole_one_does_at_that_phase(phase, stacked):
    transform = Chain([shear(2, 2).scaled(0.8), *on_places([bump(2)] * stacked, 3)])
    system, rest = DiffeomorphicSystem(transform, phased(2, 2)), np.array([phase, 0.4, -0.2])
    places = states(2)(20)[:, :2]
    whole = np.column_stack([places, np.broadcast_to(rest, (20, 3))])
    held = frozen(system, rest)
    np.testing.assert_allclose(held.velocity(places), system.velocity(whole)[:, :2], atol=1e-12)
    np.testing.assert_allclose(held.lyapunov(places), system.lyapunov(whole), atol=1e-15)
    np.testing.assert_allclose(held.transform.forward(places), transform.forward(whole)[:, :2], atol=1e-15)
    # its streamlines are those of its velocity, and end where that is zero
    rays = Rays(held.transform.forward(places), held.base)
    line = held.transform.inverse(rays.at(np.zeros(3, int), np.array([0.5, 0.5 + 1e-6, 1.0])))
    slope = (line[1] - line[0]) / 1e-6
    velocity = held.velocity(line[:1])[0]
    np.testing.assert_allclose(slope / np.linalg.norm(slope), velocity / np.linalg.norm(velocity), atol=1e-4)
    np.testing.assert_allclose(held.velocity(line[2:]), 0.0, atol=1e-9)
    level = held.base.potential_at(0.07)
    ring = transform.inverse(np.append(system.base.goal[:2] + np.array([0.07, 0.0]), rest))
    assert held.lyapunov(ring[:2]) == pytest.approx(level)


def test_a_system_without_a_phase_is_never_frozen():
    plain = DiffeomorphicSystem(bump(2), Attractor(np.zeros(2)))
    assert frozen(plain, np.empty(0)) is plain
