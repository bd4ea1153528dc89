"""Paths of single points found as a whole, against the same flows step by step."""

import numpy as np
import pytest
from laws.registry import bent
from scipy.linalg import expm

from dt_viz.flows.collocation import collocated, implicit_euler_path
from dt_viz.flows.integrators import implicit_euler, integrate, rk4
from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.obstacles.union import Union
from dt_viz.transforms.bias import BiasPoint


class Linear:
    """V(s) = A·s."""

    def __init__(self, A):
        self.A, self.dim = A, len(A)

    def __call__(self, s):
        return s @ self.A.T

    def with_jacobian(self, s):
        return self(s), np.broadcast_to(self.A, (len(s), *self.A.shape))


FIELDS = {
    "sphere": Union((Sphere((0.0, 0.0, 0.0), 0.12),)).field("free-space", 6.0),
    "box": Union((Box((0.01, 0.0, 0.0), (0.1, 0.04, 0.08)),)).field("probability", 3.0),
    "bias point": BiasPoint((0.02, 0.0, -0.01)).field(0.12),
}


@pytest.mark.parametrize("duration", [0.7, -0.7])
def test_along_a_linear_field_it_is_the_matrix_exponential(duration):
    A = np.array([[-1.0, 3.0, 0.0], [-3.0, -1.0, 0.5], [0.0, 0.2, 2.0]])
    s = np.array([0.3, -0.2, 0.1])
    mapped = collocated(Linear(A), s, duration, 1e-10)
    assert mapped is not None
    end, J = mapped
    np.testing.assert_allclose(J, expm(duration * A), rtol=0, atol=1e-9)
    np.testing.assert_allclose(end, expm(duration * A) @ s, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("tolerance", [1e-5, 1e-6])
def test_along_the_fields_of_stacks_it_keeps_the_tolerance(name, tolerance):
    field, duration = FIELDS[name], 0.9
    s = np.random.default_rng(0).uniform(-0.08, 0.08, (30, 3))
    exact, tangents = integrate(rk4, field, s, np.broadcast_to(np.eye(3), (30, 3, 3)), duration, 800)
    assert tangents is not None
    for point, there, J in zip(s, exact, tangents, strict=True):
        mapped = collocated(field, point, duration, tolerance)
        assert mapped is not None
        end, found = mapped
        np.testing.assert_allclose(end, there, rtol=0, atol=tolerance)
        np.testing.assert_allclose(found, J, rtol=0, atol=1e-3 * np.abs(J).max())


def test_a_field_that_is_too_steep_is_told():
    assert collocated(Linear(1e5 * np.array([[0.0, 1.0], [-1.0, 0.0]])), np.array([0.1, 0.0]), 1.0, 1e-6) is None


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("steps", [1, 4, 9])
def test_implicit_euler_as_a_whole_is_that_step_by_step(dim, steps):
    rng = np.random.default_rng(steps)
    field = bent(dim, steps, 0.1)
    for point in rng.uniform(-1, 1, (10, dim)):
        end, tangents = integrate(implicit_euler, field, point[None], np.eye(dim)[None], 1.0, steps)
        mapped = implicit_euler_path(field, point, 1.0, steps, 1e-8)
        assert mapped is not None and tangents is not None
        np.testing.assert_allclose(mapped[0], end[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(mapped[1], tangents[0], rtol=0, atol=1e-4)
