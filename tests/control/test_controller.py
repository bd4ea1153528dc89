"""The robot in the loop: it follows eq. (4) exactly while nothing changes, and whatever happens to it, limits hold in
every tick, it says what is wrong, and it goes on when it can."""

from dataclasses import replace

import numpy as np
import pytest
from body_spheres import cover
from scenes import avoiding, changed

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.control.courses import Section
from dt_viz.control.feasible import ContactLimit
from dt_viz.control.settings import ControllerSettings
from dt_viz.kernels.proximity import contacts, least_contacts
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.models import load_jaco

TICK, LATE = 0.01, 0.5
MARGIN = 0.03
TIMES = np.linspace(0, 3, 2401)
SETTINGS = ControllerSettings()
SLACK = 1 + 1e-9


class Robot:
    """A robot that does what it is told, and remembers; its limits are checked in each tick."""

    def __init__(self, controller, q):
        self.controller, self.robot, self.q = controller, controller.robot, np.array(q, float)
        self.velocity, self.unavoidable, self.passed = np.zeros(6), 0.0, [self.q]

    def tick(self, dt=TICK):
        before, self.velocity = self.velocity, self.controller.step(self.q, dt)
        assert (np.abs(self.velocity) <= SLACK * self.robot.velocity_limits).all()
        assert (np.abs(self.velocity - before) <= SLACK * SETTINGS.acceleration * dt + 1e-12).all()
        least = min(self.room(), self.unavoidable)
        self.q = self.q + dt * self.velocity
        assert self.room() >= least - 1e-9
        self.passed.append(self.q)

    def room(self):
        """Smallest distance of a joint from the ends of its range."""
        return np.minimum(self.q - self.robot.lower, self.robot.upper - self.q).min()

    def moved_to(self, q):
        """Others move it, maybe so near to the end of a joint's range that no braking within limits stops it before."""
        self.q = q
        braking = self.velocity**2 / (2 * SETTINGS.acceleration) + TICK * np.abs(self.velocity)
        room = np.where(self.velocity < 0, q - self.robot.lower, self.robot.upper - q)
        self.unavoidable = min(0.0, float((room - braking).min()))

    def run(self, seconds, until=None):
        for _ in range(round(seconds / TICK)):
            self.tick()
            if self.controller.phase is until and np.abs(self.velocity).max() < 1e-3:
                break
        return self

    def see(self, *places, diameter=0.15):
        spheres = tuple(Sphere(as_point(np.asarray(place, float)), diameter) for place in places)
        self.controller.see(ArmAvoidance(Union(spheres), margin=MARGIN))

    @property
    def hand(self):
        return self.robot.end_effector(self.q)


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

    def missed(self, robot):
        return np.linalg.norm(robot.hand - self.goal)

    def assert_arrives(self, robot, seconds=15.0):
        """The robot comes to rest at the goal."""
        robot.run(seconds, until=Phase.RESTING)
        assert robot.controller.phase is Phase.RESTING and not robot.controller.held_back and self.missed(robot) < 1e-3

    def assert_goes_on(self, robot):
        robot.controller.see(None)
        robot.controller.follow(self.solved)
        robot.controller.release()
        robot.controller.go()
        self.assert_arrives(robot, 40.0)


@pytest.fixture(scope="module", name="scene")
def _scene(engine, initial):
    return Scene(engine, initial("push_box"))


@pytest.fixture(name="live")
def _live(scene):
    return scene.begun(0.0)


