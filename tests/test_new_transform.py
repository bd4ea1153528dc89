"""A new kind of transform, as the README shows it: one file with a subclass like this one, one line in the registry."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, cast  # noqa: F401 - of the README's example

import numpy as np
import pytest
from pages import Bound
from scenes import avoiding, changed

import dt_viz
from dt_viz.engine.frame import Stage
from dt_viz.flows.diffeomorphisms import Flow  # noqa: F401
from dt_viz.flows.fields import Array
from dt_viz.scenario.stack import anchored, listed, shifted, surroundings, switched, tunable, with_added
from dt_viz.transforms import registry
from dt_viz.transforms.base import Built, MotionBelow, Number, Setting, Transform  # noqa: F401
from dt_viz.ui.panel.transforms import add, add_transform_controls, addable


@dataclass(frozen=True)
class Whirl:
    """V(s) = exp(−‖s − c‖²/r²)·ẑ × (s − c): turns space around a vertical axis through c."""

    centre: Array
    radius: float

    dim = 3

    def __call__(self, s):
        return self.with_jacobian(s)[0]

    def with_jacobian(self, s):
        offset = s - self.centre
        weight = np.exp(-(offset**2).sum(axis=1) / self.radius**2)
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        V = weight[:, None] * offset @ turn.T
        return V, weight[:, None, None] * turn - 2 / self.radius**2 * V[:, :, None] * offset[:, None, :]


def shown_in_the_readme():
    """The class that dt_viz/README.md shows, made from its text."""
    text = (Path(dt_viz.__file__).parent / "README.md").read_text(encoding="utf-8")
    code = text.split("## Adding a new transform")[1].split("```python")[1].split("```")[0]
    names = dict(globals())
    exec(compile("from __future__ import annotations\n" + code, "README.md", "exec"), names)
    return names["Twirl"]


@pytest.fixture(params=[("Twirl 1", "Avoidance"), ("Avoidance", "Twirl 1")], ids=" below ".join)
def scenario(request, engine, initial, monkeypatch):
    """The kind is looked up and added as the page does."""
    monkeypatch.setattr(registry, "KINDS", (*registry.KINDS, shown_in_the_readme()))  # the one line
    plain = initial("lift_box")
    twirl = next(kind for kind in registry.KINDS if kind.title == "Twirl").beside(
        surroundings(engine.task("lift_box"), plain)
    )
    stack, name = with_added(plain, twirl)
    scenario = replace(plain, stack=stack)
    if request.param[1] == name:
        scenario = replace(scenario, stack=shifted(scenario, name, 1))
    assert listed(scenario) == request.param
    return scenario


def test_a_new_transform_needs_a_file_and_a_line(engine, scenario):
    assert set(listed(scenario)) < set(tunable(scenario))
    assert not anchored(scenario)  # it has no handles
    *_, frame = engine.frames(scenario)
    assert frame.stage is Stage.CERTIFIED
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        assert np.isfinite(path).all()
        np.testing.assert_allclose(path[0], before[0], atol=1e-6)
        np.testing.assert_allclose(path[-1], frame.goal, atol=1e-3)
    assert dict(zip([layer.name for layer in scenario.stack], frame.durations, strict=True))["Twirl 1"] == 0.8
    assert frame.certificates.min_det_jacobian > 0
    assert frame.certificates.round_trip_error < 1e-6
    assert frame.certificates.lyapunov_falls


def test_it_turns_motions_as_it_says_and_not_when_it_is_off(engine, scenario):
    alone = changed(scenario, avoids=False)
    *_, frame = engine.frames(alone)
    below, turned = frame.levels
    moved = max(np.linalg.norm(a - b, axis=1).max() for a, b in zip(below, turned, strict=True))
    assert 0.02 < moved < 0.2
    off = replace(alone, stack=switched(alone, "Twirl 1"))
    *_, frame = engine.frames(off)
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        assert max(np.linalg.norm(before - point, axis=1).min() for point in path) < 1e-3


def test_the_page_offers_it_and_has_its_controls(server, monkeypatch):
    monkeypatch.setattr(registry, "KINDS", (*registry.KINDS, shown_in_the_readme()))
    bound = Bound(avoiding("lift_box"))
    session: Any = bound.edited
    add_transform_controls(server.gui, bound, later=lambda work: work())
    assert list(addable()) == ["Bias", "Twirl"]
    add(session, addable()["Twirl"])
    assert bound["Angle [rad]"].control.value == 0.8
    bound.set("Angle [rad]", -0.5)
    assert [layer.name for layer in session.scenario.stack] == ["Twirl 1", "Avoidance"]
    assert cast(Any, session.scenario.stack[0].transform).angle == -0.5
