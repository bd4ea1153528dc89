"""What methods are fitted to."""

import pytest

from dt_viz.baselines.registry import problem_of
from dt_viz.scenario.scenario import Scenario


@pytest.fixture(scope="session")
def problem(engine):
    """*Push box*, with the arm's postures along its demonstrations."""
    return problem_of(engine.nominal(Scenario("push_box")).learned, engine.follower)
