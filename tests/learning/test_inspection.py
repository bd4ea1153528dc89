"""What is odd about takes is found, said and repaired; what is not odd stays as it is, to the last bit."""

from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from corrupted import CORRUPTIONS, NOISE, corrupted, elsewhere, noise, sampled, slower
from crossings import crossings
from scipy.spatial import KDTree

from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.inspection import PreparationSettings
from dt_viz.learning.preparation import ImitationError, prepare
from dt_viz.learning.state import learn
from dt_viz.metrics import interpolate, resample_by_arc_length
from dt_viz.scenario.tasks import TASKS

KINDS = {"noise": "jitter", "tremor": "jitter", "pauses": "pause", "gaps": "gap", "outliers": "outliers"}
"""Kind of the finding about each corruption."""


def found(motions):
    return {each.kind for inspection in motions.inspections for each in inspection.findings}


def off(takes, clean):
    """Largest distance of samples of takes from the paths of clean ones, metres."""
    return max(
        KDTree(resample_by_arc_length(own.positions, 2000)).query(take.positions)[0].max()
        for take, own in zip(takes, clean, strict=True)
    )


CLEAN = {name: task().demonstrations for name, task in TASKS.items()} | {
    name: case.demonstrations for name, case in crossings().items()
}


@pytest.mark.parametrize("rate", [None, 5, 1000])
@pytest.mark.parametrize("name", CLEAN)
def test_clean_takes_have_no_findings_and_are_not_touched(name, rate):
    takes = CLEAN[name]
    if rate is not None:
        pairs = [sampled(own.times, own.positions, rate) for own in takes]
        takes = [Demonstration(*pair, own.name) for pair, own in zip(pairs, takes, strict=True)]
    motions = prepare(takes)
    assert motions.warnings == ()
    for take, own in zip(motions.repaired, takes, strict=True):
        assert take is own


@pytest.mark.parametrize("name", CORRUPTIONS)
@pytest.mark.parametrize(("task", "rate"), [("push_box", 20), ("push_box", 1000), ("draw_z", 100)])
def test_a_corruption_is_found_by_its_kind_and_repaired(task, name, rate):
    clean = TASKS[task]().demonstrations[:6]
    takes = corrupted(clean, [name], rate, seed=3)
    motions = prepare(takes)
    assert found(motions) - {"end"} == {KINDS[name]}
    assert all(inspection.kept for inspection in motions.inspections)
    left = {"noise": 0.7 if rate == 1000 else 1.5, "tremor": 1.5, "gaps": 2.0}.get(name, 0.2)
    if rate == 20 and KINDS[name] == "jitter":
        left = 4.0  # little of it can be told from motion at 20 Hz
    assert off(motions.repaired, clean) < left * NOISE
    assert not found(prepare(motions.repaired)) - {"end"}


@pytest.mark.parametrize("name", [name for name in CORRUPTIONS if name != "gaps"])
def test_each_repair_has_a_switch(name):
    switch = {"outliers": "drop_outliers", "pauses": "cut_pauses"}.get(name, "smooth_jitter")
    takes = corrupted(TASKS["push_box"]().demonstrations[:6], [name], 100, seed=3)
    repairs: dict[str, Any] = dict.fromkeys(
        ["smooth_jitter", "cut_pauses", switch], False
    )  # outliers look like jitter and pauses
    motions = prepare(takes, PreparationSettings(**repairs))
    assert KINDS[name] in found(motions)
    for take, own in zip(motions.repaired, takes, strict=True):
        np.testing.assert_array_equal(take.times, own.times)


def test_a_gap_is_bridged_by_a_curve_unless_that_is_switched_off():
    clean = TASKS["draw_s"]().demonstrations[:6]
    takes = corrupted(clean, ["gaps"], 100, seed=3)
    motions = prepare(takes)
    assert all(len(take.times) > len(own.times) for take, own in zip(motions.repaired, takes, strict=True))
    straight = prepare(takes, PreparationSettings(bridge_gaps=False))
    assert all(take is own for take, own in zip(straight.repaired, takes, strict=True))
    uneven = corrupted(TASKS["draw_j"]().demonstrations[:6], [*KINDS][:4], 5, seed=149)
    assert all((np.diff(take.times) > 0.01).all() for take in prepare(uneven).repaired)
    assert "straight line" in straight.warnings[0] and "curve" in motions.warnings[0]


