"""The whole arm's system against stepped integration, and the section that lifts the end effector's motion."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from oracles import central_differences, stepped
from scenes import changed

from dt_viz.control.arm_system import ArmSystem, Section
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Conjugated, Flow, Identity
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.metrics import resample_by_arc_length
from dt_viz.motion.following import Follower
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.inverse_kinematics import track

ARRIVED = 0.02
"""Metres in base space from the goal at which the motions that are compared end."""


class Case:
    """A task's system with an obstacle in the middle of its path, and without one."""

    def __init__(self, engine, robot, scenario):
        mean = np.mean([resample_by_arc_length(path, 101) for path in engine.task(scenario.task).paths], axis=0)
        x, y, z = (float(c) for c in mean[50])
        scenario = changed(scenario, space="cspace", obstacles=Sphere((x, y, z), 0.15))
        follower = Follower(robot)
        self.nominal = engine.nominal(scenario)
        self.lifted = follower.undisturbed(self.nominal)
        self.section = Section(robot, self.lifted.reference)
        # the learned pace is not smooth enough for RK4 to show its order: a plain attractor takes its place
        base = Attractor(self.nominal.system.base.goal, speed=0.2, smoothing=0.05)
        hand = DiffeomorphicSystem(self.nominal.system.transform, base)
        solution = follower.whole_arm.avoiding(self.lifted, scenario.arm_avoidance, LIVE.spacing, coarse=True)
        avoids = solution.transform
        assert isinstance(avoids, Conjugated) and isinstance(avoids.inner, Flow)
        self.field, self.duration = avoids.inner.field, avoids.inner.duration
        # equal steps: their Jacobian is their derivative to rounding, the adaptive flow's to 3e-4 of itself
        avoiding = Conjugated(Flow(self.field, self.duration, 8), avoids.by)
        self.systems = {
            "nothing": ArmSystem(hand, self.section, Identity(6)),
            "an obstacle": ArmSystem(hand, self.section, avoiding),
        }
        self.times = np.linspace(
            0, base.arrival_time(hand.transform.forward(self.nominal.task.starts), ARRIVED).max(), 4
        )

    def starts(self, system, num=2):
        return system.postures(self.nominal.task.starts[:num, None])[:, 0]


@pytest.fixture(scope="module", name="case")
def _case(engine, robot, initial):
    return Case(engine, robot, initial("push_box"))


@pytest.fixture(params=["nothing", "an obstacle"], name="system")
def _system(request, case):
    return case.systems[request.param]


class TestSection:
    def test_it_is_what_tracking_computes(self, case):
        q = case.lifted.tracked.q
        exact = case.section.postures(case.section.robot.end_effector(q))
        assert np.abs(exact - q).max() < 1e-3  # where a waypoint of `track` is done
        paths = case.nominal.bundle.positions.reshape(len(q), -1, 3)
        np.testing.assert_allclose(
            case.section.robot.end_effector(case.section.postures(paths)), paths, rtol=0, atol=1e-13
        )

    def test_no_posture_beside_it_with_the_hand_in_place_is_better(self, case, robot):
        """Tracking that begins there goes nowhere, but for the damping of its pseudo-inverse."""
        paths = case.nominal.bundle.positions.reshape(len(case.lifted.fractions), -1, 3)[:2, ::10]
        exact = case.section.postures(paths)
        start = np.broadcast_to(case.lifted.reference, (2, 6))
        tracked = track(robot, paths, start, exact, reference=start).q
        np.testing.assert_allclose(tracked, exact, rtol=0, atol=1e-5)

    def test_velocities_are_derivatives(self, case):
        paths = case.nominal.bundle.positions.reshape(len(case.lifted.fractions), -1, 3)[:, ::20]
        slopes = central_differences(case.section.postures, paths, 1e-4)
        for direction, slope in zip(np.eye(3), np.moveaxis(slopes, -1, 0), strict=True):
            analytic = case.section.velocities(case.section.postures(paths), np.broadcast_to(direction, paths.shape))
            np.testing.assert_allclose(analytic, slope, rtol=0, atol=1e-6)

    def test_velocities_move_the_hand_as_asked_anywhere(self, case, robot):
        q = case.lifted.tracked.q[:, ::10] + np.random.default_rng(0).normal(scale=0.1, size=(7, 10, 6))
        asked = np.random.default_rng(1).normal(size=(7, 10, 3))
        moved = robot.jacobian(q) @ case.section.velocities(q, asked)[..., None]
        np.testing.assert_allclose(moved[..., 0], asked, rtol=0, atol=1e-11)


