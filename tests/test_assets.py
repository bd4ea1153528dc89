"""The demonstrations that ship: what the README says of them, and that the script still makes them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from dt_viz.learning.demonstrations import load_demonstrations

ASSETS = Path(__file__).parents[1] / "assets"
NUMBERS = {f"draw_{letter}": (7, 2) for letter in ("s", "j", "c", "g", "w", "z", "8", "s_wavy")}
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
