"""Videos that a page saves: what their frames show, how they are encoded, and that nothing of them stays."""

import sys
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from decoding import decoded
from pages import NoFrames, Page, all_of, wait_until

from dt_viz.obstacles.shapes import rotation
from dt_viz.session.frame import Stage
from dt_viz.session.progress import Pace
from dt_viz.ui.scene.camera import TURN, shot_of
from dt_viz.ui.scene.export import MOTION, TURNTABLE, WARP, FilmSettings
from dt_viz.ui.scene.palette import DARK, LIGHT

SHORT = FilmSettings(rate=5, motion=1.0, turn=2.0, warp=0.8, rest=0.4)
SIZE = 1280, 720


class Camera:
    """A browser that renders, of what the page has sent, a colour that tells the number of the frame."""

    def __init__(self, page):
        self.page, self.shots, self.seen = page, [], []
        self.waits, self.goes_on = threading.Event(), threading.Event()
        self.goes_on.set()
        self.size = SIZE

    def get_render(self, height, width, *, wxyz, position, fov, **_how):
        self.waits.set()
        assert self.goes_on.wait(30)
        self.shots.append((np.array(wxyz), np.array(position), fov))
        self.seen.append(self.look())
        frame = np.zeros((self.size[1], self.size[0], 4), np.uint8)
        frame[: self.size[1] // 2] = (*(len(self.seen) * np.array([9, 5, 2])).clip(0, 255), 255)
        return frame

    def look(self):
        arms = self.page.visitor.robot.arms.arm.frames[1:]
        handles = [gizmo.opacity for gizmo in self.page.gizmos.values()]
        return np.array([frame.wxyz for frame in arms]), handles


@pytest.fixture(scope="module")
def frame(at_rest, initial):
    return at_rest(initial("draw_s"), Stage.CERTIFIED)


@pytest.fixture
def filming(server, robot, frame, engine, monkeypatch, tmp_path):
    """A page that shows a motion, held at a moment of it, and what renders it."""
    for module in ("page", "scene.export"):
        monkeypatch.setattr(f"dt_viz.ui.{module}.SETTINGS", SHORT)
    fine = lambda _self, scenario, cancelled: engine.fine(scenario, cancelled)  # noqa: E731
    monkeypatch.setattr(NoFrames, "fine", fine, raising=False)
    page: Any = Page(server, robot)
    page.sent, page.browser, page.file = [], Camera(page), tmp_path / "video"
    page.client.send_file_download = lambda name, content, **_how: page.sent.append((name, content))
    page.client.get_render = page.browser.get_render
    view = replace(frame.scenario.view, replay=True, handles=True)
    page.session.edit("test", **all_of(replace(frame.scenario, view=view)))
    visitor = page.visitor
    visitor._previews = False
    visitor.shown = frame
    visitor.pictures.draw(frame)
    visitor.robot.draw(frame, visitor.pictures.look)
    player = visitor.robot.playback.replay
    player.seek(0.3 * player.duration)
    page.camera.wxyz = shot_of((page.camera.position, page.camera.look_at)).wxyz
    shown = robot.joint_frames(player.q)
    wait_until(lambda: np.allclose(page.browser.look()[0], shown, atol=0.01))
    yield page
    page.browser.goes_on.set()
    page.close()
    server.gui.reset()
    server.scene.reset()


def begin(page, what, suffix=".mp4"):
    page.claim(page["Save as"], suffix[1:].upper())
    page.claim(page["Video of"], what)
    button = page["Save video"]
    page.claim(button, True)
    return button


def save(page, what, suffix=".mp4"):
    """The file of a video, or what is said in its place."""
    begin(page, what, suffix)
    assert page.session.jobs.wait_idle("Save picture", 60)
    if not page.sent:
        return page.session._screen.progress.message.text
    ((name, content),) = page.sent
    assert name == f"dt-viz-draw_s{suffix}"
    page.file.write_bytes(content)
    return page.file


def state(page):
    """All that a video must leave as it was: the scene, where the camera and the timeline are, and the scenario."""
    nodes = {
        name: (np.round(node.position, 6).tolist(), np.round(node.wxyz, 6).tolist(), node.visible)
        for name, node in page.nodes.items()
    }
    handles = {name: (gizmo.scale, gizmo.opacity) for name, gizmo in page.gizmos.items()}
    playback, camera = page.visitor.robot.playback, page.camera
    player = playback.replay
    timeline = id(playback.arm), id(player.motion), player.clock, player.playing, playback.film
    pose = [np.array(at).tolist() for at in (camera.position, camera.look_at, camera.wxyz)]
    return nodes, handles, timeline, pose, page.session.scenario, page["Save as"].value


def as_before(page, before):
    wait_until(lambda: [a for a, b in zip(before[:-1], state(page)[:-1], strict=True) if a != b] == [])


@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_motion_goes_from_its_start_to_its_goal_and_rests(filming, frame, robot, suffix):
    before = state(filming)
    told, frames = decoded(file := save(filming, MOTION, suffix))
    assert f"{SHORT.rate} fps" in told and frames.shape[1:] == (SIZE[1], SIZE[0], 3)
    if suffix == ".mp4":  # slide programs play it
        content = file.read_bytes()
        assert "Video: h264" in told and "yuv420p(tv, bt709" in told
        assert content.index(b"moov") < content.index(b"mdat")
    assert len(filming.browser.seen) == 6 and len(frames) == 6 + 2
    joints, handles = zip(*filming.browser.seen, strict=True)
    for k, part in enumerate(np.linspace(0, 1, 6)):
        moment = part * frame.arm.times[-1]
        q = np.array([np.interp(moment, frame.arm.times, angles) for angles in frame.arm.q.T])
        np.testing.assert_allclose(joints[k], robot.joint_frames(q), atol=5e-3)
    assert not np.any(handles)
    middles = frames[:, 180, 640].astype(int)  # of the upper half, which tells the number
    np.testing.assert_allclose(middles[:6], np.arange(1, 7)[:, None] * [9, 5, 2], atol=4)
    np.testing.assert_allclose(middles[6:], middles[[5, 5]], atol=2)
    assert frames[:, 600, 1000].min() > 250  # what is transparent is white
    as_before(filming, before)


def test_a_turntable_goes_around_the_middle_once(filming):
    before = state(filming)
    _, frames = decoded(save(filming, TURNTABLE))
    assert len(frames) == len(filming.browser.shots) == 10
    camera = filming.visitor.camera
    first = camera.shot(SIZE)
    middle = first.position + camera.depth * rotation(tuple(first.wxyz))[:, 2]
    np.testing.assert_allclose(filming.browser.shots[0][1], first.position, atol=1e-9)
    angles = []
    for wxyz, position, fov in filming.browser.shots:
        assert fov == first.fov
        np.testing.assert_allclose(position + camera.depth * rotation(tuple(wxyz))[:, 2], middle, atol=1e-6)
        assert position[2] == pytest.approx(first.position[2])
        angles.append(np.arctan2(*(position - middle)[1::-1]))
    np.testing.assert_allclose(np.diff(np.unwrap([*angles, angles[0]])), 2 * np.pi / 10, atol=1e-6)
    assert np.ptp([joints for joints, _ in filming.browser.seen], axis=0).max() == 0
    as_before(filming, before)


@pytest.mark.long
def test_the_warp_goes_from_straight_motions_to_the_whole_stack(filming, frame, engine, robot, monkeypatch):
    before, drawn = state(filming), []
    draw = filming.visitor.pictures.draw
    monkeypatch.setattr(filming.visitor.pictures, "draw", lambda frame: (drawn.append(frame), draw(frame)))
    last = dict(engine._last)
    assert len(decoded(save(filming, WARP))[1]) == 5 + 2
    assert [warped.scenario.warp for warped in drawn[:-1]] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert drawn[-1] is frame is filming.visitor.shown  # it is shown again
    ends = drawn[0].rollouts[0][[0, -1]]
    along = (drawn[0].rollouts[0] - ends[0]) @ (ends[1] - ends[0]) / np.sum(np.square(ends[1] - ends[0]))
    off = np.linalg.norm(drawn[0].rollouts[0] - ends[0] - along[:, None] * (ends[1] - ends[0]), axis=1)
    assert off.max() < 1e-3
    np.testing.assert_allclose(drawn[-2].rollouts[0][-1], frame.rollouts[0][-1], atol=1e-3)
    for warped, (joints, _) in zip(drawn[:-1], filming.browser.seen, strict=True):
        moment = SHORT.along * warped.arm.times[-1]
        q = np.array([np.interp(moment, warped.arm.times, angles) for angles in warped.arm.q.T])
        np.testing.assert_allclose(joints, robot.joint_frames(q), atol=5e-3)
    assert engine._last == last
    as_before(filming, before)


@pytest.mark.parametrize("what", [MOTION, TURNTABLE, WARP])
def test_it_is_cancelled_at_once_though_the_browser_is_busy(filming, what):
    before, browser = state(filming), filming.browser
    browser.goes_on.clear()
    button = begin(filming, what)
    assert browser.waits.wait(30) and button.label == "Cancel"
    filming.claim(button, True)
    assert filming.session.jobs.wait_idle("Save picture", 10)  # while the browser renders still, for 30 s
    assert button.label == "Save video" and not filming.sent
    as_before(filming, before)
    browser.goes_on.set()


def test_an_edit_ends_it_and_is_shown(filming, frame):
    browser, visitor, edited = filming.browser, filming.visitor, replace(frame, stage=Stage.FINE)
    browser.goes_on.clear()
    begin(filming, MOTION)
    assert browser.waits.wait(30)
    drawing = threading.Thread(target=visitor.draw, args=(edited, Pace(0.02, 10.0, 0)))
    drawing.start()
    drawing.join(0.5)
    assert drawing.is_alive() and visitor.pictures._frame is frame  # it waits
    filming.session.step("test", warp=0.5)
    drawing.join(10)
    assert visitor.pictures._frame is edited is visitor.shown
    assert filming.session.jobs.wait_idle("Save picture", 10)
    message = filming.session._screen.progress.message.text
    assert message.startswith("Save video: the scene: found an edit while it was filmed") and not filming.sent
    assert filming.session.scenario.warp == 0.5 and filming.visitor.robot.playback.film is None


@pytest.mark.long
def test_what_moves_waits_and_the_theme_that_is_chosen_comes_afterwards(filming, monkeypatch):
    visitor, browser = filming.visitor, filming.browser
    visitor.robot.playback.replay.play()
    visitor.camera.orbits = True
    visitor.camera._shown = visitor.shown.task, (), "Home"
    visitor.camera._given.append((np.array(filming.camera.position), np.array(filming.camera.look_at)))
    wait_until(lambda: visitor.camera._turned is not None)
    browser.goes_on.clear()
    begin(filming, TURNTABLE)
    assert browser.waits.wait(30)
    clock, place = visitor.robot.playback.replay.clock, np.array(filming.camera.position)
    filming.claim(filming["Dark theme"], True)
    filming.done()
    visitor.robot.playback.advance(1.0)
    assert visitor.pictures._theme is LIGHT and visitor._studio.theme is DARK
    assert visitor.robot.playback.replay.clock == clock and np.array_equal(filming.camera.position, place)
    browser.goes_on.set()
    assert filming.session.jobs.wait_idle("Save picture", 60)
    wait_until(lambda: not np.array_equal(filming.camera.position, place))
    turned = np.linalg.norm(filming.camera.position - place) / np.linalg.norm(place - filming.camera.look_at)
    assert turned < 0.5 * TURN  # it goes on from where it was
    assert visitor.pictures._theme is DARK
    visitor.camera.orbits = False
    filming.claim(filming["Dark theme"], False)
    filming.done()


WRONG = {
    "no answer": "the browser, its page out of sight perhaps, drew nothing within 0.3 s",
    "another size": "the browser: found a PNG of 8x8 pixels; accepted: an RGBA PNG of 1280x720 pixels",
    "no picture": "the browser: found no PNG",
    "no ffmpeg": "ffmpeg: found not installed; accepted: pip install 'dt-viz[video]'",
    "broken ffmpeg": "ffmpeg: found a failure (no such codec)",
    "no motion": "the motion: found none that the arm follows",
}


@pytest.mark.parametrize("why", WRONG)
def test_what_goes_wrong_is_said_in_a_line_and_nothing_stays(filming, frame, why, monkeypatch, tmp_path):
    browser, before = filming.browser, state(filming)
    if why == "no answer":
        for module in ("page", "scene.export"):
            monkeypatch.setattr(f"dt_viz.ui.{module}.SETTINGS", replace(SHORT, patience=0.3))
        browser.goes_on.clear()
    elif why == "another size":
        browser.size = 8, 8
    elif why == "no picture":
        monkeypatch.setattr(filming.client, "get_render", lambda *_size, **_how: b"")  # as viser's page has failed
    elif why == "no ffmpeg":
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    elif why == "broken ffmpeg":
        (tmp_path / "ffmpeg").write_text("#!/bin/sh\necho no such codec >&2\nexit 1\n")
        (tmp_path / "ffmpeg").chmod(0o755)
        monkeypatch.setattr("dt_viz.pictures.video.ffmpeg", lambda: str(tmp_path / "ffmpeg"))
    else:
        filming.visitor.shown = replace(frame, arm=None)
    text = save(filming, MOTION)
    assert isinstance(text, str) and text.startswith(f"Save video: {WRONG[why]}") and "\n" not in text
    filming.visitor.shown = frame
    as_before(filming, before)
    browser.goes_on.set()


def test_controls_of_videos_come_with_their_formats_and_take_what_they_offer(filming):
    shown = lambda: {handle.label for handle in filming.inputs if handle.visible}  # noqa: E731
    assert not {"Video of", "Save video"} & shown()
    filming.claim(filming["Resolution"], "3840 × 2160")
    filming.claim(filming["Save as"], "GIF")
    assert {"Video of", "Save video", "Resolution"} <= shown() and "Transparent" not in shown()
    assert filming["Resolution"].value == "1920 × 1080"
    for label, forged in (("Resolution", "3840 × 2160"), ("Video of", "Everything"), ("Video of", 7)):
        before = filming[label].value
        filming.claim(filming[label], forged)
        assert filming[label].value == before
    filming.claim(filming["Save as"], "PNG")
    assert not {"Video of", "Save video"} & shown() and "3840 × 2160" in filming["Resolution"].options
