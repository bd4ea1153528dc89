"""Obstacles in the way of motions: what is measured around them, and where they are."""

import numpy as np
import pytest
from hook import NUM_DEMONSTRATIONS, apart, hook

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.around import FIGURES, TURN_ARC, _row, _shares
from dt_viz.metrics import distance_from_path, sharpest_turn
from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import known_tasks


@pytest.fixture(scope="module")
def middle(lasa):
    """The middle of the mean demonstration in the world, metres."""
    return known_tasks(lasa)["Hook"]().mean_path[50]


@pytest.fixture
def around(measured):
    """Runs the command with a sphere of 10 cm at a centre: what it writes, rows by their names, figures by theirs."""

    def run(centre, more=""):
        where = ",".join(f"{value:.6f}" for value in centre)
        return split(measured("around", f"--obstacle {where} --diameter 0.1 {more}"))

    return run


def split(written_and_printed):
    arrays, (rows, figures) = written_and_printed
    return arrays, {row[""]: row for row in rows}, {row["figure"]: row["value"] for row in figures}


def test_angles_end_effector_and_demonstration_belong_together_and_the_figures_are_theirs(around, middle, robot):
    arrays, rows, figures = around(middle)
    model, ball = load_jaco().collision, Sphere(tuple(middle), 0.1)
    for i in range(NUM_DEMONSTRATIONS):
        q, x, demo = arrays[f"q_{i}"], arrays[f"x_{i}"], arrays[f"demo_{i}"]
        assert q.shape == (len(x), 6) and len(arrays[f"times_{i}"]) == len(q) and x.shape[1] == demo.shape[1] == 3
        np.testing.assert_allclose(robot.end_effector(q), x, atol=1e-12)
        assert np.abs(np.diff(q, axis=0)).max() < 1  # unwrapped
        assert len(demo) == len(hook(i)[0])
        assert arrays["hand"][0, i] == pytest.approx(np.linalg.norm(x - middle, axis=1).min() - 0.05, abs=1e-6)
        assert arrays["arm"][0, i] == pytest.approx(model.obstacle_distance(q, ball)[0].min(), abs=1e-3)
        assert arrays["frechet"][0, i] == pytest.approx(apart(x, demo), abs=1e-9)
        assert arrays["turn"][0, i] == pytest.approx(sharpest_turn(x, TURN_ARC)) != arrays["turn_without"][0, i]
        assert arrays["goal_miss"][0, i] == pytest.approx(np.linalg.norm(x[-1] - arrays["demo_0"][-1]), abs=1e-4)
        assert rows[f"start {i}"]["hand mm"] == pytest.approx(1e3 * arrays["hand"][0, i])
    assert rows["all"]["F.D. mm"] == pytest.approx(1e3 * arrays["frechet"].max())
    assert rows["all"]["arm mm"] == pytest.approx(1e3 * arrays["arm"].min())
    assert rows["all"]["goal missed mm"] < 1 and rows["all"]["outside limits"] == 0
    assert float(figures["F.D. mean mm"]) == pytest.approx(1e3 * arrays["frechet"].mean(), abs=0.06)
    assert figures["collisions"] == "0 of 1 (0.0 %)" and figures["at least 9 mm kept"] == "1 of 1 (100.0 %)"


def test_the_whole_arm_avoids_what_the_hand_alone_does_not_and_without_avoidance_both_are_inside(around, middle):
    by_arm, by_hand = around(middle)[0], around(middle, "--space task")[0]
    assert by_hand["hand"].min() > 0.009 and by_hand["arm"].min() < -0.02
    assert by_arm["arm"].min() > 0.009
    arrays, _, figures = around(middle, "--no-avoidance")
    assert figures["collisions"] == "1 of 1 (100.0 %)" and arrays["hand"].min() < -0.03
    np.testing.assert_allclose(arrays["arm"], by_arm["arm_without"], atol=1e-3)
    assert arrays["detour"].max() < 1e-3 < by_arm["detour"].min()


def test_a_start_inside_the_obstacle_is_said_for_the_hand_and_left_out_for_the_arm(
    around, middle, capsys, lasa, tmp_path
):
    demo = around(middle)[0]["demo_0"]
    where = ["--obstacle", ",".join(map(str, demo[0])), "--size", "0.1", "--out", str(tmp_path / "a.npz")]
    task = ["--task", "Hook", "--lasa", str(lasa)]
    assert main(["around", *task, *where, "--space", "task"]) == 0
    assert "warning: start 1 is inside the obstacle" in capsys.readouterr().out
    arrays, _, figures = around(demo[0])
    left = [name[2:] for name in arrays if name.startswith("q_")]
    assert 0 < len(left) < NUM_DEMONSTRATIONS and "0" not in left and np.isnan(arrays["hand"][0, 0])
    assert figures["from some of the starts only"] == "1 of 1 (100.0 %)"


def test_it_is_said_why_there_is_no_motion(around, middle, lasa, tmp_path, capsys):
    goal = around(middle)[0]["demo_0"][-1]
    task = ["--task", "Hook", "--lasa", str(lasa), "--out", str(tmp_path / "a.npz")]
    for where, reason in {
        ",".join(map(str, goal)): "the goal is inside the obstacle",
        "0,0,0.1": "the obstacle touches the arm's base",
    }.items():
        assert main(["around", *task, "--obstacle", where, "--diameter", "0.15"]) == 1
        assert f"no motion: {reason}" in capsys.readouterr().err


