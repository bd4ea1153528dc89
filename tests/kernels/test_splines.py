"""Cubic splines of several curves, against scipy's."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dt_viz.kernels.splines import cubics


@pytest.mark.parametrize("num", [4, 5, 40])
@pytest.mark.parametrize("ratio", [1.0, 100.0])
def test_each_curve_has_the_spline_of_its_own_knots(num, ratio):
    rng = np.random.default_rng(num)
    knots = np.cumsum(np.geomspace(1, ratio, num) * rng.uniform(0.5, 1.5, (3, num)), axis=1)
    values = rng.normal(size=(3, num, 6))
    found = cubics(knots, values)
    for r in range(3):
        expected = CubicSpline(knots[r], values[r]).c
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(found[:, r] / scale, expected / scale, atol=1e-11)
