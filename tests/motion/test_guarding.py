"""The control barrier: no distance falls faster than it may, and what is allowed is not changed."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.arm.whole_arm import OVERSHOOT, WholeArm
from dt_viz.motion.guarding import KEPT, RATE, WINDOW, guarded, is_allowed
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.transforms.base import ArmAvoidance

STEP = 1e-5


@pytest.fixture(scope="module", name="arm")
def _arm(engine):
    return engine.follower.whole_arm


def distances(arm: WholeArm, q, avoidance, moved=0.0, velocities=None):
    """Distances h of the moving links' spheres from the parts, for all pairs, after the parts have moved."""
    points = arm.links.positions(arm.robot, q)
    radius = arm.links.radius
    parts = avoidance.obstacle.parts
    shifts = np.zeros((len(parts), 3)) if velocities is None else moved * velocities
    kept = min(KEPT, avoidance.margin / 2)
    return np.concatenate(
        [p.signed_distance(points - shift) - radius for p, shift in zip(parts, shifts, strict=True)]
    ) + (OVERSHOOT - kept)


def scenes(arm: WholeArm, num):
    """Postures, velocities and obstacles near the arm."""
    rng = np.random.default_rng(5)
    for k in range(num):
        q = arm.robot.home + rng.normal(scale=0.5, size=6)
        place = arm.links.positions(arm.robot, q)[rng.integers(5, len(arm.links.radius))]
        way = rng.normal(size=3)
        place = place + way / np.linalg.norm(way) * rng.uniform(0.12, 0.2)
        at = as_point(place)
        shape = (Sphere(at, 0.15), Box(at, (0.1, 0.12, 0.14)), Cylinder(at, 0.1, 0.2))[k % 3]
        velocities = rng.normal(scale=0.15, size=(1, 3)) * (k % 2)
        yield q, rng.normal(scale=0.8, size=6), ArmAvoidance(Union((shape,)), margin=0.02), velocities


def test_no_distance_falls_faster_than_it_may(arm):
    changed = 0
    for q, wanted, avoidance, velocities in scenes(arm, 60):
        v, nearest = guarded(arm, q, wanted, avoidance, velocities)
        h = distances(arm, q, avoidance)
        later = distances(arm, q + STEP * v, avoidance, STEP, velocities)
        rate, near = (later - h) / STEP, h < WINDOW
        assert (rate[near] >= -RATE * np.maximum(h[near], 0) - 0.02).all()
        everywhere = avoidance.obstacle.signed_distance(arm.links.positions(arm.robot, q)) - arm.links.radius
        assert nearest == pytest.approx(everywhere.min() + OVERSHOOT)
        unguarded = (distances(arm, q + STEP * wanted, avoidance, STEP, velocities) - h) / STEP
        if (unguarded[near] >= -RATE * np.maximum(h[near], 0)).all():
            np.testing.assert_array_equal(v, wanted)
        else:
            changed += 1
            assert np.abs(v - wanted).max() > 0
    assert changed > 15


def test_several_velocities_are_allowed_where_each_of_them_is(arm):
    told = []
    for q, wanted, avoidance, velocities in scenes(arm, 60):
        postures = q + np.linspace(0, 0.05, 4)[:, None]
        several = wanted * np.array([1.0, 0.5, -0.5, 0.1])[:, None]
        alone = [guarded(arm, p, v, avoidance, velocities) for p, v in zip(postures, several, strict=True)]
        allowed, nearest = is_allowed(arm, postures, several, avoidance, velocities)
        unchanged = np.array_equal([v for v, _ in alone], several)
        assert unchanged if allowed else nearest.min() < WINDOW + KEPT
        if allowed:
            np.testing.assert_allclose(nearest, [room for _, room in alone], atol=1e-12)
        told.append((allowed, unchanged))
    assert {(True, True), (False, False)} <= set(told) and told.count((False, True)) < 5


def test_it_stops_before_what_it_runs_into(arm):
    """Straight into a sphere for ten seconds: the distance shrinks to what is kept, and no further."""
    q = arm.robot.home.copy()
    hand = arm.robot.end_effector(q)
    sphere = Sphere(as_point(hand + np.array([0.2, 0.0, 0.0])), 0.1)
    avoidance = ArmAvoidance(Union((sphere,)), margin=0.02)
    J = arm.robot.jacobian(q)
    wanted, closest = np.linalg.pinv(J) @ np.array([0.3, 0.0, 0.0]), np.inf
    for _ in range(1000):
        v, _ = guarded(arm, q, wanted, avoidance, np.zeros((1, 3)))
        q = q + 0.01 * v
        closest = min(closest, float(distances(arm, q, avoidance).min()))
    assert -1e-3 < closest < 5e-3


def test_less_is_kept_where_less_is_asked_for(arm):
    q, wanted, avoidance, velocities = next(scenes(arm, 1))
    v, nearest = guarded(arm, q, wanted, replace(avoidance, margin=0.0), velocities)
    _, same = guarded(arm, q, wanted, avoidance, velocities)
    assert nearest == same and np.isfinite(v).all()


def test_without_obstacles_everything_is_allowed(arm):
    wanted = np.arange(6.0)
    v, nearest = guarded(arm, arm.robot.home, wanted, ArmAvoidance(Union(())), np.zeros((0, 3)))
    assert nearest == np.inf
    np.testing.assert_array_equal(v, wanted)
