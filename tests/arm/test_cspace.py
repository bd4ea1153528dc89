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
    PINS,
    REACH,
    ROBOT,
    UP,
    beside_hand,
    beside_limits,
    near_ready,
)
from oracles import central_differences

from dt_viz.arm.cspace import BLOCK, COMPLEX_STEP, CORE, SHARPNESS, GradientField, WholeArmField
from dt_viz.arm.robot import HOME, NUM_JOINTS
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Chain, Flow, Inverse, round_trip_error
from dt_viz.obstacles.shapes import Box, Sphere

seeds = st.integers(0, 2**32 - 1)
ESCAPES = {name: field for name, field in ARM_FIELDS.items() if isinstance(field, WholeArmField)}


@pytest.fixture(params=ARM_FIELDS, name="field")
def _field(request):
    return ARM_FIELDS[request.param]


@pytest.fixture(params=ESCAPES, name="escape")
def _escape(request):
    return ESCAPES[request.param]


def clearance(field, q):
    points = field.body.positions(field.robot, q)
    return (field.obstacle.signed_distance(points) - field.body.radius).min(axis=-1)


def rounding(field, q):
    """What rounding may leave of a field's values: some tens of operations on the places of body points, a metre or so
    away, by the steepest slope of the field; ten times that."""
    return 1e3 * np.finfo(float).eps * np.abs(field.with_jacobian(q)[1]).max()


class TestFields:
    def test_complex_steps_do_not_depend_on_their_length(self, field):
        q, u = near_ready(20), np.random.default_rng(1).normal(size=NUM_JOINTS)
        DV = field.with_jacobian(q)[1]
        for h in (1e3 * COMPLEX_STEP, 1e-20):
            np.testing.assert_allclose(field(q + 1j * h * u).imag / h, DV @ u, rtol=0, atol=1e-11 * np.abs(DV).max())

    def test_many_postures_are_worked_out_as_few_are(self, field):
        """In blocks, and with those parts of the arm left out that are far from the obstacle in all of a block."""
        size = BLOCK // np.dtype(float).itemsize
        q = near_ready(2 * size + 5, spread=0.4)
        together, beside_borders = field(q), [0, 1, size - 1, size, size + 1, 2 * size - 1, 2 * size, 2 * size + 4]
        for k in (*beside_borders, *range(100, 400, 25)):
            np.testing.assert_allclose(together[k], field(q[k : k + 1])[0], rtol=0, atol=rounding(field, q[:50]))

    def test_beyond_its_reach_nothing_moves(self, field):
        q = near_ready(1200, spread=0.6)
        distance = clearance(field, q)
        beyond = distance >= field.reach
        assert 20 < beyond.sum() < 1180
        velocity, DV = field.with_jacobian(q[beyond])
        np.testing.assert_array_equal(velocity, 0)
        np.testing.assert_array_equal(DV, 0)
        assert np.abs(field(q[distance < 0.5 * field.reach])).max(axis=1).min() > 0

    def test_it_fades_to_nothing_smoothly(self, field):
        """No jump, nor one of the derivative, where the field ends: both vanish towards it."""
        q = near_ready(1200, spread=0.6)
        distance = clearance(field, q)
        outskirts = q[(distance > 0.97 * field.reach) & (distance < field.reach)]
        assert len(outskirts) > 2
        for faint, anywhere in zip(field.with_jacobian(outskirts), field.with_jacobian(q), strict=True):
            assert np.abs(faint).max() < 0.05 * np.abs(anywhere).max()

    def test_a_body_point_on_the_middle_of_the_obstacle_is_nothing_special(self, field):
        q = near_ready(8, seed=3)
        x, y, z = BODY.positions(ROBOT, q)[0, 20]
        there = replace(field, obstacle=Sphere((x, y, z), 0.15))
        velocity, DV = there.with_jacobian(q)
        assert np.isfinite(there(q)).all() and np.isfinite(velocity).all() and np.isfinite(DV).all()


class TestWholeArmField:
    def test_pinned_postures_stay(self, escape):
        pinned = WholeArmField(ROBOT, BODY, escape.obstacle, UP, near_ready(5), escape.reach)
        assert np.abs(escape(near_ready(5))).max() > 0.01
        velocity, DV = pinned.with_jacobian(near_ready(5))
        np.testing.assert_array_equal(velocity, 0)
        np.testing.assert_allclose(DV, 0, rtol=0, atol=1e-13)

    def test_the_contact_escapes(self, escape):
        """The average contact, moved against V, moves along its own way out."""
        q, h = near_ready(200), 1e-6
        points = BODY.positions(ROBOT, q)
        distance = escape.obstacle.signed_distance(points) - BODY.radius
        core = -CORE * (escape.obstacle.radius + BODY.radius)
        u = np.clip((escape.reach - distance) / (escape.reach - core), 0, 1)
        weights = ((6 * u**5 - 15 * u**4 + 10 * u**3) ** SHARPNESS)[..., None]
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
        moved = (BODY.positions(ROBOT, q - h * escape(q)) - points) / h
        contact = (weights * moved).sum(axis=1)
        outward = points - escape._source[:, 0]
        outward = (weights * outward / np.linalg.norm(outward, axis=2, keepdims=True)).sum(axis=1)
        touching = distance.min(axis=1) < 0
        assert touching.sum() > 20
        assert ((contact * outward).sum(axis=1)[touching] > 0).all()
        assert (contact @ UP)[touching].mean() > 0.02

    @pytest.mark.parametrize("diameter", [0.04, 0.15, 0.30])
    @pytest.mark.parametrize("reach", [0.0133, 0.08, 0.2667])
    def test_the_point_that_contacts_fan_out_from_is_out_of_reach(self, diameter, reach):
        """There the direction turns over no distance at all, so no flow passes it."""
        field = WholeArmField(ROBOT, BODY, beside_hand(diameter=diameter), UP, PINS, reach)
        source = field._source[:, 0]
        assert field.obstacle.signed_distance(source) > reach + BODY.radius.max()
        np.testing.assert_allclose(np.cross(source - np.array(field.obstacle.position), UP), 0, atol=1e-12)


