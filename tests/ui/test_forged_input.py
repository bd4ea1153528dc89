"""What a page sends, forged: each control, gizmo and node of a visitor's page, through viser's own handlers."""

import dataclasses
import inspect
import itertools
import math
from typing import Any

import numpy as np
import pytest
import viser  # noqa: TID251 - forges what a browser sends
from pages import CLIENT, MIDDLE, Page, wait_until
from viser import _messages as messages  # noqa: TID251

from dt_viz.avoidance.detour import DetourSettings
from dt_viz.scenario.paper_scenes import offered
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import anchored
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui import bindings
from dt_viz.ui.scene import draggables, markers
from dt_viz.ui.scene.camera import view_of

SCENES = offered(TASKS)
BORDERS = {bindings.__name__, draggables.__name__, markers.__name__}
UPLOAD = viser.GuiUploadButtonHandle
FILE = viser.UploadedFile(name="x", content=b"\0" * 100)
NO_NUMBERS = (math.nan, math.inf, -math.inf, 1e300, -1e300)
CLAIMS = [*NO_NUMBERS, 1e6, -9, 0, 2**70, "9" * 4000, "nan", True, None, "", "x" * 1_000_000, [], {}, FILE]
PLACES = [
    *((number, 0.1, 0.2) for number in (math.nan, -math.inf, 1e300, 6.0)),
    *((0.1, 0.2, number) for number in (math.inf, -1e300)),
]
TURNS = [(0.0,) * 4, (math.nan, 0.0, 0.0, 0.0), (1e300, 0.0, 0.0, 0.0)]


@pytest.fixture(autouse=True)
def _at_rest(page):
    """No presentation, tour or gesture, and a camera that stays where it is put: a forgery may have begun one."""
    page.session.end_gesture()  # while one goes on, an edit is shown with its frame, not at once
    page.visitor._panel.presentation.show(False)
    page.settle()
    page.visitor._panel.tour.end(page.session)
    page.settle()
    for switch in page.inputs:
        if switch.label in ("Orbit", "Lock camera") and switch.value:
            page.claim(switch, False)


def values_of(value: Any):
    """All plain values in a scenario, but for what obstacles keep of files and what the page does not offer."""
    if isinstance(value, DetourSettings):
        return
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from values_of(getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for one in value:
            yield from values_of(one)
    else:
        yield value


def assert_sound(page: Page) -> None:
    """The scenario holds nothing that the page could not have asked for, and each control shows what it allows."""
    scenario = page.session.scenario
    for value in values_of(scenario):
        assert not isinstance(value, float | int) or (math.isfinite(value) and abs(value) <= 50)
        assert not isinstance(value, str) or len(value) < 40
    assert scenario.task in TASKS and 0 <= scenario.view.generator_layer <= 20 and scenario.arm_rollout >= 0
    for obstacle in scenario.obstacles:
        assert 0.01 < obstacle.radius < 1 and 0.9 < np.linalg.norm(obstacle.wxyz) < 1.1
    for handle in page.inputs:
        value = handle.value
        if isinstance(handle, viser.GuiSliderHandle):
            assert type(value) in (int, float)
            within = lambda slider=handle: slider.min <= slider.value <= max(slider.max, 20)  # noqa: E731
            wait_until(within)  # a thread sets the limits of the timeline, and then its value
        elif isinstance(handle, viser.GuiDropdownHandle):
            assert value in handle.options
        elif isinstance(handle, viser.GuiCheckboxHandle):
            assert isinstance(value, bool)
        assert not isinstance(value, str) or len(value) < 100
    for gizmo in page.gizmos.values():
        assert (gizmo.position.shape, gizmo.wxyz.shape) == ((3,), (4,))
        assert np.isfinite([*gizmo.position.astype(float), *gizmo.wxyz.astype(float)]).all()


def test_nothing_that_a_page_sends_passes_by_the_border(page):
    """Whoever adds a control cannot forget to have it checked. Uploads are bytes, and checked by what reads them."""
    page.busy()
    inputs = [handle for handle in page.inputs if handle.label and not isinstance(handle, UPLOAD)]
    assert len(inputs) > 50 and page.gizmos and page.nodes
    callbacks = [(handle.label, callback) for handle in inputs for callback in handle._impl.update_cb]
    assert {label for label, _ in callbacks} == {handle.label for handle in inputs}
    callbacks += [(name, cb) for name, gizmo in page.gizmos.items() for cb in gizmo._impl_aux.update_cb]
    for name, node in page.nodes.items():
        callbacks += [(name, entry.callback) for entry in (*(node._impl.click_cb or ()), *(node._impl.drag_cb or ()))]
    callbacks += [(label, cb) for label, command in page.commands.items() for cb in command._impl.trigger_cb]
    callbacks += [("scene", entry.callback) for entry in page.scene._scene_pointer_cb]
    some = {
        "scene",
        "/obstacles/0/surface",
        "/bias/0/ball",
        "/starts/1",
        "/slice",
        "Undo",
        "Hide the panel, or show it",
    }
    assert {name for name, _ in callbacks} > some
    for name, callback in callbacks:
        assert callback.__module__ in BORDERS, name
        assert inspect.iscoroutinefunction(callback), f"{name} would wait in the pool that all visitors share"


@pytest.mark.long
@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: repr(claim)[:20])
def test_a_forged_value_is_refused_or_moved_to_the_limits(page, claim):
    seen = []
    for selected in range(3):  # each kind of obstacle has sizes of its own
        page.busy(selected=selected)
        shown = [handle for handle in page.inputs if handle.visible]
        for handle in page.inputs if selected == 0 else shown:
            if not isinstance(handle, UPLOAD) and handle not in seen:
                page.claim(handle, claim)
                assert_sound(page)
        seen += shown


