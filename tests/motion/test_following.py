"""What the joints follow, what is in the arm's way, and what is shown meanwhile."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import changed, frame_at, kinds, starts_at

from dt_viz.avoidance.arm_solver import LONG
from dt_viz.avoidance.avoidance import ArmAvoidance, StartStatus
from dt_viz.avoidance.lift import NUM_CONFIGURATIONS
from dt_viz.control.courses import Section
from dt_viz.errors import UnwantedError
from dt_viz.motion.following import MAX_TRACKING_ERROR, NUM_ARM_SAMPLES, Follower
from dt_viz.motion.solve import solve
from dt_viz.motion.stack import FINE, LIVE, build_stack
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union
from dt_viz.robot.collision import SELF_MARGIN
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.warning import Kind

FAR = Sphere((3.0, 3.0, 3.0))


def around(point, diameter=0.15):
    x, y, z = (float(c) for c in point)
    return Sphere((x, y, z), diameter)


def placed(scenario, *obstacles, **changes):
    return changed(scenario, obstacles=obstacles, space="cspace", view=View(field=False), **changes)


@pytest.fixture(scope="module", name="nominal")
def _nominal(engine, initial):
    return engine.nominal(initial("push_box"))


@pytest.fixture(scope="module", name="follower")
def _follower(robot):
    return Follower(robot)


@pytest.fixture(scope="module", name="too_far")
def _too_far(fits, robot):
    """An engine whose push lies two metres away."""

    def shifted():
        task = TASKS["push_box"]()
        return replace(task, origin=task.origin + np.array([2.0, 0.0, 0.0]))

    return Engine({"push_box": replace(TASKS["push_box"], load=shifted)}, fits, robot)


class TestAdmission:
    def admission(self, follower, nominal, *obstacles):
        return follower.admission(nominal, ArmAvoidance(Union(obstacles)))

    def reasons(self, follower, nominal, obstacle):
        return self.admission(follower, nominal, obstacle).blocked

    def test_nothing_is_in_the_way_of_what_has_to_be_avoided(self, follower, nominal, initial):
        for obstacles in (initial("push_box").obstacles, (FAR,), ()):
            admission = self.admission(follower, nominal, *obstacles)
            assert admission.nominal == nominal and not admission.blocked  # with its usual posture, too

    def test_a_covered_start_is_left_out_and_named(self, follower, nominal):
        away = np.linalg.norm(nominal.task.starts - nominal.task.starts[2], axis=1)
        admission = self.admission(follower, nominal, around(nominal.task.starts[2], 0.12))
        assert not admission.blocked and admission.nominal.status[2] is StartStatus.IN_COLLISION
        (reason,) = admission.nominal.warnings
        assert reason.kind is Kind.START_COVERED and reason.text.startswith("start") and "3" in reason.text
        assert (away[~admission.nominal.moving] < 0.15).all()
        assert len(admission.nominal.trajectories) == len(admission.nominal.status) == 7

    @pytest.mark.parametrize(
        ("place", "diameter", "kind", "says"),
        [
            ("the starts", 0.4, Kind.START_COVERED, "1, 2, 3, 4, 5, 6, 7"),
            ("the goal", 0.15, Kind.GOAL_COVERED, "the arm there touches it"),
            ((0.0, 0.08, 0.05), 0.1, Kind.ARM_BLOCKED, "base"),
            ((0.0, 0.08, 0.2), 0.1, Kind.ARM_BLOCKED, "link 1"),
        ],
    )
    def test_what_blocks_the_arm_is_named(self, follower, nominal, place, diameter, kind, says):
        known = {"the starts": nominal.task.starts.mean(axis=0), "the goal": nominal.goal}
        (reason,) = self.reasons(follower, nominal, around(known.get(place, place), diameter))
        assert reason.kind is kind and says in reason.text
        assert ("cannot move away" in reason.text) == (kind is Kind.ARM_BLOCKED)

    def test_what_fits_between_the_fingers_covers_the_goal_only_where_it_is_there(self, follower, nominal, robot):
        """The end effector is a point of the arm, too: its way may not begin or end in an obstacle."""
        ball, pins = around(nominal.goal, 0.02), follower.undisturbed(nominal).pins
        assert load_jaco().collision.obstacle_distance(pins[-1:], ball)[0][0] > 0  # the fingers are beside it
        (reason,) = self.reasons(follower, nominal, ball)
        assert reason.kind is Kind.GOAL_COVERED
        across = np.cross(robot.hand_direction(pins[-1]), [0.0, 1.0, 0.0])
        beside = around(nominal.goal + 0.2 * across / np.linalg.norm(across), 0.02)
        assert self.reasons(follower, nominal, beside) == ()
        ball = around(nominal.task.starts[2], 0.02)  # a start is left out likewise
        assert load_jaco().collision.obstacle_distance(follower.undisturbed(nominal).pins[2:3], ball)[0][0] > 0
        assert self.admission(follower, nominal, ball).nominal.status[2] is StartStatus.IN_COLLISION

    def test_demonstrations_out_of_reach_are_named(self, too_far, initial, robot):
        nominal = too_far.nominal(initial("push_box"))
        follower = Follower(robot)
        (reason,) = self.reasons(follower, nominal, FAR)
        assert reason.kind is Kind.OUT_OF_REACH
        assert "cannot reach the starts" in reason.text and "no configuration reaches" in reason.text
        for _ in range(2):  # the second answer is the remembered one
            with pytest.raises(UnreachableError):
                follower.undisturbed(nominal)


class TestReferencePosture:
    """A ball beside the goal, which the hand clears and the arm at rest there does not."""

    @pytest.fixture(name="beside", params=["push_box", "drop_pots"])
    def _beside(self, request, engine, initial):
        nominal = engine.nominal(initial(request.param))
        mean = np.mean(nominal.paths, axis=0)
        place = mean[np.argmin(np.abs(np.linalg.norm(mean - nominal.goal, axis=1) - 0.11))]
        return nominal, ArmAvoidance((around(place),))

    def truth(self, q, avoidance):
        """Distance of the meshes from the obstacle at each posture."""
        (part,) = avoidance.avoided.parts
        return load_jaco().collision.obstacle_distance(q, part)[0]

    @pytest.mark.long
    def test_the_arm_rests_elsewhere_with_the_hand_where_it_was_and_can_be_taken_there(self, follower, beside, robot):
        nominal, avoidance = beside
        assert self.truth(follower.undisturbed(nominal).pins, avoidance).min() < 0  # so there is something to do
        found = follower.admission(nominal, avoidance)
        assert not found.blocked and found.nominal.moving.all() and found.nominal.posture is not None
        assert Follower(robot).admission(nominal, avoidance).nominal.posture == found.nominal.posture
        lifted = follower.undisturbed(found.nominal)
        assert self.truth(lifted.pins, avoidance).min() >= avoidance.margin - 1e-3
        np.testing.assert_allclose(robot.end_effector(lifted.pins), nominal.ends, rtol=0, atol=1e-5)
        # along all motions
        assert lifted.tracked.error.max() < MAX_TRACKING_ERROR
        assert not lifted.tracked.limits_hit.any() and not lifted.tracked.damped.any()
        assert (lifted.tracked.q > robot.lower).all() and (lifted.tracked.q < robot.upper).all()
        itself = load_jaco().collision.nearest_to_itself(lifted.tracked.q[0])
        assert itself is None or itself.distance >= SELF_MARGIN
        # by one section from every start
        q = lifted.tracked.q[:, ::20]
        again = Section(robot, lifted.reference).postures(robot.end_effector(q))
        np.testing.assert_allclose(again, q, rtol=0, atol=1e-3)

    def test_the_meshes_keep_clear_of_each_other_with_all_reference_postures(self, follower, beside):
        known, model = follower.reference_postures(beside[0].learned), load_jaco().collision
        for posture in range(0, len(known.references), 20):
            near = [model.nearest_to_itself(q) for q in (known.on_path[posture], *known.at_starts[posture][:, None])]
            assert all(nearest is None or nearest.distance >= SELF_MARGIN for nearest in near)

    def test_the_motion_ends_at_the_goal_around_the_obstacle(self, engine, beside, robot):
        nominal, avoidance = beside
        scenario = changed(Scenario(nominal.task.name), obstacles=avoidance.avoided.parts, space="cspace")
        solved = engine.solved(scenario, FINE)
        assert solved.cleared and solved.nominal.posture is not None
        rows = np.r_[np.diff(solved.arm.index) > 0, True]
        hand = robot.end_effector(solved.arm.p[rows])
        np.testing.assert_allclose(hand, np.broadcast_to(nominal.goal, hand.shape), rtol=0, atol=1e-4)
        assert self.truth(solved.arm.p[::7], avoidance).min() >= avoidance.margin - 1e-3


class Lift:
    """A box that is lifted around a ball, and what the arm finds for motions."""

    def __init__(self, follower, nominal, scenario, monkeypatch):
        self.follower, self.nominal, self.avoiding = follower, nominal, follower.whole_arm.avoiding
        self.scenario, self.monkeypatch = placed(scenario, around(np.mean(nominal.paths, axis=0)[90])), monkeypatch

    def change(self, found):
        """Have the arm find something else: `found` takes the lifted motions, and what the arm finds for them."""
        avoiding = lambda lifted, *given, **options: found(lifted, self.avoiding(lifted, *given, **options))  # noqa: E731
        self.monkeypatch.setattr(self.follower.whole_arm, "avoiding", avoiding)

    def go_straight_through(self):
        """The arm avoids nothing."""
        arm = self.follower.whole_arm
        through = lambda lifted, avoidance, spacing, **_: arm.undisturbed(lifted, avoidance, spacing)  # noqa: E731
        self.monkeypatch.setattr(arm, "avoiding", through)

    def solved(self, precision=LIVE, passing=None, moved=0.0, **changes):
        x, y, z = self.scenario.obstacle.parts[0].position
        scenario = changed(self.scenario, obstacles=Sphere((x, y, z + moved)), **changes)
        return solve(replace(scenario, passing=passing), self.nominal, precision, self.follower)


@pytest.fixture(name="lift")
def _lift(engine, follower, initial, monkeypatch):
    return Lift(follower, engine.nominal(initial("lift_box")), initial("lift_box"), monkeypatch)


class TestNoWay:
    @pytest.mark.parametrize("poor", [{"stuck": np.arange(7) == 0}, {"duration": 1.01 * LONG}], ids=["none", "long"])
    def test_other_postures_are_tried_where_the_usual_one_has_no_way_or_a_long_one_unless_it_is_by_hand(
        self, lift, poor
    ):
        assert lift.solved().nominal is lift.nominal
        usual = lift.follower.reference(lift.nominal)
        lift.change(lambda lifted, found: replace(found, **poor) if np.all(lifted.reference == usual) else found)
        other = lift.solved()
        assert other.cleared and other.nominal.posture is not None
        assert lift.solved(duration=0.3).nominal is lift.nominal

    def test_starts_from_which_there_is_no_way_are_left_out_and_named_and_not_tried_again_in_a_drag(self, lift):
        tried = []

        def stuck(lifted, found):
            tried.append(lifted.shaping.sum())
            return replace(found, stuck=np.arange(len(lifted.shaping)) == 2) if lifted.shaping.all() else found

        lift.change(stuck)
        solved = lift.solved()
        assert solved.arm is not None and solved.cleared
        assert [status is StartStatus.NO_WAY for status in solved.nominal.status] == [k == 2 for k in range(tried[0])]
        np.testing.assert_array_equal(np.unique(solved.arm.index), np.flatnonzero(solved.nominal.shaping))
        (warning,) = solved.nominal.warnings
        assert warning.text == "start 3 is without a way around the obstacle for the arm"
        tried.clear()
        after = lift.solved(LIVE, solved.passing, moved=0.003)
        assert after.nominal.status == solved.nominal.status and after.nominal.warnings == (warning,) and not tried
        lift.solved(FINE, solved.passing, moved=0.003)
        assert tried[0] == len(solved.nominal.status)

    @pytest.mark.parametrize("precision", [LIVE, pytest.param(FINE, marks=pytest.mark.slow)], ids=["live", "fine"])
    def test_no_way_is_said_instead_of_shown_where_the_arm_would_touch_unless_it_is_by_hand(self, lift, precision):
        lift.change(lambda lifted, found: replace(found, stuck=np.ones(len(lifted.shaping), bool)))
        assert lift.solved(precision).blocked == ()  # it comes near, but does not touch
        lift.go_straight_through()
        (warning,) = lift.solved(precision).blocked
        assert warning.kind is Kind.NO_WAY
        assert lift.solved(precision, duration=0.0).blocked == ()

    def test_a_frame_is_blocked_where_there_is_no_way(self, new_engine, initial, monkeypatch):
        engine = new_engine()
        lift = Lift(engine.follower, engine.nominal(initial("lift_box")), initial("lift_box"), monkeypatch)
        lift.go_straight_through()
        frame, motions = engine.arm_motions(lift.scenario)
        assert kinds(frame.blocked) == {Kind.NO_WAY} and motions == {}

    def test_a_covered_start_leaves_the_arm_with_another_and_all_others_in_their_places(self, new_engine, initial):
        engine, added = new_engine(), ((0.1, -0.45, 0.3), (0.0, -0.45, 0.35))
        scenario = placed(initial("push_box"), around(engine.task("push_box").starts[0], 0.1))
        frame, motions = engine.arm_motions(scenario)
        assert 0 < len(motions) < 7 and Kind.START_COVERED in kinds(frame.certificates.found)
        places = [place for place, path in enumerate(frame.rollouts) if len(path)]
        assert frame.chosen == places[0] > 0 and list(motions) == places and len(frame.rollouts) == 7
        for level in frame.levels:
            assert [place for place, path in enumerate(level) if len(path)] == places
        for place in places:
            np.testing.assert_allclose(frame.rollouts[place][0], frame.task.starts[place], atol=5e-3)
        frame = next(engine.frames(replace(scenario, starts=starts_at(*added))))
        assert Kind.START_COVERED in kinds(frame.certificates.found)
        assert [place for place, path in enumerate(frame.rollouts) if len(path)] == [*places, 7, 8]
        np.testing.assert_array_equal(np.flatnonzero(frame.shaping), places)
        for path, start in zip(frame.rollouts[-2:], added, strict=True):
            np.testing.assert_allclose(path[0], start, atol=5e-3)


class TestFollowing:
    @pytest.mark.parametrize(("exact", "tolerance"), [(False, 1e-3), (True, 1e-8)])
    def test_behaviours_of_the_hand_are_followed(self, follower, nominal, initial, robot, exact, tolerance):
        scenario = changed(initial("push_box"), space="task")
        solution = build_stack(nominal, scenario.active, LIVE)
        lifted = follower.behaving(nominal, solution, exact=exact)
        assert lifted.fractions.shape == (7, NUM_CONFIGURATIONS)
        assert (np.diff(lifted.fractions, axis=1) > 0).all()
        index, fraction = np.repeat(np.arange(7), 60), np.tile(np.linspace(0, 1, 60), 7)
        miss = robot.end_effector(lifted.at(index, fraction)) - solution.positions_at(index, fraction)
        assert np.linalg.norm(miss, axis=1).max() < tolerance

    def test_warnings_say_what_misses_its_path(self, follower, nominal):
        path = np.linspace([0.0, -0.5, 0.2], [0.0, -1.2, 0.2], NUM_ARM_SAMPLES)
        joints = follower.along(nominal, path)
        missed, damped = follower.warnings(joints, 4)
        assert missed.kind is Kind.PATH_MISSED and "misses the path of rollout 5" in missed.text
        assert damped.kind is Kind.DAMPED
        assert follower.warnings(follower.undisturbed(nominal).tracked, 0) == ()


class TestBlocked:
    def test_the_last_good_motion_is_shown_marked_until_the_obstacle_moves_away(self, new_engine, initial):
        engine, free = new_engine(), placed(initial("push_box"), *initial("push_box").obstacles)
        good = frame_at(engine, free, Stage.FINE)
        assert good.blocked == ()
        covered = placed(initial("push_box"), around(good.goal))
        frames = list(engine.frames(covered))
        assert [frame.stage for frame in frames] == list(Stage)
        for frame in frames:
            assert frame.scenario == covered
            assert Kind.GOAL_COVERED in kinds(frame.blocked)
            assert frame.rollouts is good.rollouts and frame.arm is (good.arm if frame.stage >= Stage.FINE else None)
            assert frame.certificates.clearance < 0  # of the motion that is shown, from the obstacle where it is now
            assert frame.certificates.min_det_jacobian is None  # certificates of another scenario certify nothing
        recovered = frame_at(engine, free, Stage.FINE)
        assert recovered.blocked == ()
        for a, b in zip(recovered.rollouts, good.rollouts, strict=True):
            np.testing.assert_array_equal(a, b)

    def test_a_drag_that_ends_blocked_shows_the_arm_along_its_last_good_motion(self, new_engine, initial):
        engine = new_engine()
        good = frame_at(engine, placed(initial("push_box"), *initial("push_box").obstacles), Stage.LIVE)
        assert good.arm is None  # nothing showed it
        blocked = frame_at(engine, placed(initial("push_box"), around(good.goal)), Stage.FINE)
        assert blocked.blocked and blocked.arm is not None
        hand = engine.follower.robot.end_effector(blocked.arm.q)
        np.testing.assert_allclose(hand, good.rollouts[good.chosen], atol=1e-9)

    def test_without_a_motion_before_it_is_the_undisturbed_one(self, new_engine, initial):
        frame = frame_at(new_engine(), placed(initial("push_box"), around((0.0, 0.0, 0.1), 0.3)), Stage.LIVE)
        assert Kind.ARM_BLOCKED in kinds(frame.blocked)
        for path, ghost in zip(frame.rollouts, frame.ghost, strict=True):
            assert np.linalg.norm(path[:, None] - ghost, axis=-1).min(axis=0).max() < 1e-12

    def test_the_undisturbed_one_follows_a_drag_and_refining_it_ends_when_it_is_cancelled(self, new_engine, initial):
        blocked = placed(initial("push_box"), around((0.0, 0.0, 0.1), 0.3))
        frames = new_engine().frames(blocked, cancelled=lambda: True)
        assert all(next(frames).blocked for _ in (Stage.ROLLOUTS, Stage.LIVE))
        with pytest.raises(UnwantedError):
            next(frames)

    def test_demonstrations_out_of_reach_are_shown_without_an_arm(self, too_far, initial):
        for frame in too_far.frames(placed(initial("push_box"), *initial("push_box").obstacles)):
            assert kinds(frame.blocked) == {Kind.OUT_OF_REACH}
            assert frame.arm is None and np.isfinite(frame.certificates.clearance)
