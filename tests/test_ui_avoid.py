"""The control of what avoids the obstacles, without a browser."""

from dataclasses import replace

import pytest
from pages import Bound, frame_of
from scenes import avoiding, changed

from dt_viz.motion.certificates import Certificates
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import avoiding_with
from dt_viz.ui.panel.avoid import AvoidPanel, avoids_with
from dt_viz.warning import ARM, Kind, MotionWarning

HAND = avoiding("draw_s", Sphere((0.0, -0.5, 0.4)))
ARM_TOO = changed(HAND, space="cspace")
ENTERS = Certificates(0.01).warning(MotionWarning(Kind.ARM_ENTERS, "finger tip 1 enters the obstacle by 64 mm", ARM))


@pytest.fixture
def bound(server):
    bound = Bound(HAND)
    AvoidPanel(server.gui, bound).add_remedy()
    bound.adopt(HAND)
    yield bound
    server.gui.reset()


def remedy(server):
    (button,) = [
        handle
        for handle in server.gui._gui_input_handle_from_uuid.values()
        if handle.label == "Let the whole arm avoid"
    ]
    return button


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


def test_the_remedy_shows_where_it_mends_and_lets_the_whole_arm_avoid(bound, server):
    button = remedy(server)
    assert not button.visible
    bound.report(frame_of(HAND, certificates=ENTERS))
    assert button.visible
    for scenario in (
        ARM_TOO,
        replace(HAND, view=View(arm=False)),
        replace(HAND, stack=avoiding_with(HAND, None)),
    ):
        bound.adopt(scenario)
        bound.report(frame_of(scenario, certificates=ENTERS))
        assert not button.visible
    bound.adopt(HAND)
    bound.report(frame_of(HAND))
    assert not button.visible
    bound.report(frame_of(HAND, certificates=ENTERS))
    assert button.visible
    bound.adopt(changed(HAND, temperature=3.0))  # what is shown is of another motion
    assert not button.visible