def velocity_by_solve(system, p):
    """ṗ = J_ψ(p)⁻¹·q̇ by the Jacobians of ψ_q and ψ, (*B, 6): the velocity without tangents carried along."""
    q, J_arm = system.transform.jacobian(p)
    z, J_hand = system.hand.transform.jacobian(system.section.robot.end_effector(q))
    of_hand = np.linalg.solve(J_hand, system.hand.base.velocity(z)[..., None])[..., 0]
    return np.linalg.solve(J_arm, system.section.velocities(q, of_hand)[..., None])[..., 0]


def by_steps(system, p0, times, substeps):
    """The motion p(t) by RK4 steps along that velocity, (*B, T, 6), independently of `rollout`."""
    return stepped(partial(velocity_by_solve, system), p0, times, substeps)


class TestSystem:
    def test_exact_rollouts_are_what_stepping_converges_to_with_order_four(self, case):
        system = case.systems["nothing"]
        p0, counts = case.starts(system), np.array([8, 16, 32])
        exact = system.rollout(p0, case.times)
        errors = [np.abs(by_steps(system, p0, case.times, int(n)) - exact).max() for n in counts]
        assert errors[-1] < 1e-6
        assert np.polyfit(np.log(counts), -np.log(errors), 1)[0] == pytest.approx(4, abs=0.4)

    @pytest.mark.slow
    def test_so_they_are_around_an_obstacle(self, case):
        """There the field's third derivatives jump, which limits the order for steps as long as these."""
        system = case.systems["an obstacle"]
        p0 = case.starts(system, 1)
        exact = system.rollout(p0, case.times)
        errors = [np.abs(by_steps(system, p0, case.times, n) - exact).max() for n in (16, 32)]
        assert errors[1] < 1e-4
        assert errors[1] < errors[0] / 2**2.5
        undisturbed = case.systems["nothing"].rollout(case.starts(case.systems["nothing"], 1), case.times)
        assert np.abs(exact - undisturbed).max() > 0.1  # the obstacle is on the path

    def test_the_velocity_is_the_derivative_of_the_rollout(self, case, system):
        p0, h = case.starts(system, 7), 1e-3
        for t in case.times[1:3]:
            before, at, after = np.moveaxis(system.rollout(p0, np.array([t - h, t, t + h])), -2, 0)
            np.testing.assert_allclose(system.velocity(at), (after - before) / (2 * h), rtol=0, atol=2e-5)

    def test_the_velocity_solves_with_the_jacobian(self, case, system):
        p = system.rollout(case.starts(system, 7), case.times)
        np.testing.assert_allclose(system.velocity(p), velocity_by_solve(system, p), rtol=0, atol=1e-5)

    def test_the_chain_to_the_base_is_a_conjugacy(self, case, system):
        p0, robot = case.starts(system, 7), case.section.robot
        images = system.hand.transform.forward(
            robot.end_effector(system.transform.forward(system.rollout(p0, case.times)))
        )
        z0 = system.hand.transform.forward(case.nominal.task.starts)
        np.testing.assert_allclose(images, system.hand.base.flow(z0, case.times), rtol=0, atol=1e-5)

    def test_the_lyapunov_value_falls_strictly_and_the_goal_is_reached(self, case, system, robot):
        times = np.append(np.linspace(0, case.times[-1], 60), 100.0)
        motion = system.rollout(case.starts(system, 7), times)
        assert (np.diff(system.lyapunov(motion[:, :60]), axis=-1) < 0).all()
        goal = system.postures(case.nominal.goal[None])[0]
        np.testing.assert_allclose(motion[:, -1], np.broadcast_to(goal, (7, 6)), rtol=0, atol=1e-6)
        np.testing.assert_allclose(system.velocity(goal), 0, rtol=0, atol=1e-6)
        np.testing.assert_allclose(robot.end_effector(goal), case.nominal.goal, rtol=0, atol=1e-6)

    def test_with_the_learned_pace_too_and_the_flow_that_the_page_shows(self, case):
        avoids = case.systems["an obstacle"].transform
        flow = replace(avoids, inner=AdaptiveFlow(case.field, case.duration, 3e-8))
        system = ArmSystem(case.nominal.system, case.section, flow)
        p0, h = case.starts(system, 7), 1e-3
        before, at, after = np.moveaxis(system.rollout(p0, np.array([1.0 - h, 1.0, 1.0 + h])), -2, 0)
        velocity = (after - before) / (2 * h)
        np.testing.assert_allclose(system.velocity(at), velocity, rtol=0, atol=1e-3 * np.abs(velocity).max())

    @pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
    def test_any_batch_of_states(self, case, system, batch):
        p = np.broadcast_to(case.starts(system, 1)[0], (*batch, 6))
        assert system.velocity(p).shape == system.rollout(p, case.times)[..., 0, :].shape == (*batch, 6)
        assert system.lyapunov(p).shape == batch
