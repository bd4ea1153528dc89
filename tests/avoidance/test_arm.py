"""The whole arm's motions around an obstacle: what each of them promises, and what the joints follow."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import changed

from dt_viz.avoidance.arm import WholeArm
from dt_viz.avoidance.arm_field import WholeArmSettings
from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE, MAX_DURATION, ArmSolution
from dt_viz.avoidance.lift import Lift
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.metrics import resample_by_arc_length, sharpest_turn
from dt_viz.motion.following import Follower
from dt_viz.motion.stack import FINE, LIVE
from dt_viz.obstacles.shapes import Box, Sphere, as_point
from dt_viz.robot.body_points import PROTRUSION
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Scenario

ELBOW = Sphere((0.04, -0.37, 0.38), 0.08)
"""In the way of the forearm that pushes the box, far from where the hand goes."""


class Case:
    """A task's motion, and what the arm makes of it."""

    def __init__(self, engine, robot, initial):
        mean = np.mean([resample_by_arc_length(path, 101) for path in engine.task(initial.task).paths], axis=0)
        self.middle = Sphere(as_point(mean[50]), 0.15)
        self.robot = robot
        self.scenario = changed(initial, space="cspace", obstacles=self.middle)
        self.nominal = engine.nominal(self.scenario)
        self.follower = Follower(robot)
        self.arm: WholeArm = self.follower.whole_arm
        self.lifted: Lift = self.follower.undisturbed(self.nominal)
        self._known: dict[tuple[Scenario, bool], ArmSolution] = {}

    def avoiding(self, obstacle=None, *, coarse=False, **changes) -> ArmSolution:
        scenario = changed(self.scenario, obstacles=obstacle or self.middle, **changes)
        if (scenario, coarse) not in self._known:
            avoidance, spacing = scenario.arm_avoidance, LIVE.spacing if coarse else FINE.spacing
            self._known[scenario, coarse] = self.arm.avoiding(self.lifted, avoidance, spacing, coarse=coarse)
        return self._known[scenario, coarse]

    def truth(self, motions, obstacle) -> float:
        """Distance of the meshes from the obstacle on motions, between their samples, too."""
        if isinstance(motions, ArmSolution):
            motions = split(motions, motions.p)
        model = load_jaco().collision
        return min(model.nearest_to_obstacle(q, obstacle).distance for q in motions)

    def beside(self, clearance, diameter=0.1) -> Sphere:
        """An obstacle that the arm passes at this distance."""
        x, y, z = self.middle.position
        q = self.lifted.tracked.q.reshape(-1, 6)
        low, high = 0.0, 1.0
        for _ in range(25):
            middle = (low + high) / 2
            near = self.arm.clearance(q, Sphere((x, y - middle, z), diameter)).min()
            low, high = (low, middle) if near > clearance else (middle, high)
        return Sphere((x, y - low, z), diameter)


@pytest.fixture(
    scope="module", params=["push_box", "draw_s", pytest.param("lift_box", marks=pytest.mark.slow)], name="case"
)
def _case(request, engine, robot, initial):
    return Case(engine, robot, initial(request.param))


@pytest.fixture(scope="module", name="push")
def _push(engine, robot, initial):
    return Case(engine, robot, initial("push_box"))


def ends(solution):
    """Which samples are the first or the last of a rollout."""
    change = np.diff(solution.index) > 0
    return np.r_[True, change] | np.r_[change, True]


def split(solution, values):
    return np.split(values, np.flatnonzero(np.diff(solution.index)) + 1)


class TestLift:
    def test_it_is_the_section_that_tracking_computes_also_between_its_samples(self, case):
        fractions = case.lifted.fractions
        between = np.sort(np.concatenate([fractions, (fractions[:, :-1] + fractions[:, 1:]) / 2], axis=1))
        index = np.repeat(np.arange(len(between)), between.shape[1])
        paths = case.nominal.system.transform.inverse(case.nominal.rays.at(index, between.ravel()))
        start = np.broadcast_to(case.lifted.reference, (len(between), 6))
        direct = track(case.robot, paths.reshape(*between.shape, 3), start, reference=start).q.reshape(-1, 6)
        q = case.lifted.at(index, between.ravel())
        # tracking itself stops within 5e-4 rad of the best posture, and with the hand in place
        assert np.abs(q - direct).max() < 5e-4
        assert np.median(np.abs(q - direct).max(axis=1)) < 1e-5
        assert np.linalg.norm(case.robot.end_effector(q) - paths, axis=1).max() < 2e-5

    def test_all_rollouts_end_in_one_posture_and_are_pinned_there(self, case):
        last = case.lifted.tracked.q[:, -1]
        np.testing.assert_allclose(last, np.broadcast_to(last[0], last.shape), rtol=0, atol=1e-4)
        np.testing.assert_array_equal(case.lifted.pins[-1], last[0])
        np.testing.assert_array_equal(case.lifted.pins[:-1], case.lifted.tracked.q[:, 0])
        np.testing.assert_allclose(case.robot.end_effector(case.lifted.pins), case.nominal.ends, rtol=0, atol=1e-5)


