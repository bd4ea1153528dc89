"""One list of diffeomorphisms, one set of checks; a new transform joins by one line."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.flows.diffeomorphisms import (
    AdaptiveFlow,
    Chain,
    Conjugated,
    Flow,
    Identity,
    Inverse,
    Placed,
    min_det_jacobian,
    round_trip_error,
)
from dt_viz.flows.fields import GaussianGrid, GridRBF, PlacedField
from dt_viz.flows.integrators import euler, implicit_euler, rk4


def field(dim, seed=0, strength=0.3):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(dim)), 0.5 / 0.6**2)
    return GridRBF(grid, strength * np.random.default_rng(seed).normal(size=(grid.num_points, dim)))


def tilted_axes():
    q, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


PLANE = Placed(Flow(field(2), 0.8, 12), np.array([0.1, -0.2, 0.3]), tilted_axes(), 0.7)

# name: diffeomorphism, how exactly its inverse undoes it
INSTANCES = {
    "flow rk4": (Flow(field(2), 1.0, 16), 1e-6),
    "flow rk4 in space": (Flow(field(3), 0.7, 16), 1e-6),
    "flow backwards": (Flow(field(2), -1.0, 16), 1e-6),
    "flow euler": (Flow(field(2), 0.5, 50, euler), 2e-2),
    "flow euler, implicit inverse": (Flow(field(2), 0.8, 6, euler, implicit_euler), 1e-13),
    "flow implicit, euler inverse": (Flow(field(3), 0.8, 6, implicit_euler, euler), 1e-13),
    "adaptive flow": (AdaptiveFlow(field(2), 1.0, 1e-9), 1e-7),
    "adaptive flow of a placed field": (
        AdaptiveFlow(PlacedField(field(3), np.array([0.2, 0.1, -0.1]), tilted_axes(), 0.5), -0.6, 1e-9),
        1e-7,
    ),
    "chain": (Chain([Flow(field(2, 1), 0.4), Flow(field(2, 2), -0.5), AdaptiveFlow(field(2, 3), 0.3)]), 1e-6),
    "inverse": (Inverse(Flow(field(2), 1.0, 6, euler, implicit_euler)), 1e-12),
    "inverse of a chain": (Inverse(Chain([Flow(field(3, 1), 0.3), Flow(field(3, 2), 0.3)])), 1e-6),
    "placed, plane in space": (PLANE, 1e-6),
    "placed, space in space": (Placed(Flow(field(3), 0.5), np.ones(3), tilted_axes(), 2.0), 1e-6),
    "chain with a placed": (Chain([PLANE, Identity(3), AdaptiveFlow(field(3, 4), 0.4)]), 1e-6),
    "identity": (Identity(3), 1e-15),
    "conjugated": (Conjugated(Flow(field(2, 5), 0.6, 12), Flow(field(2, 6), 0.8, 6, euler, implicit_euler)), 1e-6),
}


@pytest.fixture(params=INSTANCES, name="case")
def _case(request):
    return INSTANCES[request.param]


def points(transform, *batch, seed=0):
    return np.random.default_rng(seed).uniform(-0.8, 0.8, (*batch, transform.dim))


def numerical_jacobian(function, y, h=1e-3):
    columns = []
    for e in h * np.eye(y.shape[-1]):
        far, near = function(y + 2 * e) - function(y - 2 * e), function(y + e) - function(y - e)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)


def test_there_and_back_again_in_both_directions(case):
    transform, tolerance = case
    y = points(transform, 40)
    np.testing.assert_allclose(transform.inverse(transform.forward(y)), y, rtol=0, atol=tolerance)
    np.testing.assert_allclose(transform.forward(transform.inverse(y)), y, rtol=0, atol=tolerance)
    assert round_trip_error(transform, y) <= tolerance * np.sqrt(transform.dim)


def test_jacobians_are_derivatives(case):
    transform, _ = case
    y = points(transform, 15)
    for function, derivative in (
        (transform.forward, transform.jacobian),
        (transform.inverse, transform.inverse_jacobian),
    ):
        value, J = derivative(y)
        np.testing.assert_allclose(value, function(y), rtol=0, atol=1e-8)
        np.testing.assert_allclose(J, numerical_jacobian(function, y), rtol=0, atol=3e-6)


def test_the_inverse_jacobian_is_the_inverse_matrix(case):
    transform, tolerance = case
    x, J = transform.jacobian(points(transform, 20))
    back = transform.inverse_jacobian(x)[1]
    np.testing.assert_allclose(back @ J, np.broadcast_to(np.eye(transform.dim), J.shape), rtol=0, atol=20 * tolerance)


def test_orientation_is_kept(case):
    transform, _ = case
    y = points(transform, 100)
    assert np.linalg.det(transform.jacobian(y)[1]).min() > 0
    assert min_det_jacobian(transform.jacobian, y) == np.linalg.det(transform.jacobian(y)[1]).min()


def test_scaled_it_goes_from_the_identity_to_itself_through_diffeomorphisms(case):
    transform, tolerance = case
    y = points(transform, 60)
    np.testing.assert_allclose(transform.scaled(0.0).forward(y), y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(transform.scaled(0.0).inverse(y), y, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(transform.scaled(1.0).forward(y), transform.forward(y))
    np.testing.assert_array_equal(transform.scaled(1.0).inverse(y), transform.inverse(y))
    moved = [0.0]
    for fraction in (0.2, 0.5, 0.8, 1.0):
        scaled = transform.scaled(fraction)
        assert min_det_jacobian(scaled.jacobian, y) > 0
        assert round_trip_error(scaled, y) <= tolerance * np.sqrt(transform.dim)
        moved.append(np.linalg.norm(scaled.forward(y) - y, axis=1).mean())
    assert moved == sorted(moved) and (moved[1] > 0 or isinstance(transform, Identity))


def test_at_another_tolerance_it_is_the_same_map_nearly(case):
    transform, _ = case
    y = points(transform, 20)
    exact, coarse = (transform.at_tolerance(tolerance).forward(y) for tolerance in (1e-11, 1e-7))
    np.testing.assert_allclose(coarse, exact, rtol=0, atol=1e-5)


def test_a_flow_takes_as_many_steps_as_its_tolerance_asks_for_unless_they_define_it():
    fixed, y = Flow(field(2), 1.0, 40), points(Flow(field(2)), 5)
    chosen = replace(fixed, tolerance=1e-8)
    for tolerance, steps in ((1e-8, 40), (16e-8, 20), (1e3, 1)):
        np.testing.assert_array_equal(chosen.at_tolerance(tolerance).forward(y), replace(fixed, steps=steps).forward(y))
    assert fixed.at_tolerance(1e-4) is fixed


def test_a_controllers_jacobian_at_one_point_is_that_of_the_flow(case):
    transform, _ = case
    controlled = transform.at_tolerance(1e-7)
    for y in points(transform, 5):
        z, J = transform.jacobian(y)
        found, D = controlled.jacobian(y)
        np.testing.assert_allclose(found, z, rtol=0, atol=1e-5)
        np.testing.assert_allclose(D, J, rtol=0, atol=2e-3 * np.abs(J).max())


def test_tangents_are_jacobian_products(case):
    transform, _ = case
    y = points(transform, 9)
    U = np.random.default_rng(1).normal(size=(9, transform.dim, 2))
    np.testing.assert_allclose(transform.forward_tangents(y, U)[1], transform.jacobian(y)[1] @ U, rtol=0, atol=1e-7)
    np.testing.assert_allclose(
        transform.inverse_tangents(y, U)[1], transform.inverse_jacobian(y)[1] @ U, rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("batch", [(), (1,), (0,), (2, 3), (2, 0, 3)])
def test_batch_axes_lead(case, batch):
    transform, _ = case
    d = transform.dim
    y = points(transform, *batch)
    U = np.random.default_rng(1).normal(size=(*batch, d, 2))
    flat, flat_U = y.reshape(-1, d), U.reshape(-1, d, 2)
    for plain, tangent in (
        (transform.forward, transform.forward_tangents),
        (transform.inverse, transform.inverse_tangents),
    ):
        assert plain(y).shape == y.shape
        np.testing.assert_allclose(plain(y).reshape(-1, d), plain(flat), rtol=0, atol=1e-12)
        V = tangent(y, U)[1]
        assert V.shape == U.shape
        np.testing.assert_allclose(V.reshape(-1, d, 2), tangent(flat, flat_U)[1], rtol=0, atol=1e-12)
    assert transform.jacobian(y)[1].shape == transform.inverse_jacobian(y)[1].shape == (*batch, d, d)


def test_arguments_stay_as_they_are(case):
    transform, _ = case
    y = points(transform, 5)
    y.setflags(write=False)
    U = np.broadcast_to(np.eye(transform.dim), (5, transform.dim, transform.dim))
    transform.forward_tangents(y, U)
    transform.inverse_tangents(y, U)


def test_points_of_another_dimension_are_refused(case):
    transform, _ = case
    with pytest.raises(ValueError, match=rf"points have 5 coordinates.*R\^{transform.dim}"):
        transform.forward(np.zeros((4, 5)))
    with pytest.raises(ValueError, match="points have 1 coordinates"):
        transform.inverse(np.zeros(1))


@given(st.floats(-1, 1), st.floats(-1, 1), st.sampled_from(["rk4", "adaptive"]))
def test_flows_are_a_one_parameter_group(s, t, kind):
    V = field(2)
    flow = (lambda d: Flow(V, d, 32)) if kind == "rk4" else (lambda d: AdaptiveFlow(V, d, 1e-10))
    y = points(flow(1.0), 12)
    np.testing.assert_allclose(flow(s + t).forward(y), flow(s).forward(flow(t).forward(y)), rtol=0, atol=1e-6)
    np.testing.assert_allclose(flow(-t).forward(y), flow(t).inverse(y), rtol=0, atol=1e-12)


def group_defect(flow, a, b):
    """How far scaled(a)∘scaled(b) is from scaled(a + b)."""
    y = points(flow, 40)
    return np.abs(flow.scaled(a).forward(flow.scaled(b).forward(y)) - flow.scaled(a + b).forward(y)).max()


@pytest.mark.parametrize(("step", "order"), [(euler, 1), (implicit_euler, 1), (rk4, 4)])
def test_scaled_flows_are_a_one_parameter_group_up_to_the_order_of_their_steps(step, order):
    coarse, fine = (group_defect(Flow(field(2), 1.0, steps, step), 0.3, 0.5) for steps in (16, 32))
    assert coarse / fine == pytest.approx(2**order, rel=0.15)


def test_scaled_adaptive_and_conjugated_flows_are_a_one_parameter_group():
    flow = AdaptiveFlow(field(3), 1.2, 1e-10)
    by = Flow(field(3, 6), 0.8, 6, euler, implicit_euler)
    for transform in (flow, Conjugated(flow, by), Placed(flow, np.ones(3), tilted_axes(), 0.6)):
        assert group_defect(transform, 0.25, 0.6) < 1e-7


def test_a_conjugated_flow_is_the_chain_of_its_parts():
    by, flow = Flow(field(2, 6), 0.8, 6, euler, implicit_euler), Flow(field(2, 5), 0.6)
    y = points(flow, 20)
    chain = Chain([Inverse(by), flow, by])
    np.testing.assert_array_equal(Conjugated(flow, by).forward(y), chain.forward(y))
    np.testing.assert_array_equal(Conjugated(flow, by).inverse(y), chain.inverse(y))


def test_the_last_of_a_chain_acts_first():
    f, g = Flow(field(2, 1), 0.9), Flow(field(2, 2), 0.9)
    y = points(f, 10)
    expected = f.forward(g.forward(y))
    np.testing.assert_array_equal(Chain([f, g]).forward(y), expected)
    np.testing.assert_array_equal((f @ g).forward(y), expected)
    assert np.abs(Chain([g, f]).forward(y) - expected).max() > 1e-3  # the order matters here
    np.testing.assert_array_equal(Chain([f, g]).inverse(y), g.inverse(f.inverse(y)))


def test_chains_are_associative():
    f, g, h = (Flow(field(2, seed), 0.5) for seed in (1, 2, 3))
    y = points(f, 10)
    left, right = Chain([Chain([f, g]), h]), Chain([f, Chain([g, h])])
    assert left == right == Chain([f, g, h])
    np.testing.assert_array_equal(left.forward(y), right.forward(y))
    assert ((f @ g) @ h).parts == (f @ (g @ h)).parts == (f, g, h)


def test_the_identity_is_neutral_and_the_inverse_undoes():
    f = Flow(field(2), 0.8, 6, euler, implicit_euler)
    y = points(f, 10)
    np.testing.assert_array_equal((f @ Identity(2)).forward(y), f.forward(y))
    np.testing.assert_array_equal((Identity(2) @ f).forward(y), f.forward(y))
    np.testing.assert_allclose((Inverse(f) @ f).forward(y), y, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(Inverse(Inverse(f)).forward(y), f.forward(y))


@pytest.mark.parametrize("parts", [[], [Identity(2), Identity(3)], [Flow(field(2)), PLANE]])
def test_chains_of_nothing_or_of_mixed_dimension_are_refused(parts):
    with pytest.raises(ValueError, match="parts of one dimension"):
        Chain(parts)


def test_a_placed_plane_acts_in_its_plane_and_leaves_the_distance_from_it():
    y = points(PLANE, 30)
    frame_before, frame_after = PLANE.to_frame(y), PLANE.to_frame(PLANE.forward(y))
    np.testing.assert_allclose(frame_after[:, 2], frame_before[:, 2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(frame_after[:, :2], PLANE.inner.forward(frame_before[:, :2]), rtol=0, atol=1e-13)


def test_frame_and_world_coordinates_are_inverse_and_missing_coordinates_are_zero():
    y = points(PLANE, 2, 4)
    np.testing.assert_allclose(PLANE.to_world(PLANE.to_frame(y)), y, rtol=0, atol=1e-14)
    u = points(PLANE.inner, 6)
    np.testing.assert_allclose(PLANE.to_frame(PLANE.to_world(u))[:, 2], 0, rtol=0, atol=1e-14)


def test_a_coarse_euler_flow_that_folds_is_recognised():
    folding = Flow(field(2, strength=8.0), 1.0, 1, euler)
    y = points(folding, 400)
    assert min_det_jacobian(folding.jacobian, y) < 0
    assert min_det_jacobian(Flow(field(2, strength=8.0), 1.0, 400).jacobian, y) > 0
    assert round_trip_error(folding, y) > 0.1


@pytest.mark.parametrize("inverse", [False, True])
def test_the_smallest_determinant_of_a_step_is_that_of_every_step(inverse):
    flow, y = Flow(field(2, strength=1.5), 1.0, 3, euler), points(PLANE.inner, 200)
    smallest, one = np.inf, Flow(flow.field, -1 / 3 if inverse else 1 / 3, 1, euler)
    s = y
    for _ in range(3):
        s, J = one.jacobian(s)
        smallest = min(smallest, np.linalg.det(J).min())
    assert flow.min_step_determinant(y, inverse=inverse) == pytest.approx(smallest, rel=1e-12)
    twice = Flow(field(2, strength=20.0), 1.0, 2, euler)  # a fold of a fold may keep its orientation, where it began
    assert twice.min_step_determinant(y, inverse=inverse) < 0
    exact = Flow(field(2), 1.0, 6, implicit_euler, euler)
    assert exact.min_step_determinant(y, inverse=inverse) > 0
