"""Generators and transforms of configuration space by their properties."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.arm.body_points import load_body_points
from dt_viz.arm.cspace import (
    BLOCK,
    COMPLEX_STEP,
    CORE,
    SHARPNESS,
    GradientField,
    JointLimits,
    WholeArmField,
)
from dt_viz.arm.robot import HOME, NUM_JOINTS, Robot, load_jaco
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Chain, Flow, Inverse, round_trip_error
from dt_viz.obstacles.shapes import Box, Sphere

ROBOT: Robot = load_jaco()
BODY = load_body_points().on_moving_links
UP = np.array([0.48, -0.6, 0.64])
REACH = 0.08
seeds = st.integers(0, 2**32 - 1)


def near(num, seed=0, spread=0.15):
    """Postures around the ready one, (num, 6) rad."""
    return np.array(HOME) + np.random.default_rng(seed).normal(scale=spread, size=(num, NUM_JOINTS))


def beside_hand(dx=0.0, dy=0.0, dz=0.0, diameter=0.15):
    x, y, z = ROBOT.end_effector(np.array(HOME)) + np.array([dx, dy, dz])
    return Sphere((float(x), float(y), float(z)), diameter)


HAND, ELBOW = beside_hand(0.02, 0.03, -0.01), Sphere((0.0, -0.05, 0.6), 0.12)
PINS = np.array(HOME) + np.array([[0.9, 0.1, -0.2, 0.3, 0.1, 0.0], [-0.9, -0.1, 0.1, -0.2, 0.2, 0.5]])
FIELDS = {
    "escape of the hand": WholeArmField(ROBOT, BODY, HAND, UP, PINS, REACH),
    "escape of the elbow": WholeArmField(ROBOT, BODY, ELBOW, UP, PINS, REACH),
    "escape from a small ball": WholeArmField(ROBOT, BODY, beside_hand(0.01, diameter=0.04), UP, PINS, REACH),
    "gradient at the hand": GradientField(ROBOT, BODY, HAND, REACH),
    "gradient at the elbow": GradientField(ROBOT, BODY, ELBOW, REACH),
}
ESCAPES = {name: field for name, field in FIELDS.items() if isinstance(field, WholeArmField)}


@pytest.fixture(params=FIELDS, name="field")
def _field(request):
    return FIELDS[request.param]


@pytest.fixture(params=ESCAPES, name="escape")
def _escape(request):
    return ESCAPES[request.param]


def central_differences(function, q, h=2e-4):
    """Of fourth order: (N, …, 6)."""
    columns = []
    for e in h * np.eye(NUM_JOINTS):
        far, close = function(q + 2 * e) - function(q - 2 * e), function(q + e) - function(q - e)
        columns.append((8 * close - far) / (12 * h))
    return np.stack(columns, axis=-1)


def clearance(field, q):
    points = field.body.positions(field.robot, q)
    return (field.obstacle.signed_distance(points) - field.body.radius).min(axis=-1)


def rounding(field, q):
    """What rounding may leave of a field's values: some tens of operations on the places of body points, a metre or so
    away, by the steepest slope of the field; ten times that."""
    return 1e3 * np.finfo(float).eps * np.abs(field.with_jacobian(q)[1]).max()


class TestFields:
    def test_the_derivative_is_that_of_central_differences(self, field):
        q = near(60)
        value, DV = field.with_jacobian(q)
        np.testing.assert_allclose(value, field(q), rtol=0, atol=rounding(field, q))
        scale = np.abs(DV).max()
        assert scale > 0.1
        np.testing.assert_allclose(DV, central_differences(field, q, 1e-5), rtol=0, atol=1e-5 * scale)

    def test_complex_steps_do_not_depend_on_their_length(self, field):
        q, u = near(20), np.random.default_rng(1).normal(size=NUM_JOINTS)
        DV = field.with_jacobian(q)[1]
        for h in (1e3 * COMPLEX_STEP, 1e-20):
            np.testing.assert_allclose(field(q + 1j * h * u).imag / h, DV @ u, rtol=0, atol=1e-11 * np.abs(DV).max())

    def test_each_posture_is_on_its_own(self, field):
        q = near(30)
        np.testing.assert_allclose(field(q)[7:9], field(q[7:9]), rtol=0, atol=rounding(field, q))
        assert field(q[:0]).shape == (0, NUM_JOINTS)
        assert field.dim == NUM_JOINTS

    def test_many_postures_are_worked_out_as_few_are(self, field):
        """In blocks, and with those parts of the arm left out that are far from the obstacle in all of a block."""
        q = near(2 * BLOCK + 5, spread=0.4)
        few = np.concatenate([field(posture[None]) for posture in q])
        np.testing.assert_allclose(field(q), few, rtol=0, atol=rounding(field, q))

    def test_beyond_its_reach_nothing_moves(self, field):
        q = near(3000, spread=0.6)
        distance = clearance(field, q)
        beyond = distance >= field.reach
        assert 50 < beyond.sum() < 2950
        velocity, DV = field.with_jacobian(q[beyond])
        np.testing.assert_array_equal(velocity, 0)
        np.testing.assert_array_equal(DV, 0)
        assert np.abs(field(q[distance < 0.5 * field.reach])).max(axis=1).min() > 0

    def test_it_fades_to_nothing_smoothly(self, field):
        """No jump, nor one of the derivative, where the field ends: both vanish towards it."""
        q = near(3000, spread=0.6)
        distance = clearance(field, q)
        outskirts = q[(distance > 0.97 * field.reach) & (distance < field.reach)]
        assert len(outskirts) > 5
        for faint, anywhere in zip(field.with_jacobian(outskirts), field.with_jacobian(q), strict=True):
            assert np.abs(faint).max() < 0.05 * np.abs(anywhere).max()

    def test_a_body_point_on_the_middle_of_the_obstacle_is_nothing_special(self, field):
        q = near(8, seed=3)
        x, y, z = BODY.positions(ROBOT, q)[0, 20]
        there = replace(field, obstacle=Sphere((x, y, z), 0.15))
        velocity, DV = there.with_jacobian(q)
        assert np.isfinite(there(q)).all() and np.isfinite(velocity).all() and np.isfinite(DV).all()


class TestWholeArmField:
    def test_pinned_postures_stay(self, escape):
        pinned = WholeArmField(ROBOT, BODY, escape.obstacle, UP, near(5), escape.reach)
        assert np.abs(escape(near(5))).max() > 0.01
        velocity, DV = pinned.with_jacobian(near(5))
        np.testing.assert_array_equal(velocity, 0)
        np.testing.assert_allclose(DV, 0, rtol=0, atol=1e-13)

    def test_the_contact_escapes(self, escape):
        """The average contact, moved against V, moves along its own way out."""
        q, h = near(200), 1e-6
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
        q = near(60)
        expected = central_differences(partial(self.potential, gradient), q)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(gradient(q), expected, rtol=0, atol=1e-6)

    def test_it_is_the_gradient_around_a_box(self):
        field = GradientField(ROBOT, BODY, Box(HAND.position, (0.2, 0.1, 0.06), (0.8, 0.0, 0.6, 0.0)), REACH)
        expected = central_differences(partial(self.potential, field), near(60))
        np.testing.assert_allclose(field(near(60)), expected, rtol=0, atol=1e-5 * np.abs(expected).max())

    def test_its_jacobian_is_symmetric(self, gradient):
        DV = gradient.with_jacobian(near(60))[1]
        np.testing.assert_allclose(DV, DV.transpose(0, 2, 1), rtol=0, atol=1e-10 * np.abs(DV).max())


LIMITS = JointLimits(ROBOT.lower, ROBOT.upper)
LIMITED = np.isfinite(ROBOT.lower)


def inside(num, seed, closest=1e-4):
    """Postures anywhere inside the limits, many of them near one."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-7, 7, (num, NUM_JOINTS))
    lower, upper = ROBOT.lower[LIMITED], ROBOT.upper[LIMITED]
    margin = closest + rng.uniform(0, 2 * LIMITS.zone, (num, LIMITED.sum()))
    side = rng.integers(0, 3, (num, LIMITED.sum()))
    anywhere = rng.uniform(lower + closest, upper - closest, (num, LIMITED.sum()))
    q[:, LIMITED] = np.choose(side, [lower + margin, upper - margin, anywhere])
    return q


