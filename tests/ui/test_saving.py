"""What a visitor takes home: files of the joints and figures, made beside the server's event loop, or one line why."""

import csv
import io
import re
import struct
import threading
import zlib
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import yaml
from checkpoints import asked_at_checkpoints
from pages import Answers, frame_of, png_of, wait_until
from PIL import Image
from viser._gui_handles import GuiProgressBarHandle  # noqa: TID251

from dt_viz.baselines.registry import METHODS
from dt_viz.control.settings import ControllerSettings
from dt_viz.errors import FormatError, UnwantedError
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import NUM_SAMPLES, Profile, Profiles
from dt_viz.pictures.figures import scene_figure
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Compared, Scores, Stage
from dt_viz.ui.patches import rendered
from dt_viz.ui.scene import figure
from dt_viz.ui.scene.export import MAX_CHUNKS, decoded
from dt_viz.ui.scene.figure import SUFFIXES, render_figure
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.tabs.plots import SAVE, joints_table, table_csv
from dt_viz.warning import ARM, Kind, MotionWarning

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of matplotlib's own parts


@pytest.fixture(scope="module")
def saving(page):
    """The page, which keeps what it sends to its visitor."""
    page.sent = []
    page.client.send_file_download = lambda name, content, **_how: page.sent.append((name, content))
    return page


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


MISSED = "the arm misses the path of rollout 1 by up to 31 mm"
UNFOLLOWED = {
    "none that is shown": lambda _: {"arm": None},
    "the goal is inside": lambda _: {"blocked": (MotionWarning(Kind.ARM_BLOCKED, "the goal is inside", ARM),)},
    MISSED: lambda made: {"certificates": made.certificates.warning(MotionWarning(Kind.PATH_MISSED, MISSED, ARM))},
}


@pytest.mark.parametrize("words", UNFOLLOWED)
def test_a_motion_that_the_arm_does_not_follow_has_no_file_and_one_line_says_why(saving, frame, words):
    shown(saving, replace(frame, **UNFOLLOWED[words](frame)))
    sent, said = press(saving, "Save joints")
    assert not sent and "\n" not in said and words in said


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "begin"), [("SVG", b"<?xml"), ("PDF", b"%PDF"), ("HTML", b"<!DOCTYPE html>"), ("PNG", b"\x89PNG")]
)
def test_a_picture_is_saved_of_what_is_shown(saving, frame, kind, begin):
    shown(saving, frame)
    saving.claim(saving["Save as"], kind)
    asked = [handle for handle in saving.inputs if handle.label == "Resolution" and handle.visible]
    ((name, content),), _ = press(saving, "Save picture")
    saving.claim(saving["Save as"], "PNG")
    assert name == f"dt-viz-draw_s.{kind.lower()}" and content.lower().startswith(begin.lower())
    assert bool(asked) == (kind == "PNG") and saving["Resolution"].visible
    if kind == "PNG":
        assert Image.open(io.BytesIO(content)).size == (1280, 720)
    if kind == "HTML":
        assert b"__VISER_EMBED_DATA__" in content


def test_a_picture_explains_the_colours_that_are_shown(saving, at_rest, initial):
    pictures = saving.visitor.pictures
    shown = View(colour="det"), View(colour="lyapunov"), View(colour="occupancy")
    for view, title in zip(shown, ("det J: ", "Lyapunov value", "Learned occupancy"), strict=True):
        scenario = replace(initial("draw_s"), view=view)
        pictures.adopt(scenario)
        pictures.draw(at_rest(scenario, Stage.LIVE))
        (legend,) = pictures.legends
        assert legend.title.startswith(title)
    pictures.adopt(initial("draw_s"))
    assert pictures.legends == []