@pytest.mark.parametrize(
    ("label", "claim", "read", "expected"),
    [
        ("Diameter [cm]", 1e6, lambda s: s.obstacles[0].diameter, 0.30),
        ("Height [cm]", -1.0, lambda s: s.obstacles[0].height, 0.03),
        ("Steps", 10**6, lambda s: s.avoidance.integration.steps, 50),
        ("Warp", 50.0, lambda s: s.warp, 1.0),
        ("Generator of flow", -9, lambda s: s.view.generator_layer, 0),
        ("Temperature T", 1e9, lambda s: s.avoidance.temperature, 20.0),
        ("Warp", math.nan, lambda s: s.warp, 1.0),
        ("Objective", "nonsense", lambda s: s.objective, "trajectory"),
        ("Task", "nonsense", lambda s: s.task, "draw_s"),
        ("Speed", math.inf, lambda s: s.view.speed, 1.0),
    ],
)
def test_what_is_forged_is_shown_as_what_it_has_become(page, label, claim, read, expected):
    page.busy(selected=0, tuned="Imitation" if label == "Objective" else "Avoidance")
    handle, told = page[label], []
    handle._queue_update = lambda name, value: told.append((name, value))
    page.claim(handle, claim)
    assert read(page.session.scenario) == expected
    assert told == [("value", handle.value)] and handle.value != claim


def test_controls_that_are_hidden_or_disabled_do_nothing(page):
    page.busy()
    hidden = [handle for handle in page.inputs if handle.disabled or not handle.visible]
    assert {"Radius: auto", "Objective", "Back to the task's slice"} & {handle.label for handle in hidden}
    for handle in hidden:
        before, shown = page.session.scenario, handle.value
        for claim in (True, False, 1, 7, *getattr(handle, "options", ())):
            if not isinstance(handle, UPLOAD):
                page.claim(handle, claim)
        assert (page.session.scenario, handle.value) == (before, shown), handle.label


def test_every_value_that_a_control_offers_is_taken(page):
    """Or the border would be too narrow."""
    page.busy()
    for handle in page.inputs:
        offered = {
            viser.GuiSliderHandle: lambda h: (h.min, h.max),
            viser.GuiDropdownHandle: lambda h: h.options,
            viser.GuiCheckboxHandle: lambda h: (True, False),
        }.get(type(handle), lambda h: ())(handle)
        for value in offered:
            if handle.visible and not handle.disabled:
                assert bindings.allowed(handle, value) == value, (handle.label, value)


@pytest.mark.parametrize("position", PLACES, ids=repr)
def test_a_gizmo_goes_nowhere_that_is_no_place(page, position):
    for moves_slice in (True, False):
        before = page.busy(move_slice=moves_slice)
        for name in page.gizmos:
            page.move(name, position)
            assert_sound(page)
        assert page.session.scenario == before


