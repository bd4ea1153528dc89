"""The same scenario gives the same rollouts as before the modules were moved into packages."""

import numpy as np
import pytest
from frozen_scenarios import DESCRIPTIONS, FOLDER, rollouts_of

NUMBERS = [3, 9, 12, 17, 18, 27, 39, 57]
"""Scenarios of the hand, of the whole arm, with bias points, added starts and a warp."""
TOLERANCE = 1e-5
"""Metres and radians: fits differ by rounding from machine to machine. On one machine it is rounding alone, see
`frozen_scenarios`."""
TIME_TOLERANCE = 5e-3
"""Seconds: motions begin at rest, where the time until the second sample hardly depends on its place."""
NUM_KEPT = 15
"""Samples kept of each path."""


def kept(path):
    """Evenly spread samples of a path."""
    return path[np.linspace(0, len(path) - 1, NUM_KEPT).round().astype(int)]


@pytest.mark.parametrize("number", NUMBERS)
def test_a_scenario_gives_the_rollouts_that_it_gave(new_engine, number):
    found = rollouts_of(new_engine(), DESCRIPTIONS[number])
    with np.load(FOLDER / "rollouts.npz") as before:
        names = {name.split("/")[1] for name in before.files if name.startswith(f"{number}/")}
        assert names == set(found)
        for name, path in found.items():
            tolerance = TIME_TOLERANCE if name.startswith("times") else TOLERANCE
            np.testing.assert_allclose(kept(path), before[f"{number}/{name}"], rtol=0, atol=tolerance, err_msg=name)


def test_descriptions_cover_what_a_stack_can_be():
    chosen = [DESCRIPTIONS[number] for number in NUMBERS]
    assert {description["avoid"]["space"] for description in chosen} == {"task", "cspace"}
    assert any(description["biases"] for description in chosen)
    assert any(description["starts"] for description in chosen)
