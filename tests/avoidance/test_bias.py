"""Bias points: the field that pulls, motions that pass their targets, and what is said of targets out of reach."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import avoiding, biases

from dt_viz.avoidance.bias import ACCEPTED, AIM, MAX_DURATION, BiasPoint, unit_field
from dt_viz.avoidance.hand import ACCEPTED_MARGIN
from dt_viz.avoidance.transform import MotionBelow
from dt_viz.flows.diffeomorphisms import Chain, min_det_jacobian, round_trip_error
from dt_viz.metrics import resample_by_arc_length, sharpest_turn
from dt_viz.motion.stack import FINE, LIVE, Solution, build_stack
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import DRAWING_AXES
from dt_viz.warning import Kind

seeds = st.integers(0, 2**32 - 1)
PLANE = as_point(DRAWING_AXES[:, 0]), as_point(DRAWING_AXES[:, 1])


def plane_of(task):
    return PLANE if task.startswith("draw") else None


@pytest.fixture(scope="session")
def nominal(engine):
    """The undisturbed motion of a task."""
    return lru_cache(lambda task: engine.nominal(Scenario(task)))


def biased(nominal, *points, precision=FINE, **changes) -> Solution:
    scenario = avoiding(nominal.task.name, layers=biases(*points), **changes)
    return build_stack(nominal, scenario.active, precision)


def satisfied(solution) -> bool:
    return all(applied.satisfied for applied in solution.built)


def motion_of(nominal, bundle) -> MotionBelow:
    return MotionBelow(nominal.task.starts, nominal.goal, bundle.index, bundle.positions)


def missed(nominal, solution, point) -> float:
    return float(point.distances(motion_of(nominal, solution.bundle)).max())


def beside(nominal, rng, plane=None):
    """A target up to 15 cm off a place in the middle three quarters of a rollout, above the table."""
    path = resample_by_arc_length(nominal.bundle.paths[rng.integers(len(nominal.bundle.paths))], 201)
    k = int(rng.integers(25, 175))
    tangent, aside = path[k + 1] - path[k - 1], rng.normal(size=3)
    if plane is not None:
        aside = np.array(plane).T @ (np.array(plane) @ aside)
    aside = aside - (aside @ tangent) / (tangent @ tangent) * tangent
    place = path[k] + rng.uniform(0.0, 0.15) * aside / np.linalg.norm(aside)
    return as_point(place) if place[2] >= 0 else beside(nominal, rng, plane)


def assert_sound(nominal, solution, goal=None):
    """Ends kept, a diffeomorphism along the rollouts, there and back again exact."""
    paths, y = solution.bundle.paths, solution.bundle.positions
    goal = nominal.goal if goal is None else goal
    for path, start in zip(paths, nominal.task.starts, strict=True):
        np.testing.assert_allclose(path[[0, -1]], [start, goal], atol=1e-6)
    assert min_det_jacobian(solution.transform.jacobian, y) > 0
    assert round_trip_error(solution.transform, y) < 1e-6


# the field


@pytest.mark.parametrize("dim", [2, 3])
def test_the_field_leads_away_from_the_centre_nearly_alike_everywhere_outside_its_core(dim):
    away = np.random.default_rng(dim).normal(size=(200, dim))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    for radius in (0.3, 0.4, 0.5):
        V = unit_field(dim)(np.pad(radius * away, ((0, 0), (0, 3 - dim))))[:, :dim] / (1 - radius**2) ** 3
        outward = (V * away).sum(axis=1)
        assert outward.min() > 0.75 and outward.max() < 1.15
        assert np.linalg.norm(V - outward[:, None] * away, axis=1).max() < 0.05


@pytest.mark.parametrize("dim", [2, 3])
def test_the_field_is_at_rest_at_the_centre_and_ends_smoothly(dim):
    """Value and derivative fade out together: near the border of its region both are small, however near."""
    field, direction = unit_field(dim), np.array([0.6, 0.8, 0.0])
    assert np.abs(field(np.zeros((1, 3)))).max() < 1e-12
    for gap, bound in ((1e-2, 1e-3), (1e-3, 1e-6)):
        V, DV = field.with_jacobian((1 - gap) * direction[None])
        assert 0 < np.abs(V).max() < bound
        assert np.abs(DV).max() < 10 * bound / gap
    outside = np.random.default_rng(0).normal(size=(100, 3))
    outside *= 1.001 / np.linalg.norm(outside[:, :dim], axis=1, keepdims=True)
    V, DV = field.with_jacobian(outside)
    assert not V.any() and not DV.any() and not field(outside).any()


# motions


@pytest.mark.parametrize("task", ["draw_s", "lift_box", pytest.param("push_box", marks=pytest.mark.slow)])
@pytest.mark.parametrize("num", [6, pytest.param(30, marks=pytest.mark.slow)])
def test_every_rollout_passes_within_a_centimetre_of_targets_up_to_15_cm_off(nominal, task, num):
    g, rng, off, turns = nominal(task), np.random.default_rng(7), [], []
    for number in range(num):
        point = BiasPoint(beside(g, rng, plane_of(task)), plane=plane_of(task))
        solution = biased(g, point, precision=FINE if number % 5 == 0 else LIVE)
        assert satisfied(solution) and solution.warnings == ()
        assert missed(g, solution, point) <= ACCEPTED
        off.append(point.distances(motion_of(g, g.bundle)).max())
        turns.append(max(sharpest_turn(path, 0.02) for path in solution.bundle.paths))
        if number % 5 == 0:
            assert_sound(g, solution)
        if plane_of(task):
            assert np.ptp(solution.bundle.positions[:, 1]) < 1e-12  # a drawing stays in its plane
    assert max(off) > (0.12 if num > 6 else 0.07)  # the targets were not all on the path
    before = max(sharpest_turn(path, 0.02) for path in g.bundle.paths)
    assert np.median(turns) < before + 65  # on two centimetres, degrees


def straight(distance, num=401, **changes):
    """A straight motion that passes the origin at this distance."""
    path = np.stack([np.linspace(-0.6, 0.6, num), np.full(num, distance), np.zeros(num)], axis=1)
    changes = {"name": "Bias 1", "tolerance": 1e-8, **changes}
    return MotionBelow(path[:1], path[-1], np.zeros(num, dtype=int), path, **changes)


def side_by_side(distances, **changes):
    """Straight motions that pass the origin at these distances."""
    motions = [straight(distance) for distance in distances]
    index = np.repeat(np.arange(len(motions)), len(motions[0].index))
    positions = np.concatenate([motion.positions for motion in motions])
    starts = np.concatenate([motion.starts for motion in motions])
    return MotionBelow(starts, motions[0].goal, index, positions, name="Bias 1", tolerance=1e-8, **changes)


@settings(max_examples=6)
@given(st.floats(0.02, 0.15), st.sampled_from([None, 0.3]))
def test_one_motion_is_shifted_to_the_target(distance, radius):
    motion, point = straight(distance), BiasPoint((0.0, 0.0, 0.0), radius)
    built = point.build(motion)
    (shift,) = Chain([built.transform]).parts
    np.testing.assert_allclose(shift.inverse(np.array([0.0, distance, 0.0])), 0, atol=1e-5)
    after = replace(motion, positions=built.transform.inverse(motion.positions))
    assert point.satisfied(after, after.positions) and not point.satisfied(motion, motion.positions)


@settings(max_examples=6)
@given(st.floats(-0.05, 0.10), st.floats(0.02, 0.06), st.sampled_from([None, 0.3]))
def test_several_are_shifted_together_and_gathered_as_briefly_as_can_be(distance, apart, radius):
    motion, point = side_by_side((distance, distance + apart)), BiasPoint((0.0, 0.0, 0.0), radius)
    built = point.build(motion)
    *shifts, waist = Chain([built.transform]).parts
    shifted = Chain(shifts).inverse(motion.positions) if shifts else motion.positions

    def after(part):
        moved = waist.scaled(part).inverse(shifted)
        return float(point.distances(replace(motion, positions=moved)).max())

    assert after(1.0) == pytest.approx(AIM, rel=0.03)
    assert after(0.97) > AIM


@pytest.mark.parametrize(("distance", "most"), [(0.05, 25), (0.10, 40)])
def test_a_letter_is_bent_without_corners_where_starts_and_goal_leave_room(nominal, distance, most):
    g = nominal("draw_s")
    mean = np.mean([resample_by_arc_length(path, 201) for path in g.bundle.paths], axis=0)
    tried = 0
    for k in range(40, 161, 15):
        across = np.cross(mean[k + 1] - mean[k - 1], [0.0, 1.0, 0.0])
        for side in (-1, 1):
            place = mean[k] + side * distance * across / np.linalg.norm(across)
            if (
                np.linalg.norm(place - np.stack([*g.task.starts, g.goal]), axis=1).min()
                < (2.2 if distance < 0.1 else 1.5) * distance
            ):
                continue
            point = BiasPoint(as_point(place), plane=PLANE)
            solution = biased(g, point, precision=LIVE)
            assert satisfied(solution) and missed(g, solution, point) <= 0.002
            assert max(sharpest_turn(path, 0.01) for path in solution.bundle.paths) < most
            tried += 1
    assert tried > 9


def test_a_chosen_strength_is_taken_as_it_is():
    motion, point = straight(0.1), BiasPoint((0.0, 0.0, 0.0), 0.3, strength=0.2)
    motion = replace(motion, earlier=replace(point, strength=None).build(motion))
    assert motion.at_least > 0.2
    built = point.build(motion)
    assert built.duration == 0.2 and built.goal is motion.goal and not built.hopeless
    assert point.satisfied(motion, motion.positions)  # nobody asked for more


# several


@pytest.mark.parametrize("level", [0, 1])
def test_bias_and_avoidance_in_either_order(nominal, level):
    g = nominal("draw_s")
    path = resample_by_arc_length(g.bundle.paths[0], 101)
    point, sphere = BiasPoint(as_point(path[75] + [0.0, 0.0, -0.06]), plane=PLANE), Sphere(as_point(path[35]), 0.10)
    solution = biased(g, point, obstacles=sphere, level=level)
    assert satisfied(solution)
    assert missed(g, solution, point) <= ACCEPTED
    assert sphere.signed_distance(solution.bundle.positions).min() > ACCEPTED_MARGIN * 0.01
    assert_sound(g, solution)


# what cannot be


@pytest.mark.parametrize(
    ("radius", "words"),
    [(0.08, "Bias 1: the region of 8 cm is too small: a motion is 12 cm from the target"), (0.123, "fades out")],
)
def test_a_region_that_does_not_reach_the_motion_or_hardly_is_said_to(radius, words):
    built = BiasPoint((0.0, 0.0, 0.0), radius).build(straight(0.12))
    assert built.hopeless and built.duration == MAX_DURATION
    (warning,) = built.warnings
    assert warning.kind is Kind.UNREACHED and warning.source == "Bias 1" and words in warning.text


def misplaced(warnings):
    return [warning.text for warning in warnings if warning.kind is Kind.MISPLACED]


@pytest.mark.parametrize(
    ("place", "radius", "targets", "words"),
    [
        ((0.6, 0.1, 0.0), 0.2, (), "Bias 1: the point is on the goal"),
        ((-0.6, 0.1, 0.0), 0.2, (), "Bias 1: the point is on a start"),
        ((0.0, 0.0, 0.0), 0.3, ((0.1, 0.1, 0.0),), "covers a bias point below it"),
        ((0.0, 0.0, 0.0), 0.3, (), None),
    ],
)
def test_a_misplaced_bias_point_is_warned_of(place, radius, targets, words):
    texts = misplaced(BiasPoint(place, radius).build(straight(0.1, tolerance=1e-6, targets=targets)).warnings)
    assert [words in text for text in texts] == ([] if words is None else [True])


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ((0.0, 0.1, -0.02), "the point is below the table"),
        ((0.0, 0.1, 1.30), "the point is 1.02 m from the arm's shoulder, which reaches 0.95 m"),
        ((0.0, -0.4, 0.3), None),
    ],
)
def test_a_bias_point_out_of_reach_is_warned_of(engine, place, words):
    frame = next(engine.frames(avoiding("lift_box", layers=biases(BiasPoint(place, strength=0.0)))))
    assert misplaced(frame.certificates.warnings) == ([] if words is None else [f"Bias 1: {words}"])


def test_a_target_behind_the_goal_is_warned_of_and_the_goal_stays(nominal, engine):
    g = nominal("drop_pots")
    point = BiasPoint((0.0, -0.52, 0.14))
    solution = biased(g, point, precision=LIVE)
    assert not satisfied(solution)
    frame = next(engine.frames(avoiding("drop_pots", layers=biases(point))))
    said = " ".join(warning.text for warning in frame.certificates.warnings)
    assert "mm from it: a start, the goal or another bias point is in its region" in said
    for path in solution.bundle.paths:
        np.testing.assert_allclose(path[-1], g.goal, atol=1e-3)


def test_a_bias_point_is_told_the_targets_below_it(nominal):
    g = nominal("lift_box")
    path = resample_by_arc_length(g.bundle.paths[0], 101)
    solution = biased(g, *(BiasPoint(as_point(path[k]), radius=0.3) for k in (50, 55)), precision=LIVE)
    assert [bool(misplaced(applied.made.warnings)) for applied in solution.built] == [False, True]
