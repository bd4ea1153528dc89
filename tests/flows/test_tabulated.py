"""Tables of ψ⁻¹: near to ψ⁻¹ itself, nearer with more nodes, and exact where there is none."""

import numpy as np
import pytest
from laws.registry import bent

from dt_viz.flows import tabulated as module
from dt_viz.flows.diffeomorphisms import Flow, Placed
from dt_viz.flows.tabulated import Tabulated, tabulated
from dt_viz.interruption import interruptible

MARGIN = 0.2


def some_flow(dim):
    """A flow that bends the unit box by about a tenth."""
    return Flow(bent(dim, dim, 0.1), 1.0, 6)


@pytest.fixture(params=[2, 3])
def exact(request):
    return some_flow(request.param)


@pytest.fixture
def points(exact):
    return np.random.default_rng(0).uniform(size=(300, exact.dim))


def error(table, points):
    """Largest errors of places and of Jacobians."""
    pairs = zip(table.inverse_jacobian(points), table.exact.inverse_jacobian(points), strict=True)
    return tuple(np.abs(found - expected).max() for found, expected in pairs)


def test_places_and_jacobians_are_those_of_the_inverse(exact, points):
    place, jacobian = error(Tabulated.around(exact, points, MARGIN), points)
    assert 0 < place < 1e-4
    assert 0 < jacobian < 1e-3
    assert np.abs(exact.inverse(points) - points).max() > 0.03  # it is not the identity


def test_with_more_nodes_the_error_falls_in_the_fourth_power_of_their_distance(exact, points, monkeypatch):
    errors = []
    for num in (300, 300 * 2**exact.dim, 300 * 4**exact.dim):
        monkeypatch.setattr(module, "NUM_NODES", num)
        errors.append(error(Tabulated.around(exact, points, MARGIN), points)[0])
    assert errors[0] > 8 * errors[1] > 64 * errors[2]


def test_all_else_is_exact(exact, points):
    table = Tabulated.around(exact, points, MARGIN)
    np.testing.assert_array_equal(table.forward(points), exact.forward(points))
    np.testing.assert_array_equal(table.inverse(points), exact.inverse(points))
    for found, expected in zip(table.jacobian(points), exact.jacobian(points), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert error(table, points + 5.0) == (0, 0)
    assert error(table, points.min(axis=0) - MARGIN * np.eye(exact.dim))[0] > 0  # up to the margin it is the table
    assert table.scaled(0.5) == exact.scaled(0.5) != exact


def test_what_is_placed_in_space_is_tabulated_in_its_own():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    placed = Placed(some_flow(2), np.array([0.1, 0.2, 0.3]), turn, 0.5)
    points = placed.to_world(np.random.default_rng(2).uniform(size=(50, 3)))
    table = tabulated(placed, points, MARGIN)
    assert isinstance(table, Placed) and isinstance(table.inner, Tabulated)
    (y, J), (exact_y, exact_J) = table.inverse_jacobian(points), placed.inverse_jacobian(points)
    assert 0 < np.abs(y - exact_y).max() < 1e-4 and np.abs(J - exact_J).max() < 1e-3
    in_space = tabulated(some_flow(3), points, MARGIN)
    assert isinstance(in_space, Tabulated)


def test_what_interrupts_it_ends_it(exact, points):
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), interruptible(interrupted):
        Tabulated.around(exact, points, MARGIN)
