"""Limits of a tick: what each allows is what it says, and a robot that obeys never leaves them."""

from dataclasses import replace

import numpy as np
import pytest
from body_spheres import cover

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.feasible import ObstacleLimit
from dt_viz.control.obstacle_flow import ObstacleMotion, Sighting
from dt_viz.kernels.dodging import LimitedArm
from dt_viz.kernels.limits import velocity_bounds
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere, as_point
from dt_viz.obstacles.union import Union

STEP = 1e-5
TICK = 0.01
KEPT, GAIN, REACH = 5e-3, 5.0, 0.25


@pytest.fixture(scope="module", name="arm")
def _arm(engine):
    return engine.follower.whole_arm


@pytest.fixture(scope="module", name="limit")
def _limit(arm):
    return ObstacleLimit(arm, KEPT, GAIN, REACH)


def distances(arm: WholeArm, q, seen, moved=0.0):
    """Distances h of the spheres that cover moving links, for all pairs, after the parts have moved for a time."""
    body, parts = cover(arm.robot.links), seen.avoidance.avoided.parts
    points, moving = body.positions(arm.robot, q), zip(parts, moved * seen.velocities, strict=True)
    distances = [part.signed_distance(points - shift) - body.radius for part, shift in moving]
    return np.concatenate(distances) - min(KEPT, seen.avoidance.margin / 2)


def scenes(arm: WholeArm, num):
    """Postures, and one or two obstacles near the arm, which rest or move."""
    rng = np.random.default_rng(5)
    for k in range(num):
        q = arm.robot.home + rng.normal(scale=0.5, size=6)
        points = arm.robot.links.positions(arm.robot, q)
        shapes = []
        for _ in range(1 + k % 2):
            way = rng.normal(size=3)
            at = as_point(points[rng.integers(5, len(points))] + way / np.linalg.norm(way) * rng.uniform(0.12, 0.2))
            shapes.append((Sphere(at, 0.15), Box(at, (0.1, 0.12, 0.14)), Cylinder(at, 0.1, 0.2))[k % 3])
        velocities = rng.normal(scale=0.15, size=(len(shapes), 3)) * (k % 2)
        motions = tuple(ObstacleMotion(velocity) for velocity in velocities)
        yield q, Sighting(0.0, ArmAvoidance(Union(tuple(shapes)), margin=0.02), motions)


def test_rows_are_the_rates_at_which_distances_change(arm, limit):
    """With the slope s by the joints and the obstacle's own velocity: ḣ = s·q̇ − n·v ≥ −γh is s·q̇ ≥ b."""
    rng = np.random.default_rng(1)
    for q, seen in scenes(arm, 40):
        slopes, bounds, nearest = limit.rows(q, seen, TICK)
        h = distances(arm, q, seen)
        assert nearest == pytest.approx(h.min() + KEPT)
        for velocity in rng.normal(size=(3, 6)):
            rate = (distances(arm, q + STEP * velocity, seen, STEP) - h) / STEP
            slack = rate + GAIN * np.where(h > 0, h, 2 * h)  # of all pairs; rows are those of the nearest
            for row in slopes @ velocity - bounds:
                assert np.abs(slack - row).min() < 2e-3


def test_less_is_kept_where_less_is_asked_for_and_nothing_without_obstacles(arm, limit):
    q, seen = next(scenes(arm, 1))
    assert seen.avoidance is not None
    closer = replace(seen, avoidance=replace(seen.avoidance, margin=0.0))
    (slopes, bounds, nearest), (same, lower, as_near) = limit.rows(q, seen, TICK), limit.rows(q, closer, TICK)
    assert nearest == as_near
    np.testing.assert_array_equal(slopes, same)
    np.testing.assert_allclose(bounds - lower, GAIN * KEPT, atol=1e-12)
    for nothing in (None, ArmAvoidance(())):
        slopes, bounds, nearest = limit.rows(q, replace(seen, avoidance=nothing, motions=()), TICK)
        assert slopes.shape == (0, 6) and not len(bounds) and nearest == np.inf


@pytest.mark.long
def test_who_obeys_brakes_before_the_range_ends_and_keeps_speed_and_acceleration(arm):
    """Random wishes for 10⁵ ticks, many of them towards a limit."""
    robot, rng, acceleration = arm.robot, np.random.default_rng(2), 4.0
    ranges = robot.lower, robot.upper, robot.velocity_limits
    limited = LimitedArm(robot.records, robot.links.spheres, *ranges, acceleration)
    q, velocity, nearest = robot.home.copy(), np.zeros(6), np.inf
    for _ in range(2000):
        wanted = rng.normal(scale=2.0, size=6)
        for _ in range(50):
            lower, upper = velocity_bounds(limited, q, velocity, TICK)
            before, velocity = velocity, np.clip(wanted, lower, upper)
            assert np.abs(velocity - before).max() <= acceleration * TICK * (1 + 1e-9)
            q = q + TICK * velocity
            nearest = min(nearest, (q - robot.lower).min(), (robot.upper - q).min())
        assert (np.abs(velocity) <= robot.velocity_limits * (1 + 1e-9)).all()
    assert 0 <= nearest < 0.01
