"""The demonstrations that ship: what the README says of them, and that the script still makes them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from dt_viz.learning.demonstrations import load_demonstrations
from dt_viz.metrics import arc_length, resample_by_arc_length, sharpest_turn
from dt_viz.scenario.tasks import POTS

ASSETS = Path(__file__).parents[1] / "assets"
TASKS = [
    "draw_s",
    "lift_box",
    "push_box",
    "draw_j",
    "drop_pots",
    "draw_c",
    "draw_g",
    "draw_w",
    "draw_z",
    "draw_8",
    "draw_s_wavy",
]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("make_demonstrations", ASSETS / "make_demonstrations.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def shipped(task):
    return load_demonstrations(ASSETS / f"{task}.npz")


def speeds(demonstration):
    return np.linalg.norm(np.diff(demonstration.positions, axis=0), axis=1) / np.diff(demonstration.times)


@pytest.mark.parametrize("task", TASKS)
def test_the_script_makes_the_files_that_ship(script, task):
    made = getattr(script, task)()
    assert [d.name for d in made] == [d.name for d in shipped(task)]
    for ours, theirs in zip(made, shipped(task), strict=True):
        # The script rounds to micrometres; another platform's mathematics may round the last one differently.
        np.testing.assert_allclose(ours.times, theirs.times, rtol=0, atol=2.1e-6)
        np.testing.assert_allclose(ours.positions, theirs.positions, rtol=0, atol=2.1e-6)


@pytest.mark.parametrize(
    ("task", "number", "dimension"),
    [
        *((f"draw_{letter}", 7, 2) for letter in "sjcgwz8"),
        ("lift_box", 8, 3),
        ("push_box", 7, 3),
        ("drop_pots", 8, 3),
    ],
)
def test_number_and_dimension(task, number, dimension):
    assert [d.dimension for d in shipped(task)] == [dimension] * number


@pytest.mark.parametrize("task", TASKS)
def test_all_of_a_task_end_in_exactly_one_point_and_start_a_few_centimetres_apart(task):
    positions = [d.positions for d in shipped(task)]
    assert len({tuple(p[-1]) for p in positions}) == 1
    starts = np.array([p[0] for p in positions])
    distances = np.linalg.norm(starts[:, None] - starts[None], axis=-1)
    assert distances[~np.eye(len(starts), dtype=bool)].min() > 0.005
    assert 0.02 < distances.max() < 0.15


@pytest.mark.parametrize("task", TASKS)
def test_durations_and_sample_counts_differ(task):
    demonstrations = shipped(task)
    assert all(4 <= d.duration <= 7 and 100 <= len(d.times) <= 250 for d in demonstrations)
    assert (
        len({len(d.times) for d in demonstrations}) == len({d.duration for d in demonstrations}) == len(demonstrations)
    )


@pytest.mark.parametrize("task", TASKS)
def test_each_starts_and_stops_softly(task):
    for demonstration in shipped(task):
        speed = speeds(demonstration)
        assert max(speed[0], speed[-1]) < 0.1 * speed.max()


def test_the_letter_is_centred_and_drawn_from_upper_right_to_lower_left():
    paths = [resample_by_arc_length(d.positions, 100) for d in shipped("draw_s")]
    mean = np.mean(paths, axis=0)
    np.testing.assert_allclose(np.ptp(mean, axis=0), [0.30, 0.40], atol=0.02)
    np.testing.assert_allclose((mean.min(axis=0) + mean.max(axis=0)) / 2, 0, atol=0.01)
    assert (mean[0] > 0.1).all() and (mean[-1] < -0.1).all()
    assert all(arc_length(path)[-1] > 1.0 for path in paths)


def test_the_lift_stays_in_reach_and_above_the_table():
    for demonstration in shipped("lift_box"):
        positions = demonstration.positions
        assert np.linalg.norm(positions - np.array([0, 0, 0.28]), axis=1).max() < 0.75
        assert positions[:, 2].min() > 0.06


def test_the_lift_turns_sharply_in_the_box_and_slows_down_there():
    for demonstration in shipped("lift_box"):
        positions = demonstration.positions
        lowest = positions[:, 2].argmin()
        assert np.linalg.norm(positions[lowest] - np.array([0.0, -0.55, 0.10])) < 0.04
        assert sharpest_turn(positions, 0.04) > 75
        inner = slice(len(positions) // 4, -len(positions) // 4)
        assert speeds(demonstration)[inner].min() < 0.6 * np.median(speeds(demonstration)[inner])


def test_the_hand_comes_down_behind_the_box_then_pushes_it_level_in_a_gentle_arc():
    for demonstration in shipped("push_box"):
        path = resample_by_arc_length(demonstration.positions, 200)
        down = int(np.argmax(path[:, 2] < 0.165))
        assert path[0, 2] - path[down, 2] > 0.15
        push = path[down:]
        assert push[:, 2].min() > 0.12 and push[:, 2].max() < 0.17  # above the table, at the height of a box
        assert arc_length(push)[-1] > 0.6
        assert arc_length(push)[-1] < 1.2 * np.linalg.norm(push[-1] - push[0])
        away = push[:, 1] - np.interp(-push[:, 0], -push[[0, -1], 0], push[[0, -1], 1])
        assert -0.13 < away.min() < -0.07  # the arc lies outwards, as the arm turns
        assert sharpest_turn(path, 0.015) < 30


def test_a_sphere_in_the_middle_of_the_push_leaves_start_and_goal_free():
    paths = [resample_by_arc_length(d.positions, 101) for d in shipped("push_box")]
    ends = np.concatenate([[path[0], path[-1]] for path in paths])
    farthest_shift = 0.05
    distance = np.linalg.norm(ends - np.mean(paths, axis=0)[50], axis=1)
    assert distance.min() - farthest_shift - 0.15 / 2 > 0.06


def test_the_letter_j_is_centred_and_drawn_down_its_stem_and_up_its_bow():
    paths = [resample_by_arc_length(d.positions, 100) for d in shipped("draw_j")]
    mean = np.mean(paths, axis=0)
    np.testing.assert_allclose(np.ptp(mean, axis=0), [0.24, 0.40], atol=0.02)
    np.testing.assert_allclose((mean.min(axis=0) + mean.max(axis=0)) / 2, 0, atol=0.01)
    lowest = mean[mean[:, 1].argmin()]
    assert mean[0, 1] == mean[:, 1].max() and mean[0, 0] > 0.08  # from the top of the stem
    assert mean[-1, 0] == mean[:, 0].min() and mean[-1, 1] > lowest[1] + 0.08  # to the upper left end of the bow


def test_each_letter_is_written_in_its_own_direction_with_its_own_corners():
    def mean(letter):
        return np.mean([resample_by_arc_length(d.positions, 201) for d in shipped(f"draw_{letter}")], axis=0)

    sizes = {"c": (0.27, 0.40), "g": (0.32, 0.40), "w": (0.41, 0.30), "z": (0.29, 0.39)}
    for letter, size in sizes.items():
        path = mean(letter)
        np.testing.assert_allclose(np.ptp(path, axis=0), size, atol=0.02)
        np.testing.assert_allclose((path.min(axis=0) + path.max(axis=0)) / 2, 0, atol=0.03)

    c, g, w, z = (mean(letter) for letter in "cgwz")
    assert c[0, 0] > 0.08 and c[0, 1] > 0.1 and c[-1, 0] > 0.08 and c[-1, 1] < -0.1  # open to the right
    assert sharpest_turn(c, 0.02) < 20
    bar = g[-20:]
    assert np.ptp(bar[:, 1]) < 0.02 and (np.diff(bar[:, 0]) < 0).all()  # in, along the bar
    assert sharpest_turn(g, 0.04) > 60  # into it
    heights = np.diff(np.sign(np.diff(w[:, 1])))
    assert heights[heights != 0].tolist() == [2, -2, 2]  # down, up, down, up
    assert (np.diff(w[:, 0]) > 0).all()
    across = np.diff(z[:, 0])
    assert across[:40].min() > 0 and across[-40:].min() > 0 and across[90:110].max() < 0  # right, back, right
    assert z[0, 1] > 0.15 and z[-1, 1] < -0.15


def test_the_object_is_carried_over_the_centre_pot_and_stops_above_it():
    left, centre, right = POTS
    assert left.x == -right.x and 0.15 <= right.x - centre.x <= 0.17 and left.y == centre.y == right.y
    for demonstration in shipped("drop_pots"):
        path = demonstration.positions
        assert (path[:, 2] > centre.height + 0.10).all()
        assert centre.catches(path[-1])
        assert not left.catches(path[-1]) and not right.catches(path[-1])
        np.testing.assert_allclose(path[-1, :2], centre.opening[:2], atol=1e-6)
        down = path[-1] - path[-len(path) // 4]
        assert -down[2] > np.linalg.norm(down[:2])  # the last quarter of the time leads down
