"""What the page shows of bias points, the stack, its settings and the warp, without a browser."""

import itertools
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pages import Bound, Edited, NoFrames, frame_of, ignored, wait_until
from scenes import avoiding, beside, biases, changed, changing

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.registry import BIAS
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.slices import BASE_PANEL
from dt_viz.scenario.stack import IMITATION, WHOLE_ARM, anchored, avoiding_with, selected
from dt_viz.scenario.tasks import TASKS
from dt_viz.session import player as player_module
from dt_viz.session.engine import Engine
from dt_viz.session.session import Session
from dt_viz.ui.panel import add_avoid_and_imitate, avoids_with
from dt_viz.ui.scene.draggables import BiasPoints
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.rollouts import LevelRollouts
from dt_viz.ui.scene.tubes import NUM_SIDES
from dt_viz.ui.tabs import stack as stack_module
from dt_viz.ui.tabs.stack import (
    BASE,
    DOWN,
    OFF,
    ON,
    SHOW,
    SHOWN,
    UP,
    StackPanel,
    add_transform_settings,
    formula_html,
    grown,
    learned_html,
    legend_html,
    press,
    rows,
)
from dt_viz.ui.tabs.world import add_transform, add_transforms, delete_transform

PLANE = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
AVOIDANCE = "Avoidance"
BALL = Sphere((0.0, -0.5, 0.4))
SCENARIO = avoiding(
    "draw_s",
    Sphere((0.0, -0.5, 0.4)),
    layers=biases(BiasPoint((0.2, -0.5, 0.4), plane=PLANE), BiasPoint((0.0, -0.4, 0.2))),
)


def frame(scenario=SCENARIO, **changes):
    given: dict[str, Any] = {
        "task": TASKS[scenario.task](),
        "goal": np.zeros(3),
        "levels": tuple((np.full((5, 3), float(k)),) for k in range(4)),
        "durations": {"Bias 1": 0.8, AVOIDANCE: 0.4},
        "learned_steps": (4, 4, 4),
        "chosen_values": {"Bias 1": {"strength": 0.8, "radius": 0.2}, AVOIDANCE: {"duration": 0.4}},
    }
    return frame_of(scenario, **(given | changes))


# --- The list ---


def listed(scenario):
    return {row.name: row for row in rows(scenario, frame(scenario).durations)}


def test_the_outermost_transform_is_on_top_and_the_base_at_the_bottom():
    assert list(listed(SCENARIO)) == [AVOIDANCE, "Bias 2", "Bias 1", IMITATION, BASE]
    assert list(listed(changed(SCENARIO, space="cspace"))) == [WHOLE_ARM, "Bias 2", "Bias 1", IMITATION, BASE]
    assert list(listed(changed(SCENARIO, obstacles=()))) == ["Bias 2", "Bias 1", IMITATION, BASE]


def test_each_row_tells_the_duration_that_was_chosen_and_offers_what_can_be_done():
    by_name = listed(SCENARIO)
    assert [by_name[name].label for name in ("Bias 1", "Bias 2", AVOIDANCE)] == [
        "Bias 1, strength\u00a00.80",
        "Bias 2",
        "Avoidance, t\u00a00.40",
    ]
    assert by_name["Bias 1"].buttons == (ON, UP, SHOW)
    assert by_name["Bias 2"].buttons == (ON, UP, DOWN, SHOW)
    assert by_name[AVOIDANCE].buttons == (ON, DOWN, SHOW)


@pytest.fixture
def session():
    return cast(Any, Edited(SCENARIO))


@pytest.mark.parametrize("name", ["Bias 1", "Bias 2", AVOIDANCE, IMITATION])
def test_a_row_switches_its_transform_off_and_on_again(session, name):
    press(session, name, ON)
    assert session.scenario != SCENARIO
    row = listed(session.scenario)[name]
    assert row.buttons[0] == OFF and (name == IMITATION or SHOW not in row.buttons)
    press(session, name, OFF)
    assert session.scenario == SCENARIO


def test_rows_move_their_transform_outwards_and_inwards(session):
    press(session, "Bias 2", "↑")
    assert tuple(layer.name for layer in session.scenario.stack) == ("Bias 1", AVOIDANCE, "Bias 2")
    press(session, "Bias 1", "↑")
    assert tuple(layer.name for layer in session.scenario.stack) == (AVOIDANCE, "Bias 1", "Bias 2")
    press(session, AVOIDANCE, "↑")
    press(session, AVOIDANCE, "↑")
    assert session.scenario == SCENARIO


