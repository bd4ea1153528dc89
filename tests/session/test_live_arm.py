"""The arm that moves: it goes its round, never jumps, gives way, and goes on from wherever it is taken."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import changed

from dt_viz.control.controller import Phase
from dt_viz.control.settings import ControllerSettings
from dt_viz.metrics import distance_from_path
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.models import load_jaco
from dt_viz.session.frame import Stage
from dt_viz.session.robot_loop import LiveArm, RoundSettings

PICTURE = 0.04
SETTINGS = RoundSettings()


class Loop:
    """An engine whose arm moves by a clock of its own, and the postures that it was in."""

    def __init__(self, engine, scenario):
        self.engine, self.arm, self.robot = engine, engine.arm, engine.follower.robot
        self.passed, self.phases = [], []
        self.show(scenario)

    def show(self, scenario, *, until=Stage.LIVE):
        """Compute a scenario's frames, as a session does."""
        self.scenario = scenario
        for frame in self.engine.frames(scenario):
            self.frame = frame
            if frame.stage in (Stage.ROLLOUTS, Stage.FINE):
                self.engine.drive(frame)
            if frame.stage is until:
                return

    def run(self, seconds, until=lambda: False, *, moves=True):
        for _ in range(round(seconds / PICTURE)):
            self.arm.advance(PICTURE, moves=moves)
            self.passed.append(self.arm.q)
            self.phases.append(self.arm.phase)
            if until():
                break
        return self

    @property
    def hand(self):
        return self.robot.end_effector(self.arm.q)

    def missed(self):
        return np.linalg.norm(self.hand - self.frame.goal)

    def assert_no_jump(self):
        q = np.array(self.passed)
        speeds = np.abs(np.diff(q, axis=0)) / PICTURE
        assert (speeds <= self.robot.velocity_limits * (1 + 1e-9)).all()
        assert (
            np.abs(np.diff(speeds, axis=0)).max() <= ControllerSettings().acceleration * PICTURE * 1.3
        )  # between means over pictures
        assert (q >= self.robot.lower).all() and (q <= self.robot.upper).all() and np.isfinite(q).all()

    def assert_arrives_without_a_jump(self):
        self.run(30, lambda: self.arm.arrived > 0)
        assert self.missed() < 1e-3
        self.assert_no_jump()

    def assert_free(self, obstacle=None, since=0):
        """The arm has touched nothing since it was in the posture of that number."""
        near = load_jaco().collision.nearest_to_obstacle(
            np.array(self.passed[since:]), obstacle or self.scenario.obstacle
        )
        assert near.distance > 0


@pytest.fixture(scope="module")
def known(new_engine):
    """An engine of this module's own, which finds again what it has computed for another test."""
    return new_engine()


@pytest.fixture
def begin(known):
    """Begins a loop with an arm that has not moved yet."""

    def loop(scenario):
        known._last.clear()
        known.arm = LiveArm(known.follower)
        return Loop(known, scenario)

    return loop


@pytest.fixture(name="whole")
def _whole(begin, initial):
    return begin(changed(initial("push_box"), space="cspace"))


def sphere_at(place, diameter=0.15):
    return Sphere(as_point(np.asarray(place, float)), diameter)


@pytest.mark.parametrize(("task", "space"), [("push_box", "cspace"), ("draw_s", "task"), ("drop_pots", "cspace")])
def test_it_goes_from_start_to_goal_and_home_to_the_next_start(begin, initial, task, space):
    loop = begin(changed(initial(task), space=space))
    arm, starts = loop.arm, loop.engine.nominal(loop.scenario).starts
    np.testing.assert_allclose(loop.hand, loop.frame.rollouts[0][0], atol=5e-3)
    loop.assert_arrives_without_a_jump()
    loop.run(3, lambda: arm.phase is Phase.HOMING)
    assert SETTINGS.rest <= arm.arrived < SETTINGS.rest + 0.1
    loop.run(30, lambda: arm.phase is Phase.RESTING)
    assert np.linalg.norm(loop.hand - starts[1]) < 5e-3
    assert arm.arrived > SETTINGS.rest  # what it carried stays where it fell
    loop.run(1, lambda: arm.phase is Phase.MOVING)
    assert arm.arrived == 0
    loop.assert_arrives_without_a_jump()
    if space == "cspace":
        loop.assert_free()
        assert {Phase.MOVING, Phase.HOMING, Phase.RESTING} >= set(loop.phases)


