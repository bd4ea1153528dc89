"""The same scenario gives the same rollouts as the version that froze them."""

import numpy as np
import pytest
from frozen_scenarios import DESCRIPTIONS, ROLLOUTS, frozen_rollouts

TOLERANCE = 1e-8
"""Metres, radians and seconds: from one fit BLAS kernels differ by 1e-13 in all; no change of what is computed is so
small."""


@pytest.mark.parametrize("number", DESCRIPTIONS)
def test_a_scenario_gives_the_rollouts_that_it_gave(robot, number):
    found = frozen_rollouts(number, robot)
    with np.load(ROLLOUTS) as before:
        assert {name for name in before.files if name.startswith(f"{number}/")} == {f"{number}/{n}" for n in found}
        for name, path in found.items():
            np.testing.assert_allclose(path, before[f"{number}/{name}"], rtol=0, atol=TOLERANCE, err_msg=name)