class TestGradientField:
    @pytest.fixture(params=[HAND, ELBOW], name="gradient")
    def _gradient(self, request):
        return GradientField(ROBOT, BODY, request.param, REACH)

    def potential(self, field, q):
        distance = field.obstacle.signed_distance(BODY.positions(ROBOT, q)) - BODY.radius
        depth = field.reach + CORE * (field.obstacle.depth + BODY.radius)
        u = np.clip((field.reach - distance) / depth, 0, 1)
        return (depth * (6 * u**5 - 15 * u**4 + 10 * u**3)).sum(axis=-1)

    def test_it_is_the_gradient_of_the_summed_occupancy(self, gradient):
        q = near_ready(60)
        expected = central_differences(partial(self.potential, gradient), q, 2e-4)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(gradient(q), expected, rtol=0, atol=1e-6)

    def test_it_is_the_gradient_around_a_box(self):
        field = GradientField(ROBOT, BODY, Box(HAND.position, (0.2, 0.1, 0.06), (0.8, 0.0, 0.6, 0.0)), REACH)
        expected = central_differences(partial(self.potential, field), near_ready(60), 2e-4)
        np.testing.assert_allclose(field(near_ready(60)), expected, rtol=0, atol=1e-5 * np.abs(expected).max())

    def test_its_jacobian_is_symmetric(self, gradient):
        DV = gradient.with_jacobian(near_ready(60))[1]
        np.testing.assert_allclose(DV, DV.transpose(0, 2, 1), rtol=0, atol=1e-10 * np.abs(DV).max())


class TestJointLimits:
    @given(seeds, st.sampled_from([1e-3, 0.1, 1.0, 10.0, 1e3]))
    def test_everything_lands_strictly_inside_the_limits(self, seed, spread):
        s = np.array(HOME) + np.random.default_rng(seed).normal(scale=spread, size=(50, NUM_JOINTS))
        q = LIMITS.inverse(s)
        assert (q > ROBOT.lower).all() and (q < ROBOT.upper).all()

    @given(seeds)
    def test_away_from_limits_and_on_continuous_joints_nothing_changes(self, seed):
        q = beside_limits(50, 1e-4, seed)
        away = ~LIMITED | ((q > ROBOT.lower + LIMITS.zone) & (q < ROBOT.upper - LIMITS.zone))
        near = (q < ROBOT.lower + LIMITS.zone / 2) | (
            q > ROBOT.upper - LIMITS.zone / 2
        )  # farther it may be lost in rounding
        for image, J in (LIMITS.jacobian(q), LIMITS.inverse_jacobian(q)):
            np.testing.assert_array_equal(image[away], q[away])
            np.testing.assert_array_equal(J[away], np.broadcast_to(np.eye(NUM_JOINTS), J.shape)[away])
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
    """What `dt_viz.arm.whole_arm` makes of the generators."""

    def chain(self, field, duration, tolerance=1e-9):
        """For a duration in units in which both kinds of generators are about as fast."""
        return Chain([Inverse(LIMITS), AdaptiveFlow(field, self.pace(field) * duration, tolerance), LIMITS])

    def pace(self, field):
        return 1.0 if isinstance(field, WholeArmField) else 0.05

    def test_flows_are_a_one_parameter_group(self, field):
        q = near_ready(12)
        for s, t in ((0.2, 0.3), (-0.2, 0.5)):
            flow = partial(self.chain, field)
            at_once, in_two = flow(s + t).inverse(q), flow(s).inverse(flow(t).inverse(q))
            np.testing.assert_allclose(at_once, in_two, rtol=0, atol=1e-7)
            np.testing.assert_allclose(flow(-t).forward(q), flow(t).inverse(q), rtol=0, atol=1e-12)

    def test_they_are_diffeomorphisms_that_squeeze_space(self, field):
        q, flow = near_ready(12), Inverse(self.chain(field, 0.5))
        image, J = flow.jacobian(q)
        assert np.abs(image - q).max() > 0.03
        assert round_trip_error(flow, q) < 1e-7
        det = np.linalg.det(J)
        assert det.min() > 0 and np.abs(det - 1).max() > 0.1

    def test_the_equal_steps_of_a_drag_come_near_the_adaptive_ones(self, field):
        q, fine = near_ready(12), self.chain(field, 0.4).inverse(near_ready(12))
        coarse = Chain([Inverse(LIMITS), Flow(field, self.pace(field) * 0.4, 2, sparse=True), LIMITS])
        np.testing.assert_allclose(coarse.inverse(q), fine, rtol=0, atol=0.02)
        hand, miss = ROBOT.end_effector(fine), ROBOT.end_effector(coarse.inverse(q))
        assert np.linalg.norm(hand - miss, axis=1).max() < 2e-3

    def test_no_flow_leaves_the_joint_limits(self, field):
        """Even if it wants to: the postures here begin beside a limit."""
        q = near_ready(12)
        q[:, 1] = ROBOT.lower[1] + 0.01
        bent = Sphere(tuple(BODY.positions(ROBOT, q)[0, 15] + 0.02), 0.15)  # pyright: ignore[reportArgumentType]
        towards = replace(field, obstacle=bent)
        for duration in (1.0, -1.0):
            moved = self.chain(towards, duration, 1e-6).inverse(q)
            assert np.abs(moved - q).max() > 0.05
            assert (moved > ROBOT.lower).all() and (moved < ROBOT.upper).all()
