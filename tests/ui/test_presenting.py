"""One presenter and those who watch: real connections to the server that `--present` starts."""

import asyncio
import contextlib
import json
import urllib.error
import urllib.request
import warnings

import numpy as np
import pytest
from pages import asynchronous, come_true, wait_until
from protocol_client import OBSTACLE, ROLLOUT, LostError, ProtocolClient

from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import OFFERS
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui import presenting
from dt_viz.ui.keeping import KEY as KEPT
from dt_viz.ui.presenting import AWAY, CARD, OWN_MACHINE, TAKEN, WRONG, reachable
from dt_viz.ui.scene.camera import Framing, followed
from dt_viz.ui.server import Server

KEY = "the-key"
PLACES = 4
FOLLOW = "Follow the presenter's camera"
PATIENCE = 90.0  # seconds that anything may take: the machine may be busy
LOOK_AT = (0.1, -0.5, 0.4)
CAMERA = ("SetCameraPositionMessage", "SetCameraLookAtMessage")


@pytest.fixture(scope="module")
def server(fits):
    server = Server(TASKS, fits, load_jaco(), task="draw_s", port=0, max_sessions=PLACES, key=KEY)
    yield server
    server.close()


@pytest.fixture
def url(server):
    """Of the WebSocket; nobody is left over from another test."""
    wait_until(lambda: not server._server.get_clients() and not server.visitors, PATIENCE)
    return f"ws://127.0.0.1:{server.port}"