class TestExactness:
    def test_the_section_is_what_tracking_computes_and_nothing_beside_it_with_the_hand_in_place_is_better(self, scene):
        robot, reference, q = scene.robot, scene.lifted.reference, scene.lifted.tracked.q
        section = Section(robot, reference)
        assert np.abs(section.postures(robot.end_effector(q)) - q).max() < 1e-3  # where a waypoint of `track` is done
        paths = scene.solved.nominal.bundle.positions.reshape(len(q), -1, 3)
        exact = section.postures(paths)
        np.testing.assert_allclose(robot.end_effector(exact), paths, rtol=0, atol=1e-13)
        # tracking that begins there goes nowhere, but for the damping of its pseudo-inverse
        start = np.broadcast_to(reference, q[:, 0].shape)
        tracked = track(robot, paths[:, ::10], start, exact[:, ::10], reference=start).q
        np.testing.assert_allclose(tracked, exact[:, ::10], rtol=0, atol=1e-5)

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
        assert scene.missed(robot) < 1e-3
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
            robot.run(20, until=Phase.RESTING)
            assert robot.controller.phase is Phase.RESTING
            assert np.linalg.norm(robot.hand - solved.nominal.goal) < 1e-3


class TestDisturbances:
    def test_it_goes_on_from_where_somebody_else_has_moved_it(self, scene):
        robot = scene.begun(1.5)
        robot.moved_to(robot.q + np.array([0.1, -0.1, 0.05, 0.2, -0.1, 0.3]))
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
        assert robot.controller.phase is Phase.ASIDE and scene.missed(robot) > 0.02
        robot.controller.follow(scene.solved)
        robot.run(5)
        assert robot.controller.phase is Phase.RESTING and scene.missed(robot) < 1e-3

    def test_a_sphere_dropped_over_the_base_stops_it_and_it_goes_on_when_it_can(self, scene):
        robot = scene.begun(1.0)
        robot.controller.follow(scene.around((0, 0, 0.25), 0.3))
        robot.run(3)
        assert robot.controller.phase is Phase.TOUCHED
        assert np.abs(robot.velocity).max() < 0.05
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


# whatever happens


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "num"), [(0, 1200), *(pytest.param(k, 5000, marks=pytest.mark.slow) for k in range(1, 20))]
)
def test_limits_hold_in_random_ticks_whatever_happens(scene, live, seed, num):
    """Spheres that fly, jump and close in, other stacks, pushes, holds, other hands, and ticks that come late."""
    rng, places, ways = np.random.default_rng(seed), np.empty((0, 3)), np.empty((0, 3))
    for k in range(num):
        if k % 40 == 0:
            live.unavoidable = 0.0
            match rng.integers(9):
                case 0 | 1:  # from up to two sides
                    ways = rng.normal(scale=0.6, size=(rng.integers(1, 3), 3))
                    places = live.hand - 0.3 * ways
                case 2:
                    places, ways = live.hand + rng.normal(scale=0.05, size=(1, 3)), np.zeros((1, 3))
                case 3:
                    places = ways = np.empty((0, 3))
                case 4:
                    live.controller.displace(live.q + rng.normal(scale=0.8, size=6))
                case 5:
                    live.controller.hold(rng.uniform([-0.9, -0.9, -0.2], [0.9, 0.9, 1.0]))
                case 6:
                    live.moved_to(scene.engine.follower.whole_arm.limits.inside(live.q + rng.normal(scale=0.2, size=6)))
                case 7:
                    live.controller.follow(scene.around(live.hand + rng.normal(0, 0.1, 3), rng.uniform(0.04, 0.3)))
                case 8:
                    live.controller.home(0) if rng.integers(2) else live.controller.go()
        if k % 3 == 0 and len(places):
            live.see(*places)
        dt = LATE if rng.random() < 0.005 else TICK
        places = places + dt * ways
        live.tick(dt)
    scene.assert_goes_on(live)


def test_a_sphere_dropped_on_the_arm_at_rest_is_said_and_left(scene, live):
    live.run(20, until=Phase.RESTING)
    live.see(np.add(live.hand, [0.0, 0.02, 0.03]))
    live.run(0.1)
    assert live.controller.phase is Phase.TOUCHED and live.controller.touched
    live.run(5)
    assert not live.controller.touched
    scene.assert_goes_on(live)


