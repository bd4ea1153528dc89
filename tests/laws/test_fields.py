"""Laws of vector fields, on an example of every class."""

from inspect import isabstract

import numpy as np
import pytest
from laws.registry import FIELDS, product_classes
from oracles import central_differences

from dt_viz.avoidance.arm_field import ArmField
from dt_viz.flows.fields import PointField

KINDS = (PointField, ArmField)


def parts_of(value):
    """A field and those that it is made of."""
    if isinstance(value, tuple):
        for part in value:
            yield from parts_of(part)
    elif isinstance(value, KINDS):
        yield value
        for part in vars(value).values():
            yield from parts_of(part)


def test_every_field_has_an_example():
    kinds = {kind for kind in product_classes() if issubclass(kind, KINDS) and not isabstract(kind)}
    assert kinds == {type(part) for case in FIELDS.values() for part in parts_of(case.field)}


@pytest.fixture(params=FIELDS, name="case")
def _case(request):
    return FIELDS[request.param]


@pytest.mark.parametrize("name", [name for name, case in FIELDS.items() if isinstance(case.field, PointField)])
def test_the_derivative_is_that_of_its_values(name):
    case = FIELDS[name]
    s, field = case.points(40), case.field
    assert isinstance(field, PointField)
    value, DV = field.with_jacobian(s)
    scale = np.abs(DV).max()
    assert scale > 0.1
    np.testing.assert_allclose(value, field(s), rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(DV, central_differences(field, s, case.step), rtol=0, atol=case.exact * max(1, scale))


def test_each_point_is_on_its_own(case):
    s = case.points(30)
    alone = np.concatenate([case.field(point[None]) for point in s])
    np.testing.assert_allclose(alone, case.field(s), rtol=0, atol=1e-12)


def test_no_points_have_no_values(case):
    none = np.empty((0, case.field.dim))
    assert case.field(none).shape == none.shape
