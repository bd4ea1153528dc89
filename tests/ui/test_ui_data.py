"""Data of plots and tables to take along: what is saved is what is shown."""

import csv
import io
from dataclasses import fields
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from pages import frame_of

from dt_viz.baselines.registry import METHODS
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import NUM_SAMPLES, Profile, Profiles
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Compared, Scores
from dt_viz.ui.tabs.data import SAVE, joints_table, table_csv


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
