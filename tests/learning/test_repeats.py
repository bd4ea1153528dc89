"""A learned motion is a continuous function of its demonstrations: rounding, order and machine do not change it."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from crossings import crossings
from drawings import extent, from_one_start

from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.flow_chain import FlowLayer
from dt_viz.learning.state import learn
from dt_viz.learning.timing import TimingSettings, _fit_pace
from dt_viz.scenario.tasks import TASKS

STATES = ("plain", "augmented")
NOISE = 1e-12
"""Deviation of demonstrations that are the same but for rounding, relative to their extent."""
ALIKE = 1e-6
"""Largest distance of motions that are the same but for rounding, relative to the extent: what rounding grows to in a
fit that turns far, with room to spare."""
SADDLE = 1e-5
"""The same for the plain fit of mirrored demonstrations, which has to leave a symmetric saddle: up to 2.6e-6 was
measured there, and 1.3e-9 in all other cases of the quick tests."""
BESIDE = 0.02  # deviation of starts beside the demonstrated ones, relative to the extent
FITTED_ELSEWHERE = ("draw_s", "draw_g", "push_box")


def motions(demonstrations, state, order=None):
    """Places of what is learned from demonstrations in an `order`: evenly by phase, and at equal times, (2, N, 100, d).

    They are ordered as the demonstrations are; the second half begins beside these.
    """
    order = np.arange(len(demonstrations)) if order is None else order
    imitation = learn([demonstrations[k] for k in order], state=state)
    starts = np.stack([d.positions[0] for d in demonstrations])
    beside = np.random.default_rng(0).normal(scale=BESIDE * extent(demonstrations), size=starts.shape)
    labels = imitation.labels
    own = [None] * len(starts) if labels is None else [labels[k] for k in np.argsort(order)]
    system, times = imitation.system, np.linspace(0, 1.2 * max(d.times[-1] for d in demonstrations), 100)
    found = []
    for start, label in zip((*starts, *(starts + beside)), own + own, strict=True):
        state_0 = system.base.states(start, label)
        by_phase = system.transform.inverse(
            system.base.at_fraction(system.transform.forward(state_0), np.linspace(1, 0, len(times)))
        )
        found.append(np.stack([by_phase, system.rollout(state_0, times)])[..., : len(start)])
    return np.stack(found, axis=1)


def assert_repeated(demonstrations, state, seed=0, alike=ALIKE):
    """What is learned does not change with the rounding of demonstrations and with their order."""
    rng, noise = np.random.default_rng(seed), NOISE * extent(demonstrations)
    rounded = [replace(d, positions=d.positions + noise * rng.normal(size=d.positions.shape)) for d in demonstrations]
    found = motions(rounded, state, rng.permutation(len(demonstrations)))
    assert np.abs(found - motions(demonstrations, state)).max() < alike * extent(demonstrations)


@pytest.mark.long
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("task", ["draw_s", "draw_z", "push_box"])
def test_motions_and_their_timing_do_not_hang_on_rounding_or_order(task, state):
    assert_repeated(TASKS[task]().demonstrations[:5], state)


def arcs(*heights):
    """Arcs over one straight line, of which starts, ends and durations agree exactly."""
    s = np.linspace(0, 1, 120)
    return [Demonstration(2 * s, np.stack([0.5 * (s - 1), k * s * (1 - s)], axis=1), f"arc {k:g}") for k in heights]


EVEN = {
    "from one start": from_one_start(TASKS["draw_g"]().demonstrations[:3]),
    "one motion three times": [TASKS["draw_g"]().demonstrations[0]] * 3,
    "mirrored": arcs(-0.4, -0.2, 0.2, 0.4),
    "straight": arcs(0.0, 0.0),
}
"""Demonstrations that tie by construction: for the directions in which starts scatter, for the nearest inducing point,
for the side on which to pass."""


@pytest.mark.long
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("name", EVEN)
def test_exactly_even_demonstrations_decide_nothing_by_rounding(name, state):
    assert_repeated(EVEN[name], state, alike=SADDLE if (name, state) == ("mirrored", "plain") else ALIKE)


@pytest.mark.long
@pytest.mark.parametrize("name", ["crossing at equal phase", "left and right from one start", "reach and retreat"])
def test_the_state_and_the_labels_do_not_hang_on_rounding_or_order(name):
    assert_repeated(list(crossings()[name].demonstrations), "auto")


def test_inducing_points_on_the_edge_of_the_reach_are_in_use_however_they_are_rounded():
    ends = np.array([[0.0, 0.0], [0.0, 5.0]])
    inner = FlowLayer.near(ends, 1.0, spacing=1.0, reach=1.25).grid.axes[1][2:-2]  # heights of inducing points
    points = np.concatenate([ends, np.stack([np.zeros_like(inner), inner], axis=1)])
    exact = FlowLayer.near(points, 1.0, spacing=1.0, reach=1.25)
    for seed in range(10):
        noise = 1e-13 * np.random.default_rng(seed).normal(size=points.shape)
        np.testing.assert_array_equal(FlowLayer.near(points + noise, 1.0, spacing=1.0, reach=1.25).active, exact.active)


@pytest.mark.parametrize("quick", [False, True])
def test_the_pace_is_solved_for_to_rounding_also_at_its_limit(quick):
    rng, knots = np.random.default_rng(0), np.linspace(-2.0, 1.0, 24)
    clock, steps = np.linspace(0.5, -2.0, 60), rng.uniform(0, 0.1, 60)
    steps[20:40] *= 0.02 if quick else 1.0
    settings = TimingSettings()
    pace = _fit_pace(knots, clock, np.cumsum(steps), np.ones(60), settings)
    assert (pace.min() == settings.min_pace) == quick and (pace >= settings.min_pace).all()
    for seed in range(5):
        noise = 1e-12 * np.random.default_rng(seed).normal(size=60)
        found = _fit_pace(knots, clock, np.cumsum(steps) + noise, np.ones(60), settings)
        np.testing.assert_allclose(found, pace, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("task", TASKS)
def test_no_task_hangs_on_rounding_or_order(task, state, seed):
    assert_repeated(TASKS[task]().demonstrations, state, seed)


FITS = """
import sys
import numpy as np
from test_repeats import FITTED_ELSEWHERE, STATES, TASKS, motions
np.savez(sys.argv[1], **{f"{t} {s}": motions(TASKS[t]().demonstrations, s) for t in FITTED_ELSEWHERE for s in STATES})
"""


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "2"])
@pytest.mark.parametrize("processor", ["Haswell", "SkylakeX", "Prescott"])
def test_another_processor_learns_the_same(processor, threads, tmp_path):
    setting = {"OPENBLAS_CORETYPE": processor, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    file = tmp_path / "motions.npz"
    subprocess.run([sys.executable, "-c", FITS, str(file)], env=os.environ | setting | {"PYTHONPATH": path}, check=True)
    with np.load(file) as elsewhere:
        for task in FITTED_ELSEWHERE:
            demonstrations = TASKS[task]().demonstrations
            for state in STATES:
                off = np.abs(elsewhere[f"{task} {state}"] - motions(demonstrations, state)).max()
                assert off < ALIKE * extent(demonstrations)
