"""The arm turns its hand as the motion does, its place coming first; by how much it fails to is computed and said."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from dataclasses import astuple, replace

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle
import pytest
from other_arms import five_joints, seven_joints
from pinocchio_arm import pinocchio_configuration, pinocchio_model, random_configurations
from scipy.spatial.transform import Rotation
from turning import GOAL, in_reach

import dt_viz as dt
from dt_viz.control.controller import Phase
from dt_viz.flows.rotations import apart, quaternions, rotation
from dt_viz.learning.store import FitStore
from dt_viz.motion.certificates import HandTurn
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.inverse_kinematics import best_start, inverse_kinematics, track
from dt_viz.scenario.tasks import TaskEntry, own_task
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

ARMS = {"six": lambda: dt.load_arm("jaco").robot, "seven": seven_joints}


@pytest.fixture(scope="module")
def motion():
    return dt.fit(in_reach())


@pytest.fixture(scope="module")
def turning(robot):
    return Engine({"turning": TaskEntry("Turning", lambda: own_task(in_reach()))}, FitStore(None), robot)


def smooth_joints(arm, num=120):
    """Joints (T, n) of a motion without singularities."""
    u = np.linspace(0, 2 * np.pi, num)[:, None]
    return arm.home + 0.25 * np.sin(u + np.arange(arm.num_joints))


class TestHand:
    def test_its_orientation_is_that_of_pinocchio_with_z_along_the_hand(self, robot):
        model, data, *_ = pinocchio_model()
        hand = model.getFrameId("j2s6s200_end_effector")
        renamed = []
        for q in random_configurations(robot, 0, (10,)):
            pin.framesForwardKinematics(model, data, pinocchio_configuration(q))
            turned = rotation(robot.hand_orientation(q)).as_matrix()
            np.testing.assert_allclose(turned[:, 2], robot.hand_direction(q), atol=1e-7)
            renamed.append(data.oMf[hand].rotation.T @ turned)
        np.testing.assert_allclose(renamed, np.round(renamed[:1]).repeat(10, 0), atol=1e-7)  # axes, the same for all q
        assert np.linalg.det(np.round(renamed[0])) == 1

    @pytest.mark.parametrize("name", ARMS)
    def test_is_turned_as_wanted_and_is_where_it_is_wanted(self, name):
        arm = ARMS[name]()
        q = smooth_joints(arm)
        places, turned = arm.end_effector(q), arm.hand_orientation(q)
        found = track(arm, places, best_start(arm, places, turned), orientations=turned)
        assert found.error.max() < 1e-4
        np.testing.assert_allclose(found.turned, apart(arm.hand_orientation(found.q), turned), atol=1e-9)
        assert np.rad2deg(found.turned).max() < 2 and np.rad2deg(np.median(found.turned)) < 0.5
        free = track(arm, places, inverse_kinematics(arm, places[0]))
        assert np.rad2deg(apart(arm.hand_orientation(free.q), turned)).max() > 10

    def test_of_five_joints_is_turned_as_far_as_its_place_allows(self, robot):
        five, q = five_joints(), smooth_joints(robot)
        places, turned = robot.end_effector(q), robot.hand_orientation(q)
        found = track(five, places, inverse_kinematics(five, places[0], orientation=turned[0]), orientations=turned)
        assert found.error.max() < 1e-3
        free = track(five, places, inverse_kinematics(five, places[0]))
        off = np.median(apart(five.hand_orientation(free.q), turned))
        assert 0.01 < np.median(found.turned) < 0.7 * off

    def test_a_turn_on_the_spot_is_followed(self, robot):
        q = smooth_joints(robot)[:1]
        place, turned = np.repeat(robot.end_effector(q), 60, 0), rotation(robot.hand_orientation(q))
        axis = np.linspace(0, 1.2, 60)[:, None] * robot.hand_direction(q)
        wanted = quaternions(Rotation.from_rotvec(axis) * turned)
        found = track(robot, place, q[0], orientations=wanted)
        assert found.error.max() < 1e-4 and np.rad2deg(found.turned).max() < 2
        assert np.abs(np.diff(found.q, axis=0)).max() < 0.2

    def test_orientations_must_fit_the_path(self, robot):
        with pytest.raises(ValueError, match="orientations must be"):
            track(robot, np.zeros((5, 3)), robot.home, orientations=np.zeros((4, 4)))


class TestCertificate:
    def test_says_by_how_much_the_hand_is_turned_aside(self, robot):
        q = smooth_joints(robot)
        wanted = robot.hand_orientation(q)
        assert HandTurn.of(robot, q, wanted).largest < 1e-4
        aside = quaternions(rotation(wanted) * Rotation.from_euler("y", 10, degrees=True))
        assert astuple(HandTurn.of(robot, q, -aside)) == pytest.approx((10, 10))
        some = np.where(np.arange(len(q))[:, None] < 20, aside, wanted)
        found = HandTurn.of(robot, q, some)
        assert found.median < 1e-4 and found.largest == pytest.approx(10)

    def test_is_of_the_arm_that_is_shown(self, turning, initial):
        scenario = replace(initial("push_box"), task="turning")
        free = replace(scenario, stack=tuple(replace(layer, on=False) for layer in scenario.stack))
        *_, frame = turning.frames(free)
        assert frame.stage is Stage.CERTIFIED and frame.remembers and frame.has_orientation
        assert frame.certificates.turn.median < 1
        assert "beside its orientation" in repr(frame.certificates)
        np.testing.assert_array_equal(
            frame.certificates.turn.largest,
            np.rad2deg(apart(turning.follower.robot.hand_orientation(frame.arm.q), frame.arm.orientations)).max(),
        )
        places, turned = frame.hand_frames(7)
        np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.eye(3)[None].repeat(7, 0), atol=1e-9)
        np.testing.assert_allclose(places[[0, -1]], frame.rollouts[frame.chosen][[0, -1]])
        assert apart(quaternions(Rotation.from_matrix(turned[-1:])), GOAL).max() < 0.15

    def test_of_places_alone_there_is_none(self, at_rest, initial):
        frame = at_rest(initial("push_box"), Stage.CERTIFIED)
        assert frame.certificates.turn is None and frame.hand_frames(7) is None and not frame.has_orientation


class TestLibrary:
    def test_a_joint_path_says_how_the_hand_is_turned(self, motion):
        arm = dt.load_arm("jaco")
        for path, joints in zip(motion.rollouts(), arm.rollouts(motion), strict=True):
            assert path.orientations is not None and joints.turned is not None
            off = np.rad2deg(apart(arm.robot.hand_orientation(joints.q), path.orientations))
            np.testing.assert_allclose(joints.turned, off, atol=1e-6)
            assert joints.error.max() < 1e-3 and np.median(joints.turned) < 1
            assert "° beside its orientation" in repr(joints)

    def test_the_whole_arm_avoids_and_keeps_the_orientation_where_it_need_not_give_way(self, motion):
        arm = dt.load_arm("jaco")
        ball = Sphere(as_point(motion.rollouts()[0].positions[100] - np.array([0.0, 0.09, 0.05])), 0.08)
        around = motion.stack(dt.Avoidance(ball, space="cspace"))
        for joints in arm.rollouts(around):
            clearance = arm.robot.body.clearance(arm.robot, joints.q, ball, 0.05)
            assert clearance.min() > 0.005 and joints.turned is not None
            assert joints.turned[[0, -1]].max() < 3 and joints.turned.max() > joints.turned[0]

    def test_the_robot_in_the_loop_turns_its_hand(self, motion):
        arm = dt.load_arm("jaco")
        controller = dt.Controller(motion, arm)
        q = arm.rollouts(motion)[0].q[0]
        for _ in range(1500):
            q = q + 0.01 * controller.step(q, 0.01)
            if controller.phase is Phase.RESTING:
                break
        assert np.linalg.norm(arm.robot.end_effector(q) - motion.goal) < 2e-3
        turned, wanted = arm.robot.hand_orientation(q[None]), motion.rollouts()[0].orientations
        assert wanted is not None and np.rad2deg(apart(turned, wanted[-1:])).max() < 2

    @pytest.mark.long
    def test_a_task_is_placed_where_its_orientations_are_followed(self):
        arm, aside = dt.load_arm("jaco"), Rotation.from_euler("x", 120, degrees=True)
        takes = [replace(take, orientations=quaternions(aside * rotation(take.orientations))) for take in in_reach()]
        off = []
        for placed in (arm.place(takes), arm.place([replace(take, orientations=None) for take in takes])):
            turned = [replace(one, orientations=take.orientations) for one, take in zip(placed, takes, strict=True)]
            off.append(
                max(np.max(joints.turned) for joints in arm.rollouts(dt.fit(turned)) if joints.turned is not None)
            )
        assert off[0] < 6 < off[1]
