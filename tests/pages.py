"""Stand-ins for what a page is given, such as a frame without a motion, and for a page that no browser shows."""

import asyncio
import contextlib
import functools
import io
import time
from dataclasses import fields, make_dataclass, replace
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import viser  # noqa: TID251 - a page that no browser shows
from PIL import Image
from scenes import biases, changed, starts_at
from viser import _messages as messages  # noqa: TID251
from viser._gui_handles import GuiProgressBarHandle  # noqa: TID251

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.motion.certificates import Certificates
from dt_viz.motion.following import Follower
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere, rotation
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.tasks import TASKS
from dt_viz.scheduler import Jobs
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.robot_loop import LiveArm
from dt_viz.session.session import Session
from dt_viz.ui.bindings import EDITS, Bindings, Control
from dt_viz.ui.page import Page as VisitorPage
from dt_viz.ui.panel import ControlPanel
from dt_viz.ui.playback import LANE as ARM
from dt_viz.ui.scene.camera import HOME, CameraController, Framing, view_of, window_size
from dt_viz.ui.tabs.opening import CHOOSING
from dt_viz.warning import Severity

MIDDLE = (0.1, -0.5, 0.4)
TITLES = {name: entry.title for name, entry in TASKS.items()}
CLIENT = cast(Any, 0)
PATIENCE = 30.0  # seconds after which a test gives up; nothing on a page takes that long


def ignored(*_what: Any) -> Any:
    """What is told of a thing that is clicked or dragged where nobody wants to know."""


def wait_until(condition: Any, patience: float = PATIENCE) -> None:
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


async def come_true(condition: Any) -> None:
    """Wait on an event loop: the machine may be busy."""
    await asyncio.to_thread(wait_until, condition, 90.0)


def asynchronous(test: Any) -> Any:
    """Runs a test on an event loop, for three minutes at most."""

    @functools.wraps(test)
    def run(**fixtures: Any) -> None:
        asyncio.run(asyncio.wait_for(test(**fixtures), 180.0))

    return run


def all_of(scenario: Scenario) -> dict[str, Any]:
    """The fields of a scenario, for an edit after which it is the session's."""
    return {field.name: getattr(scenario, field.name) for field in fields(scenario)}


def painted_at(image: Any, half_size: Any, seen: Any) -> np.ndarray:
    """Place in the world of the middle of those pixels of an image that are `seen` (rows, columns)."""
    rows, columns = np.nonzero(seen)
    height, width = seen.shape
    across = 2 * (columns.mean() + 0.5) / width - 1, 2 * (rows.mean() + 0.5) / height - 1  # to the right and down
    w, x, y, z = (float(component) for component in image.wxyz)
    return image.position + rotation((w, x, y, z)) @ [*np.multiply(half_size, across), 0.0]


GIVEN: dict[str, Any] = dict.fromkeys(("task", "level", "goal", "reached", "durations", "chosen_values"))
GIVEN |= dict.fromkeys(("ghost", "rollouts", "times", "levels", "shaping", "labels", "learned_steps"), ())
GIVEN |= {"chosen": 0, "remembers": False, "has_orientation": False, "reason": ""}
FrameWithoutMotion: Any = make_dataclass(
    "FrameWithoutMotion", [(name, Any, value) for name, value in GIVEN.items()], bases=(Frame,), frozen=True, eq=False
)
"""A frame that is given what others take from their motion."""


def frame_of(scenario: Scenario, **changes: Any) -> Frame:
    """The last frame of a scenario, with nothing in it but what is given."""
    nothing: Any = None
    known = {"stage": Stage.CERTIFIED, "certificates": Certificates(0.01), "durations": {}, "chosen_values": {}}
    given = known | changes
    given.setdefault("shaping", np.ones(len(changes.get("rollouts", ())), bool))
    return FrameWithoutMotion(scenario, motion=nothing, drawn=nothing, **given)