@pytest.mark.long
@pytest.mark.parametrize("task", ["push_box", pytest.param("lift_box", marks=pytest.mark.slow)])
def test_a_robot_that_is_pushed_down_does_not_go_into_the_table(engine, initial, task):
    scene = Scene(engine, initial(task))
    live = scene.begun(1.0)
    model, lowest, said = load_jaco().collision, np.inf, set()
    height = min(0.0, model.nearest_to_table(live.q[None]).distance)
    for _ in range(4):
        live.controller.hold(live.hand - [0, 0, 0.4])
        for _ in range(40):
            live.run(0.05)
            said.add(live.controller.held_back)
            lowest = min(lowest, model.nearest_to_table(live.q[None]).distance)
        live.controller.release()
        live.run(0.3)
    assert "kept from the table" in said and lowest > height - 2e-3
    scene.assert_goes_on(live)


@pytest.mark.long
def test_a_robot_that_is_folded_does_not_touch_itself(scene, live):
    rng, model, closest, said = np.random.default_rng(1), load_jaco().collision, np.inf, set()
    live.run(1.0)
    for _ in range(12):
        live.controller.hold(np.array([0.0, 0.0, 0.35]) + rng.normal(scale=0.1, size=3))
        for _ in range(20):
            live.run(0.1)
            said.add(live.controller.held_back)
            closest = min(closest, apart.distance if (apart := model.nearest_to_itself(live.q[None])) else np.inf)
    assert "kept from itself" in said and closest > 0
    scene.assert_goes_on(live)


@pytest.mark.long
def test_links_come_near_the_table_and_each_other_no_faster_than_is_reckoned_with(live):
    body, postures = live.robot.body, np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 6))
    for make in (ContactLimit.table, ContactLimit.itself):
        pairs = make(live.robot, 5e-3, 20.0).pairs
        found = [contacts(live.robot.records, body.spheres, pairs, q, 9.0) for q in postures]
        _, apart, slopes = (np.concatenate(parts) for parts in zip(*found, strict=True))
        assert (np.abs(slopes[apart > 0]) @ live.robot.velocity_limits).max() < live.robot.top_speed


def test_distances_of_contacts_have_these_slopes(live):
    body, rng, joints, reach = live.robot.body, np.random.default_rng(0), live.robot.records, 0.3
    whole, small = body.spheres, cover(body)
    owner = np.searchsorted(body.indices, np.flatnonzero(whole["end"] == np.arange(len(whole)) + 1), side="right") - 1
    for limit in (ContactLimit.table(live.robot, 5e-3, 20.0), ContactLimit.itself(live.robot, 5e-3, 20.0)):
        q = live.q + rng.normal(scale=0.3, size=6)

        def exact(q, limit=limit):
            at, found = small.positions(live.robot, q), []
            for a, b in limit.pairs:
                of_b = owner == np.searchsorted(body.indices, b)
                if a < 0:
                    found.append((at[of_b, 2] - small.radius[of_b]).min())
                    continue
                of_a = owner == np.searchsorted(body.indices, a)
                away = np.linalg.norm(at[of_a, None] - at[of_b], axis=2) - small.radius[of_b]
                found.append((away - small.radius[of_a, None]).min())
            return np.array(found)

        which, apart, slopes = contacts(joints, whole, limit.pairs, q, reach)
        every = exact(q)
        np.testing.assert_array_equal(which, np.flatnonzero(every < reach))
        assert len(which)
        np.testing.assert_allclose(apart, every[which], atol=1e-12)
        way = rng.normal(size=6)
        behind, ahead = ((exact(q + step * way) - every)[which] / step for step in (-1e-7, 1e-7))
        slope = slopes @ way  # of one of those that are nearest, of which the smallest distance is left
        assert (ahead - 1e-4 < slope).all() and (slope < behind + 1e-4).all()
        motion = q + rng.normal(scale=0.3, size=(3, 6))
        least = np.minimum(np.min([exact(row) for row in motion], axis=0), 0.1)
        np.testing.assert_allclose(least_contacts(joints, whole, limit.pairs, motion, 0.1), least, atol=1e-12)
