"""What diffeomorphisms do beside the laws that all of them obey (tests/laws)."""

import numpy as np
import pytest
from laws.registry import EXACT, PLANE, bent, uniform

from dt_viz.flows.diffeomorphisms import Chain, Conjugated, Flow, Identity, min_det_jacobian, round_trip_error
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER, RK4


def group_defect(flow, a, b):
    """How far scaled(a)∘scaled(b) is from scaled(a + b)."""
    y = uniform(2)(40)
    return np.abs(flow.scaled(a).forward(flow.scaled(b).forward(y)) - flow.scaled(a + b).forward(y)).max()


@pytest.mark.parametrize(("step", "order"), [(EULER, 1), (IMPLICIT_EULER, 1), (RK4, 4)])
def test_scaled_flows_are_a_one_parameter_group_up_to_the_order_of_their_steps(step, order):
    coarse, fine = (group_defect(Flow(bent(2), 1.0, steps, step), 0.3, 0.5) for steps in (16, 32))
    assert coarse / fine == pytest.approx(2**order, rel=0.15)


def test_the_last_of_a_chain_acts_first_and_a_conjugated_flow_is_the_chain_of_its_parts():
    f, g, by = Flow(bent(2, 1), 0.9), Flow(bent(2, 2), 0.9), EXACT
    y = uniform(2)(10)
    expected = f.forward(g.forward(y))
    np.testing.assert_array_equal((f @ g).forward(y), expected)
    assert np.abs(Chain([g, f]).forward(y) - expected).max() > 1e-3  # the order matters here
    np.testing.assert_array_equal(Chain([f, g]).inverse(y), g.inverse(f.inverse(y)))
    np.testing.assert_array_equal(Conjugated(f, by).forward(y), by.inverse(f.forward(by.forward(y))))
    np.testing.assert_array_equal(Conjugated(f, by).inverse(y), by.inverse(f.inverse(by.forward(y))))


def test_chains_are_associative_and_the_identity_is_neutral():
    f, g, h = (Flow(bent(2, seed), 0.5) for seed in (1, 2, 3))
    y = uniform(2)(10)
    assert Chain([Chain([f, g]), h]) == Chain([f, Chain([g, h])]) == Chain([f, g, h])
    assert ((f @ g) @ h).parts == (f @ (g @ h)).parts == (f, g, h)
    np.testing.assert_array_equal((f @ Identity(2) @ g).forward(y), (f @ g).forward(y))


@pytest.mark.parametrize("parts", [[], [Identity(2), Identity(3)], [Flow(bent(2)), PLANE]])
def test_chains_of_nothing_or_of_mixed_dimension_are_refused(parts):
    with pytest.raises(ValueError, match="parts of one dimension"):
        Chain(parts)


def test_a_placed_plane_acts_in_its_plane_and_leaves_the_distance_from_it():
    y = uniform(3)(30)
    before, after = (((s - PLANE.origin) @ PLANE.axes) / PLANE.scale for s in (y, PLANE.forward(y)))
    np.testing.assert_allclose(after[:, 2], before[:, 2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(after[:, :2], PLANE.inner.forward(before[:, :2]), rtol=0, atol=1e-13)
    in_plane = PLANE.to_world(before[:, :2])
    expected = PLANE.to_world(PLANE.inner.forward(before[:, :2]))
    np.testing.assert_allclose(PLANE.forward(in_plane), expected, rtol=0, atol=1e-13)


def test_a_coarse_euler_flow_that_folds_is_recognised():
    folding = Flow(bent(2, strength=8.0), 1.0, 1, EULER)
    y = uniform(2)(400)
    assert min_det_jacobian(folding.jacobian, y) < 0
    assert min_det_jacobian(Flow(bent(2, strength=8.0), 1.0, 400).jacobian, y) > 0
    assert round_trip_error(folding, y) > 0.1


@pytest.mark.parametrize("inverse", [False, True])
def test_the_smallest_determinant_of_a_step_is_that_of_every_step(inverse):
    flow, y = Flow(bent(2, strength=1.5), 1.0, 3, EULER), uniform(2)(200)
    smallest, one = np.inf, Flow(flow.field, -1 / 3 if inverse else 1 / 3, 1, EULER)
    s = y
    for _ in range(3):
        s, J = one.jacobian(s)
        smallest = min(smallest, np.linalg.det(J).min())
    assert flow.min_step_determinant(y, inverse=inverse) == pytest.approx(smallest, rel=1e-12)
    twice = Flow(bent(2, strength=20.0), 1.0, 2, EULER)  # a fold of a fold may keep its orientation, where it began
    assert twice.min_step_determinant(y, inverse=inverse) < 0
    exact = Flow(bent(2), 1.0, 6, IMPLICIT_EULER, EULER)
    assert exact.min_step_determinant(y, inverse=inverse) > 0