class TestJointLimits:
    @given(seeds, st.sampled_from([1e-3, 0.1, 1.0, 10.0, 1e3]))
    def test_everything_lands_strictly_inside_the_limits(self, seed, spread):
        s = np.array(HOME) + np.random.default_rng(seed).normal(scale=spread, size=(50, NUM_JOINTS))
        q = LIMITS.inverse(s)
        assert (q > ROBOT.lower).all() and (q < ROBOT.upper).all()

    @given(seeds)
    def test_there_and_back_again(self, seed):
        q = inside(50, seed)
        np.testing.assert_allclose(LIMITS.inverse(LIMITS.forward(q)), q, rtol=0, atol=1e-12)
        s = np.array(HOME) + np.random.default_rng(seed).normal(scale=2.0, size=(50, NUM_JOINTS))
        np.testing.assert_allclose(LIMITS.forward(LIMITS.inverse(s)), s, rtol=0, atol=1e-6)

    @given(seeds)
    def test_away_from_limits_and_on_continuous_joints_nothing_changes(self, seed):
        q = inside(50, seed)
        away = ~LIMITED | ((q > ROBOT.lower + LIMITS.zone) & (q < ROBOT.upper - LIMITS.zone))
        near = (q < ROBOT.lower + LIMITS.zone / 2) | (
            q > ROBOT.upper - LIMITS.zone / 2
        )  # farther it may be lost in rounding
        for image, J in (LIMITS.jacobian(q), LIMITS.inverse_jacobian(q)):
            np.testing.assert_array_equal(image[away], q[away])
            np.testing.assert_array_equal(J[away], np.broadcast_to(np.eye(NUM_JOINTS), J.shape)[away])
            assert (image[near] != q[near]).all()

    @given(seeds, st.floats(0, 1))
    def test_scaled_it_is_the_same_flow_for_a_part_of_its_time(self, seed, part):
        q = inside(50, seed)
        np.testing.assert_array_equal(LIMITS.scaled(0.0).forward(q), q)
        split = LIMITS.scaled(1 - part).inverse(LIMITS.scaled(part).inverse(q))
        np.testing.assert_allclose(split, LIMITS.inverse(q), rtol=0, atol=1e-12)

    @given(seeds)
    def test_jacobians_are_derivatives(self, seed):
        q = inside(20, seed, closest=0.01)
        np.testing.assert_allclose(
            LIMITS.jacobian(q)[1], central_differences(LIMITS.forward, q, 1e-5), rtol=1e-5, atol=1e-5
        )
        np.testing.assert_allclose(
            LIMITS.inverse_jacobian(q)[1], central_differences(LIMITS.inverse, q, 1e-5), rtol=0, atol=1e-5
        )

    @given(seeds)
    def test_the_order_of_joint_angles_is_kept(self, seed):
        a, b = inside(50, seed), inside(50, seed + 1)
        np.testing.assert_array_equal(LIMITS.forward(a) < LIMITS.forward(b), a < b)
        assert (np.linalg.det(LIMITS.jacobian(a)[1]) >= 1).all()  # what is held back here is far away there

    def test_a_path_is_put_where_the_map_is_finite_and_hardly_moved(self):
        at_limits = np.where(LIMITED, ROBOT.lower, 3.0)[None]
        kept = LIMITS.inside(np.concatenate([at_limits, np.where(LIMITED, ROBOT.upper, -3.0)[None], near(4)]))
        assert np.isfinite(LIMITS.forward(kept)).all()
        np.testing.assert_allclose(kept[0], at_limits[0], rtol=0, atol=0.1 * LIMITS.zone + 1e-12)
        np.testing.assert_array_equal(kept[2:], near(4))


