"""The demonstrations that ship: what the README says of them, and that the script still makes them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from dt_viz.learning.demonstrations import load_demonstrations
from dt_viz.metrics import arc_length, resample_by_arc_length, sharpest_turn
from dt_viz.scenario.tasks import POTS

ASSETS = Path(__file__).parents[1] / "assets"
SIZES = {
    "draw_s": (0.30, 0.40),
    "draw_j": (0.24, 0.40),
    "draw_c": (0.27, 0.40),
    "draw_g": (0.32, 0.40),
    "draw_w": (0.41, 0.30),
    "draw_z": (0.29, 0.39),
    "draw_8": (0.26, 0.40),
}
"""Width and height of each letter, metres."""
NUMBERS = {letter: (7, 2) for letter in (*SIZES, "draw_s_wavy")}
NUMBERS |= {"lift_box": (8, 3), "push_box": (7, 3), "drop_pots": (8, 3)}
"""Number and dimension of the demonstrations of each task."""


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


def mean_of(task):
    """The mean of the demonstrations, (201, d)."""
    return np.mean([resample_by_arc_length(d.positions, 201) for d in shipped(task)], axis=0)


def test_every_task_is_described_here():
    assert set(NUMBERS) == {file.stem for file in ASSETS.glob("*.npz")} - {"body_points"}


@pytest.mark.parametrize("task", NUMBERS)
def test_the_script_makes_the_files_that_ship(script, task):
    made = getattr(script, task)()
    assert [d.name for d in made] == [d.name for d in shipped(task)]
    for ours, theirs in zip(made, shipped(task), strict=True):
        # The script rounds to micrometres; another platform's mathematics may round the last one differently.
        np.testing.assert_allclose(ours.times, theirs.times, rtol=0, atol=2.1e-6)
        np.testing.assert_allclose(ours.positions, theirs.positions, rtol=0, atol=2.1e-6)


@pytest.mark.parametrize("task", NUMBERS)
def test_they_are_varied_and_end_softly_in_exactly_one_point(task):
    demonstrations = shipped(task)
    number, dimension = NUMBERS[task]
    assert [d.dimension for d in demonstrations] == [dimension] * number
    assert len({tuple(d.positions[-1]) for d in demonstrations}) == 1
    starts = np.array([d.positions[0] for d in demonstrations])
    distances = np.linalg.norm(starts[:, None] - starts, axis=-1)
    assert distances[~np.eye(number, dtype=bool)].min() > 0.005
    assert 0.02 < distances.max() < 0.15
    assert len({len(d.times) for d in demonstrations}) == len({d.duration for d in demonstrations}) == number
    for demonstration in demonstrations:
        assert 4 <= demonstration.duration <= 7 and 100 <= len(demonstration.times) <= 250
        speed = speeds(demonstration)
        assert max(speed[0], speed[-1]) < 0.1 * speed.max()


@pytest.mark.parametrize("letter", SIZES)
def test_each_letter_has_its_size_and_is_centred(letter):
    path = mean_of(letter)
    np.testing.assert_allclose(np.ptp(path, axis=0), SIZES[letter], atol=0.02)
    np.testing.assert_allclose((path.min(axis=0) + path.max(axis=0)) / 2, 0, atol=0.03)


def test_the_lift_stays_in_reach_turns_sharply_in_the_box_and_slows_down_there():
    for demonstration in shipped("lift_box"):
        positions, speed = demonstration.positions, speeds(demonstration)
        assert np.linalg.norm(positions - np.array([0, 0, 0.28]), axis=1).max() < 0.75
        assert positions[:, 2].min() > 0.06  # above the table
        assert np.linalg.norm(positions[positions[:, 2].argmin()] - np.array([0.0, -0.55, 0.10])) < 0.04
        assert sharpest_turn(positions, 0.04) > 75
        inner = speed[len(positions) // 4 : -len(positions) // 4]
        assert inner.min() < 0.6 * np.median(inner)


def test_the_hand_comes_down_behind_the_box_then_pushes_it_level_in_a_gentle_arc():
    for demonstration in shipped("push_box"):
        path = resample_by_arc_length(demonstration.positions, 200)
        down = int(np.argmax(path[:, 2] < 0.165))
        assert path[0, 2] - path[down, 2] > 0.15
        push = path[down:]
        assert push[:, 2].min() > 0.12 and push[:, 2].max() < 0.17  # above the table, at the height of a box
        assert 0.6 < arc_length(push)[-1] < 1.2 * np.linalg.norm(push[-1] - push[0])
        away = push[:, 1] - np.interp(-push[:, 0], -push[[0, -1], 0], push[[0, -1], 1])
        assert -0.13 < away.min() < -0.07  # the arc lies outwards, as the arm turns
        assert sharpest_turn(path, 0.015) < 30


def test_the_object_is_carried_over_the_centre_pot_and_stops_above_it():
    left, centre, right = POTS
    assert left.x == -right.x and 0.15 <= right.x - centre.x <= 0.17 and left.y == centre.y == right.y
    for demonstration in shipped("drop_pots"):
        path = demonstration.positions
        assert (path[:, 2] > centre.height + 0.10).all()
        assert [pot.catches(path[-1]) for pot in POTS] == [False, True, False]
        np.testing.assert_allclose(path[-1, :2], centre.opening[:2], atol=1e-6)
        down = path[-1] - path[-len(path) // 4]
        assert -down[2] > np.linalg.norm(down[:2])  # the last quarter of the time leads down