class Guest(ProtocolClient):
    """Somebody with a page, whose camera is known, and who may tell a key as its script does."""

    def __init__(self, url, **options):
        super().__init__(url, **options)
        self.cameras, self.kinds = [], set()

    def _apply(self, message, now):
        self.kinds.add(message["type"])
        if message["type"] == CAMERA[0]:
            self.cameras.append(np.array(message["position"]))
        super()._apply(message, now)

    def says(self, text):
        return any(text in str(control) for control in self.controls.values())

    @property
    def gizmo(self):
        return "disable_rotations" in self.nodes[OBSTACLE]

    async def look_from(self, position):
        where = {"position": position, "look_at": LOOK_AT, "up_direction": (0.0, 0.0, 1.0)}
        image = {"fov": 0.75, "near": 0.01, "far": 1000.0, "image_height": 720, "image_width": 1280}
        await self.send("ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), **where, **image)


@contextlib.asynccontextmanager
async def watching(url):
    """A viewer with a card."""
    async with Guest(url) as guest:
        await guest.look()
        assert await guest.wait_for(lambda: guest.says("dt-qr"), PATIENCE)
        yield guest


@contextlib.asynccontextmanager
async def presenting_at(url):
    """The presenter, with the first picture."""
    async with watching(url) as guest:
        await guest.present(KEY)
        assert await guest.wait_for(lambda: guest.has_picture, PATIENCE)
        yield guest


async def moved_to(presenter, place):
    """Drag the first obstacle there."""
    await presenter.grab()
    await presenter.move(place)
    await presenter.release()


def stands_at(guest, place):
    return np.allclose(guest.nodes.get(OBSTACLE, {}).get("position", 0), place)


def same(one, other):
    """Whether two pages show the same nodes, alike."""

    def told(nodes):
        return {name: {k: v for k, v in node.items() if k != "owner"} for name, node in nodes.items()}

    a, b = told(one.nodes), told(other.nodes)
    return a.keys() == b.keys() and all(
        a[name].keys() == b[name].keys() and all(np.array_equal(a[name][k], b[name][k]) for k in a[name]) for name in a
    )


@pytest.mark.long
@asynchronous
async def test_viewers_see_what_the_presenter_draws_early_or_late(url, server):
    async with watching(url) as early, presenting_at(url) as presenter:
        await presenter.set("Pause", True)
        await moved_to(presenter, (0.12, -0.5, 0.4))
        assert await early.wait_for(lambda: stands_at(early, (0.12, -0.5, 0.4)), PATIENCE)
        assert await early.wait_for(lambda: early.says("✓ safe"), PATIENCE)
        assert np.ptp(early.nodes[ROLLOUT]["vertices"]) > 0
        async with watching(url) as late:
            await come_true(lambda: same(early, late))
            mine, theirs = presenter.nodes, late.nodes
            await come_true(lambda: np.array_equal(mine[ROLLOUT]["vertices"], theirs[ROLLOUT]["vertices"]))
            await come_true(lambda: early.says("Draw S") and late.says("Draw S"))
            assert not late.gizmo and presenter.gizmo


@asynchronous
async def test_nothing_that_a_viewer_sends_changes_the_scene_and_no_handle_reaches_him(url, server):
    async with presenting_at(url) as presenter, watching(url) as viewer:
        assert await viewer.wait_for(lambda: viewer.has_rollouts, PATIENCE)
        (visitor,) = server.visitors
        await presenter.set("Handles", True)
        await presenter.set(OFFERS["click_to_start"].label, True)
        assert await presenter.wait_for(lambda: presenter.kinds >= HANDLES, PATIENCE)
        assert not viewer.kinds & HANDLES
        assert [one["label"] for one in viewer.controls.values() if "label" in one] == ["Window", FOLLOW]
        before = visitor.session.scenario
        for owner in ("", viewer.nodes[OBSTACLE]["owner"], presenter.nodes[OBSTACLE]["owner"]):
            await forge(viewer, presenter, owner)
        assert await presenter.ping() < PATIENCE and await viewer.ping() < PATIENCE
        assert visitor.session.wait_idle(PATIENCE)
        assert visitor.session.scenario == before and not viewer.lost
        assert not stands_at(viewer, FORGED) and not stands_at(presenter, FORGED)


FORGED = (0.2, -0.4, 0.5)
HANDLES = {
    "TransformControlsMessage",
    "SetSceneNodeDragBindingsMessage",
    "SetSceneNodeClickBindingsMessage",
    "ScenePointerEnableMessage",
}
"""Messages by which a page gets something to click or to drag."""


async def forge(viewer, presenter, owner):
    """Send what only the presenter's page may, in his name or another."""
    pose = {"name": OBSTACLE, "owner": owner}
    await viewer.send("TransformControlsDragStartMessage", **pose)
    await viewer.send("TransformControlsUpdateMessage", **pose, wxyz=(1.0, 0.0, 0.0, 0.0), position=FORGED)
    await viewer.send("TransformControlsDragEndMessage", **pose)
    ray = {"ray_origin": (0.8, -1.6, 0.8), "ray_direction": (0.0, 1.0, 0.0)}
    clicked = {"name": f"{OBSTACLE}/surface", "owner": owner, "instance_index": None, "modifier": None}
    await viewer.send("SceneNodeClickMessage", **clicked, **ray, screen_pos=(0.5, 0.5))
    places = {"start_position": (0.0, 0.0, 0.0), "end_position": FORGED}
    places |= {"start_screen_pos": (0.5, 0.5), "end_screen_pos": (0.6, 0.5)}
    for phase in ("start", "update", "end"):
        await viewer.send("SceneNodeDragMessage", **clicked, **places, button="left", phase=phase)
    await viewer.send("ScenePointerMessage", event_type="click", modifier=None, **ray, screen_pos=((0.5, 0.5),))
    for label, value in (("Imitate", False), ("Avoid", "Off"), ("Task", "Draw J")):
        await viewer.send("GuiUpdateMessage", uuid=presenter.find(label), updates={"value": value})


@asynchronous
async def test_a_wrong_key_is_answered_once_changes_nothing_and_ends_the_connection(url, server):
    async with presenting_at(url) as presenter, watching(url) as viewer:
        num_controls = len(viewer.controls)
        with pytest.raises(LostError):
            for number in range(10**6):
                await viewer.present(f"another-key-{number}")
                await asyncio.sleep(0.001)
        assert viewer.notices == [WRONG] and len(viewer.controls) == num_controls + 1  # a script that forgets the key
        assert server._lecture.presenter.client_id == server.visitors[0].client.client_id
        assert len(server.visitors) == 1 and not presenter.lost and not viewer.says("Show address")


@pytest.mark.long
@asynchronous
async def test_who_comes_later_with_the_key_takes_over_and_who_leaves_is_missed(url, server):
    async with watching(url) as viewer:
        async with presenting_at(url) as first:
            await moved_to(first, (0.12, -0.5, 0.4))
            assert await viewer.wait_for(lambda: stands_at(viewer, (0.12, -0.5, 0.4)), PATIENCE)
            assert await first.wait_for(lambda: "0.12" in first.storage.get(KEPT, ""), PATIENCE)
            (before,), kept = server.visitors, dict(first.storage)
            await first.set("Add", "Sphere")
            assert await viewer.wait_for(lambda: "/obstacles/1" in viewer.nodes, PATIENCE)
            async with Guest(url) as second:
                second.storage = kept  # what this browser kept before
                await second.look()
                assert await second.wait_for(lambda: second.says("dt-qr"), PATIENCE)
                await second.present(KEY)
                with pytest.raises(LostError):
                    await first.wait_for(lambda: False, PATIENCE)
                assert TAKEN in first.notices and first.says("removeItem")
                assert await second.wait_for(lambda: second.has_picture, PATIENCE)
                assert await second.wait_for(lambda: stands_at(second, (0.12, -0.5, 0.4)), PATIENCE)
                assert await viewer.wait_for(lambda: "/obstacles/1" not in viewer.nodes, PATIENCE)
                await moved_to(second, (0.1, -0.55, 0.4))
                assert await viewer.wait_for(lambda: stands_at(viewer, (0.1, -0.55, 0.4)), PATIENCE)
                await come_true(lambda: not viewer.says(AWAY))  # it is told twice a second
                await come_true(lambda: len(server.visitors) == 1)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # he has gone
                    before.client.scene.add_frame("/gone")
                assert await second.ping() < PATIENCE and "/gone" not in viewer.nodes
                kept = server._server._websock_server.get_message_buffer().message_from_id  # that whoever comes is sent
                assert not any(getattr(one, "name", "") == "/gone" for one in [*kept.values()])
        assert await viewer.wait_for(lambda: viewer.says(AWAY), PATIENCE)
        assert viewer.has_rollouts and stands_at(viewer, (0.1, -0.55, 0.4))


@pytest.mark.long
@asynchronous
async def test_the_camera_follows_until_that_is_switched_off_and_again_from_then_on(url, server):
    async def sees(place, guest, seconds=PATIENCE):
        await presenter.look_from(place)
        pose = np.array(place), np.array(LOOK_AT)
        seen, _ = followed(pose, Framing(), CARD)
        return await guest.wait_for(lambda: guest.cameras and np.allclose(guest.cameras[-1], seen, atol=0.02), seconds)

    async with presenting_at(url) as presenter, watching(url) as viewer:
        viewer.cameras.clear()
        assert await sees((0.3, -2.0, 0.8), viewer)
        assert len(viewer.cameras) <= 2  # nothing where nothing moves
        await viewer.set(FOLLOW, False)
        assert not await sees((0.9, -2.0, 0.9), viewer, 2.0)
        await viewer.set(FOLLOW, True)
        assert await sees((0.9, -2.0, 0.9), viewer)
        followed_last = viewer.cameras[-1]
        await viewer.set(FOLLOW, False)
        await viewer.look_from((-0.5, -1.5, 0.6))
        viewer.cameras.clear()
        await viewer.set(FOLLOW, True)  # while the presenter's rests
        assert await viewer.wait_for(lambda: viewer.cameras, PATIENCE)
        np.testing.assert_allclose(viewer.cameras[-1], followed_last, atol=1e-6)


def test_who_follows_sees_all_that_the_presenter_sees_and_in_the_same_window_the_same():
    pose = np.array([0.3, -2.0, 0.8]), np.array([0.1, 0.2, 0.3])
    same_window = followed(pose, Framing(), Framing())
    np.testing.assert_allclose(same_window[0], pose[0], atol=1e-9)
    phone = Framing((390, 844), panel=0.0, under=0.36)
    back = followed(followed(pose, Framing(), phone), phone, Framing())
    ahead = pose[1] - pose[0]
    assert (followed(pose, Framing(), phone)[0] - pose[0]) @ ahead < 0  # from farther away
    np.testing.assert_allclose(np.cross(back[1] - back[0], ahead), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("page", "host", "own"),
    [
        ("https://demo.example.org", "127.0.0.1", True),
        ("http://10.0.0.7:8080", "0.0.0.0", True),
        ("http://127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:8080", "0.0.0.0", False),
    ],
)
def test_the_address_of_viewers_is_the_presenters_unless_only_this_machine_gets_there(monkeypatch, page, host, own):
    class Network:
        def __init__(self, *_kind):
            pass

        __enter__ = lambda self: self  # noqa: E731
        __exit__ = lambda *_: None  # noqa: E731
        connect = lambda *_: None  # noqa: E731
        getsockname = lambda _: ("192.168.1.5", 9)  # noqa: E731

    monkeypatch.setattr(presenting.socket, "socket", Network)
    assert reachable(page, host) == (f"{page}/" if own else "http://192.168.1.5:8080/")


@asynchronous
async def test_the_presenter_gets_in_where_all_places_are_taken_and_health_counts_him(url, server):
    def health():
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/health") as answer:
                return json.load(answer)
        except urllib.error.HTTPError as error:
            return json.load(error)

    assert server.gate.of_address == server.gate.connections  # a hall may have one address
    async with contextlib.AsyncExitStack() as stack:
        for _ in range(PLACES):
            await stack.enter_async_context(watching(url))
        assert {"status": "full", "visitors": PLACES, "waiting": 0}.items() <= health().items()
        late = await stack.enter_async_context(Guest(url))
        await late.look()
        assert await late.wait_for(lambda: late.says("places are taken"), PATIENCE)
        assert health()["waiting"] == 1
        await late.present(KEY)
        assert await late.wait_for(lambda: late.has_picture, PATIENCE)
        assert not late.says("places are taken")
        assert {"visitors": PLACES + 1, "waiting": 0}.items() <= health().items()
        assert late.says(OWN_MACHINE)