class CameraClient:
    """A visitor with a camera only."""

    def __init__(self) -> None:
        self._reported: Any = None
        self.camera = SimpleNamespace(
            position=np.array([0.8, -1.6, 0.8]),
            look_at=np.zeros(3),
            wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
            fov=0.75,
            image_width=1280,
            image_height=720,
            on_update=lambda reported: setattr(self, "_reported", reported),
        )
        self.atomic = contextlib.nullcontext

    def moves(self, position: Any, look_at: Any = (0.0, 0.0, 0.0)) -> None:
        """Report where the browser has moved the camera to."""
        self.camera.position, self.camera.look_at = np.array(position), np.array(look_at)
        asyncio.run(self._reported(self.camera))


def camera_for(task: Any, camera: Any, view: str = HOME, hand: Any = None, **framing: Any) -> tuple[Any, Any]:
    """Position and look-at of a view of a task in the window of a camera."""
    return view_of(task, Framing(window_size(camera), **framing), view, hand=hand)


def panel_of(server: viser.ViserServer, notify: Any = ignored) -> ControlPanel:
    """The panel of a page that shows nothing else."""
    page = cast(Any, MagicMock())
    page.client.gui, page.notify = server.gui, notify
    page.camera = CameraController(cast(Any, CameraClient()), lambda: None)
    return ControlPanel(page, TITLES, {"": "JACO"}, load_jaco())


class Kept(dict):
    """What a browser keeps for this page, told at once."""

    def get_item(self, key: str, timeout: float | None = None) -> Any:
        return self.get(key)

    def set_item(self, key: str, value: str) -> None:
        self[key] = value

    def remove_item(self, key: str) -> None:
        self.pop(key, None)


class NoFrames:
    """An engine that has no frames: nothing here is about motions."""

    bring, refining = Engine.bring, Engine.refining

    def __init__(self, robot=None):
        self.follower = Follower(robot or load_jaco())
        self.arm, self.own, self._last = LiveArm(self.follower), {}, {}

    def title(self, name):
        return TASKS[name].title

    def see(self, _scenario):
        pass

    def task(self, name):
        return self.own[name][0] if name in self.own else TASKS[name]()

    def frames(self, *_what: Any, draw: Any) -> Any:
        return iter(())


class Answers:
    """The connection of a page that answers what it is to render by the `get_render` of its client, as a PNG."""

    def __init__(self, client: Any) -> None:
        self._client, self.handlers = client, []

    def register_handler(self, _kind: Any, handler: Any) -> None:
        self.handlers.append(handler)

    def unregister_handler(self, _kind: Any, handler: Any) -> None:
        self.handlers.remove(handler)

    def queue_message(self, asked: Any) -> None:
        shot = {name: getattr(asked, name) for name in ("wxyz", "position", "fov")}
        answer = self._client.get_render(asked.height, asked.width, **shot)
        self.answer(asked.render_uuid, answer if isinstance(answer, bytes) else png_of(answer))

    def answer(self, uuid: str, payload: bytes) -> None:
        for handler in [*self.handlers]:
            handler(self._client.client_id, messages.GetRenderResponseMessage(payload, uuid))


def png_of(rgba: Any) -> bytes:
    """A PNG of pixels (height, width, 4)."""
    file = io.BytesIO()
    Image.fromarray(rgba, "RGBA").save(file, "PNG")
    return file.getvalue()