@pytest.mark.parametrize("coarse", [True, False])
class TestAroundTheMiddle:
    """A ball of 15 cm at the middle of the mean demonstration."""

    def test_every_motion_is_cleared_within_the_joint_limits_and_so_are_the_meshes(self, case, coarse):
        solution = case.avoiding(coarse=coarse)
        assert solution.cleared and solution.clearance > 0
        assert solution.clearance == pytest.approx(case.arm.clearance(solution.p, case.middle).min())
        assert case.truth(solution, case.middle) > 0
        held = case.arm.robot.end_effector(solution.p)  # between the fingers, which may pass on both sides
        assert case.middle.signed_distance(held).min() > case.scenario.arm_avoidance.margin - MARGIN_TOLERANCE
        assert (solution.p > case.robot.lower).all() and (solution.p < case.robot.upper).all()
        assert case.truth(case.lifted.tracked.q, case.middle) < -0.05  # so there was something to do

    def test_start_and_goal_stay(self, case, coarse):
        solution = case.avoiding(coarse=coarse)
        np.testing.assert_allclose(solution.p[ends(solution)], solution.q[ends(solution)], rtol=0, atol=1e-6)
        hand = case.robot.end_effector(solution.p[ends(solution)]).reshape(-1, 2, 3)
        np.testing.assert_allclose(hand[:, 0], case.nominal.task.starts, rtol=0, atol=1e-5)
        np.testing.assert_allclose(hand[:, 1], np.broadcast_to(case.nominal.goal, hand[:, 1].shape), rtol=0, atol=1e-5)

    def test_neighbouring_samples_are_near(self, case, coarse):
        solution = case.avoiding(coarse=coarse)
        spacing = WholeArmSettings().coarse_spacing if coarse else FINE.spacing
        for p, fraction in zip(split(solution, solution.p), split(solution, solution.fraction), strict=True):
            assert np.linalg.norm(np.diff(p * case.robot.levers, axis=0), axis=1).max() <= spacing
            assert (np.diff(fraction) > 0).all() and fraction[0] == 0 and fraction[-1] == 1
            hand = case.robot.end_effector(p)
            assert np.linalg.norm(np.diff(hand, axis=0), axis=1).max() < 2 * spacing

    def test_the_motion_is_the_image_of_the_lifted_one(self, case, coarse):
        solution = case.avoiding(coarse=coarse)
        q = case.arm.limits.inside(solution.q)
        error = np.abs(solution.transform.inverse(q) - solution.p).max()
        # a drag's flow is continued in steps of other lengths where new samples ask for more of it
        assert error < (5e-3 if coarse else 1e-5)

    def test_the_duration_is_the_shortest(self, case, coarse):
        solution = case.avoiding(coarse=coarse)
        less = case.avoiding(coarse=coarse, duration=0.9 * solution.duration)
        margin = case.scenario.arm_avoidance.margin - 1e-3
        assert not less.cleared or case.truth(less, case.middle) < margin
        same = case.avoiding(coarse=coarse, duration=solution.duration)
        assert same.cleared


@pytest.mark.parametrize("shape", ["ball", pytest.param("box", marks=pytest.mark.slow)])
class TestMargin:
    """What is asked for is kept by the meshes, and hardly more than that."""

    @pytest.fixture(name="obstacle")
    def _obstacle(self, push, shape):
        place = as_point(push.nominal.task.mean_path[40] + [0.0, 0.02, 0.01])
        return Sphere(place, 0.15) if shape == "ball" else Box(place, (0.12, 0.1, 0.14), (0.8, 0.6, 0.0, 0.0))

    @pytest.mark.parametrize("coarse", [True, False])
    def test_the_meshes_keep_what_is_asked_for_and_hardly_more(self, push, obstacle, coarse):
        margin, solution = push.scenario.arm_avoidance.margin, push.avoiding(obstacle, coarse=coarse)
        assert margin - MARGIN_TOLERANCE <= push.truth(solution, obstacle) < margin + PROTRUSION + MARGIN_TOLERANCE
        assert solution.clearance < margin + 2 * MARGIN_TOLERANCE