class TestFlows:
    """What `dt_viz.arm.whole_arm` makes of the generators."""

    def chain(self, field, duration, tolerance=1e-9):
        """For a duration in units in which both kinds of generators are about as fast."""
        return Chain([Inverse(LIMITS), AdaptiveFlow(field, self.pace(field) * duration, tolerance), LIMITS])

    def pace(self, field):
        return 1.0 if isinstance(field, WholeArmField) else 0.05

    def test_flows_are_a_one_parameter_group(self, field):
        q = near(12)
        for s, t in ((0.2, 0.3), (-0.2, 0.5)):
            flow = partial(self.chain, field)
            at_once, in_two = flow(s + t).inverse(q), flow(s).inverse(flow(t).inverse(q))
            np.testing.assert_allclose(at_once, in_two, rtol=0, atol=1e-7)
            np.testing.assert_allclose(flow(-t).forward(q), flow(t).inverse(q), rtol=0, atol=1e-12)

    def test_there_and_back_again(self, field):
        q = near(12)
        moved = self.chain(field, 0.5).inverse(q)
        assert np.abs(moved - q).max() > 0.03
        assert round_trip_error(Inverse(self.chain(field, 0.5)), q) < 1e-7

    def test_the_equal_steps_of_a_drag_come_near_the_adaptive_ones(self, field):
        q, fine = near(12), self.chain(field, 0.4).inverse(near(12))
        coarse = Chain([Inverse(LIMITS), Flow(field, self.pace(field) * 0.4, 2, sparse=True), LIMITS])
        np.testing.assert_allclose(coarse.inverse(q), fine, rtol=0, atol=0.02)
        hand, miss = ROBOT.end_effector(fine), ROBOT.end_effector(coarse.inverse(q))
        assert np.linalg.norm(hand - miss, axis=1).max() < 2e-3

    def test_orientation_is_kept(self, field):
        det = np.linalg.det(self.chain(field, 0.5, 1e-7).inverse_jacobian(near(20))[1])
        assert det.min() > 0
        assert np.abs(det - 1).max() > 0.1

    def test_no_flow_leaves_the_joint_limits(self, field):
        """Even if it wants to: the postures here begin beside a limit."""
        q = near(12)
        q[:, 1] = ROBOT.lower[1] + 0.01
        bent = Sphere(tuple(BODY.positions(ROBOT, q)[0, 15] + 0.02), 0.15)  # pyright: ignore[reportArgumentType]
        towards = replace(field, obstacle=bent)
        for duration in (1.0, -1.0):
            moved = self.chain(towards, duration, 1e-6).inverse(q)
            assert np.abs(moved - q).max() > 0.05
            assert (moved > ROBOT.lower).all() and (moved < ROBOT.upper).all()