class Page:
    """A visitor's page on a server that nobody looks at, and what a browser may send to it."""

    def __init__(
        self, server: viser.ViserServer, robot: Any, arms: Any = None, kept: Any = None, **offered: Any
    ) -> None:
        self.gui, self.scene = server.gui, server.scene
        self.camera = CameraClient().camera
        self.client = SimpleNamespace(
            client_id=0,
            gui=server.gui,
            scene=server.scene,
            camera=self.camera,
            local_storage=Kept() if kept is None else kept,
            atomic=contextlib.nullcontext,
            flush=lambda: None,
            add_notification=lambda *_what, **_how: None,
            get_render=lambda height, width, **_how: np.zeros((height, width, 4), np.uint8),
            send_file_download=lambda *_what, **_how: None,
        )
        self.client._websock_connection = Answers(self.client)
        self.client._viser_server = SimpleNamespace(flush=lambda: None, get_clients=lambda: {0: self.client})
        self.gui._resolve_client = lambda _id: self.client  # type: ignore[method-assign]
        self.scene._get_client_handle = lambda _id: self.client  # type: ignore[method-assign]
        engine = cast(Engine, NoFrames())
        self.visitor = VisitorPage(cast(Any, self.client), engine, robot, TITLES, "draw_s", arms, **offered)
        self._loop = asyncio.new_event_loop()
        self.session = self.visitor.session
        self._initial = self.session.scenario

    def close(self) -> None:
        """The visitor leaves."""
        self.visitor.close()
        self._loop.close()

    @property
    def inputs(self) -> list[Any]:
        """All but those whose value nobody reads."""
        inputs = self.gui._gui_input_handle_from_uuid.values()
        return [handle for handle in inputs if not isinstance(handle, GuiProgressBarHandle)]

    def __getitem__(self, label: str) -> Any:
        """The first input that is shown with this label: of two it is the obstacle's."""
        return next(handle for handle in self.inputs if handle.label == label and handle.visible)

    @property
    def commands(self) -> dict[str, Any]:
        """The commands of the palette, by name."""
        return {command.label: command for command in self.gui._command_handle_from_uuid.values()}

    def give(self, command: Any) -> None:
        message = messages.CommandTriggerMessage(command._impl.uuid)
        self.run(self.gui._handle_command_trigger(CLIENT, message))

    @property
    def gizmos(self) -> dict[str, Any]:
        return self.scene._handle_from_transform_controls_name

    @property
    def nodes(self) -> dict[str, Any]:
        return self.scene._handle_from_node_name

    def run(self, *handling) -> None:
        """Handle messages as viser does: what raises ends the handling of that message only."""

        async def one_after_the_other():
            for coroutine in handling:
                with contextlib.suppress(Exception):
                    await coroutine

        self._loop.run_until_complete(one_after_the_other())
        assert self.session.wait_idle(PATIENCE)

    def claim(self, handle: Any, value: Any) -> None:
        if isinstance(value, viser.UploadedFile):  # an upload can be sent to any input
            handle._impl.value = value
            event = viser.GuiEvent(cast(Any, self.client), CLIENT, handle)
            self.run(*(cb(event) for cb in handle._impl.update_cb))
        else:
            self.run(
                self.gui._handle_gui_updates(CLIENT, messages.GuiUpdateMessage(handle._impl.uuid, {"value": value}))
            )

    def move(self, name: str, position: Any, wxyz: Any = (1.0, 0.0, 0.0, 0.0)) -> None:
        self.run(
            self.scene._handle_transform_controls_drag_start(CLIENT, messages.TransformControlsDragStartMessage(name)),
            self.scene._handle_transform_controls_updates(
                CLIENT, messages.TransformControlsUpdateMessage(name, wxyz, position)
            ),
            self.scene._handle_transform_controls_drag_end(CLIENT, messages.TransformControlsDragEndMessage(name)),
        )

    def click(self, name: str) -> None:
        message = messages.SceneNodeClickMessage(name, None, (0.8, -1.6, 0.8), (0.0, 1.0, 0.0), (0.5, 0.5), None)
        self.run(self.scene._handle_node_click_updates(CLIENT, message))

    def point(self, origin: Any, direction: Any) -> None:
        """Click on the scene along a ray."""
        message = messages.ScenePointerMessage("click", origin, direction, ((0.5, 0.5),), None)
        self.run(self.scene._handle_scene_pointer_updates(CLIENT, message))

    def drag(self, name: str, start: Any, end: Any, phase: Any = "update") -> None:
        at = {"start_position": start, "end_position": end}
        at |= {"start_screen_pos": (0.5, 0.5), "end_screen_pos": (0.5, 0.5)}
        message = messages.SceneNodeDragMessage(
            phase=phase, name=name, instance_index=None, button="left", modifier=None, **at
        )
        self.run(self.scene._handle_node_drag(CLIENT, message))

    def done(self) -> None:
        """Wait until the work of buttons is done."""
        assert self.session.jobs.wait_idle(EDITS, PATIENCE)

    def settle(self) -> None:
        """Wait until nothing is done any more but that the arm moves."""
        wait_until(lambda: {*self.session.jobs._lanes} <= {ARM})

    def begin(self, scenario: Scenario) -> None:
        self.session.edit("test", **all_of(scenario))

    def busy(self, **view: Any) -> Scenario:
        """A scenario in which most controls are shown, and most things stand in the scene; all else is as at first."""
        assert self.session.jobs.wait_idle(CHOOSING, PATIENCE)
        self.visitor._panel.opening.close()
        obstacles = (Cylinder(MIDDLE, 0.08, 0.16), Box(MIDDLE, (0.1, 0.1, 0.1)), Sphere(MIDDLE))
        avoidance = {"space": "cspace", "duration": 0.5, "integration": Integration("rk4", 8)}
        layers = biases(BiasPoint(MIDDLE, radius=0.1, strength=0.5))
        scenario = replace(
            changed(self._initial, obstacles=obstacles, layers=layers, **avoidance),
            starts=starts_at((0.1, -0.5, 0.4), (0.2, -0.5, 0.4)),
            view=View(generator=True, click_to_start=True, handles=True, **view),
        )
        self.begin(scenario)
        return self.session.scenario


