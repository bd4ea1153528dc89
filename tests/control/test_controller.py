"""The robot in the loop: it follows eq. (4) exactly while nothing changes, and stays within limits whatever does."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import avoiding, changed

from dt_viz.control.controller import ArmController, Phase
from dt_viz.control.settings import ControllerSettings
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.models import load_jaco

TICK = 0.01
MARGIN = 0.03
TIMES = np.linspace(0, 3, 2401)


class Robot:
    """A robot that does what it is told, and remembers."""

    def __init__(self, controller, q):
        self.controller, self.q = controller, np.array(q, float)
        self.passed, self.velocities, self.phases = [self.q], [], []

    def tick(self):
        velocity = self.controller.step(self.q, TICK)
        self.q = self.q + TICK * velocity
        self.passed.append(self.q)
        self.velocities.append(velocity)
        self.phases.append(self.controller.phase)

    def run(self, seconds, until=None):
        for _ in range(round(seconds / TICK)):
            self.tick()
            if until is not None and self.phases[-1] is until and np.abs(self.velocities[-1]).max() < 1e-3:
                break
        return self

    def excess(self):
        """Largest velocity and acceleration of a joint, in limits."""
        velocities = np.array([np.zeros(6), *self.velocities])
        changes = np.abs(np.diff(velocities, axis=0)).max() / TICK
        return (
            np.abs(velocities) / self.controller.robot.velocity_limits
        ).max(), changes / ControllerSettings().acceleration


@pytest.fixture(scope="module", name="scene")
def _scene(engine, initial):
    return Scene(engine, initial("push_box"))


class Scene:
    """A task, with a sphere somewhere or without one."""

    def __init__(self, engine, scenario):
        self.engine, self.robot = engine, engine.follower.robot
        self.scenario = changed(scenario, space="cspace", obstacles=(), margin=MARGIN)
        self.solved = engine.solved(self.scenario, LIVE)
        self.lifted = engine.follower.undisturbed(self.solved.nominal)
        self.start, self.goal = self.lifted.tracked.q[0, 0], self.solved.nominal.goal
        self.middle = self.robot.end_effector(self.lifted.tracked.q[0, 50])

    def around(self, place, diameter=0.15):
        sphere = Sphere(as_point(np.asarray(place, float)), diameter)
        return replace(self.solved, scenario=changed(self.scenario, obstacles=sphere))

    def controller(self, solved=None):
        return ArmController(self.engine.follower, solved or self.solved)

    def begun(self, seconds, solved=None):
        """A robot that has moved for some seconds from the start."""
        return Robot(self.controller(solved), self.start).run(seconds)

    def missed(self, q):
        return np.linalg.norm(self.robot.end_effector(q) - self.goal)

    def assert_arrives(self, robot, seconds=15.0):
        """The robot comes to rest at the goal, within its limits all the way."""
        robot.run(seconds, until=Phase.RESTING)
        assert robot.phases[-1] is Phase.RESTING and self.missed(robot.q) < 1e-3
        assert max(robot.excess()) < 1 + 1e-9


class TestExactness:
    @pytest.mark.parametrize("obstacle", [False, True])
    def test_it_goes_through_the_postures_of_the_exact_rollout(self, scene, obstacle):
        """Its own pace differs: it starts from rest, and keeps its limits."""
        controller = scene.controller(scene.around(scene.middle) if obstacle else None)
        robot = Robot(controller, scene.start)
        robot.tick()
        plain = controller._section.postures(
            scene.solved.stack.system.rollout(scene.robot.end_effector(scene.start), TIMES)
        )
        exact = controller._flow.transform.inverse(plain)
        robot.run(1.9)  # later on joints at their limits cut corners
        passed = np.array(robot.passed)[30:]
        gaps = np.abs(passed[:, None] - exact).max(axis=2).min(axis=1)
        assert gaps.max() < 1e-3  # of a cubic between two of the samples of the motion ahead
        if obstacle:
            assert np.abs(passed[:, None] - plain).max(axis=2).min(axis=1).max() > 0.1


class TestArrival:
    @pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 12))])
    def test_from_postures_beside_the_section(self, scene, seed):
        """Each converges to the posture that the section has for the goal."""
        rng = np.random.default_rng(seed)
        q = scene.engine.follower.whole_arm.limits.inside(scene.start + rng.normal(scale=0.5, size=6))
        robot = Robot(scene.controller(), q)
        scene.assert_arrives(robot, 30)
        turned = (robot.q - scene.lifted.tracked.q[0, -1]) / (2 * np.pi)
        turned -= np.where(np.isinf(scene.robot.lower), np.round(turned), 0)
        np.testing.assert_allclose(turned, 0, atol=2e-3)
        passed = np.array(robot.passed)
        assert (passed >= scene.robot.lower).all() and (passed <= scene.robot.upper).all()

    def test_around_a_sphere_that_rests_in_the_way(self, scene):
        solved = scene.around(scene.middle)
        robot = Robot(scene.controller(solved), scene.start).run(20, until=Phase.RESTING)
        assert scene.missed(robot.q) < 1e-3
        near = load_jaco().collision.nearest_to_obstacle(np.array(robot.passed)[::5], solved.scenario.obstacle)
        assert near.distance > 0.8 * MARGIN

    @pytest.mark.long
    def test_it_rests_only_once_the_way_around_a_sphere_has_come_to_that_of_the_end(self, engine):
        ball = Sphere((0.042637, -0.469151, 0.353698), 0.112008)
        solved = engine.solved(avoiding("drop_pots", ball, space="cspace", margin=0.01), LIVE)
        assert solved.arm is not None
        for rollout in (5, 6):  # the way around it still moves the goal where the course of the last one ends
            robot = Robot(ArmController(engine.follower, solved), solved.arm.p[np.argmax(solved.arm.index == rollout)])
            robot.controller.begin(robot.q, rollout)
            while not robot.phases or robot.phases[-1] is not Phase.RESTING:
                robot.run(0.01)
                assert len(robot.phases) < 2000
            missed = engine.follower.robot.end_effector(robot.q) - solved.nominal.goal
            assert np.linalg.norm(missed) < 1e-3

    def test_and_then_home_and_back(self, scene):
        robot = Robot(scene.controller(), scene.start).run(12, until=Phase.RESTING)
        robot.controller.home(1)
        assert robot.controller.phase is Phase.HOMING
        robot.run(20, until=Phase.RESTING)
        start = scene.solved.nominal.starts[1]
        assert np.linalg.norm(scene.robot.end_effector(robot.q) - start) < 1e-3
        robot.controller.go()
        scene.assert_arrives(robot)


class TestDisturbances:
    @pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 3))])
    def test_limits_hold_under_random_stacks_and_pushes(self, scene, seed):
        rng = np.random.default_rng(seed)
        robot = Robot(scene.controller(), scene.start)
        for _ in range(40):
            robot.run(rng.uniform(0.02, 0.3))
            match rng.integers(5):
                case 0 | 1:
                    place = scene.robot.end_effector(robot.q) + rng.normal(scale=0.1, size=3)
                    robot.controller.follow(scene.around(place, rng.uniform(0.04, 0.3)))
                case 2:
                    robot.controller.follow(scene.solved)
                case 3:
                    robot.controller.displace(robot.q + rng.normal(scale=0.3, size=6))
                case 4:
                    robot.controller.hold(scene.middle + rng.normal(scale=0.1, size=3))
        assert np.isfinite(robot.passed).all()
        assert max(robot.excess()) < 1 + 1e-9
        robot.controller.follow(scene.solved)
        robot.controller.go()
        scene.assert_arrives(robot, 30)

    def test_it_goes_on_from_where_somebody_else_has_moved_it(self, scene):
        robot = scene.begun(1.5)
        robot.q = robot.q + np.array([0.1, -0.1, 0.05, 0.2, -0.1, 0.3])
        place = robot.q
        robot.run(0.05)
        assert np.abs(robot.q - place).max() < 0.05  # no way back to where it was
        scene.assert_arrives(robot)

    @pytest.mark.long
    def test_at_rest_it_steps_aside_and_comes_back(self, scene):
        robot = Robot(scene.controller(), scene.start).run(12, until=Phase.RESTING)
        model, closest = load_jaco().collision, np.inf
        hand = scene.robot.end_effector(robot.q)
        for distance in np.linspace(0.25, 0.03, 100):  # 7 cm/s
            solved = scene.around(hand + distance * np.array([0.0, -0.6, 0.8]))
            robot.controller.follow(solved)
            robot.run(0.03)
            closest = min(closest, model.nearest_to_obstacle(robot.q[None], solved.scenario.obstacle).distance)
        assert closest > 0.01
        assert robot.phases[-1] is Phase.ASIDE and scene.missed(robot.q) > 0.02
        robot.controller.follow(scene.solved)
        robot.run(5)
        assert robot.phases[-1] is Phase.RESTING and scene.missed(robot.q) < 1e-3
        assert max(robot.excess()) < 1 + 1e-9

    def test_a_sphere_dropped_over_the_base_stops_it_and_it_goes_on_when_it_can(self, scene):
        robot = scene.begun(1.0)
        robot.controller.follow(scene.around((0, 0, 0.25), 0.3))
        robot.run(3)
        assert robot.phases[-1] is Phase.TOUCHED
        assert np.abs(robot.velocities[-1]).max() < 0.05
        robot.controller.follow(scene.solved)
        scene.assert_arrives(robot)

    @pytest.mark.parametrize("turns", [0, 1])
    def test_a_stack_of_the_hand_takes_over_where_the_motion_is(self, scene, engine, turns):
        """The base coordinates go on, so that the robot comes to the same motion seen through the new stack."""
        scenario = changed(scene.scenario, space="task", obstacles=Sphere(as_point(scene.middle), 0.1), margin=0.02)
        turned = scene.start + 2 * np.pi * turns * np.isinf(scene.robot.lower)
        robot = Robot(scene.controller(), turned).run(1.5)
        robot.controller.follow(engine.solved(scenario, LIVE))
        course, section = robot.controller._progress.course, robot.controller._section
        ahead = course.q[course.times > 2]  # by then it has nearly converged to the section
        exact = section.postures(scene.robot.end_effector(ahead)[::-1])[::-1]
        assert len(ahead) > 10 and np.abs(np.sin((ahead - exact) / 2)).max() < 5e-3
        scene.assert_arrives(robot)
        hand = scene.robot.end_effector(np.array(robot.passed))
        assert scenario.obstacle.signed_distance(hand).min() > 0.01

    def test_another_posture_to_stay_near_is_taken_gradually(self, scene):
        class Leaning:
            """The arm, staying near another posture."""

            robot, whole_arm = scene.engine.follower.robot, scene.engine.follower.whole_arm
            body, at_ends = scene.engine.follower.robot.body, scene.engine.follower.at_ends

            def reference(self, nominal):
                return scene.engine.follower.reference(nominal) + offset

        offset = np.zeros(6)
        robot = Robot(ArmController(Leaning(), scene.solved), scene.start).run(1.0)  # pyright: ignore[reportArgumentType]
        offset = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
        robot.controller.follow(scene.solved)
        scene.assert_arrives(robot)
        assert np.abs(robot.q - scene.lifted.tracked.q[0, -1]).max() > 0.1


@pytest.mark.parametrize(
    ("q", "dt", "accepted"),
    [
        (np.zeros(5), TICK, "6 finite angles"),
        (np.full(6, np.nan), TICK, "6 finite angles"),
        (np.zeros(6), 0.0, "more than 0"),
        (np.zeros(6), -1.0, "more than 0"),
        (np.zeros(6), np.nan, "more than 0"),
    ],
)
def test_postures_have_to_be_such_and_time_has_to_pass(scene, q, dt, accepted):
    with pytest.raises(ValueError, match=accepted):
        scene.controller().step(q, dt)
    with pytest.raises(ValueError, match=accepted):
        scene.controller().steps(q, dt, 3)
