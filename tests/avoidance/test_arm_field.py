"""Generators and transforms of configuration space beside the laws that all of them obey (tests/laws)."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from laws.registry import (
    ARM_FIELDS,
    BODY,
    ELBOW,
    HAND,
    LIMITED,
    LIMITS,
    REACH,
    ROBOT,
    beside_limits,
    near_ready,
)
from oracles import central_differences

from dt_viz.avoidance.arm_field import GradientField, WholeArmField
from dt_viz.flows.diffeomorphisms import Conjugated, Flow
from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.robot.models import HOME

seeds = st.integers(0, 2**32 - 1)
STEP = 1e-5  # of differences, rad
ESCAPES = {name: field for name, field in ARM_FIELDS.items() if isinstance(field, WholeArmField)}


@pytest.fixture(params=ARM_FIELDS, name="field")
def _field(request):
    return ARM_FIELDS[request.param]


@pytest.fixture(params=ESCAPES, name="escape")
def _escape(request):
    return ESCAPES[request.param]


def clearance(field, q):
    points = field.body.positions(field.robot, q)
    return (field.obstacles[0].signed_distance(points) - field.body.radius).min(axis=-1)


def occupancy(field, points, depth):
    """How far body points (*B, P, 3) are in an obstacle: 0 out of the field's reach, 1 at its core."""
    distance = field.obstacles[0].signed_distance(points) - field.body.radius
    u = np.clip((field.reach - distance) / (field.reach + field.settings.core * (depth + field.body.radius)), 0, 1)
    return 6 * u**5 - 15 * u**4 + 10 * u**3


class TestFields:
    def test_beyond_its_reach_nothing_moves_and_the_field_fades_towards_there(self, field):
        q = near_ready(2400, spread=0.6)
        distance = clearance(field, q)
        beyond = distance >= field.reach
        assert 20 < beyond.sum() < 2380
        np.testing.assert_array_equal(field(q[beyond]), 0)
        assert np.abs(field(q[distance < 0.5 * field.reach])).max(axis=1).min() > 0
        outskirts = q[(distance > 0.97 * field.reach) & (distance < field.reach)]
        assert len(outskirts) > 2
        for function in (field, lambda q: central_differences(field, q, STEP)):
            assert np.abs(function(outskirts)).max() < 0.05 * np.abs(function(q)).max()

    def test_a_body_point_on_the_middle_of_the_obstacle_is_nothing_special(self, field):
        q = near_ready(8, seed=3)
        x, y, z = BODY.positions(ROBOT, q)[0, 20]
        there = replace(field, obstacles=(Sphere((x, y, z), 0.15),))
        assert np.isfinite(there(q)).all() and np.isfinite(central_differences(there, q, STEP)).all()


class TestWholeArmField:
    def test_pinned_postures_stay(self, escape):
        pinned = replace(escape, pins=near_ready(5))
        assert np.abs(escape(near_ready(5))).max() > 0.01
        np.testing.assert_array_equal(pinned(near_ready(5)), 0)
        np.testing.assert_allclose(central_differences(pinned, near_ready(5), STEP), 0, rtol=0, atol=1e-13)


BOX = Box(HAND.position, (0.2, 0.1, 0.06), (0.8, 0.0, 0.6, 0.0))


class TestGradientField:
    @pytest.fixture(params=[HAND, ELBOW, BOX], ids=["hand", "elbow", "box"], name="gradient")
    def _gradient(self, request):
        return GradientField(ROBOT, BODY, (request.param,), REACH)

    def potential(self, field, q):
        depth = field.reach + field.settings.core * (field.obstacles[0].depth + BODY.radius)
        return (depth * occupancy(field, BODY.positions(ROBOT, q), field.obstacles[0].depth)).sum(axis=-1)

    def test_it_is_the_gradient_of_the_summed_occupancy(self, gradient):
        q = near_ready(60)
        expected = central_differences(partial(self.potential, gradient), q, 2e-4)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(gradient(q), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


class TestJointLimits:
    @given(seeds, st.sampled_from([1e-3, 0.1, 1.0, 10.0, 1e3]))
    def test_everything_lands_strictly_inside_the_limits(self, seed, spread):
        s = np.array(HOME) + np.random.default_rng(seed).normal(scale=spread, size=(50, ROBOT.num_joints))
        q = LIMITS.inverse(s)
        assert (q > ROBOT.lower).all() and (q < ROBOT.upper).all()

    @given(seeds)
    def test_away_from_limits_and_on_continuous_joints_nothing_changes(self, seed):
        q = beside_limits(50, 1e-4, seed)
        beyond = np.fmax(ROBOT.lower - q, q - ROBOT.upper) + LIMITS.zone  # how deep in the zone beside a limit
        away, near = beyond < 0, beyond > LIMITS.zone / 2  # farther from it the difference may be lost in rounding
        for image, J in (LIMITS.jacobian(q), LIMITS.inverse_jacobian(q)):
            np.testing.assert_array_equal(image[away], q[away])
            np.testing.assert_array_equal(J[away], np.broadcast_to(np.eye(ROBOT.num_joints), J.shape)[away])
            assert (image[near] != q[near]).all()

    @given(seeds)
    def test_the_order_of_joint_angles_is_kept(self, seed):
        a, b = beside_limits(50, 1e-4, seed), beside_limits(50, 1e-4, seed + 1)
        np.testing.assert_array_equal(LIMITS.forward(a) < LIMITS.forward(b), a < b)
        assert (np.linalg.det(LIMITS.jacobian(a)[1]) >= 1).all()  # what is held back here is far away there

    def test_a_path_is_put_where_the_map_is_finite_and_hardly_moved(self):
        at_limits = np.where(LIMITED, ROBOT.lower, 3.0)[None]
        kept = LIMITS.inside(np.concatenate([at_limits, np.where(LIMITED, ROBOT.upper, -3.0)[None], near_ready(4)]))
        assert np.isfinite(LIMITS.forward(kept)).all()
        np.testing.assert_allclose(kept[0], at_limits[0], rtol=0, atol=0.1 * LIMITS.zone + 1e-12)
        np.testing.assert_array_equal(kept[2:], near_ready(4))


class TestFlows:
    """What `dt_viz.avoidance.arm` makes of the generators."""

    def chain(self, field, duration, tolerance=1e-9):
        """For a duration in units in which both kinds of generators are about as fast."""
        return Conjugated(Flow.adaptive(field, self.pace(field) * duration, tolerance), LIMITS)

    def pace(self, field):
        return 1.0 if isinstance(field, WholeArmField) else 0.05

    def test_no_flow_leaves_the_joint_limits(self, field):
        """Even if it wants to: the postures here begin beside a limit."""
        q = near_ready(12)
        q[:, 1] = ROBOT.lower[1] + 0.01
        bent = Sphere(tuple(BODY.positions(ROBOT, q)[0, 15] + 0.02), 0.15)  # pyright: ignore[reportArgumentType]
        towards = replace(field, obstacles=(bent,))
        for duration in (1.0, -1.0):
            moved = self.chain(towards, duration, 1e-6).inverse(q)
            assert np.abs(moved - q).max() > 0.05
            assert (moved > ROBOT.lower).all() and (moved < ROBOT.upper).all()
