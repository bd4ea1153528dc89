"""What a visitor takes home: files of the joints and figures, made beside the server's event loop, or one line why."""

import io
import re
import threading
from dataclasses import replace

import numpy as np
import pytest
import yaml
from pages import Page, wait_until
from PIL import Image
from viser._gui_handles import GuiProgressBarHandle  # noqa: TID251

from dt_viz.checkpoints import checked
from dt_viz.control.settings import ControllerSettings
from dt_viz.errors import UnwantedError
from dt_viz.session.frame import Stage
from dt_viz.ui.scene import figure
from dt_viz.ui.scene.figure import SUFFIXES, render_figure
from dt_viz.ui.scene.picture import Look
from dt_viz.warning import ARM, Kind, MotionWarning

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of matplotlib's own parts


@pytest.fixture(scope="module")
def saving(server, robot):
    """A page that keeps what it sends to its visitor."""
    page = Page(server, robot)
    sent: list = []
    page.client.send_file_download = lambda name, content, **_how: sent.append((name, content))
    page.sent = sent  # type: ignore[attr-defined]
    yield page
    page.close()


@pytest.fixture
def frame(at_rest, initial):
    return at_rest(initial("draw_s"), Stage.FINE)


def press(page, label):
    """Press a button, and return what the visitor is sent and told."""
    page.sent.clear()
    page.claim(page[label], True)
    assert page.session.jobs.wait_idle(label, 60)
    message = page.session._screen.progress.message
    return list(page.sent), "" if message is None else message.text


def bars(page):
    """Progress bars that are seen."""
    handles = page.gui._gui_input_handle_from_uuid.values()
    return [handle for handle in handles if isinstance(handle, GuiProgressBarHandle) and handle.visible]


def shown(page, frame):
    page.visitor._panel.bindings.report(frame)
    page.visitor.shown = frame


def test_the_joints_are_saved_in_each_format_as_the_frame_has_them(saving, frame, robot):
    shown(saving, frame)
    for chosen, suffix in (("ROS 2 YAML", ".yaml"), ("CSV", ".csv"), ("npz", ".npz")):
        saving.claim(saving["Joints as"], chosen)
        ((name, content),), _ = press(saving, "Save joints")
        assert name == f"dt-viz-draw_s{suffix}"
        if suffix == ".yaml":
            points = yaml.safe_load(content)["points"]
            ends = np.array([points[k]["positions"] for k in (0, -1)])
            accelerations = np.abs([point["accelerations"] for point in points])
        elif suffix == ".csv":
            table = np.loadtxt(io.BytesIO(content), delimiter=",", skiprows=1)
            ends, accelerations = table[[0, -1], 1:7], np.abs(table[:, 13:])
        else:
            arrays = np.load(io.BytesIO(content))
            ends, accelerations = arrays["positions"][[0, -1]], np.abs(arrays["accelerations"])
        np.testing.assert_allclose(ends, frame.arm.q[[0, -1]], atol=1e-8)
        assert 0.1 < accelerations.max() <= ControllerSettings.acceleration


@pytest.mark.parametrize("why", ["none shown", "blocked", "missed"])
def test_a_motion_that_the_arm_does_not_follow_has_no_file_and_one_line_says_why(saving, frame, why):
    text = "the arm misses the path of rollout 1 by up to 31 mm"
    missed = MotionWarning(Kind.PATH_MISSED, text, ARM)
    without = {
        "none shown": replace(frame, arm=None),
        "blocked": replace(frame, blocked=(MotionWarning(Kind.ARM_BLOCKED, "the goal is inside", ARM),)),
        "missed": replace(frame, certificates=frame.certificates.warning(missed)),
    }
    shown(saving, without[why])
    sent, said = press(saving, "Save joints")
    assert not sent and "\n" not in said
    assert {"none shown": "none that is shown", "blocked": "the goal is inside", "missed": text}[why] in said


