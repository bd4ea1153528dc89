"""A compared method that is registered, and nothing else, is in the tab, the scene, saved files and measurements."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from scenes import frame_at

from dt_viz.baselines.base import Method, Plan
from dt_viz.baselines.registry import METHODS
from dt_viz.errors import never
from dt_viz.evaluate.__main__ import main
from dt_viz.scenario.saved import Saved, decode, encode
from dt_viz.session.frame import Stage
from dt_viz.ui.page import known_names
from dt_viz.ui.scene.comparison import ComparedMotions
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.tabs.plots import SAVE

SHIFT = np.array([0.0, 0.0, 0.03])


def fit(problem):
    task = problem.task

    def plan(obstacle, starts, cancelled=never):
        return Plan(tuple(path + SHIFT for path in task.paths), tuple(d.times for d in task.demonstrations))

    return plan


@pytest.fixture(scope="module", autouse=True, name="shifted")
def _shifted():
    method = Method("shifted", "Shifted", "The demonstrations, 3 cm above.", fit, live=True, avoids=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(METHODS, method.name, method)
        yield method


@pytest.fixture(scope="module")
def frame(engine, initial):
    scenario = initial("draw_s")
    return frame_at(engine, replace(scenario, view=replace(scenario.view, compared=("shifted",))), Stage.LIVE)


@pytest.fixture
def ticked(page, frame):
    """The page after its checkbox was ticked and a frame has come."""
    page.claim(page["Shifted"], True)
    page.visitor._panel.bindings.report(frame)
    return page


def test_the_tab_has_its_checkbox_its_name_its_promise_and_its_scores(ticked, shifted):
    assert ticked.session.scenario.view.compared == ("shifted",)
    texts = [child for tab in ticked.gui._container_handle_from_uuid.values() for child in tab._children.values()]
    (table,) = (each.content for each in texts if "Shifted</td>" in getattr(each, "content", "") and each.visible)
    assert shifted.promise in table and ">30</td>" in table
    ticked.claim(ticked["Their arm"], shifted.title)
    assert ticked.session.scenario.view.their_arm == "shifted"


def test_the_scene_has_its_motions_in_a_colour_and_its_name(scene, frame, shifted):
    picture = ComparedMotions(scene)
    picture.draw(frame, Look())
    drawn = picture.motions[shifted]
    assert drawn.label.text == "Shifted" and tuple(drawn.followed.node.colors) == LIGHT.compared[0]  # begins again
    np.testing.assert_allclose(drawn.followed.node.points[0, 0], frame.task.paths[0][0] + SHIFT, atol=1e-6)


def test_a_saved_scenario_names_it(ticked):
    scenario = ticked.session.scenario
    assert decode(encode(Saved(scenario)), known_names((scenario.task,), ("",))).scenario.view.compared == ("shifted",)


def test_saved_tables_have_its_scores_and_its_curves(ticked, monkeypatch):
    files = {}
    monkeypatch.setattr(ticked.client, "send_file_download", lambda name, content, **_: files.update({name: content}))
    ticked.claim(next(each for each in ticked.inputs if each.label == SAVE and each.visible), True)
    ticked.done()
    scores, curves = (list(csv.DictReader(io.StringIO(content.decode()))) for content in files.values())
    assert [row["method"] for row in scores] == ["Ours", "Shifted"]
    assert float(scores[1]["to_demo_mm"]) == pytest.approx(30, abs=0.1)
    assert all(float(row["shifted_distance_mm"]) <= 30.1 for row in curves)


def test_table_1_measures_it(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    command = ["table1", "--methods", "shifted", "--tasks", "draw_s", "--count", "1", "--perturbed", "0"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    cells = json.loads((tmp_path / "table1.json").read_text())["shifted"]["draw_s"]
    assert cells["frechet"]["mean"] == pytest.approx(0.03, abs=1e-4)
