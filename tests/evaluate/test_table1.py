"""The comparison: where the places are, what the cells are made from, and what stands beside them."""

import json

import numpy as np
import pytest

from dt_viz.baselines.base import Plan
from dt_viz.baselines.registry import problem_of
from dt_viz.errors import FormatError, never
from dt_viz.evaluate import table1
from dt_viz.evaluate.__main__ import main
from dt_viz.metrics import discrete_frechet, resample_by_arc_length
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS

ARGUMENTS = ("table1", "--tasks", "push_box", "--count", "2", "--perturbed", "3", "--methods")
CHEAP = ("ours-no-avoidance", "linear")


@pytest.fixture(scope="module")
def problem(engine):
    return problem_of(engine.nominal(Scenario("push_box")).learned, engine.follower)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("table")
    assert main([*ARGUMENTS, *CHEAP, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def table(folder):
    return json.loads((folder / "table1.json").read_text())


def loaded(folder, method):
    with np.load(folder / f"{method}_push_box.npz") as file:
        return dict(file)


@pytest.mark.parametrize("method", CHEAP)
def test_cells_are_those_of_the_arrays_beside_them(folder, table, method):
    arrays, cells = loaded(folder, method), table[method]["push_box"]
    rows = {column: [] for column in ("frechet", "arm_depth", "clearance", "hand_depth", "goal_error")}
    for k in range(2):
        *centre, diameter = arrays[f"obstacle_{k}"]
        assert diameter == 0.15
        ball = Sphere(tuple(centre), diameter)
        for i in range(len(TASKS["push_box"]().paths)):
            x, q = arrays[f"x_{k}_{i}"], arrays[f"q_{k}_{i}"]
            dense = [resample_by_arc_length(path, 1500) for path in (x, arrays[f"demo_{i}"])]
            rows["frechet"].append(float(discrete_frechet(*dense)))
            distances, _ = load_jaco().collision.obstacle_distance(q, ball)
            rows["clearance"].append(distances.min())
            rows["arm_depth"].append(max(0, -distances.min()))
            rows["hand_depth"].append(max(0, -ball.signed_distance(resample_by_arc_length(x, 1500)).min()))
            rows["goal_error"].append(np.linalg.norm(x[-1] - TASKS["push_box"]().paths[0][-1]))
    for column, values in rows.items():
        assert cells[column]["mean"] == pytest.approx(np.mean(values), abs=1e-3)
        worst = min(values) if column == "clearance" else max(values)
        assert cells[column]["worst"] == pytest.approx(worst, abs=1e-3)
    reached = [np.linalg.norm(arrays[f"ends_{k}"] - arrays["goal"], axis=1) <= table1.REACHED for k in range(2)]
    assert sum(map(len, reached)) == 3
    assert cells["reached"]["mean"] == np.mean([np.mean(share) for share in reached])
    assert set(cells) == set(table1.COLUMNS)


def test_the_printed_row_has_mean_worst_and_paper(table):
    cells = {column: {"mean": 0.1, "worst": 0.2, "paper": None} for column in table1.COLUMNS}
    cells["frechet"]["paper"] = 0.124
    row = table1._row("Ours", "Draw S", cells)
    assert (row["method"], row["task"], row["frechet"], row["turn °"]) == ("Ours", "Draw S", "100 (200) [124]", "0 (0)")


def test_imitation_alone_is_nearer_and_deeper_than_a_straight_line(table):
    ours, linear = (table[method]["push_box"] for method in CHEAP)
    assert ours["frechet"]["mean"] < 0.02 < linear["frechet"]["mean"]
    assert ours["arm_depth"]["mean"] > linear["arm_depth"]["mean"]


def test_places_collide_with_each_motion_and_leave_the_ends_free(problem, monkeypatch):
    monkeypatch.setattr(table1, "ALONG", (0, 1))
    monkeypatch.setattr(table1, "WITHIN", 0.1)
    places, again = (table1.drawn(problem, 4, 10, seed=3) for _ in range(2))
    fewer = table1.drawn(problem, 4, 0, seed=3)
    assert [place.sphere for place in places] == [place.sphere for place in again] == [place.sphere for place in fewer]
    assert len({place.sphere.position for place in places}) == 4
    assert sum(len(place.perturbed) for place in places) == 10
    ends = np.concatenate([path[[0, -1]] for path in problem.postures])
    for place in places:
        for path in problem.learned.demonstrated.paths:
            assert place.sphere.signed_distance(path).min() < 0
        distances, _ = load_jaco().collision.obstacle_distance(ends, place.sphere)
        assert distances.min() > 0
        away = np.linalg.norm(place.perturbed[:, None] - problem.task.starts, axis=2).min(axis=1)
        assert (away <= table1.PERTURBED_BY).all()


def test_motions_that_end_beside_the_goal_have_not_reached_it(problem):
    """Of three perturbed starts one is taken to the goal, one 5 mm and one 2 cm beside it."""
    goal, starts = problem.learned.goal, problem.task.starts[:3]
    ends = goal + np.array([[0.0, 0.0, 0.0], [0.005, 0.0, 0.0], [0.0, 0.02, 0.0]])

    def plan(obstacle, starts, cancelled=never):
        paths = tuple(np.stack([begin, end]) for begin, end in zip(starts, np.resize(ends, starts.shape), strict=True))
        return Plan(paths, tuple(np.array([0.0, 1.0]) for _ in paths), tuple(np.zeros((2, 6)) for _ in paths))

    place = table1.RandomPlace(Sphere((5.0, 0.0, 0.0), 0.15), starts)
    arrays = table1.gathered(problem, [table1.measured(plan, problem, 0, place)])
    np.testing.assert_allclose(arrays["ends_0"], ends)
    assert arrays["reached"] == pytest.approx([2 / 3])


def test_too_many_places_are_refused(problem, monkeypatch):
    monkeypatch.setattr(table1, "MAX_DRAWN", 3)
    with pytest.raises(FormatError, match="among 3 spheres"):
        table1.drawn(problem, 4, 0, seed=3)


def test_paths_of_the_hand_are_tracked_by_the_arm(problem):
    paths = problem.task.paths
    (q, *_) = table1.joints_along(problem, Plan(paths, paths))
    np.testing.assert_allclose(problem.robot.end_effector(q), paths[0], atol=1e-3)
    own = tuple(np.zeros((3, 6)) for _ in paths)
    assert table1.joints_along(problem, Plan(paths, paths, own)) is own


def test_a_motion_that_stays_at_its_start_is_measured(problem):
    x, q = problem.task.paths[0][:1], problem.postures[0][:1]
    nowhere = Union((Sphere((5.0, 0.0, 0.0), 0.15),))
    measured = table1.measure(problem, x, np.zeros(1), q, problem.task.paths[0], nowhere)
    found = dict(zip(table1.COLUMNS, measured, strict=False))
    assert found["frechet"] == pytest.approx(np.linalg.norm(problem.task.paths[0] - x, axis=1).max(), rel=1e-4)
    assert found["goal_error"] == pytest.approx(np.linalg.norm(problem.learned.goal - x[0]))
    assert found["hand_depth"] == found["turn"] == found["jerk"] == 0


class TestMissing:
    def test_what_is_not_installed_is_said(self, monkeypatch, tmp_path, capsys):
        monkeypatch.setattr("dt_viz.baselines.base.find_spec", lambda module: None)
        assert main([*ARGUMENTS, "mpnet-rrt", "linear", "--out", str(tmp_path)]) == 2
        assert "--methods: found MPNet-RRT, which needs ompl; accepted: pip install" in capsys.readouterr().err
        assert not (tmp_path / "table1.json").exists()


class TestFigure6:
    def test_is_drawn_in_both_formats(self, folder):
        assert (folder / "figure6_push_box.svg").read_text().startswith("<?xml")
        assert (folder / "figure6_push_box.png").read_bytes().startswith(b"\x89PNG")
