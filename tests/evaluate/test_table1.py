"""The comparison: where the places are, what the cells are made from, and which orderings are said to hold."""

import json

import numpy as np
import pytest

from dt_viz.arm.collision import load_collision_model
from dt_viz.baselines.base import Plan
from dt_viz.baselines.mpnet import MPNet
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.evaluate import figure6, table1
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.options import InputError
from dt_viz.metrics import discrete_frechet, resample_by_arc_length
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union
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
            distances, _ = load_collision_model().obstacle_distance(q, ball)
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


def test_the_paper_stands_beside_what_is_known_of_it(table):
    assert table["linear"]["push_box"]["frechet"]["paper"] is None
    cell = table1.cells("ours", "draw_s", dict.fromkeys(table1.COLUMNS, np.array([[0.1, 0.2]])))
    assert cell["frechet"] == {"mean": pytest.approx(0.15), "worst": 0.2, "paper": 0.067}
    assert cell["clearance"]["worst"] == 0.1


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
            assert place.obstacle.signed_distance(path).min() < 0
        distances, _ = load_collision_model().obstacle_distance(ends, place.sphere)
        assert distances.min() > 0
        away = np.linalg.norm(place.perturbed[:, None] - problem.task.starts, axis=2).min(axis=1)
        assert (away <= table1.PERTURBED_BY).all()


def test_too_many_places_are_refused(problem, monkeypatch):
    monkeypatch.setattr(table1, "MAX_DRAWN", 3)
    with pytest.raises(InputError, match="among 3 spheres"):
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
    found = table1.measure(x, np.zeros(1), q, problem.task.paths[0], problem.learned.goal, nowhere)
    assert found.frechet == pytest.approx(np.linalg.norm(problem.task.paths[0] - x, axis=1).max())
    assert found.goal_error == pytest.approx(np.linalg.norm(problem.learned.goal - x[0]))
    assert found.hand_depth == found.turn == found.jerk == 0


class TestMissing:
    def test_what_is_not_installed_is_said(self, monkeypatch, tmp_path, capsys):
        for module in ("dt_viz.baselines.base", "dt_viz.evaluate.figure6"):
            monkeypatch.setattr(f"{module}.find_spec", lambda module: None)
        assert main([*ARGUMENTS, "mpnet-rrt", "linear", "--out", str(tmp_path)]) == 1
        said = capsys.readouterr().err
        assert "MPNet-RRT needs ompl: pip install" in said
        assert "figure 6 needs matplotlib" in said
        assert not (tmp_path / "table1.json").exists()

    def test_a_method_that_was_not_trained_is_said(self, monkeypatch, tmp_path, capsys):
        monkeypatch.setitem(METHODS, "mpnet", MPNet(tmp_path))
        assert main([*ARGUMENTS, "mpnet", "--no-figures", "--out", str(tmp_path)]) == 1
        assert "MPNet, Push box: mpnet has not been trained" in capsys.readouterr().err


class TestFigure6:
    def test_is_drawn_in_both_formats_unless_it_is_left_out(self, folder, monkeypatch, tmp_path):
        assert (folder / "figure6_push_box.svg").read_text().startswith("<?xml")
        assert (folder / "figure6_push_box.png").read_bytes().startswith(b"\x89PNG")
        monkeypatch.setattr("dt_viz.evaluate.figure6.find_spec", lambda module: None)  # then it is not missed
        few = ["linear", "--count", "1", "--perturbed", "0", "--no-figures"]
        assert main([*ARGUMENTS, *few, "--out", str(tmp_path)]) == 0
        assert not list(tmp_path.glob("figure6*"))

    def test_curves_are_distance_and_depth_along_the_path(self):
        x = np.stack([np.linspace(0, 1, 7), np.full(7, 0.25), np.zeros(7)], axis=1)
        arrays = {"x_1_2": x, "demo_2": x[[0, -1]] * [1, 0, 0], "obstacle_1": np.array([0.5, 0.25, 0, 0.5])}
        distance, depth = figure6.curves(arrays, 1, 2)
        np.testing.assert_allclose(distance, 0.25)
        at = np.linspace(0, 1, figure6.NUM_SAMPLES)
        np.testing.assert_allclose(depth, np.maximum(0.25 - np.abs(at - 0.5), 0), atol=1e-12)


class TestOrderings:
    @staticmethod
    def row(**changes):
        """Cells for which all orderings hold, but for changes METHOD_COLUMN."""
        frechet = {"ours": 0.08, "ours-no-avoidance": 0.01, "eflow": 0.015, "eflow-repulsive": 0.2}
        frechet |= {"mpnet": 0.2, "mpnet-rrt": 0.3, "linear": 0.2}
        depth = {"ours-no-avoidance": 0.06, "eflow": 0.06, "mpnet": 0.05, "linear": 0.04}
        rows = {}
        for method, value in frechet.items():
            turn = 90 if method == "eflow-repulsive" else 20
            rows[method] = {
                "frechet": {"mean": value, "paper": 0.124 if method == "ours" else None},
                "arm_depth": {"mean": 0.0, "worst": depth.get(method, 0.0)},
                "hand_depth": {"mean": 0.0, "worst": depth.get(method, 0.0)},
                "turn": {"mean": turn},
            }
        for (method, column, which), value in changes.get("to", {}).items():
            rows[method][column][which] = value
        return rows

    def test_hold_where_they_do(self):
        found = table1.orderings(self.row())
        assert len(found) == 10
        assert all(holds for _, holds, _ in found)

    @pytest.mark.parametrize(
        ("changed", "value", "text"),
        [
            (("eflow", "frechet", "mean"), 0.025, "comparable"),
            (("ours", "arm_depth", "worst"), 0.01, "ours is free"),
            (("ours", "frechet", "mean"), 0.25, "of the whole arm"),
            (("eflow", "hand_depth", "worst"), 0.0, "of the hand alone"),
            (("ours", "frechet", "mean"), 0.13, "below the paper's"),
            (("eflow-repulsive", "turn", "mean"), 10, "repulsive"),
            (("mpnet", "arm_depth", "worst"), 0.0, "MPNet collides"),
            (("linear", "arm_depth", "worst"), 0.0, "Linear collides"),
            (("mpnet-rrt", "arm_depth", "worst"), 0.01, "MPNet-RRT does not"),
            (("mpnet-rrt", "frechet", "mean"), 0.07, "departs farther than ours"),
        ],
    )
    def test_do_not_where_they_do_not(self, changed, value, text):
        failing = [said for said, holds, _ in table1.orderings(self.row(to={changed: value})) if not holds]
        assert any(text in said for said in failing)

    def test_of_methods_that_were_left_out_are_not_said(self):
        row = self.row()
        assert [text for text, _, _ in table1.orderings({"linear": row["linear"]})] == ["Linear collides"]
