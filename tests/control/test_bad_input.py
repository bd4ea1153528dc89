"""Whatever happens to the robot, limits hold in every tick, it says what is wrong, and it goes on when it can."""

import numpy as np
import pytest
from body_spheres import cover
from scenes import changed

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.control.limits import ContactLimit
from dt_viz.control.settings import ControllerSettings
from dt_viz.kernels.proximity import contacts, least_contacts
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco

TICK, LATE = 0.01, 0.5
SETTINGS = ControllerSettings()
SLACK = 1 + 1e-9


class Robot:
    """A robot that does what it is told; what it does is checked in each tick."""

    def __init__(self, engine, initial, task="push_box"):
        self.follower, self.robot = engine.follower, engine.follower.robot
        self.solved = engine.solved(changed(initial(task), space="cspace", obstacles=(), margin=0.03), LIVE)
        self.q = self.follower.undisturbed(self.solved.nominal).tracked.q[0, 0].copy()
        self.controller, self.velocity = ArmController(self.follower, self.solved), np.zeros(6)
        self.unavoidable = 0.0

    def tick(self, dt=TICK):
        before, self.velocity = self.velocity, self.controller.step(self.q, dt)
        assert (np.abs(self.velocity) <= SLACK * self.robot.velocity_limits).all()
        assert (np.abs(self.velocity - before) <= SLACK * SETTINGS.acceleration * dt + 1e-12).all()
        room = np.minimum(self.q - self.robot.lower, self.robot.upper - self.q).min()
        self.q = self.q + dt * self.velocity
        assert (
            np.minimum(self.q - self.robot.lower, self.robot.upper - self.q).min() >= min(room, self.unavoidable) - 1e-9
        )

    def moved_to(self, q):
        """Others move it, maybe so near to the end of a joint's range that no braking within limits stops it before."""
        self.q = q
        braking = self.velocity**2 / (2 * SETTINGS.acceleration) + TICK * np.abs(self.velocity)
        room = np.where(self.velocity < 0, q - self.robot.lower, self.robot.upper - q)
        self.unavoidable = min(0.0, float((room - braking).min()))

    def run(self, seconds, until=None):
        for _ in range(round(seconds / TICK)):
            self.tick()
            if until is not None and self.controller.phase is until:
                break
        return self

    def see(self, *places, diameter=0.15):
        spheres = tuple(Sphere(as_point(np.asarray(place, float)), diameter) for place in places)
        self.controller.see(ArmAvoidance(Union(spheres), margin=0.03))

    @property
    def hand(self):
        return self.robot.end_effector(self.q)

    def goes_on(self):
        self.controller.see(None)
        self.controller.release()
        self.controller.go()
        self.run(40, until=Phase.RESTING)
        assert self.controller.phase is Phase.RESTING and not self.controller.held_back
        assert np.linalg.norm(self.hand - self.solved.nominal.goal) < 2e-3


@pytest.fixture(name="live")
def _live(engine, initial):
    return Robot(engine, initial)


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "num"), [(0, 1200), *(pytest.param(k, 5000, marks=pytest.mark.slow) for k in range(1, 20))]
)
def test_limits_hold_in_random_ticks_whatever_happens(live, seed, num):
    """Spheres that fly, jump and close in, pushes, holds, other hands, and ticks that come late."""
    rng, places, ways = np.random.default_rng(seed), np.empty((0, 3)), np.empty((0, 3))
    for k in range(num):
        if k % 40 == 0:
            live.unavoidable = 0.0
            match rng.integers(8):
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
                    live.moved_to(live.follower.whole_arm.limits.inside(live.q + rng.normal(scale=0.2, size=6)))
                case 7:
                    live.controller.home(0) if rng.integers(2) else live.controller.go()
        if k % 3 == 0 and len(places):
            live.see(*places)
        dt = LATE if rng.random() < 0.005 else TICK
        places = places + dt * ways
        live.tick(dt)
    live.goes_on()


def test_a_sphere_dropped_on_the_arm_at_rest_is_said_and_left(live):
    live.run(20, until=Phase.RESTING)
    live.see(np.add(live.hand, [0.0, 0.02, 0.03]))
    live.run(0.1)
    assert live.controller.phase is Phase.TOUCHED and live.controller.touched
    live.run(5)
    assert not live.controller.touched
    live.goes_on()


@pytest.mark.long
def test_two_spheres_that_close_in_from_both_sides(live):
    live.run(1.5)
    for gap in np.linspace(0.4, 0.1, 60):
        live.see(*(np.add(live.hand, [side, 0, 0]) for side in (gap, -gap)))
        live.run(0.03)
    live.goes_on()


@pytest.mark.long
@pytest.mark.parametrize("task", ["push_box", pytest.param("lift_box", marks=pytest.mark.slow)])
def test_a_robot_that_is_pushed_down_does_not_go_into_the_table(engine, initial, task):
    live = Robot(engine, initial, task)
    live.run(1.0)
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
    live.goes_on()


@pytest.mark.long
def test_a_robot_that_is_folded_does_not_touch_itself(live):
    rng, model, closest, said = np.random.default_rng(1), load_jaco().collision, np.inf, set()
    live.run(1.0)
    for _ in range(12):
        live.controller.hold(np.array([0.0, 0.0, 0.35]) + rng.normal(scale=0.1, size=3))
        for _ in range(20):
            live.run(0.1)
            said.add(live.controller.held_back)
            closest = min(closest, apart.distance if (apart := model.nearest_to_itself(live.q[None])) else np.inf)
    assert "kept from itself" in said and closest > 0
    live.goes_on()


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