@pytest.mark.parametrize("wxyz", TURNS, ids=repr)
def test_a_gizmo_takes_no_turn_that_is_none(page, wxyz):
    before = page.busy()
    for name in page.gizmos:
        page.move(name, MIDDLE, wxyz)
        assert_sound(page)
    assert page.session.scenario == before
    page.session.edit("test", view=View(move_slice=True))
    page.move("/slice", MIDDLE, wxyz)
    assert page.session.scenario.view.slice is None


def test_only_gizmos_that_are_shown_can_be_moved_and_those_can(page):
    before = page.busy(selected=1)
    for name in ("/obstacles/0", "/obstacles/2", "/slice"):
        page.move(name, (0.2, -0.4, 0.3))
    assert page.session.scenario == before
    page.move("/obstacles/1", (0.2, -0.4, 0.3))
    assert page.session.scenario.obstacles[1].position == (0.2, -0.4, 0.3)
    page.move("/bias/0", (0.2, -0.4, 0.3))
    assert page.session.scenario != before


DRAGGED = {
    "/obstacles/0/surface": lambda scenario: scenario.obstacles[0].position,
    "/bias/0/ball": lambda scenario: next(iter(anchored(scenario).values())).position,
    "/starts/1": lambda scenario: scenario.starts[1].place,
}
"""Where things stand, by the name of what is dragged in the scene."""


@pytest.mark.parametrize("name", DRAGGED)
@pytest.mark.parametrize("lag", [0, 1, 4])
def test_what_is_dragged_is_under_the_pointer_however_late_the_browser_sees_it_move(page, name, lag):
    before = page.busy()
    began = np.array(DRAGGED[name](before))
    seen = [began] * (lag + 1)
    phases = ["start", *["update"] * 4, "end"]
    for phase, shift in zip(phases, np.linspace(0.0, 1.0, len(phases))[:, None] * (0.05, 0.0, 0.03), strict=True):
        page.drag(name, tuple(seen[-1 - lag]), tuple(began + shift), phase)
        seen.append(np.array(DRAGGED[name](page.session.scenario)))
        np.testing.assert_allclose(seen[-1] - began, shift, atol=1e-9)
    after = page.session.scenario
    stay = [other for other in DRAGGED if other != name]
    assert after.obstacles[1:] == before.obstacles[1:]
    assert [DRAGGED[other](after) for other in stay] == [DRAGGED[other](before) for other in stay]
    page.drag(name, MIDDLE, (900.0, -0.5, 0.4))  # too far away
    assert page.session.scenario == after


@pytest.mark.parametrize("place", PLACES, ids=repr)
def test_nothing_in_the_scene_is_dragged_to_or_seen_from_what_is_no_place(page, place, monkeypatch):
    page.busy()
    dragged = [name for name, node in page.nodes.items() if node._impl.drag_cb]
    assert len(dragged) >= 7
    for name, phase in itertools.product(dragged, ("start", "update", "end")):
        page.drag(name, place, MIDDLE, phase)
        page.drag(name, MIDDLE, place, phase)
        assert_sound(page)
    monkeypatch.setattr(page.camera, "position", place)
    for name in dragged:
        page.drag(name, MIDDLE, (0.2, -0.4, 0.3))
        assert_sound(page)


@pytest.mark.parametrize("ray", [*PLACES, (0.0, 0.0, 0.0), None], ids=repr)
def test_a_ray_that_is_none_adds_no_start(page, ray):
    before = page.busy()
    for origin, direction in ((ray, (0.0, 1.0, 0.0)), ((0.8, -1.6, 0.8), ray)):
        page.point(origin, direction)
        assert_sound(page)
    assert len(page.session.scenario.starts) <= len(before.starts) + 1


def test_reset_and_commands_bring_the_camera_back(page):
    task, camera = TASKS["draw_s"](), page.visitor.camera
    page.busy()
    page.session.edit("warp", warp=0.5)
    camera.look(task)
    for act, view in (
        (lambda: page.claim(page["History"], "Undo"), None),
        (lambda: page.claim(page["Reset"], "Reset"), "Home"),
        (lambda: page.give(page.commands["View: Top"]), "Top"),
        (lambda: page.give(page.commands["Frame: move the camera back"]), "Home"),
    ):
        page.camera.position, page.camera.look_at = np.full(3, 9.0), np.ones(3)
        act()
        seen = page.camera.position, page.camera.look_at
        wanted = view_of(task, camera.framing, view) if view else (np.full(3, 9.0), np.ones(3))
        np.testing.assert_array_equal(seen, wanted)