@pytest.mark.long
def test_a_figure_is_saved_of_what_is_shown(saving, frame):
    shown(saving, frame)
    assert saving["Resolution"].visible
    for suffix in SUFFIXES:
        saving.claim(saving["Save as"], suffix[1:].upper())
        assert not [handle for handle in saving.inputs if handle.label == "Resolution" and handle.visible]
        ((name, content),), _ = press(saving, "Save picture")
        assert name == f"dt-viz-draw_s{suffix}"
        assert content.startswith({".svg": b"<?xml", ".pdf": b"%PDF"}[suffix])
    saving.claim(saving["Save as"], "PNG")
    assert saving["Resolution"].visible
    ((name, content),), _ = press(saving, "Save picture")
    assert name.endswith(".png") and Image.open(io.BytesIO(content)).size == (2, 2)


def test_a_page_that_plays_is_saved_of_what_is_shown(saving, frame):
    shown(saving, frame)
    saving.claim(saving["Save as"], "HTML")
    assert not [handle for handle in saving.inputs if handle.label == "Resolution" and handle.visible]
    ((name, content),), _ = press(saving, "Save picture")
    saving.claim(saving["Save as"], "PNG")
    assert name == "dt-viz-draw_s.html" and "__VISER_EMBED_DATA__" in content.decode()


def test_a_second_press_cancels_and_the_button_comes_back(saving, frame, monkeypatch):
    began, goes_on = threading.Event(), threading.Event()

    def drawn(frame, suffix, step):
        step(0.2)
        began.set()
        assert goes_on.wait(30)
        step(0.4)
        pytest.fail("it goes on")

    monkeypatch.setattr("dt_viz.ui.panel.render_figure", drawn)
    shown(saving, frame)
    saving.claim(saving["Save as"], "SVG")
    saving.sent.clear()
    button = saving["Save picture"]
    saving.claim(button, True)
    assert began.wait(30)
    assert button.label == "Cancel" and [one.value for one in bars(saving)] == [20]
    assert saving.gui._thread_executor.submit(lambda: True).result(timeout=20)  # nobody else waits for it
    saving.claim(button, True)
    goes_on.set()
    wait_until(lambda: button.label == "Save picture")
    assert saving.session.jobs.wait_idle("Save picture", 30) and not saving.sent and not bars(saving)
    saving.claim(saving["Save as"], "PNG")


def test_a_png_is_cancelled_at_once_though_the_browser_is_busy(saving, frame, monkeypatch):
    asked, answers = threading.Event(), threading.Event()

    def render(*_size, **_how):
        asked.set()
        assert answers.wait(30)
        return np.zeros((2, 2, 4), np.uint8)

    monkeypatch.setattr(saving.client, "get_render", render)
    shown(saving, frame)
    saving.sent.clear()
    button, handles = saving["Save picture"], {name: gizmo.opacity for name, gizmo in saving.gizmos.items()}
    saving.claim(button, True)
    assert asked.wait(30)
    assert button.label == "Cancel" and not bars(saving)  # nobody knows how far the browser is
    saving.claim(button, True)
    assert saving.session.jobs.wait_idle("Save picture", 10)  # the browser has not answered, and would after 30 s
    assert button.label == "Save picture" and not saving.sent
    assert {name: gizmo.opacity for name, gizmo in saving.gizmos.items()} == handles
    answers.set()
    ((name, _),), _ = press(saving, "Save picture")
    assert name == "dt-viz-draw_s.png"


def test_a_browser_that_gives_no_png_is_told_of_in_a_line(saving, frame, monkeypatch):
    answers = threading.Event()
    monkeypatch.setattr("dt_viz.ui.visitor.TIMEOUT", 0.2)
    monkeypatch.setattr(saving.client, "get_render", lambda *_size, **_how: answers.wait(30))
    shown(saving, frame)
    sent, said = press(saving, "Save picture")
    answers.set()
    assert not sent and said.startswith("Save picture: the browser, its page out of sight perhaps, drew nothing")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_figure_that_is_drawn_lets_others_go_first_many_times_and_ends_when_it_is_cancelled(frame, suffix):
    asked = []
    with checked(lambda: asked.append(True)):
        render_figure(frame, suffix)
    assert len(asked) > 100

    def end():
        raise UnwantedError

    with checked(end), pytest.raises(UnwantedError):
        render_figure(frame, suffix)


def texts(svg):
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg.decode())


