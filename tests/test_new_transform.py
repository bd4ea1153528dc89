"""A new kind of transform, as the README shows it: one file with a value like this one, one line in the layers."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from dt_viz.engine.frame import Stage
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Layer
from dt_viz.transforms.base import Built, Motion


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


@dataclass(frozen=True)
class Twirl:
    """Motions are turned around a place by an angle, radians."""

    centre: tuple[float, float, float]
    angle: float

    def build(self, motion: Motion, tolerance: float, at_least: float) -> Built:
        flow = Flow(Whirl(np.array(self.centre), 0.12), -self.angle, steps=16)
        return Built(flow, self.angle, motion.goal)

    def satisfied(self, motion: Motion) -> bool:
        return True


@pytest.fixture(params=["below avoidance", "above avoidance"])
def scenario(request, initial):
    plain = initial("lift_box")
    twirl = Layer(Twirl((0.2, -0.35, 0.3), 0.8), name="Twirl")  # the one line
    return replace(plain, layers=(twirl,), avoidance_level=0 if request.param == "above avoidance" else None)


def test_a_new_transform_needs_a_value_and_a_line(engine, scenario):
    *_, frame = engine.frames(scenario)
    assert frame.stage is Stage.CERTIFIED
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        assert np.isfinite(path).all()
        np.testing.assert_allclose(path[0], before[0], atol=1e-6)
        np.testing.assert_allclose(path[-1], frame.goal, atol=1e-3)
    assert frame.health.layer_durations == (0.8,)
    assert frame.health.min_det_jacobian > 0
    assert frame.health.round_trip_error < 1e-6
    assert frame.health.lyapunov_falls


def test_it_turns_motions_as_it_says_and_not_when_it_is_off(engine, scenario):
    alone = replace(scenario, avoidance=False)
    *_, frame = engine.frames(alone)
    below, turned = frame.levels
    moved = max(np.linalg.norm(a - b, axis=1).max() for a, b in zip(below, turned, strict=True))
    assert 0.02 < moved < 0.2
    off = replace(alone, layers=(replace(alone.layers[0], on=False),))
    *_, frame = engine.frames(off)
    for path, before in zip(frame.rollouts, frame.ghost, strict=True):
        assert max(np.linalg.norm(before - point, axis=1).min() for point in path) < 1e-3