def test_another_task_does_not_move_it_at_once(begin, initial):
    loop = begin(changed(initial("push_box"), space="cspace")).run(1.0)
    loop.show(changed(initial("draw_s"), space="task"))
    assert loop.arm.phase is Phase.MOVING
    loop.run(30, lambda: loop.phases[-2:] == [Phase.RESTING] * 2)
    np.testing.assert_allclose(loop.hand, loop.frame.rollouts[0][0], atol=5e-3)
    loop.assert_arrives_without_a_jump()


def test_another_rollout_is_begun_at_its_start(whole):
    whole.run(1.0)
    whole.show(replace(whole.scenario, arm_rollout=4))
    whole.run(30, lambda: whole.arm.phase is Phase.RESTING)
    np.testing.assert_allclose(whole.hand, whole.frame.ghost[4][0], atol=5e-3)
    whole.assert_no_jump()


def test_pushed_aside_again_and_again_it_still_reaches_the_goal(whole):
    whole.run(2.0)
    free, aside = whole.arm.ahead, []
    for _ in range(3):
        whole.arm.push()
        whole.run(0.6)
        aside.append(distance_from_path(whole.hand[None], free)[0])
    assert SETTINGS.push_distance / 4 < max(aside) < 3 * SETTINGS.push_distance
    whole.assert_arrives_without_a_jump()
    assert Phase.HELD in whole.phases
    whole.assert_free()
    assert whole.robot.end_effector(np.array(whole.passed))[:, 2].min() > 0


class TestHolding:
    def held(self, loop, place):
        for u in np.linspace(0, 1, 12):
            loop.arm.hold((1 - u) * loop.hand + u * place)
            loop.run(PICTURE)
        loop.run(5.0)

    def test_the_hand_follows_stays_and_goes_on_when_it_is_let_go(self, whole):
        whole.run(1.5)
        place = whole.hand + np.array([0.02, 0.03, 0.10])
        self.held(whole, place)
        assert np.linalg.norm(whole.hand - place) < 5e-3 and whole.arm.phase is Phase.HELD and not whole.arm.note
        whole.arm.release()
        whole.assert_arrives_without_a_jump()

    @pytest.mark.parametrize("seconds", [0.0, 1.5])
    def test_it_is_held_also_in_a_pause_and_stays_where_it_is_let_go(self, whole, seconds):
        whole.run(seconds)
        place = whole.hand + np.array([0.0, 0.0, 0.08])
        whole.arm.hold(place)
        whole.run(0.1, moves=False)
        whole.arm.release()
        stays = whole.run(3.0, moves=False).arm.q
        assert np.linalg.norm(whole.hand - place) < 5e-3
        np.testing.assert_array_equal(whole.run(1.0, moves=False).arm.q, stays)
        whole.run(30, lambda: whole.arm.arrived > 0)
        assert whole.missed() < 1e-3

    @pytest.mark.parametrize(
        ("place", "note"),
        [((0.0, -3.0, 0.5), "out of the arm's reach"), (None, "inside the obstacle")],
        ids=["too far", "in the obstacle"],
    )
    def test_what_keeps_the_hand_from_where_it_is_held_is_said(self, whole, place, note):
        whole.run(1.5)
        self.held(whole, np.array(whole.scenario.obstacles[0].position if place is None else place))
        assert whole.arm.note == note
        whole.assert_no_jump()
        whole.assert_free()


