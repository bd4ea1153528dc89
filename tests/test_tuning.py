"""Settings of the transforms: each changes what it says, of the transform that it says, and nothing else."""

from dataclasses import replace

import pytest

from dt_viz.flows.diffeomorphisms import AUTO, Integration
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Layer, Scenario, View
from dt_viz.scenario.stack import AVOIDANCE, IMITATION, WHOLE_ARM, bias_points, with_bias_point
from dt_viz.scenario.tuning import flow_settings, transforms, tuned, with_flow
from dt_viz.transforms.avoidance import ObstacleAvoidance
from dt_viz.transforms.bias import BiasPoint

LAYERS = with_bias_point(with_bias_point((), BiasPoint((0.2, -0.5, 0.4))), BiasPoint((0.0, -0.4, 0.2), strength=0.7))
SCENARIO = Scenario("draw_s", (Sphere((0.0, -0.5, 0.4)),), layers=LAYERS, space="both", duration=0.4)
EULER = Integration("euler", 3)


def test_transforms_are_listed_from_the_outermost_inwards_where_they_have_something_to_do():
    assert transforms(SCENARIO) == (WHOLE_ARM, AVOIDANCE, "Bias 2", "Bias 1", IMITATION)
    assert transforms(replace(SCENARIO, space="task", avoidance_level=0)) == ("Bias 2", "Bias 1", AVOIDANCE, IMITATION)
    assert transforms(replace(SCENARIO, obstacles=())) == ("Bias 2", "Bias 1", IMITATION)


def test_the_chosen_transform_is_tuned_or_the_outermost_if_it_is_gone():
    chosen = replace(SCENARIO, view=View(tuned="Bias 2"))
    assert tuned(SCENARIO) == WHOLE_ARM
    assert tuned(chosen) == "Bias 2"
    assert tuned(replace(chosen, layers=LAYERS[:1])) == WHOLE_ARM
    assert chosen.computes_like(SCENARIO)


@pytest.mark.parametrize("name", [WHOLE_ARM, AVOIDANCE, "Bias 1", "Bias 2"])
@pytest.mark.parametrize("changes", [{"duration": 1.1}, {"duration": None}, {"integration": EULER}])
def test_what_is_set_is_what_is_read_and_the_others_stay(name, changes):
    before = {other: flow_settings(SCENARIO, other) for other in transforms(SCENARIO)}
    edited = replace(SCENARIO, **with_flow(SCENARIO, name, **changes))
    for other, settings in before.items():
        shared = {name, other} <= {WHOLE_ARM, AVOIDANCE}
        expected = replace(settings, **changes) if settings and (other == name or shared) else settings
        assert flow_settings(edited, other) == expected
    rest = ("duration", "integration") if name in {WHOLE_ARM, AVOIDANCE} else ("layers",)
    assert replace(edited, **{field: getattr(SCENARIO, field) for field in rest}) == SCENARIO


def test_a_bias_point_keeps_its_place_and_its_name():
    edited = replace(SCENARIO, **with_flow(SCENARIO, "Bias 2", duration=None, integration=EULER))
    before, after = bias_points(SCENARIO.layers), bias_points(edited.layers)
    assert after["Bias 2"] == replace(before["Bias 2"], strength=None, integration=EULER)
    assert after["Bias 1"] == before["Bias 1"]


def test_what_was_learned_and_transforms_of_other_kinds_have_no_flow_to_set():
    other = replace(SCENARIO, layers=(Layer(ObstacleAvoidance(), name="Twist"),))
    for scenario, name in ((SCENARIO, IMITATION), (other, "Twist")):
        assert flow_settings(scenario, name) is None
        assert with_flow(scenario, name, duration=1.0) == {}
    settings = flow_settings(Scenario("draw_s", ()), AVOIDANCE)
    assert settings is not None and settings.integration == AUTO
