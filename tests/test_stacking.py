"""Edits of the stack: what is moved, switched or taken out leaves the others as they were."""

import numpy as np
import pytest

from dt_viz.engine.frame import Stage
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import (
    AVOIDANCE,
    BESIDE,
    IMITATION,
    MAX_BIAS_POINTS,
    bias_points,
    levels,
    names,
    place_beside,
    plane_of,
    shifted,
    switched,
    with_bias_point,
    with_changed_point,
    without,
)
from dt_viz.scenario.tasks import TASKS
from dt_viz.transforms.avoidance import ObstacleAvoidance
from dt_viz.transforms.bias import Biasing, BiasPoint

SIMILAR = ("draw_j", "draw_c", "draw_g", "draw_z")
"""Tasks that behave much as "draw_s" and "draw_w" do."""
PLACES = ((0.1, -0.5, 0.4), (0.2, -0.5, 0.4), (0.3, -0.5, 0.4))


def stack(num=3, **changes):
    layers = ()
    for place in PLACES[:num]:
        layers = with_bias_point(layers, BiasPoint(place))
    return Scenario("draw_s", (Sphere((0.0, -0.5, 0.4)),), layers=layers, **changes)


def below(layer):
    assert isinstance(layer.behaviour, Biasing)
    return layer.behaviour.below


def edited(scenario, **changes):
    return Scenario(**{name: getattr(scenario, name) for name in scenario.__dataclass_fields__} | changes)


def test_new_bias_points_are_outermost_below_avoidance_and_take_the_first_free_name():
    scenario = stack()
    assert names(scenario) == ("Bias 1", "Bias 2", "Bias 3", AVOIDANCE)
    fewer = edited(scenario, **without(scenario, "Bias 2"))
    assert names(fewer) == ("Bias 1", "Bias 3", AVOIDANCE)
    assert list(bias_points(with_bias_point(fewer.layers, BiasPoint((0.0, 0.0, 0.0))))) == [
        "Bias 1",
        "Bias 3",
        "Bias 2",
    ]


@pytest.mark.parametrize("name", ["Bias 1", "Bias 2", "Bias 3", AVOIDANCE])
@pytest.mark.parametrize("steps", [1, -1])
def test_what_is_moved_out_and_in_again_is_where_it_was(name, steps):
    scenario = edited(stack(), avoidance_level=2)
    order = names(scenario)
    moved = edited(scenario, **shifted(scenario, name, steps))
    k = order.index(name)
    if 0 <= k + steps < len(order):
        assert names(moved).index(name) == k + steps
        assert edited(moved, **shifted(moved, name, -steps)) == edited(scenario, layers=moved_back(moved, name, steps))
    else:
        assert names(moved) == order
    assert [n for n in names(moved) if n != name] == [n for n in order if n != name]


def moved_back(moved, name, steps):
    return shifted(moved, name, -steps)["layers"]


def test_avoidance_that_is_outermost_again_stays_so_when_layers_are_added():
    scenario = stack()
    inner = edited(scenario, **shifted(scenario, AVOIDANCE, -1))
    assert inner.avoidance_level == 2
    assert edited(inner, **shifted(inner, AVOIDANCE, 1)).avoidance_level is None


def test_what_is_below_avoidance_that_does_nothing_moves_past_it_at_once():
    for scenario in (stack(space="cspace"), edited(stack(), obstacles=())):
        assert names(edited(scenario, **shifted(scenario, "Bias 3", 1)))[:3] == ("Bias 1", "Bias 2", "Bias 3")
        assert names(edited(scenario, **shifted(scenario, "Bias 3", -1)))[:3] == ("Bias 1", "Bias 3", "Bias 2")


def test_each_bias_point_knows_the_targets_below_it_that_are_on():
    layers = switched(stack().layers, "Bias 2")
    assert [layer.on for layer in layers] == [True, False, True]
    assert [below(layer) for layer in layers] == [(), PLACES[:1], PLACES[:1]]
    layers = with_changed_point(layers, "Bias 1", BiasPoint((0.5, 0.0, 0.0)))
    assert [below(layer) for layer in layers][1:] == [((0.5, 0.0, 0.0),)] * 2
    scenario = edited(stack(), layers=switched(layers, "Bias 2"))
    down = shifted(scenario, "Bias 3", -1)["layers"]
    assert [(layer.name, below(layer)) for layer in down] == [
        ("Bias 1", ()),
        ("Bias 3", ((0.5, 0.0, 0.0),)),
        ("Bias 2", ((0.5, 0.0, 0.0), PLACES[2])),
    ]


def test_a_layer_of_another_kind_is_left_as_it_is():
    other = Layer(ObstacleAvoidance(), name="Twist")
    layers = with_bias_point((other,), BiasPoint(PLACES[0]))
    assert layers[0] == other
    assert isinstance(layers[1].behaviour, Biasing)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (IMITATION, "Bias 1", AVOIDANCE, "Bias 2")),
        ({"avoidance": False}, (IMITATION, "Bias 1", "Bias 2")),
        ({"space": "cspace"}, (IMITATION, "Bias 1", "Bias 2")),
        ({"obstacles": ()}, (IMITATION, "Bias 1", "Bias 2")),
        ({"layers": switched(stack(2).layers, "Bias 1")}, (IMITATION, AVOIDANCE, "Bias 2")),
    ],
)
def test_levels_have_the_names_of_what_the_engine_stacks(engine, changes, expected):
    scenario = edited(stack(2, avoidance_level=1), **changes)
    assert levels(scenario) == expected
    assert len(next(engine.frames(scenario)).levels) == len(expected)


@pytest.mark.parametrize("task", [name for name in TASKS])
def test_new_bias_points_lie_beside_the_motion_apart_from_each_other_and_in_the_plane_of_a_drawing(task, initial):
    task, scenario = TASKS[task](), initial(task)
    for _ in range(MAX_BIAS_POINTS):
        point = place_beside(task, scenario)
        assert (point.plane is None) == (task.demonstrations[0].dimension == 3)
        assert 0.02 < min(np.linalg.norm(path - point.position, axis=1).min() for path in task.paths) < 2 * BESIDE
        for other in bias_points(scenario.layers).values():
            assert np.linalg.norm(np.subtract(point.position, other.position)) > 0.5 * BESIDE
        if (plane := plane_of(task)) is not None:
            assert abs(np.cross(*plane) @ (np.asarray(point.position) - task.slice.centre)) < 1e-9
        assert point.position[2] > 0
        scenario = edited(scenario, layers=with_bias_point(scenario.layers, point))


@pytest.mark.parametrize("task", [pytest.param(t, marks=[pytest.mark.slow] * (t in SIMILAR)) for t in TASKS])
def test_two_new_bias_points_do_not_pull_against_each_other(task, engine, initial):
    scenario = initial(task)
    for _ in range(2):
        point = place_beside(engine.task(task), scenario)
        scenario = edited(scenario, layers=with_bias_point(scenario.layers, point))
    frame = next(frame for frame in engine.frames(scenario) if frame.stage is Stage.FINE)
    assert frame.health.doubts == ()
    for point in bias_points(scenario.layers).values():
        for path in frame.rollouts:
            assert np.linalg.norm(path - point.position, axis=1).min() <= 0.0105  # between samples, too