def test_one_level_is_looked_at_at_a_time_and_the_legend_names_it(session):
    assert legend_html(SCENARIO) == ""
    for name in (IMITATION, "Bias 1"):
        press(session, name, SHOW)
        assert session.scenario.view.level == name
        assert [row.name for row in listed(session.scenario).values() if SHOWN in row.buttons] == [name]
    assert "bias 1" in legend_html(session.scenario)
    press(session, "Bias 1", SHOWN)
    press(session, BASE, SHOW)
    assert session.scenario.view == View(panels=(BASE_PANEL,), tuned="Bias 1")  # and its settings stay in sight


def test_rows_are_reused_and_hidden_when_the_stack_shrinks(server):
    bound = Bound(SCENARIO)
    panel = StackPanel(server.gui, bound)
    bound.adopt(SCENARIO)
    bound.report(frame())
    shown = [handle.label for handle in panel.rows if handle.visible]
    assert shown == ["Avoidance, t\u00a00.40", "Bias 2", "Bias 1, strength\u00a00.80", IMITATION, BASE]
    bound.adopt(changed(SCENARIO, layers=(), obstacles=()))
    assert [handle.label for handle in panel.rows if handle.visible] == [IMITATION, BASE]
    bound.adopt(SCENARIO)
    assert len(panel.rows) == 5
    server.gui.reset()


def test_the_selected_level_is_drawn_and_named(scene):
    picture = LevelRollouts(scene)
    for name, level in ((IMITATION, 0), ("Bias 2", 2), (AVOIDANCE, 3)):
        picture.draw(frame(replace(SCENARIO, view=View(level=name)), level=level), Look())
        assert picture.visible and name.lower() in picture.label.text.lower()
        middles = picture.tubes.node.vertices.reshape(-1, NUM_SIDES, 3).mean(axis=1)
        np.testing.assert_allclose(middles[-1], level, atol=1e-6)
    picture.draw(frame(), Look())
    assert not picture.visible


def test_the_end_of_a_level_is_marked_where_it_is_not_the_goal(scene):
    picture = LevelRollouts(scene)
    seen = replace(SCENARIO, view=View(level="Bias 2"))
    for goal, marked in ((2.0, False), (2.1, True), (2.0, False)):
        picture.draw(frame(seen, level=2, goal=np.full(3, goal)), Look())
        assert picture.end.visible == marked
        np.testing.assert_array_equal(picture.end.position, np.full(3, 2.0))


# --- Bias points ---


def test_bias_points_stand_where_they_are_and_the_one_that_was_clicked_has_handles(scene):
    picture = BiasPoints(scene, ignored)
    picture.adopt(SCENARIO)
    picture.draw(frame(), Look())
    first, second = picture.items
    for item, point in zip((first, second), anchored(SCENARIO).values(), strict=True):
        np.testing.assert_allclose(item.node.position, cast(Any, point).position)
    assert first.node.active_axes == (True, True, False)  # in the drawing's plane
    assert second.node.active_axes == (True, True, True)
    assert (first.node.opacity, second.node.opacity) == (0.0, 0.0)
    assert not first.region.visible
    picture.adopt(replace(SCENARIO, view=View(bias_handles=True)))
    assert (first.node.opacity, second.node.opacity) == (0.0, 1.0)  # the newest
    picture.adopt(replace(SCENARIO, view=View(bias="Bias 1", bias_handles=True)))
    assert (first.node.opacity, second.node.opacity) == (1.0, 0.0)
    with picture.without_handles():
        assert first.node.opacity == 0.0
    assert first.node.opacity == 1.0
    assert first.region.visible and np.ravel(first.region.scale)[0] == 0.2
    assert not np.any(first.region.points[..., 2]) and np.ptp(second.region.points, axis=(0, 1)).min() > 1.9
    assert not second.region.visible  # nobody knows how large
    picture.adopt(changed(SCENARIO, layers=()))
    assert picture.items == []


def test_bias_points_are_added_changed_and_deleted():
    session: Any = Edited(changed(SCENARIO, layers=()))
    for _ in range(BIAS.most + 1):
        add_transform(session, BiasPoint)
    points = anchored(session.scenario)
    assert len(points) == BIAS.most
    assert selected(session.scenario) == list(points)[-1]
    session.edit("select", view=View(bias="Bias 2"))
    delete_transform(session)
    assert list(anchored(session.scenario)) == ["Bias 1", "Bias 3", "Bias 4"]
    for _ in range(4):
        delete_transform(session)
    assert beside(session.scenario) == ()


def test_the_panel_shows_what_auto_chose(server):
    bound = Bound(SCENARIO)
    add_transforms(server.gui, bound)
    bound.adopt(replace(SCENARIO, view=View(bias="Bias 1")))
    bound.report(frame())
    radius = bound["Radius [cm]"].control
    assert radius.value == 20.0 and radius.handle.disabled