def test_a_second_press_cancels_and_the_button_comes_back(saving, frame, monkeypatch):
    began, goes_on = threading.Event(), threading.Event()

    def drawn(frame, suffix, step):
        step(0.2)
        began.set()
        assert goes_on.wait(30)
        step(0.4)
        pytest.fail("it goes on")

    monkeypatch.setattr("dt_viz.ui.scene.recording.render_figure", drawn)
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

    def render(height, width, **_how):
        asked.set()
        assert answers.wait(30)
        return np.zeros((height, width, 4), np.uint8)

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


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_figure_that_is_drawn_ends_when_it_is_cancelled(frame, suffix):
    def end():
        raise UnwantedError

    with asked_at_checkpoints(end), pytest.raises(UnwantedError):
        render_figure(frame, suffix)


def texts(svg):
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg.decode())


class TestFigure:
    def test_its_text_is_text_and_nothing_in_it_is_pixels(self, frame):
        svg = render_figure(frame, ".svg")
        dotted = "projection; dotted where hidden by an obstacle"
        assert {"rollouts", "demonstrations", "undisturbed", "obstacle", "goal", "10 cm", dotted} <= set(texts(svg))
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
        drawn, key = figure._scene(frame, ""), picture.legend
        picture.visible = False
        in_scene = {(name, figure._hex(colour)) for name, colour in key.names}
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

    @pytest.mark.parametrize("task", ["draw_s", "lift_box", "push_box"])
    def test_what_an_obstacle_hides_is_dotted_and_what_passes_before_it_is_not(self, at_rest, initial, task):
        frame = at_rest(initial(task), Stage.FINE)
        obstacle, toward = frame.scenario.obstacle, -np.subtract(frame.task.camera[1], frame.task.camera[0])
        normal = frame.slice.normal * np.sign(frame.slice.normal @ toward)
        shown = {part.label: part for part in figure._scene(frame, "").strokes}
        for label, paths in (("rollouts", frame.rollouts), ("demonstrations", frame.task.paths)):
            for path, mask in zip(paths, shown[label].hidden, strict=True):
                before = np.linspace(0, 0.4, 2001)[:, None, None] * normal
                least = obstacle.signed_distance(path + before).min(axis=0)
                sure = np.abs(least) > 2e-3  # others pass along its rim
                np.testing.assert_array_equal(mask[sure], least[sure] < 0)
        seen = [mask.any() for mask in shown["rollouts"].hidden]
        assert any(seen) == (task != "push_box")  # there all pass over it
        drawn = scene_figure([figure._scene(frame, "")])
        lines = [line for line in drawn.axes[0].lines if line.get_color() == shown["demonstrations"].colour]
        parts = [np.isfinite(line.get_xdata()) for line in lines]
        assert [line.is_dashed() for line in lines] == [False, True]
        assert (parts[0] | parts[1]).sum() == sum(map(len, frame.task.paths))  # nothing is left out
        assert not (parts[0][1:-1] & parts[1][1:-1] & parts[1][:-2] & parts[1][2:]).any()  # nor drawn through

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


# --- What a browser answers where a picture is asked for ---