def test_several_gaps_are_bridged_by_straight_lines():
    own = TASKS["draw_s"]().demonstrations[0]
    kept = [k for k in range(len(own.times)) if k not in {*range(40, 60), *range(100, 120)}]
    take = replace(own, times=own.times[kept], positions=own.positions[kept])
    motions = prepare([take], PreparationSettings(bridge_gaps=False))
    assert motions.warnings[0].endswith(", 2 gaps; bridged by a straight line") and motions.repaired == (take,)


def test_a_pause_of_most_takes_belongs_to_the_motion_but_not_one_before_it_begins():
    own = TASKS["draw_s"]().demonstrations[0]
    even = np.linspace(0.0, own.times[-1] + 1.5, 400)
    for at, kept in ((0.4 * own.times[-1], True), (0.0, False)):
        waiting = np.where(even < at, even, np.maximum(at, even - 1.5))
        takes = [Demonstration(even, interpolate(waiting, own.times, own.positions), f"{k}") for k in range(3)]
        motions = prepare(takes)
        assert found(motions) == {"pause"}
        assert ("kept" in motions.warnings[0]) == kept
        assert motions.times[0][-1] == pytest.approx(even[-1] - (0 if kept else 1.5), abs=0.1)


def test_orientations_go_with_the_samples():
    clean = TASKS["push_box"]().demonstrations[:3]
    takes = []
    for own in corrupted(clean, ["gaps", "outliers", "noise"], 100, seed=3):
        turns = np.column_stack([np.cos(0.2 * own.times), 0 * own.times, 0 * own.times, np.sin(0.2 * own.times)])
        takes.append(Demonstration(own.times, own.positions, own.name, turns))
    motions = prepare(takes)
    for take in motions.repaired:
        assert take.orientations is not None and len(take.times) == len(take.orientations)
        half = np.arctan2(take.orientations[:, 3], take.orientations[:, 0])
        np.testing.assert_allclose(np.diff(half), 0.2 * np.diff(take.times), atol=1e-9)


def test_a_take_in_millimetres_is_converted_and_said():
    takes = list(TASKS["push_box"]().demonstrations[:4])
    takes[2] = replace(takes[2], positions=1e3 * np.asarray(takes[2].positions))
    motions = prepare(takes)
    assert "millimetres" in motions.warnings[0] and "it is converted" in motions.warnings[0]
    expected = prepare(TASKS["push_box"]().demonstrations[:4])
    np.testing.assert_allclose(motions.positions[2], expected.positions[2], atol=1e-9)


# ---- ends that are apart ----


def ending(*places):
    """Takes of one shape, 40 cm long, that end at these places."""
    own = TASKS["draw_s"]().demonstrations[0]
    path = own.positions - own.positions[-1]
    return [Demonstration(own.times, path + np.array(place), f"take {k}") for k, place in enumerate(places)]


def test_the_goal_is_that_of_most_takes_and_others_are_left_out():
    takes = ending((0, 0), (0.3, 0), (0, 0.3), (0, 0), (0.002, 0), (0, 0))
    motions = prepare(takes)
    assert motions.numbers == (0, 3, 4, 5)
    np.testing.assert_allclose(motions.goal, (0.0005, 0.0), atol=1e-12)
    assert [each.kept for each in motions.inspections] == [True, False, False, True, True, True]
    everything = prepare(takes, PreparationSettings(leave_out=False))
    assert everything.numbers == tuple(range(6))
    assert all((path[-1] == everything.goal).all() for path in everything.positions)
    assert prepare(takes, PreparationSettings(move_ends=False)).numbers == (0, 3, 5)  # all that end at one place


