"""The warp and the settings of the transforms in the page, without a browser."""

import itertools
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pages import Bound, NoFrames, frame_of, wait_until
from scenes import avoiding, biases, changing

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import IMITATION, anchored
from dt_viz.scenario.tasks import TASKS
from dt_viz.session import player as player_module
from dt_viz.session.engine import Engine
from dt_viz.session.session import Session
from dt_viz.ui.tabs import stack as stack_module
from dt_viz.ui.tabs.stack import add_transform_settings, grown, learned_html

AVOIDANCE = "Avoidance"
SCENARIO = avoiding("draw_s", Sphere((0.0, -0.5, 0.4)), layers=biases(BiasPoint((0.2, -0.5, 0.4))))


def frame(scenario=SCENARIO, **changes):
    given: dict[str, Any] = {
        "chosen_values": {"Bias 1": {"strength": 0.8, "radius": 0.2}, AVOIDANCE: {"duration": 0.4}},
        "learned_steps": (4, 4, 4),
        "task": TASKS[scenario.task](),
    }
    return frame_of(scenario, **(given | changes))


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
def session():
    session = Session(cast(Engine, NoFrames()), lambda *_: SCENARIO, "draw_s", cast(Any, Quiet()))
    yield session
    session.close()


def play_warp(session, told, seconds, monkeypatch):
    monkeypatch.setattr(stack_module, "SECONDS", seconds)
    player_module.start(session, "Warp", grown, told.append)


def plays(session):
    return session.jobs.busy(player_module.LANE)


def test_playing_goes_from_straight_rays_to_the_full_stack_as_one_step_for_undo(session, monkeypatch):
    edit = session.edit
    session.edit("Warp", warp=0.7)
    session.end_gesture()
    told, clock = [], itertools.count()
    monkeypatch.setattr(player_module, "time", SimpleNamespace(monotonic=lambda: 0.03 * next(clock)))
    warps = []
    monkeypatch.setattr(session, "edit", lambda name, warp: warps.append(warp) or edit(name, warp=warp))
    play_warp(session, told, 0.3, monkeypatch)
    wait_until(lambda: told == [True, False])
    assert warps == sorted(warps) and warps[0] < 0.3 and warps[-1] == 1
    assert session.scenario == SCENARIO
    session.undo()
    assert session.scenario.warp == 0.7
    session.undo()
    assert session.scenario == SCENARIO


def test_playing_stops_when_it_is_told_to_or_something_else_is_moved(session, monkeypatch):
    told = []
    play_warp(session, told, 1000.0, monkeypatch)
    wait_until(lambda: session.scenario.warp < 0.5)
    session.edit("view", view=View(grid=True))  # moves nothing
    assert plays(session)
    player_module.stop(session)
    wait_until(lambda: not plays(session))
    assert told == [True, False]
    player_module.start(session, "Warp", grown, told.append)
    wait_until(lambda: told == [True, False, True])
    session.edit("obstacle", **changing(session.scenario, obstacles=(), warp=0.9))
    wait_until(lambda: not plays(session))
    assert session.scenario.warp == 0.9


def test_of_two_things_that_are_played_the_second_ends_the_first(session, monkeypatch):
    told = {"warp": [], "other": []}
    play_warp(session, told["warp"], 1000.0, monkeypatch)
    wait_until(lambda: told["warp"] == [True])
    player_module.start(session, "Other", lambda _scenario, _seconds: None, told["other"].append)
    wait_until(lambda: not plays(session))
    assert told == {"warp": [True, False], "other": [True, False]}


def test_closing_ends_playing(session, monkeypatch):
    play_warp(session, [], 1000.0, monkeypatch)
    session.close()
    wait_until(lambda: not plays(session))
