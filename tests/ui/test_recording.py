"""A page that replays a motion without a server: what its recording holds."""

import base64
import re
from dataclasses import replace

import msgspec.msgpack
import numpy as np
import pytest
import zstandard

from dt_viz.errors import UnwantedError, end_if
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Stage
from dt_viz.session.robot_loop import RoundSettings
from dt_viz.ui.patches import Tape
from dt_viz.ui.scene.arm import ArmFrames
from dt_viz.ui.scene.figure import key_of
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.recording import RATE, record

MOST = 5e6  # largest size of a page, bytes


@pytest.fixture(scope="module")
def frame(at_rest, initial):
    return at_rest(initial("draw_s"), Stage.CERTIFIED)


@pytest.fixture(scope="module")
def page(frame, engine):
    return record(frame, engine.follower)


def recorded(page):
    """Duration, seconds, and messages with their times, of a page."""
    found = re.search(rb'__VISER_EMBED_DATA__="([^"]+)"', page)
    assert found is not None
    data = base64.b64decode(found[1])
    size = int.from_bytes(data[:8], "little")
    inner = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=size)
    length = int.from_bytes(inner[:8], "little")
    held = msgspec.msgpack.decode(inner[8 : 8 + length])
    return held["durationSeconds"], held["messages"]


def test_it_is_titled_and_small(page, frame):
    assert len(page) < MOST
    assert f"<title>{frame.task.title} – DT-Viz</title>" in page.decode()


def test_a_legend_names_what_is_shown_with_the_scale_of_the_slice(page, at_rest, engine, initial):
    assert "<summary>Legend</summary>" in page.decode() and "det J" not in page.decode()
    shown = View(demonstrations=False, colour="det")
    frame = at_rest(replace(initial("draw_s"), view=shown), Stage.CERTIFIED)
    assert [name for name, _ in key_of(frame).names] == ["undisturbed", "rollouts", "obstacle", "goal"]
    assert dict(key_of(frame).names)["rollouts"] == LIGHT.rollout
    assert "det J: volume" in record(frame, engine.follower).decode()


def test_its_joints_go_along_the_frames_motion(page, frame, robot):
    duration, messages = recorded(page)
    np.testing.assert_allclose(duration, frame.arm.times[-1] + RoundSettings.rest, atol=1 / RATE)
    turns = [(time, told) for time, told in messages if told["type"] == "SetOrientationMessage"]
    assert len({time for time, _ in turns}) > 0.6 * duration * RATE
    tape = Tape()
    expected = ArmFrames(tape.scene, robot, "/arm")
    for joint in range(robot.num_joints):
        name = expected.frames[joint + 1].name
        own = [(time, told["wxyz"]) for time, told in turns if told["name"] == name]
        for time in np.linspace(0, frame.arm.times[-1], 7):
            q = np.array([np.interp(time, frame.arm.times, frame.arm.q[:, k]) for k in range(robot.num_joints)])
            expected.pose(q)
            newest = [wxyz for when, wxyz in own if when <= time + 1e-9][-1]
            dot = abs(np.dot(newest, expected.frames[joint + 1].wxyz))
            assert 2 * np.arccos(min(1.0, dot)) < 0.05  # rad: a joint turns by less until the next posture


def test_it_holds_what_the_frame_shows_and_nothing_else_of_the_server(page, frame, engine, server):
    server.scene.add_frame("/of-somebody-else")
    duration, messages = recorded(record(frame, engine.follower))
    assert (duration, len(messages)) == (recorded(page)[0], len(recorded(page)[1]))
    assert "of-somebody-else" not in str(messages)
    assert not [told["type"] for _, told in messages if told["type"].startswith(("Gui", "RunJavascript"))]
    assert {told["owner"] for _, told in messages if "owner" in told} == {""}
    assert not re.search(rb"127\.0\.0\.1:|/home/|/root/", page)


def test_without_a_motion_of_the_arm_nothing_moves(frame, engine):
    duration, messages = recorded(record(replace(frame, arm=None), engine.follower))
    assert duration == 0 and {time for time, _ in messages} == {0}


def test_the_camera_is_where_the_visitor_has_put_it(frame, engine):
    pose = np.array([1.0, -2.0, 0.5]), np.array([0.1, 0.2, 0.3])
    _, messages = recorded(record(frame, engine.follower, pose))
    told = {message["type"]: message for _, message in messages if message.get("initial")}
    assert told["SetCameraPositionMessage"]["position"] == [1.0, -2.0, 0.5]
    assert told["SetCameraLookAtMessage"]["look_at"] == [0.1, 0.2, 0.3]


def test_it_can_be_cancelled_at_any_moment(frame, engine):
    parts = []

    def step(part):
        parts.append(part)
        end_if(lambda: part > 0.5)

    with pytest.raises(UnwantedError):
        record(frame, engine.follower, step=step)
    assert parts == sorted(parts) and parts[0] == 0 and parts[-1] < 0.52
