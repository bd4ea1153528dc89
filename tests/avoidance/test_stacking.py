"""Edits of the stack: what is moved, switched, changed or taken out leaves the others as they were."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scenes import avoiding, biases, changed, frame_at

from dt_viz.avoidance.bias import MAX_TARGET_MISS, BiasPoint
from dt_viz.avoidance.hand import Avoidance, HandAvoidance
from dt_viz.avoidance.page import Choice, FlowIntegration, Number, Switch
from dt_viz.avoidance.registry import BIAS, KINDS, PLACED_BESIDE, bias_beside
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Layer, Scenario, View
from dt_viz.scenario.stack import (
    IMITATION,
    WHOLE_ARM,
    anchored,
    avoidance_layer,
    levels,
    listed,
    plane_of,
    shifted,
    surroundings,
    switched,
    transform_of,
    tunable,
    tuned,
    with_added,
    with_avoidance,
    with_transform,
    without,
)
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage

QUICK = ("draw_s", "draw_8", "push_box")
"""Tasks whose new bias points are followed in the quick tests, too."""
PLACES = ((0.1, -0.5, 0.4), (0.2, -0.5, 0.4), (0.3, -0.5, 0.4))
SPHERE = Sphere((0.0, -0.5, 0.4))
AVOIDANCE = KINDS[HandAvoidance].title


def stack(num=3, **changes):
    return avoiding("draw_s", SPHERE, layers=biases(*map(BiasPoint, PLACES[:num])), **changes)


def added(scenario, transform):
    return replace(scenario, stack=with_added(scenario, transform)[0])


def moved(scenario, name, steps):
    return replace(scenario, stack=shifted(scenario, name, steps))


def test_new_bias_points_are_outermost_below_avoidance_and_take_the_first_free_name():
    scenario = avoiding("draw_s", SPHERE)
    for place in PLACES:
        scenario = added(scenario, BiasPoint(place))
    assert scenario == stack()
    assert listed(scenario) == ("Bias 1", "Bias 2", "Bias 3", AVOIDANCE)
    fewer = replace(scenario, stack=without(scenario, "Bias 2"))
    assert listed(fewer) == ("Bias 1", "Bias 3", AVOIDANCE)
    again, name = with_added(fewer, BiasPoint((0.0, 0.0, 0.0)))
    assert (name, listed(replace(fewer, stack=again))) == ("Bias 2", ("Bias 1", "Bias 3", "Bias 2", AVOIDANCE))


@pytest.mark.parametrize("name", ["Bias 1", "Bias 2", "Bias 3", AVOIDANCE])
@pytest.mark.parametrize("steps", [1, -1])
def test_what_is_moved_out_and_in_again_is_where_it_was(name, steps):
    scenario = stack(level=2)
    order = listed(scenario)
    after = moved(scenario, name, steps)
    k = order.index(name)
    if 0 <= k + steps < len(order):
        assert listed(after).index(name) == k + steps
        assert moved(after, name, -steps) == scenario
    else:
        assert after == scenario
    assert [n for n in listed(after) if n != name] == [n for n in order if n != name]


def test_layers_are_added_below_avoidance_only_while_that_is_outermost_and_move_past_it_at_once_where_it_does_nothing():
    inner, point = moved(stack(2), AVOIDANCE, -1), BiasPoint(PLACES[2])
    assert listed(added(inner, point)) == ("Bias 1", AVOIDANCE, "Bias 2", "Bias 3")
    assert listed(added(moved(inner, AVOIDANCE, 1), point)) == ("Bias 1", "Bias 2", "Bias 3", AVOIDANCE)
    for idle in (stack(space="cspace", level=2), changed(stack(level=2), obstacles=())):
        assert listed(moved(idle, "Bias 3", 1)) == ("Bias 1", "Bias 2", "Bias 3")
        assert listed(moved(idle, "Bias 3", -1)) == ("Bias 1", "Bias 3", "Bias 2")


@pytest.mark.parametrize(
    "edit",
    [
        lambda scenario: with_transform(scenario, "Bias 2", BiasPoint((0.5, 0.0, 0.0), strength=0.3)),
        lambda scenario: with_avoidance(scenario, temperature=3.0),
        lambda scenario: with_added(scenario, BiasPoint((0.0, 0.0, 0.0)))[0],
        lambda scenario: without(scenario, "Bias 2"),
        lambda scenario: switched(scenario, "Bias 2"),
        lambda scenario: switched(scenario, WHOLE_ARM),
    ],
)
def test_an_edit_is_of_one_layer_and_leaves_the_others_as_they_are(edit):
    scenario = stack(level=1)
    before, after = dict.fromkeys(scenario.stack), dict.fromkeys(edit(scenario))
    kept = [layer for layer in before if layer in after]
    assert kept == [layer for layer in after if layer in before]  # in their order
    assert (len(before) - len(kept), len(after) - len(kept)) in {(1, 1), (1, 0), (0, 1)}


@pytest.mark.parametrize(
    "edit", [switched, without, lambda scenario, name: with_transform(scenario, name, Avoidance())]
)
def test_there_is_nothing_to_edit_in_what_was_learned(edit):
    assert edit(stack(), IMITATION) == stack().stack
    assert transform_of(stack(), IMITATION) is None


def test_a_stack_without_avoidance_gets_one_outermost_with_the_first_obstacle():
    none = Scenario("draw_s", biases(BiasPoint(PLACES[0])))
    assert not none.avoids and none.obstacles == () and not avoidance_layer(none).on
    some = replace(none, stack=with_avoidance(none, obstacles=(SPHERE,)))
    assert listed(some) == ("Bias 1", AVOIDANCE) and some.avoids
    assert some.stack[1] == Layer(Avoidance(SPHERE), name=AVOIDANCE)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, (IMITATION, "Bias 1", AVOIDANCE, "Bias 2")),
        ({"avoids": False}, (IMITATION, "Bias 1", "Bias 2")),
        ({"space": "cspace"}, (IMITATION, "Bias 1", "Bias 2")),
        ({"obstacles": ()}, (IMITATION, "Bias 1", "Bias 2")),
        ({"stack": switched(stack(2, level=1), "Bias 1")}, (IMITATION, AVOIDANCE, "Bias 2")),
    ],
)
def test_levels_have_the_names_of_what_the_engine_stacks(engine, changes, expected):
    scenario = changed(stack(2, level=1), **changes)
    assert levels(scenario) == expected
    assert len(frame_at(engine, scenario, Stage.ROLLOUTS).levels) == len(expected)


def placed_beside(task, scenario):
    return bias_beside(surroundings(task, scenario))


@pytest.mark.parametrize("task", TASKS)
def test_new_bias_points_lie_beside_the_motion_apart_from_each_other_and_in_the_plane_of_a_drawing(task, initial):
    task, scenario = TASKS[task](), initial(task)
    for _ in range(BIAS.most):
        point = placed_beside(task, scenario)
        assert (point.plane is None) == (task.demonstrations[0].dimension == 3)
        nearest = min(np.linalg.norm(path - point.position, axis=1).min() for path in task.paths)
        assert 0.02 < nearest < 2 * PLACED_BESIDE
        for other in anchored(scenario).values():
            assert isinstance(other, BiasPoint)
            assert np.linalg.norm(np.subtract(point.position, other.position)) > 0.5 * PLACED_BESIDE
        if (plane := plane_of(task)) is not None:
            assert abs(np.cross(*plane) @ (np.asarray(point.position) - task.slice.centre)) < 1e-9
        assert point.position[2] > 0
        scenario = added(scenario, point)
    assert len(anchored(scenario)) == BIAS.most


@pytest.mark.parametrize("task", [pytest.param(t, marks=[pytest.mark.slow] * (t not in QUICK)) for t in TASKS])
def test_two_new_bias_points_do_not_pull_against_each_other(task, engine, initial):
    scenario = initial(task)
    for _ in range(2):
        scenario = added(scenario, placed_beside(engine.task(task), scenario))
    frame = frame_at(engine, scenario, Stage.FINE)
    assert frame.certificates.warnings == ()
    for point in anchored(scenario).values():
        assert isinstance(point, BiasPoint)
        for path in frame.rollouts:
            assert np.linalg.norm(point.offsets(path), axis=1).min() <= 0.0105  # between samples, too
            # what goes around the obstacle through the depth is not all back in the plane yet
            assert np.linalg.norm(path - point.position, axis=1).min() <= MAX_TARGET_MISS


# settings


TUNED = stack(2, space="cspace", duration=0.4)


def test_transforms_are_listed_from_the_outermost_inwards_and_the_chosen_one_is_tuned_while_it_is_there():
    assert tunable(TUNED) == (WHOLE_ARM, "Bias 2", "Bias 1", IMITATION)
    assert tunable(changed(TUNED, space="task", level=0)) == ("Bias 2", "Bias 1", AVOIDANCE, IMITATION)
    assert tunable(changed(TUNED, obstacles=())) == ("Bias 2", "Bias 1", IMITATION)
    chosen = replace(TUNED, view=View(tuned="Bias 2"))
    assert tuned(TUNED) == WHOLE_ARM
    assert tuned(chosen) == "Bias 2"
    assert tuned(replace(chosen, stack=without(chosen, "Bias 2"))) == WHOLE_ARM
    assert chosen.computes_like(TUNED)


@pytest.mark.parametrize("kind", KINDS)
def test_settings_are_of_fields_and_show_what_a_new_transform_has(kind, initial):
    """Only what is chosen automatically has no value yet."""
    entry = KINDS[kind]
    transform = entry.added(surroundings(TASKS["draw_s"](), initial("draw_s"))) if entry.added else kind()
    assert {setting.field for setting in entry.settings} <= {field.name for field in fields(transform)}
    for setting in entry.settings:
        value = getattr(transform, setting.field)
        match setting:
            case Number():
                shown = setting.initial if value is None else setting.scale * value
                assert setting.automatic == (value is None) and setting.low <= shown <= setting.high
            case Choice():
                assert value in setting.options
            case Switch():
                assert isinstance(value, bool)
            case FlowIntegration():
                assert isinstance(value, Integration)
