"""Phased systems: a shear is a diffeomorphism with det J = 1, motions are exact, and what is stacked keeps all that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.phased import PhaseCurve, PhasedAttractor, Shear, frozen, on_places
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning.timing import TimedAttractor

TOP = 0.2


class Waves:
    """Predictions without a meaning: curves and clocks that change smoothly with the condition."""

    def __init__(self, dim, num_conditions=0, seed=0):
        self.dim, self.num_conditions = dim, num_conditions
        rng = np.random.default_rng(seed)
        self.knots = np.linspace(0, TOP, 12)
        self.points = 0.1 * rng.normal(size=(12, dim))
        self.turn = 0.3 * rng.normal(size=(12, dim, num_conditions))
        self.shift = rng.uniform(0, 6)

    def states(self, places, label=None):
        rest = np.concatenate([[TOP], 0.1 * np.ones(self.num_conditions)])
        return np.concatenate([places, np.broadcast_to(rest, (*places.shape[:-1], len(rest)))], axis=-1)

    def demonstrated(self, starts):
        return self.states(starts)

    def caught(self, state):
        return float(state[self.dim])

    def curve(self, condition):
        return PhaseCurve.through(self.knots, self.points + 0.3 * np.sin(self.turn @ condition))

    def sensitivity(self, condition):
        return PhaseCurve.through(self.knots, 0.3 * np.cos(self.turn @ condition)[..., None] * self.turn)

    def clock(self, condition):
        knots = np.linspace(-1.0, 2.5, 120)
        paces = 1 + 0.5 * np.sin(1.5 * knots + self.shift + condition.sum())[None]
        return TimedAttractor(np.zeros(1), 0.1, 0.02, directions=np.ones((1, 1)), knots=knots, paces=paces)


def shear(dim, num_conditions=0, seed=0):
    return Shear(Waves(dim, num_conditions, seed))


def attractor(dim, power=3.0, seed=0, num_conditions=0):
    waves = Waves(dim, num_conditions, seed)
    return PhasedAttractor(
        goal=np.zeros(dim + 1 + num_conditions), speed=0.1, smoothing=0.02, predictions=waves, power=power
    )


def bump(dim, seed=1):
    """A flow of R^dim that moves space by a few centimetres."""
    rng = np.random.default_rng(seed)
    grid = GaussianGrid(tuple(np.linspace(-0.2, 0.2, 4) for _ in range(dim)), 0.5 / 0.1**2)
    return Flow(GridRBF(grid, 0.04 * rng.normal(size=(grid.num_points, dim))), 1.0, 16)


def states(dim, num, num_conditions=0, seed=2):
    """States, in which each condition comes twice."""
    rng = np.random.default_rng(seed)
    conditions = np.repeat(rng.uniform(-1, 1, ((num + 1) // 2, num_conditions)), 2, axis=0)[:num]
    return np.column_stack([rng.uniform(-0.3, 0.3, (num, dim)), rng.uniform(0.02, TOP, num), conditions])


@pytest.mark.parametrize("num_conditions", [0, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_shear_is_a_diffeomorphism_of_determinant_1(dim, num_conditions):
    psi, z = shear(dim, num_conditions), states(dim, 50, num_conditions)
    np.testing.assert_allclose(psi.inverse(psi.forward(z)), z, atol=1e-15)
    image, J = psi.jacobian(z)
    np.testing.assert_allclose(np.linalg.det(J), 1.0, atol=1e-12)
    h = 1e-6
    for k in range(psi.dim):
        step = h * np.eye(psi.dim)[k]
        slope = (psi.forward(z + step) - psi.forward(z - step)) / (2 * h)
        np.testing.assert_allclose(J[..., k], slope, atol=1e-5)
    np.testing.assert_allclose(
        psi.inverse_jacobian(image)[1] @ J, np.broadcast_to(np.eye(psi.dim), J.shape), atol=1e-12
    )


def test_parts_of_a_shear_add_up_and_it_is_the_flow_of_its_field():
    psi, z = shear(2, 2), states(2, 30, 2)
    both = psi.scaled(0.3).forward(psi.scaled(0.7).forward(z))
    np.testing.assert_allclose(both, psi.forward(z), atol=1e-14)
    np.testing.assert_allclose(psi.scaled(0.0).forward(z), z)
    speed = (psi.scaled(1e-6).forward(z) - z) / 1e-6
    curve = np.stack([psi.predictions.curve(row[3:]).at(row[2:3])[0] for row in z])
    np.testing.assert_allclose(speed[:, :2], -curve, atol=1e-8)
    np.testing.assert_allclose(speed[:, 2:], 0.0)


def test_a_curve_goes_on_straight_beyond_its_ends():
    bent = Waves(2).curve(np.empty(0))
    ends = np.array([0.0, TOP])
    np.testing.assert_allclose(
        bent.at(ends + np.array([-0.1, 0.1])), bent.at(ends) + np.array([[-0.1], [0.1]]) * bent.slope(ends)
    )
    near = np.array([TOP - 1e-7, TOP + 1e-7])
    np.testing.assert_allclose(bent.slope(near)[0], bent.slope(near)[1], atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.5, 5.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.integers(0, 3))
def test_motions_of_the_base_are_a_flow_and_their_potential_falls(seed, power, first, second, num):
    base, z = attractor(2, power, seed, num), states(2, 5, num, seed)
    once = base.flow(z, np.array([first + second]))[:, 0]
    twice = base.flow(base.flow(z, np.array([first]))[:, 0], np.array([second]))[:, 0]
    np.testing.assert_allclose(once, twice, atol=1e-9)
    path = base.flow(z, np.linspace(0, 6, 60))
    assert (np.diff(base.potential(path), axis=1) <= 1e-12).all()
    np.testing.assert_array_equal(path[..., 3:], np.broadcast_to(z[:, None, 3:], (5, 60, num)))


@pytest.mark.parametrize("num_conditions", [0, 2])
@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
def test_velocities_are_the_derivatives_of_motions_also_at_phase_0(power, num_conditions):
    base = attractor(2, power, num_conditions=num_conditions)
    z = np.concatenate([states(2, 20, num_conditions), [[0.1, -0.05, 0.0, *[0.3] * num_conditions]]])
    h = 1e-5
    ahead, behind = base.flow(z, np.array([h]))[:, 0], z
    np.testing.assert_allclose((ahead - behind) / h, base.velocity(z), atol=2e-3)
    np.testing.assert_allclose(base.velocity(base.goal), 0.0, atol=1e-12)


def test_times_are_those_of_the_motions():
    base, z = attractor(2, num_conditions=2), states(2, 10, 2)
    fraction = np.broadcast_to(np.linspace(1, 0.01, 9), (10, 9))
    times = base.times_at(z, fraction * base.left(z)[:, None])
    np.testing.assert_allclose(base.flow(z, times), base.at_fraction(z, fraction), atol=1e-8)
    assert (np.diff(times, axis=1) > 0).all()


@pytest.mark.parametrize("stacked", [False, True], ids=["alone", "with a flow stacked on it"])
@pytest.mark.parametrize(("dim", "num_conditions"), [(2, 0), (3, 0), (2, 3)])
def test_exact_rollouts_are_what_stepping_converges_to(dim, num_conditions, stacked):
    psi = shear(dim, num_conditions)
    transform = Chain([psi, *on_places([bump(dim)], 1 + num_conditions)]) if stacked else psi
    system = DiffeomorphicSystem(transform, attractor(dim, num_conditions=num_conditions))
    start = states(dim, 4, num_conditions)
    times = np.linspace(0, 1.5, 6)
    exact = system.rollout(start, times)
    errors = [np.abs(system.stepped_rollout(start, times, n) - exact).max() for n in (5, 30)]
    assert errors[1] < 2e-5 and errors[1] < errors[0] / 20  # the clock's paces have kinks
    values = system.lyapunov(exact)
    assert (np.diff(values, axis=1) < 0).all()
    ends = np.column_stack([np.zeros((4, dim + 1)), start[:, dim + 1 :]])
    np.testing.assert_allclose(system.rollout(start, np.array([200.0]))[:, 0], transform.inverse(ends), atol=1e-6)


def test_what_is_stacked_leaves_the_phase_and_keeps_space_from_folding():
    flow, z = bump(2), states(2, 40, 2)
    (stacked,) = on_places([flow], 3)
    image, J = stacked.jacobian(z)
    np.testing.assert_array_equal(image[:, 2:], z[:, 2:])
    np.testing.assert_allclose(image[:, :2], flow.forward(z[:, :2]))
    np.testing.assert_allclose(np.linalg.det(J), np.linalg.det(flow.jacobian(z[:, :2])[1]))
    np.testing.assert_allclose(stacked.inverse(image), z, atol=1e-7)
    assert (np.linalg.det(Chain([shear(2, 2), stacked]).jacobian(z)[1]) > 0).all()
    half = stacked.scaled(0.5)
    np.testing.assert_allclose(half.forward(half.forward(z)), image, atol=1e-6)
    assert on_places([flow], 0) == [flow]


@pytest.mark.parametrize("stacked", [False, True], ids=["alone", "with a flow stacked on it"])
@pytest.mark.parametrize("phase", [0.0, 0.3 * TOP, TOP])
def test_a_frozen_system_moves_places_as_the_whole_one_does_at_that_phase(phase, stacked):
    transform = Chain([shear(2, 2).scaled(0.8), *on_places([bump(2)] * stacked, 3)])
    system, rest = DiffeomorphicSystem(transform, attractor(2, num_conditions=2)), np.array([phase, 0.4, -0.2])
    places = states(2, 20)[:, :2]
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
