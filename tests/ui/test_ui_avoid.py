"""The controls of what avoids the obstacles and of the imitation, without a browser."""

from dataclasses import replace

import pytest
from pages import Bound
from scenes import avoiding, changed

from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoiding_with
from dt_viz.ui.panel.avoid import add_avoid_and_imitate, avoids_with

HAND = avoiding("draw_s", Sphere((0.0, -0.5, 0.4)))


@pytest.fixture
def bound(server):
    bound = Bound(HAND)
    add_avoid_and_imitate(server.gui, bound)
    bound.adopt(HAND)
    yield bound
    server.gui.reset()


def test_the_whole_arm_avoids_at_first():
    assert avoids_with(Scenario("draw_s")) == "Arm"


@pytest.mark.parametrize("name", ["Off", "Hand", "Arm"])
def test_what_avoids_is_chosen_and_shown(bound, name):
    bound.set("Avoid", name)
    scenario = bound.edited.scenario
    assert avoids_with(scenario) == name == bound["Avoid"].control.value
    assert scenario.avoids == (name != "Off")
    assert (scenario.arm_avoidance is not None) == (name == "Arm")
    assert bool(scenario.active) == (name == "Hand")
    assert scenario.obstacles == HAND.obstacles
    bound.set("Avoid", "Hand")
    assert bound.edited.scenario == HAND


def test_what_is_off_comes_back_as_it_was_in_all_but_its_space():
    tuned = changed(HAND, temperature=3.0, margin=0.02)
    off = replace(tuned, stack=avoiding_with(tuned, None))
    assert replace(off, stack=avoiding_with(off, "cspace")) == changed(tuned, space="cspace")


def test_imitation_is_switched_where_it_is_seen_first(bound):
    for on in (False, True):
        bound.set("Imitate", on)
        assert bound.edited.scenario == replace(HAND, imitation=on)
        assert bound["Imitate"].control.value is on