def test_where_no_goal_is_that_of_most_the_message_says_which_there_are_and_one_can_be_given():
    takes = ending((0, 0), (0.3, 0), (0, 0), (0.3, 0))
    with pytest.raises(ImitationError, match=r"'take 0', 'take 2' at \(0, 0\) m; 'take 1', 'take 3' at .*goal=…"):
        prepare(takes)
    motions = prepare(takes, PreparationSettings(goal=(0.301, 0.0)))
    assert motions.numbers == (1, 3)
    np.testing.assert_array_equal(motions.goal, (0.301, 0.0))
    with pytest.raises(ImitationError, match=r"no demonstration ends; accepted: a place within .* such as \(0"):
        prepare(takes, PreparationSettings(goal=(3.0, 0.0)))
    with pytest.raises(ImitationError, match=r"goal: found \(1.0,\); accepted: 2 finite numbers"):
        prepare(takes, PreparationSettings(goal=(1.0,)))


# ---- what is learned ----


def rollouts(imitation, takes):
    """Places of the learned motions from the starts of clean takes, evenly by phase."""
    states = imitation.system.base.demonstrated(np.stack([own.positions[0] for own in takes]))
    z = imitation.system.base.at_fraction(imitation.system.transform.forward(states), np.linspace(1, 0, 300))
    return imitation.system.transform.inverse(z)[..., : takes[0].dimension]


def misses(imitation, takes):
    """Largest distance (R,) of points of either, the learned motion and the take, from the other, metres."""
    found = []
    for path, own in zip(rollouts(imitation, takes), takes, strict=True):
        ends = resample_by_arc_length(path, 1000), resample_by_arc_length(own.positions, 1000)
        found.append(max(KDTree(a).query(b)[0].max() for a, b in (ends, ends[::-1])))
    return np.array(found)


@cache
def expected_miss(clean, state):
    """Largest distance of motions that are learned from clean takes, metres."""
    return misses(learn(clean, state=state), clean).max()


def assert_learned(takes, clean, state):
    """Motions learned from takes are as near to the clean ones as those learned from these, but for the noise."""
    expected = expected_miss(tuple(clean), state)
    assert misses(learn(prepare(takes).repaired, state=state), clean).max() < expected + 2 * NOISE + 0.005


TOLD = ("draw_s", "draw_z", "push_box", "lift_box", "drop_pots")
ALL = [*product(TOLD, (50, 100, 1000), ("plain", "augmented"), range(8))]
QUICK = {("draw_s", 50, "plain", 0), ("draw_z", 100, "augmented", 1), ("push_box", 1000, "augmented", 2)}


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "rate", "state", "seed"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case not in QUICK)) for case in ALL],
)
def test_takes_with_random_corruptions_are_learned_as_clean_ones_are(task, rate, state, seed):
    rng = np.random.default_rng(seed)
    clean = TASKS[task]().demonstrations[:6]
    names = [name for name in CORRUPTIONS if rng.uniform() < 0.6]
    assert_learned(corrupted(clean, names, rate, seed), clean, state)


@pytest.mark.parametrize(("num", "num_samples"), [(1, 20), (3, 2000), (50, 20)])
def test_few_and_many_takes_of_any_duration_and_start_are_learned(num, num_samples):
    rng, s = np.random.default_rng(num), np.linspace(0.0, 1.0, 400)
    base = np.column_stack([0.4 * (1 - s), 0.15 * np.sin(4 * (1 - s))])
    clean, takes = [], []
    for k in range(num):
        times, path = slower(*elsewhere(4 * s, base, rng), rng)
        clean.append(Demonstration(times, path, f"take {k}"))
        even = np.linspace(0.0, times[-1], num_samples)
        takes.append(Demonstration(*noise(even, interpolate(even, times, path), rng), f"take {k}"))
    durations = [own.times[-1] for own in clean]
    assert num < 50 or max(durations) > 4 * min(durations)
    assert_learned(takes, clean, "augmented")


def test_many_samples_become_a_few():
    s = np.linspace(0.0, 1.0, 200_000)
    path = np.column_stack([0.4 * (1 - s), 0.15 * np.sin(4 * (1 - s))])
    take = Demonstration(*noise(4 * s, path, np.random.default_rng(0)), "long")
    motions = prepare([take])
    assert len(motions.times[0]) <= 2001 and off(motions.repaired, [Demonstration(4 * s, path)]) < NOISE / 3