def test_a_pause_stops_the_robot_and_not_the_world(whole):
    stays = whole.run(1.0).arm.q
    np.testing.assert_array_equal(whole.run(1.0, moves=False).arm.q, stays)
    ahead = whole.arm.ahead
    whole.show(changed(whole.scenario, obstacles=(sphere_at(ahead[len(ahead) // 2] + np.array([0, 0, 0.05])),)))
    np.testing.assert_array_equal(whole.run(1.0, moves=False).arm.q, stays)
    assert len(ahead) != len(whole.arm.ahead) or np.abs(ahead - whole.arm.ahead).max() > 0.02
    whole.run(30, lambda: whole.arm.arrived > 0)
    assert whole.missed() < 1e-3


def test_a_thread_that_was_held_up_does_not_make_it_rush(whole):
    before = whole.run(0.5).arm.q
    whole.arm.advance(60.0, moves=True)
    assert np.abs(whole.arm.q - before).max() < 0.26 * whole.robot.velocity_limits.max()


def test_what_is_seen_is_not_touched_before_there_is_a_motion_around_it(whole):
    """However long that takes: the sphere comes to rest in the way, and no stack takes over. It may slide along it."""
    ahead = whole.run(1.0).arm.ahead
    place = ahead[np.linalg.norm(ahead - whole.hand, axis=1) > 0.25][0]
    seen = changed(whole.scenario, obstacles=(sphere_at(place),))
    whole.engine.see(seen)
    begun = len(whole.passed)
    whole.run(6.0)
    whole.assert_free(seen.obstacle, since=begun)
    whole.show(seen)
    whole.run(30, lambda: whole.missed() < 1e-3)
    whole.assert_arrives_without_a_jump()
    whole.assert_free(since=begun)


def test_it_says_that_it_is_touched_gives_way_and_goes_on(whole):
    whole.run(2.0)
    before, sphere = whole.scenario, sphere_at(whole.hand + np.array([0, 0, 0.1]), 0.6)
    whole.show(changed(before, obstacles=(sphere,)), until=Stage.CERTIFIED)
    whole.run(0.2)
    assert whole.arm.phase is Phase.TOUCHED and whole.arm.note == "touched"
    whole.run(3.0)
    whole.assert_free(since=-2)
    whole.show(before)
    whole.assert_arrives_without_a_jump()


@pytest.mark.parametrize("where", ["base", "start", "goal"])
def test_nothing_jumps_where_there_is_no_motion(whole, where):
    whole.run(1.0)
    places = {"base": np.array([0.0, 0.0, 0.2]), "start": whole.frame.ghost[0][0], "goal": whole.frame.goal}
    free = whole.scenario
    whole.show(changed(free, obstacles=(sphere_at(places[where], 0.3),)), until=Stage.CERTIFIED)
    assert whole.frame.blocked
    whole.run(8.0)
    whole.show(free)
    whole.run(40, lambda: whole.missed() < 1e-3)
    assert whole.missed() < 1e-3
    whole.assert_no_jump()


def test_it_waits_for_its_first_motion(engine):
    arm = LiveArm(engine.follower)
    arm.push()
    arm.advance(1.0, moves=True)
    assert arm.q is None and arm.undisturbed is None and len(arm.ahead) == 0 and arm.note == ""


def test_it_is_put_elsewhere_and_goes_on_from_there(whole):
    elsewhere = whole.run(1.0).arm.q + np.array([0.2, 0.1, -0.1, 0.0, 0.1, 0.0])
    whole.arm.put(elsewhere)
    whole.passed.clear()
    whole.run(PICTURE)
    assert np.abs(whole.arm.q - elsewhere).max() < 0.03
    whole.assert_arrives_without_a_jump()


@pytest.mark.parametrize("space", ["task", "cspace"])
def test_the_undisturbed_posture_is_on_the_learned_motion(begin, initial, space):
    loop = begin(changed(initial("push_box"), space=space))
    learned, apart = loop.engine.nominal(loop.scenario).paths[0], 0.0
    for _ in range(12):
        loop.run(0.3)
        hand = loop.robot.end_effector(loop.arm.undisturbed)
        assert np.linalg.norm(learned - hand, axis=1).min() < 6e-3
        apart = max(apart, float(np.linalg.norm(hand - loop.hand)))
    assert apart > 0.03


def test_an_arm_whose_thread_is_late_moves_as_far(begin, initial):
    scenario, left = changed(initial("push_box"), space="cspace"), []
    for period in (SETTINGS.tick, 0.2):
        arm = begin(scenario).arm
        for _ in range(round(2.0 / period)):
            arm.advance(period, moves=True)
        left.append(arm.left)
    assert 0 < left[0] < 0.95 and abs(left[0] - left[1]) < 0.03
