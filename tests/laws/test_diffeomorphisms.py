"""Laws of diffeomorphisms, on an example of every class."""

from inspect import isabstract

import numpy as np
import pytest
from laws.registry import MAPS, product_classes
from oracles import central_differences

from dt_viz.flows.diffeomorphisms import Diffeomorphism, min_det_jacobian, round_trip_error


def parts_of(value):
    """A diffeomorphism and those that it is made of."""
    if isinstance(value, Diffeomorphism):
        yield value
        for part in vars(value).values():
            for one in part if isinstance(part, tuple) else (part,):
                yield from parts_of(one)


def test_every_diffeomorphism_has_an_example():
    kinds = {kind for kind in product_classes() if issubclass(kind, Diffeomorphism) and not isabstract(kind)}
    assert kinds - {type(part) for case in MAPS.values() for part in parts_of(case.transform)} == set()


@pytest.fixture(params=MAPS, name="case")
def _case(request):
    return MAPS[request.param]


def both_ways(transform):
    """Each direction, and what gives its Jacobian."""
    return (transform.forward, transform.jacobian), (transform.inverse, transform.inverse_jacobian)


def test_there_and_back_again_in_both_directions(case):
    transform, y = case.transform, case.some(40)
    np.testing.assert_allclose(transform.inverse(transform.forward(y)), y, rtol=0, atol=case.back)
    np.testing.assert_allclose(transform.forward(transform.inverse(y)), y, rtol=0, atol=case.back)
    assert round_trip_error(transform, y) <= case.back * np.sqrt(transform.dim)


def test_jacobians_are_derivatives(case):
    y = case.some(15)
    for function, derivative in both_ways(case.transform):
        value, J = derivative(y)
        np.testing.assert_allclose(value, function(y), rtol=0, atol=1e-8)
        np.testing.assert_allclose(J, central_differences(function, y, case.step), rtol=1e-6, atol=3e-6)


def test_the_inverse_jacobian_is_the_inverse_matrix(case):
    x, J = case.transform.jacobian(case.some(20))
    found = case.transform.inverse_jacobian(x)[1] @ J
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(x.shape[1]), J.shape), rtol=0, atol=1e-12 + 20 * case.back)


def test_orientation_is_kept(case):
    y = case.some(60)
    smallest = np.linalg.det(case.transform.jacobian(y)[1]).min()
    assert min_det_jacobian(case.transform.jacobian, y) == smallest > 0


def test_scaled_it_goes_from_the_identity_to_itself_through_diffeomorphisms(case):
    transform, y = case.transform, case.some(30)
    if not case.scales:
        assert transform.scaled(0.5) is transform
        return
    np.testing.assert_allclose(transform.scaled(0.0).forward(y), y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(transform.scaled(0.0).inverse(y), y, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(transform.scaled(1.0).forward(y), transform.forward(y))
    np.testing.assert_array_equal(transform.scaled(1.0).inverse(y), transform.inverse(y))
    moved = [0.0]
    for fraction in (0.3, 0.7, 1.0):
        scaled = transform.scaled(fraction)
        assert min_det_jacobian(scaled.jacobian, y) > 0
        assert round_trip_error(scaled, y) <= case.back * np.sqrt(transform.dim)
        moved.append(np.linalg.norm(scaled.forward(y) - y, axis=1).mean())
    assert moved == sorted(moved) and (moved[1] > 0 or (transform.forward(y) == y).all())


@pytest.mark.parametrize("name", [name for name, case in MAPS.items() if case.group is not None])
def test_parts_of_a_flow_add_up(name):
    case = MAPS[name]
    y, tolerance = case.some(20), case.group or 0.0
    both = case.transform.scaled(0.25).forward(case.transform.scaled(0.6).forward(y))
    np.testing.assert_allclose(both, case.transform.scaled(0.85).forward(y), rtol=0, atol=tolerance)


def test_tangents_are_products_with_the_jacobian(case):
    y = case.some(9)
    U = np.random.default_rng(1).normal(size=(*y.shape, 2))
    for tangents, jacobian in (
        (case.transform.forward_tangents, case.transform.jacobian),
        (case.transform.inverse_tangents, case.transform.inverse_jacobian),
    ):
        np.testing.assert_allclose(tangents(y, U)[1], jacobian(y)[1] @ U, rtol=0, atol=1e-6)


def test_batch_axes_lead(case):
    transform = case.transform
    for batch in ((), (0,), (2, 3), (2, 0, 3)):
        flat = case.some(int(np.prod(batch)))
        flat_U = np.random.default_rng(1).normal(size=(*flat.shape, 2))
        y, U = flat.reshape(*batch, transform.dim), flat_U.reshape(*batch, transform.dim, 2)
        for plain, tangents in (
            (transform.forward, transform.forward_tangents),
            (transform.inverse, transform.inverse_tangents),
        ):
            image, V = tangents(y, U)
            assert plain(y).shape == image.shape == y.shape and V.shape == U.shape
            np.testing.assert_allclose(plain(y).reshape(flat.shape), plain(flat), rtol=0, atol=1e-12)
            np.testing.assert_allclose(V.reshape(flat_U.shape), tangents(flat, flat_U)[1], rtol=0, atol=1e-12)
        square = (*batch, transform.dim, transform.dim)
        assert transform.jacobian(y)[1].shape == transform.inverse_jacobian(y)[1].shape == square


def test_arguments_stay_as_they_are(case):
    y = case.some(5)
    y.setflags(write=False)
    U = np.broadcast_to(np.eye(y.shape[1]), (*y.shape, y.shape[1]))
    case.transform.forward_tangents(y, U)
    case.transform.inverse_tangents(y, U)


def test_points_of_another_dimension_are_refused(case):
    wrong = case.transform.dim + 1
    with pytest.raises(ValueError, match=rf"points have {wrong} coordinates.*R\^{case.transform.dim}"):
        case.transform.forward(np.zeros((4, wrong)))
    with pytest.raises(ValueError, match=f"points have {wrong} coordinates"):
        case.transform.inverse(np.zeros(wrong))