class TestFigure:
    def test_its_text_is_text_and_nothing_in_it_is_pixels(self, frame):
        svg = render_figure(frame, ".svg")
        assert {"rollouts", "demonstrations", "undisturbed", "obstacle", "goal", "10 cm"} <= set(texts(svg))
        assert b"<image" not in svg
        assert b"/Font" in render_figure(frame, ".pdf")

    @pytest.mark.long
    def test_it_has_what_the_view_shows_in_the_pages_colours(self, at_rest, initial):
        scenario = initial("draw_s")
        view = replace(scenario.view, streamlines=True, colour="lyapunov", demonstrations=False, grid=True)
        names = texts(render_figure(at_rest(replace(scenario, view=view), Stage.FINE), ".svg"))
        assert {"streamlines", "warped grid", "Lyapunov value, cm²/s"} <= set(names)
        assert "demonstrations" not in names
        assert sum(name.isdecimal() for name in names) >= 4  # values on the level lines
        svg = render_figure(at_rest(scenario, Stage.FINE), ".svg")
        assert b"#d55e00" in svg and b"#cc79a7" in svg

    def test_compared_methods_are_drawn_and_named_as_in_the_scene(self, at_rest, initial, saving):
        scenario = initial("draw_s")
        view = replace(scenario.view, compared=("linear", "modulation"))
        frame = at_rest(replace(scenario, view=view), Stage.FINE)
        *near, last = frame.comparison
        far = replace(last, paths=[path + np.array([0.4, 0.0, 0.0]) for path in last.paths])
        frame = replace(frame, comparison=(*near, far))
        picture = saving.visitor.pictures.layer("compared")
        picture.draw(frame, Look())
        picture.visible = True
        drawn, key = figure._scene(frame, ""), picture.key
        picture.visible = False
        in_scene = {(name, figure._hex(colour)) for name, colour in key.lines}
        assert len(in_scene) == 3 and in_scene <= {(part.label, part.colour) for part in drawn.strokes}
        assert {name for name, _ in in_scene} <= set(texts(render_figure(frame, ".svg")))
        for motions in picture.motions.values():
            for lines in (motions.followed, motions.others):
                colour = figure._hex(tuple(lines.node.colors))
                (part,) = (
                    part for part in drawn.strokes if (part.colour, part.width) == (colour, lines.node.thickness)
                )
                places = np.concatenate([np.stack([path[:-1], path[1:]], axis=1) for path in part.paths])
                plane = figure._Plane.of(frame.slice, frame)
                off = places - plane.across(np.asarray(lines.node.points, float))
                np.testing.assert_allclose(off, np.broadcast_to(off[0, 0], off.shape), atol=1e-6)  # another middle
                assert (places >= drawn.lower - 1e-9).all() and (places <= drawn.upper + 1e-9).all()

    def test_an_outline_is_where_the_obstacle_is(self, frame):
        (sphere,) = frame.scenario.obstacles
        drawn = figure._scene(frame, "")
        (body,) = drawn.levels
        covered = np.argwhere(body.values > body.levels[0])
        spacing = (body.upper - body.lower) / (np.array(body.values.shape) - 1)
        middle = body.lower + covered.mean(axis=0) * spacing
        plane = figure._Plane.of(frame.slice.holding([*frame.task.paths, *frame.rollouts]), frame)
        np.testing.assert_allclose(middle, plane.across(np.array(sphere.position)), atol=2e-3)
        np.testing.assert_allclose(np.sqrt(len(covered) * spacing.prod() / np.pi), sphere.radius, atol=2e-3)

    def test_level_lines_lie_where_the_function_has_their_value(self, at_rest, initial):
        """The goal, where the Lyapunov value is 0, is where the drawn lattice has its least value."""
        scenario = initial("draw_s")
        frame = at_rest(replace(scenario, view=replace(scenario.view, colour="lyapunov")), Stage.FINE)
        drawn = figure._scene(frame, "")
        (levels,) = [one for one in drawn.levels if not one.is_body]
        least = np.array(np.unravel_index(np.nanargmin(levels.values), levels.values.shape))
        place = levels.lower + least / (np.array(levels.values.shape) - 1) * (levels.upper - levels.lower)
        np.testing.assert_allclose(place, drawn.points["goal"][0][0], atol=0.01)
