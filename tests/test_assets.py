"""The demonstrations that ship: what the README says of them, and that the script still makes them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from dt_viz.demos import load_demonstrations
from dt_viz.metrics import arc_length, resample_by_arc_length, sharpest_turn

ASSETS = Path(__file__).parents[1] / "assets"
TASKS = ["draw_s", "lift_box"]


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


@pytest.mark.parametrize(("task", "number", "dimension"), [("draw_s", 7, 2), ("lift_box", 8, 3)])
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
