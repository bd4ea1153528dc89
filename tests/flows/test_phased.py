"""Phased systems beside the laws (tests/laws): shears of determinant 1, what is stacked on them, frozen systems."""

import numpy as np
import pytest
from laws.registry import TOP, Waves, bump, phased, states

from dt_viz.flows.augmented_systems import Shear, frozen, on_places
from dt_viz.flows.diffeomorphisms import Chain
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem


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
