"""Arms of five and seven joints: kinematics, avoidance, joint paths and the loop, beside each other in one process."""

from dataclasses import replace

import numpy as np
import pytest
from other_arms import OTHER_ARMS, five_joints, seven_joints, shorter
from scenes import avoiding

import dt_viz as dt
from dt_viz.control.controller import ArmController, Phase
from dt_viz.memo import Memo
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.inverse_kinematics import inverse_kinematics, track
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage


@pytest.fixture(scope="module", params=OTHER_ARMS)
def arm(request) -> Robot:
    return OTHER_ARMS[request.param]()


class TestKinematics:
    def test_a_path_is_followed_on_one_branch(self, arm):
        u = np.linspace(0, 2 * np.pi, 200)
        path = np.array([0.0, -0.5, 0.35]) + 0.12 * np.stack([np.sin(u), 0.3 * np.cos(u), np.sin(2 * u)], axis=1)
        followed = track(arm, path, inverse_kinematics(arm, path[0]))
        assert followed.q.shape == (200, arm.num_joints)
        assert followed.error.max() < 1e-5 and not followed.limits_hit.any()
        assert np.abs(np.diff(followed.q, axis=0)).max() < 0.2
        np.testing.assert_allclose(followed.q[-1], followed.q[0], atol=1e-3)

    def test_links_that_may_touch_are_not_kept_apart(self, robot):
        names = [mesh.name for mesh in robot.meshes]
        folded = np.array([0.0, np.pi, 0.5, 0.0, 5.7, 0.0])  # the hand in the upper arm
        near = robot.collision.nearest_to_itself(folded[None])
        assert near is not None and near.distance == 0 and robot.self_clearance(folded[None], 0.05) < 0
        upper, hand = names[2], names[6:]
        lenient = replace(robot, touching=frozenset(frozenset({upper, name}) for name in (*hand, "none of these")))
        of_pairs = robot.body.spheres["joint"][lenient.pairs(2)]
        assert len(lenient.pairs(2)) < len(robot.pairs(2)) and not (of_pairs == [1, 5]).all(axis=1).any()
        left = lenient.collision.nearest_to_itself(folded[None])
        assert left is None or set(left.links) != set(near.links)
        every = replace(robot, touching=frozenset(frozenset({a, b}) for a in names for b in names if a != b))
        assert every.collision.nearest_to_itself(folded[None]) is None
        assert every.self_clearance(folded[None], 0.05) == 0.05

    @pytest.mark.parametrize("num", [2, 9])
    def test_an_arm_with_too_few_or_too_many_joints_is_refused(self, robot, num):
        with pytest.raises(ValueError, match=f"jaco: found {num} joints; accepted: 3 to 8"):
            replace(robot, joint_translations=np.zeros((num, 3)))


class TestAvoidance:
    @pytest.mark.long
    def test_the_whole_arm_clears_a_ball_and_the_loop_takes_it_to_the_goal(self, arm, fits):
        engine = Engine(TASKS, fits, arm)
        task = engine.task("push_box")
        middle = task.mean_path[len(task.mean_path) // 2]
        ball = Sphere(as_point(np.add(middle, (0.0, 0.0, 0.06))), 0.1)
        scenario = avoiding("push_box", ball, space="cspace", margin=0.01)
        frame = next(frame for frame in engine.frames(scenario) if frame.stage is Stage.CERTIFIED)
        motion, report = frame.arm, frame.certificates.collision
        assert not frame.blocked and frame.motion.arm is not None and motion is not None and report is not None
        assert frame.motion.arm.cleared
        q = motion.q
        assert q.shape[1] == arm.num_joints and ((q >= arm.lower) & (q <= arm.upper)).all()
        assert arm.collision.nearest_to_obstacle(motion.without, ball).distance < 0  # it was in the way
        assert report.obstacle.distance > 0.009
        assert np.linalg.norm(arm.end_effector(q[-1]) - frame.goal) < 1e-3
        speeds = np.abs(np.diff(q, axis=0)) / np.diff(motion.times)[:, None]
        assert (speeds <= arm.velocity_limits * (1 + 1e-6)).all()

        controller, passed = ArmController(engine.follower, engine.solved(scenario, FINE)), [q[0]]
        while controller.phase is not Phase.RESTING or len(passed) < 10:
            passed.append(passed[-1] + 0.01 * controller.step(passed[-1], 0.01))
            assert len(passed) < 3000
        assert np.linalg.norm(arm.end_effector(passed[-1]) - frame.goal) < 1e-3
        assert arm.collision.nearest_to_obstacle(np.array(passed)[::5], ball).distance > 4e-3
        with pytest.raises(ValueError, match=f"accepted: {arm.num_joints} finite angles"):
            controller.step(np.zeros(6), 0.01)


@pytest.mark.long
def test_engines_of_two_arms_share_what_is_kept_and_none_gets_what_is_the_others(robot, fits):
    shared, found = Memo(), {}
    scenario = avoiding("push_box", Sphere((0.1, -0.5, 0.3), 0.1), space="cspace")
    for memo in (shared, None):
        for arm in (robot, five_joints(), seven_joints()):
            engine = Engine(TASKS, fits, arm, memo)
            solved = engine.solved(scenario, FINE)
            known = engine.follower.reference_postures(solved.nominal.learned)
            assert solved.arm is not None
            assert known.references.shape[1] == solved.arm.p.shape[1] == arm.num_joints
            np.testing.assert_array_equal(solved.arm.p, found.setdefault(arm.name, solved.arm.p))


def around_a_ball(arm: Robot, size: float) -> tuple[dt.JointPath, ...]:
    """The whole arm pushes the box around a ball, all lengths of the task scaled."""
    takes = tuple(replace(take, positions=size * take.positions) for take in dt.example("push_box")[:3])
    ball = dt.Sphere(as_point(size * TASKS["push_box"]().mean_path[55]), diameter=0.12 * size)
    around = dt.fit(takes, state="plain").stack(dt.ArmAvoidance(ball, margin=0.01 * size))
    return dt.Arm(arm).rollouts(around, spacing=0.005 * size)


@pytest.mark.long
def test_an_arm_of_half_the_size_moves_as_the_whole_one(robot):
    """All lengths in settings scale with the arm: in a world of half the size its joints do the same."""
    for whole, half in zip(around_a_ball(robot, 1.0), around_a_ball(shorter(robot, 0.5), 0.5), strict=True):
        np.testing.assert_allclose(half.q, whole.q, atol=1e-8)
        np.testing.assert_allclose(half.error, whole.error / 2, atol=1e-9)
        assert whole.error.max() > 0.02  # the hand gives way