@pytest.mark.parametrize(
    ("scenario", "formula"),
    [
        (Scenario("draw_s"), "z = ψi(y)"),
        (avoiding("draw_s", BALL), "z = ψi(ψo(y))"),
        (avoiding("draw_s", BALL, layers=biases(BiasPoint(BALL.position))), "z = ψi(ψb1(ψo(y)))"),
        (replace(avoiding("draw_s", BALL), imitation=False), "z = ψo(y)"),
        (avoiding("draw_s", BALL, avoids=False), "z = ψi(y)"),
        (avoiding("draw_s", BALL, space="cspace"), "z = ψi(fk(ψq(q)))"),
        (avoiding("draw_s", BALL, space="cspace", layers=biases(BiasPoint(BALL.position))), "z = ψi(ψb1(fk(ψq(q))))"),
    ],
)
def test_the_formula_follows_the_stack_and_names_its_parts_in_their_colours(scenario, formula):
    said = formula_html(scenario)
    above, below, _ = re.sub(r"<(?!/div)[^>]*>", "", said).split("</div>")
    assert above == formula
    parts = re.findall(r"<b style='color:[^']*'>ψ<sub>[^<]*</sub></b>", said)
    named = parts[len(parts) // 2 :]
    assert parts[: len(parts) // 2] == named and below.count(" · ") == len(named)
    assert len({part.split("'")[1] for part in named}) == len(named)  # each has a colour of its own


# --- What avoids, and the imitation ---


@pytest.fixture
def bound(server):
    bound = Bound(SCENARIO)
    add_avoid_and_imitate(server.gui, bound)
    bound.adopt(SCENARIO)
    yield bound
    server.gui.reset()


@pytest.mark.parametrize("name", ["Off", "Hand", "Arm"])
def test_what_avoids_is_chosen_and_shown(bound, name):
    bound.set("Avoid", name)
    scenario = bound.edited.scenario
    assert avoids_with(Scenario("draw_s")) == "Arm"  # at first
    assert avoids_with(scenario) == name == bound["Avoid"].control.value
    assert scenario.avoids == (name != "Off")
    assert (scenario.arm_avoidance is not None) == (name == "Arm")
    assert (AVOIDANCE in [layer.name for _, layer in scenario.active]) == (name == "Hand")
    assert scenario.obstacles == SCENARIO.obstacles
    bound.set("Avoid", "Hand")
    assert bound.edited.scenario == SCENARIO


def test_what_is_off_comes_back_as_it_was_in_all_but_its_space():
    tuned = changed(SCENARIO, temperature=3.0, margin=0.02)
    off = replace(tuned, stack=avoiding_with(tuned, None))
    assert replace(off, stack=avoiding_with(off, "cspace")) == changed(tuned, space="cspace")


def test_imitation_is_switched_where_it_is_seen_first(bound):
    for on in (False, True):
        bound.set("Imitate", on)
        assert bound.edited.scenario == replace(SCENARIO, imitation=on)
        assert bound["Imitate"].control.value is on


# --- The settings of the transforms, and the warp ---


@pytest.fixture
def notes():
    """HTML elements of the settings."""
    return []


@pytest.fixture
def controls(server, notes, monkeypatch):
    add_html = server.gui.add_html
    monkeypatch.setattr(server.gui, "add_html", lambda *what, **how: notes.append(add_html(*what, **how)) or notes[-1])
    bound = Bound(SCENARIO)
    add_transform_settings(server.gui, bound, 0)
    bound.adopt(SCENARIO)
    yield bound
    server.gui.reset()


def visible(bound):
    return {item.control.handle.label for item in bound.inputs(visible=True)}


STRENGTH = {"Settings of", "Strength: auto", "Strength t", "Integrator"}
FLOW = {"Settings of", "Flow time: auto", "Flow time t", "Integrator"}


def test_only_what_the_chosen_transform_has_is_shown(controls):
    assert visible(controls) == FLOW | {"Generator", "Temperature T"}  # the outermost is the avoidance
    controls.set("Settings of", "Bias 1")
    assert visible(controls) == STRENGTH  # as the paper calls the t of a bias point
    controls.set("Integrator", "Euler (the paper's)")
    assert visible(controls) == STRENGTH | {"Steps"}
    controls.set("Settings of", AVOIDANCE)
    assert visible(controls) == FLOW | {"Generator", "Temperature T"}
    controls.set("Settings of", IMITATION)
    assert visible(controls) == {"Settings of", "Objective", "State"}


def test_settings_change_the_transform_that_they_are_shown_for(controls):
    controls.set("Settings of", "Bias 1")
    controls.set("Integrator", "Euler (the paper's)")
    controls.set("Steps", 3)
    assert cast(BiasPoint, anchored(controls.edited.scenario)["Bias 1"]).integration == Integration("euler", 3)
    assert controls.edited.scenario.avoidance == SCENARIO.avoidance
    controls.set("Settings of", AVOIDANCE)
    assert (controls["Integrator"].control.value, controls.inputs("Steps", visible=True)) == ("auto", [])
    controls.set("Temperature T", 9.0)
    assert controls.edited.scenario.avoidance.temperature == 9.0


def test_a_duration_by_hand_goes_on_from_what_auto_chose(controls):
    for name, label, chosen in ((AVOIDANCE, "Flow time", 0.4), ("Bias 1", "Strength", 0.8)):
        controls.set("Settings of", name)
        controls.report(frame(controls.edited.scenario))
        slider, before = controls[f"{label} t"].control, controls.edited.scenario
        assert slider.handle.disabled and slider.value == chosen
        controls.set(f"{label} t", 1.5)
        assert controls.edited.scenario == before  # it is `auto` that chooses
        controls.set(f"{label}: auto", False)
        assert not slider.handle.disabled and slider.value == chosen
        controls.set(f"{label} t", 1.5)
    assert controls.edited.scenario.avoidance.duration == 1.5
    assert cast(BiasPoint, anchored(controls.edited.scenario)["Bias 1"]).strength == 1.5
    controls.set("Strength: auto", True)
    assert cast(BiasPoint, anchored(controls.edited.scenario)["Bias 1"]).strength is None


def test_the_imitation_says_what_it_is_made_of_and_why_there_is_nothing_to_choose(controls, notes):
    (note,) = notes
    controls.report(frame())
    assert not note.visible
    controls.set("Settings of", IMITATION)
    assert note.visible and "3 flows of 4 Euler steps" in note.content and "nothing to choose" in note.content
    assert "One flow of 12 Euler steps" in learned_html(frame(learned_steps=(12,)))
    assert "straight" in learned_html(None)
    remembering = learned_html(frame(learned_steps=(), remembers=True, reason="they cross"))
    assert "Chosen because they cross" in remembering and "remembers its phase" in remembering


# --- The warp ---


class Quiet:
    """A display that shows nothing."""

    def __getattr__(self, name):
        return lambda *_: None


@pytest.fixture
def played():
    played = Session(cast(Engine, NoFrames()), lambda *_: SCENARIO, "draw_s", cast(Any, Quiet()))
    yield played
    played.close()


def play_warp(played, told, seconds, monkeypatch):
    monkeypatch.setattr(stack_module, "SECONDS", seconds)
    player_module.start(played, "Warp", grown, told.append)


def plays(played):
    return played.jobs.busy(player_module.LANE)


def test_playing_goes_from_straight_rays_to_the_full_stack_as_one_step_for_undo(played, monkeypatch):
    edit = played.edit
    played.edit("Warp", warp=0.7)
    played.end_gesture()
    told, clock = [], itertools.count()
    monkeypatch.setattr(player_module, "time", SimpleNamespace(monotonic=lambda: 0.03 * next(clock)))
    warps = []
    monkeypatch.setattr(played, "edit", lambda name, warp: warps.append(warp) or edit(name, warp=warp))
    play_warp(played, told, 0.3, monkeypatch)
    wait_until(lambda: told == [True, False])
    assert warps == sorted(warps) and warps[0] < 0.3 and warps[-1] == 1
    assert played.scenario == SCENARIO
    played.undo()
    assert played.scenario.warp == 0.7
    played.undo()
    assert played.scenario == SCENARIO


def test_playing_stops_when_it_is_told_to_or_something_else_is_moved(played, monkeypatch):
    told = []
    play_warp(played, told, 1000.0, monkeypatch)
    wait_until(lambda: played.scenario.warp < 0.5)
    played.edit("view", view=View(grid=True))  # moves nothing
    assert plays(played)
    player_module.stop(played)
    wait_until(lambda: not plays(played))
    assert told == [True, False]
    player_module.start(played, "Warp", grown, told.append)
    wait_until(lambda: told == [True, False, True])
    played.edit("obstacle", **changing(played.scenario, obstacles=(), warp=0.9))
    wait_until(lambda: not plays(played))
    assert played.scenario.warp == 0.9


def test_of_two_things_that_are_played_the_second_ends_the_first(played, monkeypatch):
    told = {"warp": [], "other": []}
    play_warp(played, told["warp"], 1000.0, monkeypatch)
    wait_until(lambda: told["warp"] == [True])
    player_module.start(played, "Other", lambda _scenario, _seconds: None, told["other"].append)
    wait_until(lambda: not plays(played))
    assert told == {"warp": [True, False], "other": [True, False]}