class Bound(Bindings):
    """Bindings whose inputs are found by their label, connected to a session that adopts each edit."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__()
        self._inputs: dict[str, list[SimpleNamespace]] = {}
        self.edited = Edited(scenario, self)
        self.connect(cast(Session, self.edited))

    def input(self, handle: Any, read: Any, change: Any, **properties: Any) -> Control:
        control = super().input(handle, read, change, **properties)
        self._inputs.setdefault(handle.label, []).append(SimpleNamespace(control=control, read=read, change=change))
        return control

    def inputs(self, label: str | None = None, *, visible: bool) -> list[SimpleNamespace]:
        """Those with this label, or all."""
        found = [item for items in self._inputs.values() for item in items] if label is None else self._inputs[label]
        return [item for item in found if item.control.handle.visible == visible]

    def __getitem__(self, label: str) -> SimpleNamespace:
        """The visible input with this label."""
        (found,) = self.inputs(label, visible=True)
        return found

    def set(self, label: str, value: Any) -> None:
        """Edit the scenario as this input does."""
        self.edited.edit(label, **self[label].change(self.edited.scenario, value))


class Edited:
    """A session that keeps the scenario of its edits, and shows it on a panel if there is one."""

    taught: Any = MappingProxyType({})

    def __init__(self, scenario: Scenario, panel: Any = None) -> None:
        self.scenario, self.task, self._panel = scenario, TASKS[scenario.task](), panel
        self.steps = 0  # for undo
        self.said: list[tuple[str, Severity]] = []
        self.jobs = Jobs(lambda error: self.say(str(error), Severity.ALARM))
        self._adopt()

    def edit(self, _gesture: str, **changes: Any) -> None:
        self.scenario = replace(self.scenario, **changes)
        self._adopt()

    def step(self, gesture: str, **changes: Any) -> None:
        self.edit(gesture, **changes)
        self.steps += 1

    def say(self, text: str, severity: Severity) -> None:
        self.said.append((text, severity))

    def _adopt(self) -> None:
        if self._panel is not None:
            self._panel.adopt(self.scenario)