def test_a_manual_duration_is_taken_as_it_is_and_motions_that_are_to_avoid_nothing_may_collide(case):
    still = case.avoiding(duration=0.0)
    np.testing.assert_allclose(still.p, still.q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(still.p, case.lifted.at(still.index, still.fraction), rtol=0, atol=1e-13)
    assert not still.cleared and still.clearance < -0.05
    undisturbed = case.arm.undisturbed(case.lifted, case.scenario.arm_avoidance, LIVE.spacing)
    assert isinstance(undisturbed.transform, Identity) and undisturbed.duration == 0
    np.testing.assert_allclose(undisturbed.p, undisturbed.q, rtol=0, atol=1e-13)
    assert not undisturbed.cleared and undisturbed.clearance == pytest.approx(still.clearance, abs=1e-3)
    little = case.avoiding(duration=0.1)
    assert little.duration == 0.1 and not little.cleared
    assert still.clearance < little.clearance < case.avoiding().clearance


def test_with_nothing_near_the_arm_moves_undisturbed(case):
    far = case.avoiding(Sphere((3.0, 3.0, 3.0)))
    assert far.cleared and far.duration == 0 and isinstance(far.transform, Identity)
    np.testing.assert_allclose(far.p, far.q, rtol=0, atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_samples_between_the_integrated_ones_are_on_the_flow_too(case, seed):
    rng = np.random.default_rng(seed)
    at = as_point(case.middle.position + rng.uniform(-0.04, 0.04, 3))
    obstacle = Sphere(at, rng.uniform(0.08, 0.2)) if seed else Box(at, as_point(rng.uniform(0.06, 0.16, 3)))
    coarse, hand = case.avoiding(obstacle, coarse=True), case.robot.end_effector
    exact = coarse.transform.inverse(case.arm.limits.inside(coarse.q))
    assert np.linalg.norm(hand(coarse.p) - hand(exact), axis=1).max() < 1e-3


def test_samples_between_the_integrated_ones_keep_the_joint_limits(engine, robot, initial):
    """A large sphere that presses joints against them: splines of the angles themselves would go beyond."""
    lift = Case(engine, robot, initial("lift_box"))
    p = lift.avoiding(Sphere((0.0288, -0.5498, 0.3220), 0.2373), coarse=True).p
    assert (p > robot.lower).all() and (p < robot.upper).all()


@pytest.mark.parametrize("duration", [None, 0.05])
def test_the_gradient_of_the_paper_is_there_to_be_compared(case, duration):
    solution = case.avoiding(generator="probability", coarse=True, duration=duration)
    assert not isinstance(solution.transform, Identity)
    assert np.isfinite(solution.p).all()
    assert (solution.p > case.robot.lower).all() and (solution.p < case.robot.upper).all()
    assert solution.clearance > case.avoiding(duration=0.0).clearance


@pytest.mark.parametrize("diameter", [0.04, 0.30])
@pytest.mark.parametrize("temperature", [1.0, 20.0])
def test_any_size_and_temperature_is_cleared_or_that_is_said(case, diameter, temperature):
    obstacle = replace(case.middle, diameter=diameter)
    solution = case.avoiding(obstacle, coarse=True, temperature=temperature)
    assert np.isfinite(solution.p).all()
    touched_at_rest = case.arm.clearance(case.lifted.pins, obstacle).min() < 0
    kept = solution.clearance
    assert touched_at_rest or (kept > 0 if solution.cleared else kept < case.scenario.arm_avoidance.margin)


def test_the_forearm_clears_what_the_hand_never_comes_near_and_the_hand_hardly_leaves_its_path(push):
    hand = push.robot.end_effector(push.lifted.tracked.q)
    assert ELBOW.signed_distance(hand).min() > 0.2
    assert push.truth(push.lifted.tracked.q, ELBOW) < -0.03
    solution = push.avoiding(ELBOW)
    assert solution.cleared
    assert push.truth(solution, ELBOW) > 0
    hand, before = push.robot.end_effector(solution.p), push.robot.end_effector(solution.q)
    np.testing.assert_allclose(hand[ends(solution)][1::2], [push.nominal.goal] * 7, rtol=0, atol=1e-4)
    assert np.linalg.norm(hand - before, axis=1).max() < 0.04
    assert np.abs(solution.p - solution.q).max() > 0.05


@pytest.mark.parametrize("temperature", [20.0, 6.0], ids=["as far as the goal", "as usual"])
def test_a_posture_that_is_pinned_beside_a_limit_or_beyond_it_is_put_inside_and_stays_there(push, temperature):
    """The arm begins and ends just above a lower limit."""
    joint, lower = 2, push.robot.lower.copy()
    lower[joint] = push.lifted.pins[:, joint].min() - 0.01
    arm = WholeArm(replace(push.robot, lower=lower))
    avoidance = replace(push.scenario.arm_avoidance, temperature=temperature, duration=0.4 if temperature > 6 else None)
    solution = arm.avoiding(push.lifted, avoidance, LIVE.spacing, coarse=True)
    np.testing.assert_allclose(solution.p[ends(solution)], solution.q[ends(solution)], rtol=0, atol=1e-6)
    assert (solution.p > lower).all() and (arm.limits.inside(solution.q) >= lower).all()


def test_where_no_way_is_free_that_is_said_and_the_motion_is_that_of_the_duration_that_is_said(push):
    solution = push.avoiding(Sphere((0.03, -0.13, 0.4), 0.22))
    assert not solution.cleared and solution.duration <= MAX_DURATION
    image = solution.transform.inverse(push.arm.limits.inside(solution.q[::20]))
    np.testing.assert_allclose(image, solution.p[::20], rtol=0, atol=1e-5)


def test_opposed_ways_out_of_two_balls_become_one_only_where_one_posture_meets_both(push, monkeypatch):
    """Balls above and below the path of the push, one after the other."""
    mean = push.nominal.task.mean_path
    pair = tuple(Sphere(as_point(mean[k] + [0.0, 0.0, z]), 0.1) for k, z in ((45, 0.03), (57, -0.03)))
    one, other = (push.avoiding(ball, coarse=True).detours[0].side for ball in pair)
    assert one @ other < WholeArmSettings().opposed
    solution, avoidance = push.avoiding(pair, coarse=True), changed(push.scenario, obstacles=pair).arm_avoidance
    first, second = solution.detours
    np.testing.assert_array_equal(first.side, second.side)
    assert solution.cleared
    monkeypatch.setattr(push.arm, "settings", WholeArmSettings(together=-1.0))  # no posture meets both
    first, second = push.arm.avoiding(push.lifted, avoidance, LIVE.spacing, coarse=True).detours
    assert first.side @ second.side < WholeArmSettings().opposed
    hands = [push.robot.end_effector(p) for p in split(solution, solution.p)]
    assert max(sharpest_turn(hand, 0.015) for hand in hands) < 90


def test_where_the_first_way_out_is_long_one_with_less_detour_is_taken(push, monkeypatch):
    box = Box((0.275, -0.457, 0.134), (0.217, 0.225, 0.206), (-0.182, -0.899, 0.319, -0.238))
    avoidance, detours = changed(push.scenario, obstacles=box).arm_avoidance, []
    for limit in (np.inf, 0.0):
        monkeypatch.setattr("dt_viz.avoidance.arm_solver.LONG", limit)
        solution = push.arm.avoiding(push.lifted, avoidance, LIVE.spacing, coarse=True)
        hand, before = push.robot.end_effector(solution.p), push.robot.end_effector(solution.q)
        detours.append(np.linalg.norm(hand - before, axis=1).max())
        assert solution.cleared
    assert detours[1] < detours[0]


@pytest.mark.parametrize("margin", [0.0, 0.01])
@pytest.mark.parametrize("clearance", [0.0005, 0.002, 0.008])
def test_what_comes_too_near_without_touching_is_taken_farther_away_or_left(case, margin, clearance):
    solution = case.avoiding(case.beside(clearance), margin=margin, coarse=True)
    assert np.isfinite(solution.p).all()
    assert solution.clearance > min(clearance, 0.002) - MARGIN_TOLERANCE
