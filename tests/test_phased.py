"""Phased systems: a shear is a diffeomorphism with det J = 1, motions are exact, and what is stacked keeps all that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.phased import AtAnyPhase, PhaseCurve, PhasedAttractor, Shear, lifted
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning.timing import TimedAttractor

TOP = 0.2


def curve(dim, seed=0):
    rng = np.random.default_rng(seed)
    return PhaseCurve.through(np.linspace(0, TOP, 12), 0.1 * rng.normal(size=(12, dim)))


def clock(seed=0):
    knots, shift = np.linspace(-1.0, 2.5, 120), np.random.default_rng(seed).uniform(0, 6)
    paces = 1 + 0.5 * np.sin(1.5 * knots + shift)[None]
    return TimedAttractor(np.zeros(1), 0.1, 0.02, directions=np.ones((1, 1)), knots=knots, paces=paces)


def attractor(dim, power=3.0, seed=0):
    return PhasedAttractor(goal=np.zeros(dim + 1), speed=0.1, smoothing=0.02, clock=clock(seed), power=power)


def bump(dim, seed=1):
    """A flow of R^dim that moves space by a few centimetres."""
    rng = np.random.default_rng(seed)
    grid = GaussianGrid(tuple(np.linspace(-0.2, 0.2, 4) for _ in range(dim)), 0.5 / 0.1**2)
    return Flow(GridRBF(grid, 0.04 * rng.normal(size=(grid.num_points, dim))), 1.0, 16)


def states(dim, num, seed=2):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.3, 0.3, (num, dim)), rng.uniform(0.0, TOP, num)])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_shear_is_a_diffeomorphism_of_determinant_1(dim):
    shear, z = Shear(curve(dim)), states(dim, 50)
    np.testing.assert_allclose(shear.inverse(shear.forward(z)), z, atol=1e-15)
    image, J = shear.jacobian(z)
    np.testing.assert_allclose(np.linalg.det(J), 1.0, atol=1e-12)
    h = 1e-6
    for k in range(dim + 1):
        step = h * np.eye(dim + 1)[k]
        slope = (shear.forward(z + step) - shear.forward(z - step)) / (2 * h)
        np.testing.assert_allclose(J[..., k], slope, atol=1e-5)
    np.testing.assert_allclose(
        shear.inverse_jacobian(image)[1] @ J, np.broadcast_to(np.eye(dim + 1), J.shape), atol=1e-12
    )


def test_parts_of_a_shear_add_up_and_it_is_the_flow_of_its_field():
    shear, z = Shear(curve(2)), states(2, 30)
    both = shear.scaled(0.3).forward(shear.scaled(0.7).forward(z))
    np.testing.assert_allclose(both, shear.forward(z), atol=1e-14)
    np.testing.assert_allclose(shear.scaled(0.0).forward(z), z)
    speed = (shear.scaled(1e-6).forward(z) - z) / 1e-6
    np.testing.assert_allclose(speed[:, :2], -shear.curve.at(z[:, 2]), atol=1e-8)
    np.testing.assert_allclose(speed[:, 2], 0.0)


def test_a_curve_goes_on_straight_beyond_its_ends():
    bent = curve(2)
    ends = np.array([0.0, TOP])
    np.testing.assert_allclose(
        bent.at(ends + np.array([-0.1, 0.1])), bent.at(ends) + np.array([[-0.1], [0.1]]) * bent.slope(ends)
    )
    near = np.array([TOP - 1e-7, TOP + 1e-7])
    np.testing.assert_allclose(bent.slope(near)[0], bent.slope(near)[1], atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.5, 5.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_motions_of_the_base_are_a_flow_and_their_potential_falls(seed, power, first, second):
    base, z = attractor(2, power, seed), states(2, 5, seed)
    once = base.flow(z, np.array([first + second]))[:, 0]
    twice = base.flow(base.flow(z, np.array([first]))[:, 0], np.array([second]))[:, 0]
    np.testing.assert_allclose(once, twice, atol=1e-9)
    path = base.flow(z, np.linspace(0, 6, 60))
    assert (np.diff(base.potential(path), axis=1) <= 1e-12).all()


@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_velocities_are_the_derivatives_of_motions_also_at_phase_0(power):
    base = attractor(2, power)
    z = np.concatenate([states(2, 20), [[0.1, -0.05, 0.0]]])
    h = 1e-5
    ahead, behind = base.flow(z, np.array([h]))[:, 0], z
    np.testing.assert_allclose((ahead - behind) / h, base.velocity(z), atol=2e-3)
    np.testing.assert_allclose(base.velocity(base.goal), 0.0, atol=1e-12)


def test_times_are_those_of_the_motions():
    base, z = attractor(2), states(2, 10) + np.array([0, 0, 0.02])
    distances = np.linspace(0.15, 0.001, 7) * np.linalg.norm(z - base.goal, axis=1)[:, None]
    times = base.times_at(z, distances)
    reached = np.linalg.norm(base.flow(z, times) - base.goal, axis=-1)
    np.testing.assert_allclose(reached, distances, rtol=1e-6)
    fraction = np.broadcast_to(np.linspace(1, 0.01, 9), (10, 9))
    np.testing.assert_allclose(base.fraction_at(z, base.times_at_fraction(z, fraction)), fraction, rtol=1e-8)


@pytest.mark.parametrize("stacked", [False, True], ids=["alone", "with a flow stacked on it"])
@pytest.mark.parametrize("dim", [2, 3])
def test_exact_rollouts_are_what_stepping_converges_to(dim, stacked):
    transform = Chain([Shear(curve(dim)), *lifted([bump(dim)])]) if stacked else Shear(curve(dim))
    system = DiffeomorphicSystem(transform, attractor(dim))
    start = states(dim, 4) + np.array([*[0.0] * dim, 0.02])
    times = np.linspace(0, 1.5, 6)
    exact = system.rollout(start, times)
    errors = [np.abs(system.stepped_rollout(start, times, n) - exact).max() for n in (5, 30)]
    assert errors[1] < 2e-5 and errors[1] < errors[0] / 20  # the clock's paces have kinks
    values = system.lyapunov(exact)
    assert (np.diff(values, axis=1) < 0).all()
    np.testing.assert_allclose(
        system.rollout(start, np.array([200.0]))[:, 0],
        transform.inverse(system.base.goal[None]).repeat(4, 0),
        atol=1e-6,
    )


def test_what_is_stacked_leaves_the_phase_and_keeps_space_from_folding():
    flow, z = bump(2), states(2, 40)
    stacked = AtAnyPhase(flow)
    image, J = stacked.jacobian(z)
    np.testing.assert_array_equal(image[:, 2], z[:, 2])
    np.testing.assert_allclose(image[:, :2], flow.forward(z[:, :2]))
    np.testing.assert_allclose(np.linalg.det(J), np.linalg.det(flow.jacobian(z[:, :2])[1]))
    np.testing.assert_allclose(stacked.inverse(image), z, atol=1e-7)
    assert (np.linalg.det(Chain([Shear(curve(2)), stacked]).jacobian(z)[1]) > 0).all()
    half = stacked.scaled(0.5)
    np.testing.assert_allclose(half.forward(half.forward(z)), image, atol=1e-6)


def test_a_clock_may_be_a_plain_attractor():
    base = PhasedAttractor(goal=np.zeros(3), speed=0.1, smoothing=0.02, clock=Attractor(np.zeros(1), 0.1, 0.02))
    z = states(2, 3) + np.array([0, 0, 0.05])
    np.testing.assert_allclose(base.flow(z, np.array([100.0]))[:, 0], 0.0, atol=1e-6)