def test_commands_do_what_the_controls_do_each_on_a_key_of_its_own(page):
    page.busy()
    commands = page.commands
    keys = [(command.hotkey, command.modifier) for command in commands.values() if command.hotkey is not None]
    assert len(set(keys)) == len(keys)
    named = *"RZFHOLPTBJK123456789", "space", "escape", "pagedown", "pageup"
    assert set(keys) == {(key, None) for key in named} | {("Z", "shift")}
    by_key = {(command.hotkey, command.modifier): command for command in commands.values()}
    before = page.session.scenario
    page.give(by_key["space", None])
    assert page.session.scenario.view.playing is not before.view.playing
    page.give(by_key["space", None])
    page.session.edit("warp", warp=0.5)
    for key, warp in ((("Z", None), 1), (("Z", "shift"), 0.5), (("R", None), 1)):
        page.give(by_key[key])
        assert page.session.scenario.warp == warp
    titles = [command.label for command in commands.values()][-len(SCENES) :]
    assert titles == [scene.title for scene in SCENES]
    page.give(by_key["2", None])
    page.settle()
    assert page.session.scenario.scene == SCENES[1].name
    page.session.leave_scene()


@pytest.mark.parametrize(
    ("command", "label", "name"),
    [
        ("Orbit: turn the camera slowly, or stop", "Orbit", "orbits"),
        ("Lock the camera, or let it go", "Lock camera", "locked"),
    ],
)
def test_a_switch_of_the_camera_and_its_command_are_one(page, command, label, name):
    switch = page[label]
    for act, on in (
        (lambda: page.claim(switch, True), True),
        (lambda: page.give(page.commands[command]), False),
        (lambda: page.give(page.commands[command]), True),
        (lambda: page.claim(switch, False), False),
    ):
        act()
        assert (getattr(page.visitor.camera, name), switch.value) == (on, on)


def test_a_command_that_is_forged_or_disabled_is_not_given(page):
    before = page.busy()
    undo = page.commands["Undo"]
    page.session.edit("warp", warp=0.5)
    undo.disabled = True
    page.give(undo)
    page.run(page.gui._handle_command_trigger(CLIENT, messages.CommandTriggerMessage("no such command")))
    assert page.session.scenario.warp == 0.5
    undo.disabled = False
    page.give(undo)
    assert page.session.scenario == before


def test_the_presentation_goes_from_scene_to_scene_and_folds_no_panel(page, monkeypatch):
    presentation, scenes = page.visitor._panel.presentation, [scene.name for scene in SCENES]
    page.session.leave_scene()

    def shown():
        page.settle()
        return page.session.scenario.scene

    def is_on():
        (on,) = {presentation.on, buttons.visible, page.visitor.camera.framing.alone}
        return on

    (buttons,) = (handle for handle in page.inputs if handle.label == "Presentation" and hasattr(handle, "options"))
    assert not is_on()
    page.give(page.commands["Presentation: the scene without the panel, or with it"])
    assert is_on()
    assert TASKS[page.session.scenario.task].title in presentation._html.content
    page.claim(buttons, "Previous")
    assert shown() == scenes[-1]
    page.give(page.commands["Next scene"])
    assert shown() == scenes[0] and SCENES[0].title in presentation._html.content
    page.claim(buttons, "Next")
    assert shown() == scenes[1]
    told = []
    with monkeypatch.context() as patch:
        patch.setattr(page.gui._websock_interface, "queue_message", told.append)
        page.give(page.commands["Hide the panel, or show it"])
        assert told == []
    page.claim(buttons, "End")
    assert not is_on()
    page.session.leave_scene()
    page.give(page.commands["Next scene"])
    assert shown() == scenes[0]
    page.session.leave_scene()
    monkeypatch.setattr(page.gui._websock_interface, "queue_message", told.append)
    for folded in (True, False, True, False):
        page.give(page.commands["Hide the panel, or show it"])
        assert told[-1].collapsed is folded
