"""A new kind of transform, as the README shows it: one file with a subclass like this one, one line in the registry."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from pages import Bound
from scenes import avoiding, frame_at
from twirl import shown_in_the_readme

from dt_viz.avoidance import registry
from dt_viz.scenario.stack import anchored, listed, shifted, tunable, with_added
from dt_viz.session.frame import Stage
from dt_viz.ui.tabs.world import add_transform, add_transforms, addable


@pytest.fixture(params=[("Twirl 1", "Avoidance"), ("Avoidance", "Twirl 1")], ids=" below ".join)
def scenario(request, engine, initial, monkeypatch):
    """The kind is added as the page does."""
    kind, kinds = shown_in_the_readme()
    monkeypatch.setattr(registry, "KINDS", kinds)  # the one line
    plain = initial("lift_box")
    stack, name = with_added(plain, kind())
    scenario = replace(plain, stack=stack)
    if request.param[1] == name:
        scenario = replace(scenario, stack=shifted(scenario, name, 1))
    assert listed(scenario) == request.param
    return scenario


def test_a_new_transform_needs_a_file_and_a_line(engine, scenario):
    assert set(listed(scenario)) < set(tunable(scenario))
    assert not anchored(scenario)  # it has no handles
    frame = frame_at(engine, scenario, Stage.CERTIFIED)
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        assert np.isfinite(path).all()
        np.testing.assert_allclose(path[0], before[0], atol=1e-6)
        np.testing.assert_allclose(path[-1], frame.goal, atol=1e-3)
    k = listed(scenario).index("Twirl 1")
    assert 0.02 < max(np.linalg.norm(a - b, axis=1).max() for a, b in zip(*frame.levels[k : k + 2], strict=True)) < 0.2
    assert frame.durations["Twirl 1"] == 0.8
    assert frame.certificates.min_det_jacobian > 0
    assert frame.certificates.round_trip_error < 1e-6
    assert frame.certificates.lyapunov_falls


def test_the_page_offers_it_and_has_its_controls(server, monkeypatch):
    monkeypatch.setattr(registry, "KINDS", shown_in_the_readme()[1])
    bound = Bound(avoiding("lift_box"))
    session: Any = bound.edited
    add_transforms(server.gui, bound)
    assert list(addable()) == ["Bias", "Twirl"]
    add_transform(session, addable()["Twirl"])
    assert bound["Angle [rad]"].control.value == 0.8
    bound.set("Angle [rad]", -0.5)
    assert [layer.name for layer in session.scenario.stack] == ["Twirl 1", "Avoidance"]
    assert cast(Any, session.scenario.stack[0].transform).angle == -0.5
