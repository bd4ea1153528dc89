"""Pictures of scenes by the command line."""

import shutil
import tempfile

import numpy as np
import pytest
from chromium import needs_chromium
from PIL import Image

from dt_viz.cli import main
from dt_viz.picture_making import VARIABLE
from dt_viz.scenario.own import Own
from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN, TASKS, own_task
from dt_viz.session.arms import ArmStore

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of matplotlib's own parts


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("nowhere", "--out", "f.png"), "SCENE: found 'nowhere'; accepted: lift, push, "),
        (("", "--out", "f.svg"), "SCENE: found ''; accepted: lift, push, "),
        (("a.json", "--out", "f.svg"), "a.json: path: found no such file; accepted: a readable file"),
        (("draw_s", "--out", "f.png", "--size", "0x0"), "--size: found '0x0'; accepted: WIDTHxHEIGHT, each 64 to 7680"),
        (("draw_s", "--out", "f.png", "--size", "1920x100000"), "--size: found '1920x100000'; accepted"),
        (("draw_s", "--out", "f.png", "--size", "large"), "--size: found 'large'; accepted"),
        (
            ("draw_s", "--out", "f.mp4", "--size", "641x360"),
            "--size: found '641x360'; accepted: WIDTHxHEIGHT, each even",
        ),
        (("draw_s", "--out", "f.gif", "--size", "3840x2160"), "--size: found '3840x2160'; accepted"),
        (
            ("draw_s", "--out", "nowhere/f.png"),
            "--out: found 'nowhere/f.png'; accepted: a file in a folder that exists",
        ),
        (("draw_s", "--out", "f.bmp"), "--out: found 'f.bmp'; accepted: a file that ends in .png, .svg, .pdf, .html"),
        (("draw_s", "--out", "."), "--out: found '.'; accepted: a file that ends in"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(given, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(VARIABLE, "true")  # a command that there is
    assert main(["picture", *given]) == 2
    out, error = capsys.readouterr()
    assert not out and error.startswith(f"dt-viz picture: {said}") and error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_png_needs_a_browser_and_says_so(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "no-browser"))
    assert main(["picture", "draw_s", "--out", str(tmp_path / "f.png")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("dt-viz picture: Chromium: found ") and "or its path in DT_VIZ_CHROMIUM" in error


@pytest.mark.parametrize(("does", "said"), [("exit", "which ended"), ("exec sleep 60", "waited for 0.5 s in vain for")])
def test_a_browser_that_opens_nothing_is_given_up(does, said, capsys, tmp_path, monkeypatch):
    browser = tmp_path / "browser"
    browser.write_text(f"#!/bin/sh\n{does}\n")
    browser.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(browser))
    monkeypatch.setattr("dt_viz.picture_making.PATIENCE", 0.5)
    assert main(["picture", "draw_s", "--out", str(tmp_path / "f.png")]) == 2
    assert said in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [browser]


@pytest.mark.long
def test_a_scene_and_a_step_of_the_tour_are_drawn_as_lines_and_text(tmp_path, cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    assert main(["picture", "fig-2", "--out", str(tmp_path / "f.svg")]) == 0
    svg = (tmp_path / "f.svg").read_text()
    assert all(f">{title}</text>" in svg for title in ("base attractor", "imitation", "+ avoidance", "rollouts"))
    assert main(["picture", "tour-4", "--out", str(tmp_path / "g.svg")]) == 0
    assert ">obstacle</text>" in (tmp_path / "g.svg").read_text()


def test_a_saved_scenario_is_recorded_with_its_demonstrations_its_arm_and_its_camera(
    tmp_path, cache, monkeypatch, capsys
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    made, recorded, engine = [], [], ArmStore.engine
    monkeypatch.setattr(ArmStore, "engine", lambda store, name: made.append(name) or engine(store))
    monkeypatch.setattr("dt_viz.picture_making.drawn", lambda *given: recorded.append(given) or b"page")
    own, sight = own_task(TASKS["push_box"]().demonstrations[:3]), ((0.4, -2.2, 1.4), (0.2, -0.3, 0.2))
    text = encode(Saved(Scenario(OWN, (), arm="panda"), sight, Own.of(own)))
    (tmp_path / "a.json").write_text(text)
    assert main(["picture", str(tmp_path / "a.json"), "--out", str(tmp_path / "f.html")]) == 0
    ((frame, _suffix, _follower, pose),) = recorded
    assert made == ["panda"] and np.array_equal(pose, sight)
    assert frame.task.demonstrations[0].positions.tobytes() == own.demonstrations[0].positions.tobytes()
    (tmp_path / "a.json").write_text(text.replace('"warp":1.0', '"warp":7.0'))
    assert main(["picture", str(tmp_path / "a.json"), "--out", str(tmp_path / "g.html")]) == 2
    assert "a.json: warp: found 7; accepted: 0 to 1\n" in capsys.readouterr().err


@pytest.mark.long
@needs_chromium
@pytest.mark.browser
def test_a_scene_is_rendered_in_any_size_and_seen_whole(tmp_path, cache, monkeypatch, request):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    own = tempfile.mkdtemp(dir="/tmp")  # Chromium needs a short path there, and leaves files behind
    monkeypatch.setenv("TMPDIR", own)
    request.addfinalizer(lambda: shutil.rmtree(own, ignore_errors=True))
    assert main(["picture", "steps", "--out", str(tmp_path / "f.png"), "--size", "1000x500"]) == 0
    image = np.asarray(Image.open(tmp_path / "f.png")).astype(int)
    assert image.shape == (500, 1000, 3)
    rows, columns = np.nonzero(np.abs(image - (213, 94, 0)).max(axis=2) < 60)  # the rollouts of three panels
    assert len(rows) > 300
    assert (np.histogram(columns, bins=3, range=(0, 1000))[0] > 50).all()
    assert columns.min() > 50 and columns.max() < 950