@pytest.mark.long
def test_random_places_are_measured_and_repeat(measured):
    arrays, rows, figures = split(measured("around", "--count 2 --size 0.1"))
    assert np.linalg.norm(arrays["places"] - arrays["places"][0], axis=2).max() <= 0.05
    assert arrays["arm"].shape == (3, NUM_DEMONSTRATIONS) and arrays["ends"].shape == (3, NUM_DEMONSTRATIONS + 1)
    assert [*rows] == ["place 0", "place 1", "place 2", "all"]
    assert figures["at least 9 mm kept"].startswith(f"{(np.nanmin(arrays['arm'], axis=1) >= 9e-3).sum()} of 3")
    assert np.nanmin(arrays["arm"]) > 0 > np.nanmax(arrays["arm_without"])
    again = measured("around", "--count 2 --size 0.1 --space task")[0]
    np.testing.assert_array_equal(again["places"], arrays["places"])
    other = measured("around", "--count 2 --size 0.1 --space task --seed 1")[0]
    assert (other["places"][1:] != arrays["places"][1:]).all()


def test_places_of_the_hand_are_measured_at_its_point_and_compared_with_what_is_forced(measured):
    arrays, _, figures = split(measured("around", "--count 2 --size 0.1 --space task"))
    assert arrays["hand_without"].min() < -0.02 and (arrays["hand"].min(axis=1) >= 9e-3).all()
    forced = arrays["detour"].max(axis=1) / (0.01 - arrays["hand_without"].min(axis=1))
    median, p95 = map(float, figures["detour/forced where a motion is in the way, median, 95 %"].split(", "))
    assert [median, p95] == pytest.approx(np.percentile(forced, [50, 95]), abs=0.006)


@pytest.mark.long
def test_places_are_any_shapes_of_any_size_along_the_whole_motion(lasa, measured):
    shapes = "--shape any --number 2 --size 0.06,0.25 --no-avoidance"
    arrays = measured("around", f"--count 12 --along 0,1 --spread 0 {shapes}")[0]
    mean = known_tasks(lasa)["Hook"]().mean_path
    places, sizes = arrays["places"][1:], arrays["sizes"][1:]
    assert (places[:, 0] != places[:, 1]).any(axis=1).all()
    assert places.shape == sizes.shape == (12, 2, 3) and arrays["turns"].shape == (13, 2, 4)
    assert set(arrays["shapes"][1:].ravel()) == {"sphere", "box", "cylinder", "capsule"}
    assert 0.06 <= sizes.min() < 0.1 and 0.2 < sizes.max() <= 0.25
    nearest = np.linalg.norm(places[:, :, None] - mean, axis=3).argmin(axis=2)
    assert nearest.min() < 25 and nearest.max() > 75
    assert distance_from_path(places.reshape(-1, 3), mean).max() < 1e-9


USUAL = {"hand": 0.03, "arm": 0.012, "hand_without": -0.04, "arm_without": -0.06, "frechet": 0.08, "detour": 0.07}
USUAL |= {"turn": 20, "turn_without": 10}
OF_ARM, OF_HAND = (Avoidance((), space=space) for space in ("cspace", "task"))


def measurements(*rollouts):
    """Figures (R, F) of a place: what is unusual about each rollout, None of a start without one."""
    figures = np.full((len(rollouts), len(FIGURES)), np.nan)
    for i, changes in enumerate(rollouts):
        if changes is not None:
            figures[i] = [(USUAL | changes).get(figure, np.nan) for figure in FIGURES]
    return figures


@pytest.mark.parametrize(("avoidance", "without", "forced"), [(OF_HAND, -50, 0.06), (OF_ARM, -70, 0.08)])
def test_a_row_has_the_worst_rollout_and_the_detour_relative_to_what_is_forced(avoidance, without, forced):
    worst = {"hand": 0.01, "arm": -0.002, "hand_without": -0.05, "arm_without": -0.07, "detour": 0.12}
    row = _row("place 0", measurements({}, None, worst), avoidance)
    assert row["hand mm"] == pytest.approx(10) and row["arm mm"] == pytest.approx(-2)
    assert row["without mm"] == pytest.approx(without) and row["detour/forced"] == pytest.approx(0.12 / forced)


def shares(*places, avoidance=OF_ARM):
    """Shares of places: ends, and figures of the rollouts."""
    ends, figures = (np.array(each) for each in zip(*places, strict=True))
    blocked = np.isnan(figures[..., 0]).all(axis=1)
    arrays = {"ends": ends, "blocked": blocked, "no_way": blocked, "frechet": figures[..., FIGURES.index("frechet")]}
    return dict(_shares(arrays, figures, avoidance))


def test_only_starts_with_a_rollout_and_the_goal_have_to_be_free():
    places = [((0.1, -0.1, 0.2), measurements({}, changes)) for changes in (None, {})]
    places.append(((0.1, 0.1, -0.2), measurements({}, {})))
    assert shares(*places)["collisions"] == "0 of 1 (0.0 %)"


def test_shares_are_of_the_places_that_have_motions():
    free = (0.1, 0.1, 0.2)
    places = [(free, measurements({"arm": clearance}, {})) for clearance in (0.012, 0.0095, 0.005, -0.002)]
    places.append((free, measurements(None, {"turn": 91})))
    places.append(((-0.1, -0.1, -0.2), measurements(None, None)))
    figures = shares(*places)
    assert figures["places that leave the end effector's starts and goal free"].startswith("5 of 6")
    assert figures["blocked"].startswith("1 of 6") and figures["blocked between free ends"].startswith("1 of 6")
    assert figures["from some of the starts only"].startswith("1 of 5")
    assert figures["collisions"].startswith("1 of 5") and figures["at least 9 mm kept"].startswith("3 of 5")
    assert figures["turns sharper than 90°"].startswith("1 of 5")
    assert figures["the same without avoidance"].startswith("0 of 5") and figures["F.D. mean mm"] == "80.0"
