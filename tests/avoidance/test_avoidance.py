"""The duration that clears an obstacle: enough, no more than enough, and the obstacle's own wherever it stands."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.avoidance.avoidance import clearing_duration
from dt_viz.avoidance.hand import ACCEPTED_MARGIN, MAX_DURATION, SNAPSHOT, HandAvoidance
from dt_viz.avoidance.transform import MotionBelow
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.warning import Kind, MotionWarning

seeds = st.integers(0, 2**32 - 1)
SPHERE = Sphere((0.1, -0.4, 0.3), 0.15)
MARGIN = 0.01
AVOIDANCE = HandAvoidance(SPHERE, margin=MARGIN)


def passing_points(seed, num=40, sphere=SPHERE):
    """Points of a straight path that misses the centre by 5 to 60 mm, as seen from the obstacle."""
    rng = np.random.default_rng(seed)
    along, aside, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.array(sphere.position) + np.linspace(-0.2, 0.2, num)[:, None] * along + rng.uniform(0.005, 0.06) * aside


def clearing(field, sphere, points, margin=MARGIN):
    """The shortest duration that clears points of a sphere."""
    return clearing_duration(field, points, lambda s, _: margin - sphere.signed_distance(s), SNAPSHOT, MAX_DURATION)


def carried(field, points, duration):
    return Flow.adaptive(field, duration, 1e-9).inverse(points)


@given(seeds, st.sampled_from([1.0, 6.0, 20.0]))
def test_the_clearing_duration_clears_by_the_margin_a_shorter_one_does_not(seed, temperature):
    field, points = SPHERE.field("free-space", temperature), passing_points(seed)
    duration = clearing(field, SPHERE, points)
    assert duration is not None and 0 < duration < MAX_DURATION
    assert SPHERE.signed_distance(carried(field, points, duration)).min() > ACCEPTED_MARGIN * MARGIN
    assert SPHERE.signed_distance(carried(field, points, 0.97 * duration - 0.005)).min() < MARGIN
    left = clearing(field, SPHERE, carried(field, points, 0.3 * duration))
    assert left == pytest.approx(0.7 * duration, abs=0.01)


def test_what_is_clear_needs_no_flow_and_the_dead_centre_is_never_clear():
    field, place = SPHERE.field("free-space", 6.0), np.array(SPHERE.position)
    for clear in (place + 0.2 * np.eye(3), np.empty((0, 3))):
        assert clearing(field, SPHERE, clear) == 0
    centre = place[None]
    for _ in range(30):  # Newton's method finds where the field vanishes
        v, DV = field.with_jacobian(centre)
        centre = centre - np.linalg.solve(DV, v[..., None])[..., 0]
    assert SPHERE.signed_distance(centre) < -0.06
    assert clearing(field, SPHERE, centre) is None
    assert clearing(field, SPHERE, centre + np.array([0.002, 0.0, 0.0])) is not None


@given(seeds, st.floats(0.04, 0.3))
def test_a_moved_and_grown_obstacle_clears_its_points_in_the_same_time(seed, diameter):
    """The duration is dimensionless: the same picture in another place and size needs the same flow."""
    rng = np.random.default_rng(seed)
    moved, scale = Sphere(as_point(rng.normal(size=3)), diameter), diameter / SPHERE.diameter
    points = passing_points(seed)
    there = np.array(moved.position) + scale * (points - np.array(SPHERE.position))
    here = clearing(SPHERE.field("free-space", 6.0), SPHERE, points)
    elsewhere = clearing(moved.field("free-space", 6.0), moved, there, scale * MARGIN)
    assert elsewhere == pytest.approx(here, rel=1e-3, abs=1e-4)


def motion(*paths, **changes):
    index = np.repeat(np.arange(len(paths)), [len(path) for path in paths])
    starts, positions = np.stack([path[0] for path in paths]), np.concatenate(paths)
    return MotionBelow(starts, paths[0][-1], index, positions, name="Avoidance", tolerance=1e-8, **changes)


@given(seeds, st.floats(0.0005, 0.02), st.floats(0, 1), st.floats(0.05, 0.5), st.floats(1, 6))
def test_the_duration_hardly_depends_on_where_a_path_is_sampled(seed, miss, phase, bend, uneven):
    """What leaves last lies between samples, mostly: there the path is closest to where the field vanishes."""
    rng = np.random.default_rng(seed)
    along, aside, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]

    def path(u):
        u = u[:, None]
        return np.array(SPHERE.position) + 0.2 * u * along + (miss + bend * (0.2 * u) ** 2) * aside

    def duration(u):
        return AVOIDANCE.build(motion(path(u))).duration

    gaps = uneven ** rng.uniform(-0.5, 0.5, 80)  # refinement leaves neighbours of very different length
    coarse = 2 * np.cumsum(gaps) / gaps.sum() - 1 + phase / 40
    assert duration(coarse) == pytest.approx(duration(np.linspace(coarse[0], coarse[-1], 8000)), rel=0.02)


def test_a_chosen_duration_is_taken_as_it_is():
    before, chosen = motion(passing_points(1)), replace(AVOIDANCE, duration=0.123)
    before = replace(before, earlier=AVOIDANCE.build(before))
    assert before.at_least > 0.2
    assert chosen.build(before).duration == 0.123
    assert chosen.satisfied(before, before.positions)  # nobody asked for more


def test_covered_ends_are_named_and_do_not_keep_the_others_from_being_cleared():
    path = passing_points(1)
    deepest = int(np.argmin(SPHERE.signed_distance(path)))
    built = AVOIDANCE.build(motion(passing_points(2), path[deepest:]))
    assert built.warnings == (MotionWarning(Kind.START_COVERED, "start 2 is inside the obstacle", "Avoidance"),)
    assert SPHERE.signed_distance(built.transform.inverse(passing_points(2))).min() > ACCEPTED_MARGIN * MARGIN
    warnings = AVOIDANCE.build(motion(path[: deepest + 1])).warnings
    (covered,) = (warning.text for warning in warnings if warning.kind is Kind.GOAL_COVERED)
    assert "goal is inside the obstacle" in covered


def test_a_covered_start_that_leaves_at_once_asks_for_no_way_out():
    away = np.array(SPHERE.position) + np.linspace(0.95, 4, 40)[:, None] * SPHERE.radius * np.eye(3)[0]
    built = AVOIDANCE.build(motion(away))
    assert built.detours == (None,) and built.duration == 0 and len(built.warnings) == 1


def test_the_margin_changes_gradually_where_an_obstacle_comes_over_a_start():
    """It shrinks to nothing there, and grows again."""
    ahead, along = SPHERE.position + 0.2 * np.eye(3)[1], np.linspace(0, 0.5, 40)[:, None] * np.eye(3)[0]
    kept = []
    for depth in (-0.02, -0.004, -0.001, 0.001, 0.004, 0.02):
        start = np.array(SPHERE.position) + (SPHERE.radius - depth) * np.eye(3)[0]
        kept.append(AVOIDANCE._kept_margin(motion(ahead + along, start + along)))
    np.testing.assert_allclose(kept, [0.01, 0.004, 0.001, 0.001, 0.004, 0.01], atol=1e-9)
