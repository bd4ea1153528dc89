"""Laws of vector fields, on an example of every class."""

import numpy as np
import pytest
from laws.registry import FIELDS, product_classes
from oracles import central_differences


def parts_of(value):
    """A field and those that it is made of."""
    if isinstance(value, tuple):
        for part in value:
            yield from parts_of(part)
    elif hasattr(value, "with_jacobian"):
        yield value
        for part in vars(value).values():
            yield from parts_of(part)


def test_every_field_has_an_example():
    kinds = {kind for kind in product_classes() if "with_jacobian" in vars(kind) and not hasattr(kind, "_is_protocol")}
    examples = {base for case in FIELDS.values() for part in parts_of(case.field) for base in type(part).__mro__}
    assert not kinds - examples


@pytest.fixture(params=FIELDS, name="case")
def _case(request):
    return FIELDS[request.param]


def test_the_derivative_is_that_of_its_values(case):
    s = case.points(40)
    value, DV = case.field.with_jacobian(s)
    scale = np.abs(DV).max()
    assert scale > 0.1
    np.testing.assert_allclose(value, case.field(s), rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(
        DV, central_differences(case.field, s, case.step), rtol=0, atol=case.exact * max(1, scale)
    )


def test_each_point_is_on_its_own(case):
    s = case.points(30)
    value, DV = case.field.with_jacobian(s)
    for point, v, J in zip(s[:7], value, DV, strict=False):
        alone, derivative = case.field.with_jacobian(point[None])
        np.testing.assert_allclose(case.field(point[None])[0], v, rtol=0, atol=1e-12 * np.abs(DV).max())
        np.testing.assert_allclose(alone[0], v, rtol=0, atol=1e-12 * np.abs(DV).max())
        np.testing.assert_allclose(derivative[0], J, rtol=0, atol=1e-9 * np.abs(DV).max())


def test_no_points_have_no_values(case):
    none = np.empty((0, case.field.dim))
    value, DV = case.field.with_jacobian(none)
    assert case.field(none).shape == value.shape == none.shape and DV.shape == (0, *[case.field.dim] * 2)