SIZE = 40, 30
PIXELS = np.random.default_rng(0).integers(0, 256, (30, 40, 4), dtype=np.uint8)
PNG = png_of(PIXELS)
HEADER = 33  # number of bytes of the signature and the header
SHOT = {"wxyz": np.array([1.0, 0.0, 0.0, 0.0]), "position": np.zeros(3), "fov": 0.75}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def encoded(kind: str, mode: str = "RGBA", **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(PIXELS, "RGBA").convert(mode).save(file, kind, **options)
    return file.getvalue()


BOMB = zlib.compress(bytes(10**7))
ADDED = {
    "text": chunk(b"zTXt", b"a\0\0" + BOMB),
    "text of another kind": chunk(b"iTXt", b"a\0\1\0\0\0" + BOMB),
    "colours": chunk(b"iCCP", b"a\0\0" + BOMB),
    "frames": chunk(b"acTL", struct.pack(">II", 10**6, 0)),
    "another header": chunk(b"IHDR", struct.pack(">IIBBBBB", 13_300, 13_300, 8, 6, 0, 0, 0)),
}


@pytest.mark.parametrize("added", ADDED.values(), ids=ADDED)
def test_pixels_are_decoded_and_nothing_else_that_a_png_may_hold(added):
    np.testing.assert_array_equal(decoded(PNG, SIZE), PIXELS)
    np.testing.assert_array_equal(decoded(PNG[:HEADER] + added + PNG[HEADER:], SIZE), PIXELS)


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (png_of(np.zeros((31, 40, 4), np.uint8)), "a PNG of 40x31 pixels"),
        (png_of(np.zeros((40, 30, 4), np.uint8)), "a PNG of 30x40 pixels"),
        (encoded("PNG", "RGB"), "a PNG of 40x30 pixels"),
        (encoded("PNG", "P"), "a PNG of 40x30 pixels"),
        (encoded("GIF", "L"), "no PNG"),
        (encoded("JPEG", "RGB"), "no PNG"),
        (encoded("TIFF"), "no PNG"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 40 30\n", "no PNG"),
        (b"", "no PNG"),
        (PNG[:20], "no PNG"),
        (PNG[:60], "a damaged PNG"),
        (PNG[:HEADER] + chunk(b"IDAT", zlib.compress(b"0123456789")) + chunk(b"IEND", b""), "a damaged PNG"),
        (PNG[:HEADER] + chunk(b"IDAT", b"") * MAX_CHUNKS + PNG[HEADER:], "a damaged PNG"),
        (PNG[:HEADER] + b"\xff\xff\xff\xffIDAT", "a damaged PNG"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_no_png_of_the_size_that_was_asked_for_is_refused_in_a_line(content, found):
    with pytest.raises(FormatError) as caught:
        decoded(content, SIZE)
    assert str(caught.value) == f"the browser: found {found}; accepted: an RGBA PNG of 40x30 pixels"


def browser(answer: Any, *, there: bool = True) -> Any:
    """A client whose browser answers so, if its page is still there."""
    client = SimpleNamespace(client_id=0, get_render=answer, flush=lambda: None)
    client._websock_connection = Answers(client)
    clients = {0: client} if there else {}
    client._viser_server = SimpleNamespace(flush=lambda: None, get_clients=lambda: clients)
    return cast(Any, client)


def test_only_the_answer_to_what_was_asked_is_taken_and_only_the_first():
    client = browser(lambda *_size, **_shot: PNG)
    connection = client._websock_connection
    pass_on = connection.answer

    def answer(uuid: str, payload: bytes) -> None:
        pass_on("another", b"of another")
        pass_on(uuid, payload)
        pass_on(uuid, b"later")

    connection.answer = answer
    assert rendered(client, SIZE, SHOT, 10.0) == PNG
    assert not connection.handlers


def test_a_browser_that_has_left_or_does_not_answer_is_waited_for_no_longer():
    for there, expected in ((False, FormatError), (True, TimeoutError)):
        client = browser(lambda *_size, **_shot: PNG, there=there)
        client._websock_connection.answer = lambda _uuid, _payload: None
        with pytest.raises(expected):
            rendered(client, SIZE, SHOT, 0.0)
        assert not client._websock_connection.handlers


# --- Data of plots and tables: what is saved is what is shown ---


def read(content):
    head, *rows = csv.reader(io.StringIO(content.decode()))
    return {name: [row[k] for row in rows] for k, name in enumerate(head)}


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def sent(page, monkeypatch):
    files = {}
    monkeypatch.setattr(page.client, "send_file_download", lambda name, content, **_how: files.update({name: content}))
    return files


def test_a_table_is_read_back_as_it_was(rng):
    numbers, texts = rng.normal(size=4) * 10.0 ** rng.integers(-9, 9, 4), ['a "b", c', "ä\nö", "", "d"]
    back = read(table_csv({"x, y": numbers, "text": texts, "score": ["", np.inf, 0.5, 2.0]}))
    np.testing.assert_allclose([float(text) for text in back["x, y"]], numbers, rtol=1e-8)
    assert back["text"] == texts and back["score"] == ["", "inf", "0.5", "2"]


def test_speeds_times_their_limits_add_up_to_the_way_of_each_joint(robot, rng):
    times = np.cumsum(rng.uniform(0.01, 0.2, 30))
    q = robot.home + np.cumsum(rng.normal(scale=0.02, size=(30, robot.num_joints)), axis=0)
    table = joints_table(ArmMotion(times, q, q), robot)
    assert next(iter(table)) == "time_s" and len(table) == 1 + 2 * robot.num_joints
    for name, angles, limit in zip(robot.joint_names, q.T, robot.velocity_limits, strict=True):
        np.testing.assert_array_equal(np.radians(table[f"{name}_deg"]).round(9), angles.round(9))
        way = (table[f"{name}_speed_percent"][:-1] / 100 * limit * np.diff(times)).sum()
        assert way == pytest.approx(np.abs(np.diff(angles)).sum())


def profile(rng):
    return Profile(*rng.uniform(size=(3, NUM_SAMPLES)), frechet=0.01, depth=0.0)


def pressed(page):
    (save,) = (each for each in page.inputs if each.label == SAVE and each.visible)
    page.claim(save, True)
    page.done()


def test_the_shown_plots_are_saved_and_no_others(page, sent, robot, rng):
    plots, times = page.visitor._panel.show.plots, np.linspace(0, 2, 9)
    q = robot.home + rng.normal(scale=0.1, size=(9, robot.num_joints))
    profiles = Profiles(profile(rng), profile(rng))
    plots.draw(cast(Any, SimpleNamespace(arm=ArmMotion(times, q, q), rollouts=(), chosen=None, profiles=profiles)))
    page.session.edit("test", view=View(health_plots=True))
    pressed(page)
    ((name, content),) = sent.items()
    assert name == "dt-viz-draw_s-path.csv"
    table, (shown, *_) = read(content), plots.health
    curves = {"lyapunov": shown.lyapunov, "distance_mm": shown.distance, "clearance_mm": shown.clearance}
    for name, plot in curves.items():
        for head, curve in zip(("path", name, f"{name}_without"), plot.data, strict=False):
            np.testing.assert_allclose([float(text) for text in table[head]], curve, rtol=1e-8)
    page.session.edit("test", view=View(joint_plots=True))
    sent.clear()
    pressed(page)
    ((name, content),) = sent.items()
    assert name == "dt-viz-draw_s-joints.csv" and content == table_csv(joints_table(ArmMotion(times, q, q), robot))
    page.session.edit("test", view=View())
    assert not [each for each in page.inputs if each.label == SAVE and each.visible]


def test_what_compared_methods_do_is_saved(page, sent, rng):
    scores = Scores(*rng.uniform(size=len(fields(Scores))))
    moves, waits = (METHODS[name] for name in ("linear", "mpnet"))
    drawn = rng.uniform(size=(NUM_SAMPLES, 2))
    comparison = Compared(moves, scores=scores, curves=drawn), Compared(waits, note="no way, yet")
    page.session.edit("test", view=View(compared=("linear", "mpnet")))
    scenario = page.session.scenario
    page.visitor._panel.bindings.report(frame_of(scenario, task=page.session.task, comparison=comparison))
    pressed(page)
    assert [name.removeprefix("dt-viz-draw_s") for name in sent] == ["-methods.csv", "-methods-path.csv"]
    table, curves = (read(content) for content in sent.values())
    assert table["method"] == [moves.title, waits.title] and table["note"] == ["", "no way, yet"]
    assert table["to_demo_mm"] == [f"{1e3 * scores.frechet:.9g}", ""]
    assert table["off_goal_mm"] == [f"{1e3 * scores.goal_error:.9g}", ""]
    assert list(curves) == ["path", "linear_distance_mm", "linear_depth_mm"]
    depths = [float(text) for text in curves["linear_depth_mm"]]
    np.testing.assert_allclose(depths, 1e3 * drawn[:, 1], rtol=1e-8)
    page.session.edit("test", view=View())
