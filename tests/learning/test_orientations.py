"""The hand's orientation, learned with its place: one stable system, whatever signs quaternions have."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from turning import GOAL, turning_takes

import dt_viz as dt
from dt_viz.evaluate.held_out import follow
from dt_viz.flows.rotations import apart, exponential, logarithm, mean_orientation, nearest, quaternions, rotation
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.inspection import Repaired, repair
from dt_viz.learning.patterns import StartProcess
from dt_viz.learning.preparation import PreparationSettings, prepare

RNG = np.random.default_rng(5)
TAKES = turning_takes()


def hand(motion):
    """Orientations (T, 4) of a take or a path that has some."""
    assert motion.orientations is not None
    return motion.orientations


@pytest.fixture(scope="module")
def imitation():
    return fit_augmented(TAKES)


def states(imitation, num=20, seed=0):
    """States (num, 6 + 1 + 4) of poses beside the motions, at all phases."""
    rng, poses = np.random.default_rng(seed), imitation.poses
    begun = poses.states(np.hstack([imitation.starts[np.arange(num) % 5], 0.2 * rng.normal(size=(num, 3))]))
    begun[:, 6] *= np.linspace(1.0, 0.05, num)
    return begun


class TestRotations:
    def test_logarithm_and_exponential_undo_each_other_and_signs_change_nothing(self):
        turned = hand(TAKES[0])
        vectors = logarithm(GOAL, turned)
        assert apart(exponential(GOAL, vectors), turned).max() < 1e-7
        signs = RNG.choice([-1.0, 1.0], size=(150, 1))
        np.testing.assert_allclose(logarithm(-GOAL, signs * turned), vectors, atol=1e-12)
        np.testing.assert_allclose(apart(mean_orientation(signs * turned), mean_orientation(turned)), 0, atol=1e-7)

    @pytest.mark.parametrize("turns", [0.4, 0.98, 1.6, 3.3])
    def test_a_motion_that_turns_far_has_no_cut(self, turns):
        axis = np.array([0.6, 0.0, 0.8])
        vectors = np.linspace(2 * np.pi * turns, 0, 400)[:, None] * axis
        np.testing.assert_allclose(logarithm(GOAL, exponential(GOAL, vectors)), vectors, atol=1e-7)
        np.testing.assert_allclose(nearest(GOAL, exponential(GOAL, vectors[0]), vectors[1]), vectors[0], atol=1e-7)

    def test_a_hand_that_rests_after_a_full_turn_has_one_axis_whatever_the_noise(self):
        axis = np.array([0.6, 0.0, 0.8])
        vectors = np.concatenate([np.full(50, 2 * np.pi), np.linspace(2 * np.pi, 0, 150)])[:, None] * axis
        turned = exponential(GOAL, vectors)
        np.testing.assert_allclose(logarithm(GOAL, turned), vectors, atol=1e-7)
        np.testing.assert_allclose(nearest(GOAL, turned[0], vectors[60]), vectors[0], atol=1e-7)
        noisy = quaternions(rotation(turned) * Rotation.from_rotvec(2e-3 * RNG.normal(size=(200, 3))))
        found = logarithm(GOAL, noisy)
        assert np.abs(np.diff(found, axis=0)).max() < 1 and apart(exponential(GOAL, found), noisy).max() < 0.03


class TestSystem:
    def test_its_jacobian_is_that_of_finite_differences(self, imitation):
        psi, state, h = imitation.poses.system.transform, states(imitation, 8), 1e-6
        J = psi.jacobian(state)[1]
        for k in range(10):  # the index of the pattern is no coordinate that changes
            step = h * np.eye(11)[k]
            slope = (psi.forward(state + step) - psi.forward(state - step)) / (2 * h)
            np.testing.assert_allclose(J[..., k], slope, atol=3e-5)

    def test_it_is_stable_and_what_turns_the_hand_aside_dies_away(self, imitation):
        system, state = imitation.poses.system, states(imitation)
        path = system.rollout(state, np.linspace(0, 6, 200))
        values = system.lyapunov(path.reshape(-1, 11)).reshape(20, -1)
        assert (np.diff(values) < 1e-12).all()
        assert (values[:, 0] > 1e-3).all()
        end = system.rollout(state, np.array([40.0]))[:, 0]
        goal = imitation.poses.orientations(end[:, 3:6])
        assert apart(goal, imitation.goal_orientation).max() < 1e-3
        np.testing.assert_allclose(end[:, :3], imitation.goal[None].repeat(20, 0), atol=1e-3)

    def test_in_a_world_that_is_turned_and_scaled_it_is_turned(self, imitation):
        world = Rotation.from_rotvec([0.3, 0.8, -0.5])
        placed = imitation.placed(np.array([0.1, 0.2, 0.3]), world.as_matrix(), 0.7)
        places = np.array([0.1, 0.2, 0.3]) + 0.7 * world.apply(imitation.starts)
        one, other = imitation.states(imitation.starts)[:, 3:], placed.states(places)[:, 3:]
        turned = quaternions(world * rotation(imitation.poses.predicted(one)))
        assert apart(placed.poses.predicted(other), turned).max() < 1e-7

    def test_velocities_are_the_derivatives_of_motions(self, imitation):
        system, state, h = imitation.poses.system, states(imitation, 6), 1e-5
        slope = (system.rollout(state, np.array([h]))[:, 0] - state) / h
        np.testing.assert_allclose(system.velocity(state), slope, atol=2e-3)

    def test_its_places_are_those_of_the_imitation(self, imitation):
        times, state = np.linspace(0, 5, 30), states(imitation)
        places = imitation.system.rollout(np.delete(state, np.s_[3:6], axis=1), times)
        np.testing.assert_allclose(imitation.poses.system.rollout(state, times)[..., :3], places[..., :3], atol=1e-14)

    def test_the_slope_of_a_process_with_a_narrow_kernel_is_that_of_differences(self):
        starts, at, h = RNG.normal(size=(6, 3)), 0.1 * RNG.normal(size=3), 1e-6
        process = StartProcess.of(starts, RNG.normal(size=(6, 4, 2)), 0.8, 2.0, 0.7, 0.3, 0.1)
        slopes = [(process.at(at + h * e) - process.at(at - h * e)) / (2 * h) for e in np.eye(3)]
        np.testing.assert_allclose(process.slope_at(at), np.stack(slopes, -1), atol=1e-7)


class TestMotion:
    def test_from_its_own_start_a_take_is_turned_as_it_was(self):
        motion = dt.fit(TAKES)
        assert motion.state == "augmented" and "orientation" in motion.reason and "with orientation" in repr(motion)
        for take, path in zip(TAKES, motion.rollouts(), strict=True):
            near = np.linalg.norm(take.positions - path.positions[:, None], axis=-1).argmin(axis=1)
            off = np.rad2deg(apart(hand(path), hand(take)[near]))
            assert np.median(off) < 1.5 and off.max() < 5
            assert apart(hand(path)[-1:], hand(motion.rollouts()[0])[-1]).max() < 1e-7

    def test_a_turn_of_the_world_turns_the_motion(self):
        world = Rotation.from_rotvec([0.4, -0.7, 1.1])
        there = [
            Demonstration(t.times, world.apply(t.positions), t.name, quaternions(world * rotation(hand(t))))
            for t in TAKES
        ]
        start = np.array([[0.42, 0.13, 0.22]])
        (one,), (other,) = dt.fit(TAKES).rollouts(start), dt.fit(there).rollouts(world.apply(start))
        np.testing.assert_allclose(world.apply(one.positions), other.positions, atol=1e-6)
        assert apart(quaternions(world * rotation(hand(one))), hand(other)).max() < 1e-5

    def test_a_turned_hand_comes_back_and_its_places_stay(self):
        motion = dt.fit(TAKES)
        usual, turned = motion.rollouts()[0], motion.rollouts(orientations=hand(TAKES[2])[40])[0]
        np.testing.assert_array_equal(usual.positions, turned.positions)
        off = apart(hand(usual), hand(turned))
        assert off[0] > 0.2 and off[-1] < 1e-6 and (np.diff(off) < 1e-9).all()

    @pytest.mark.long
    def test_a_hand_in_the_loop_is_turned_to_the_goal(self):
        motion = dt.fit(TAKES)
        place, now, h = TAKES[0].positions[0], rotation(hand(TAKES[0])[60]), 0.02
        controller = dt.HandController(motion, place)
        for k in range(500):
            turn = controller.turn(quaternions(now), h)
            place = place + h * controller.step(place, h)
            now = Rotation.from_rotvec(h * turn) * now
            if k == 60:
                now = Rotation.from_rotvec([0.5, 0.0, 0.0]) * now  # somebody turns it
        assert apart(quaternions(now)[None], hand(motion.rollouts()[0])[-1]).max() < 1e-3

    def test_saving_keeps_it(self, tmp_path):
        motion = dt.fit(TAKES)
        motion.save(tmp_path / "turns.npz")
        for one, other in zip(motion.rollouts(), dt.Motion.load(tmp_path / "turns.npz").rollouts(), strict=True):
            np.testing.assert_array_equal(hand(one), hand(other))

    @pytest.mark.long
    def test_what_does_not_learn_it_says_so(self):
        plain = dt.fit(TAKES, state="plain")
        assert plain.rollouts()[0].orientations is None and "not learned in the plain state" in plain.report()
        mixed = dt.fit([*TAKES[1:], Demonstration(TAKES[0].times, TAKES[0].positions, "bare")], state="augmented")
        assert mixed.rollouts()[0].orientations is None and "'bare' has none" in mixed.report()
        with pytest.raises(dt.FormatError, match="no orientations were learned"):
            plain.rollouts(orientations=GOAL)
        with pytest.raises(dt.FormatError, match="quaternions wxyz"):
            dt.fit(TAKES).rollouts(orientations=np.ones(3))
        with pytest.raises(dt.DataError, match="orientations of '0'"):
            dt.fit([Demonstration(TAKES[0].times, TAKES[0].positions, "0", np.zeros((150, 4)))])


class TestOthersStarts:
    """What turns are worth from a start that was not demonstrated."""

    def off(self, explained):
        """Errors of takes left out, whose turns a start explains or not, by those of the mean of the others."""
        rng, u = np.random.default_rng(3), np.linspace(0, 1, 120)
        slope, takes = 3 * rng.normal(size=(3, 3)), []
        for k in range(8):
            aside, scattered = 0.04 * rng.normal(size=3), 0.12 * rng.normal(size=3)
            path = np.outer(1 - u, np.array([0.3, 0.0, 0.2]) + aside) + np.outer(np.sin(np.pi * u), [0.0, 0.1, 0.1])
            turn = np.outer(1 - u, np.array([0.5, -0.8, 0.3]) + (slope @ aside if explained else scattered))
            takes.append(Demonstration(4 * u, path, f"{k}", exponential(GOAL, turn)))
        followed = [each for k in range(len(takes)) for each in follow(takes, fit_augmented, range(k, k + 1))]
        return np.mean([each.degrees["learned"] for each in followed]) / np.mean(
            [each.degrees["mean"] for each in followed]
        )

    @pytest.mark.long
    def test_they_are_learned_from_starts_where_these_explain_them_and_else_are_the_mean(self):
        assert self.off(explained=True) < 0.6
        assert self.off(explained=False) < 1.08


class TestPreparation:
    def test_a_hand_that_only_turns_does_not_pause(self):
        times, still = np.linspace(0, 6, 300), np.linspace(0, 1, 100)
        there, corner = np.outer(still, [0.2, 0, 0]), np.tile([0.2, 0, 0], (100, 1))
        path = np.concatenate([there, corner, corner + np.outer(still, [0, 0.2, 0])])
        angle = np.concatenate([np.zeros(100), np.linspace(0, 1.5, 100), np.full(100, 1.5)])
        turned = exponential(GOAL, angle[:, None] * [0.0, 0.0, 1.0])
        found = []
        for orientations in (None, np.tile(GOAL, (300, 1)), turned):
            take = Repaired(Demonstration(times, path, "t", orientations), times, path)
            repair([take], PreparationSettings())
            found.append([each.kind for each in take.findings])
        assert found == [["pause"], ["pause"], []]

    def test_orientations_go_with_what_is_cut_off_at_the_start(self):
        u = np.linspace(0, 2 * np.pi, 200)
        path = 0.2 * np.column_stack([np.sin(u), 1 - np.cos(u), 0 * u])  # begins at its goal
        turned = exponential(GOAL, (2 * np.pi - u)[:, None] * [0.2, 0, 0])
        take = Demonstration(np.linspace(0, 5, 200), path, "round", turned)
        motions = prepare([take])
        assert len(motions.turns[0]) == len(motions.positions[0]) < 200
        first = 200 - len(motions.turns[0])
        np.testing.assert_allclose(motions.turns[0], (2 * np.pi - u)[first:, None] * [0.2, 0, 0], atol=1e-6)

    def test_jitter_of_the_hand_is_smoothed_and_said(self):
        rng, clean = np.random.default_rng(4), dt.fit(TAKES).rollouts()
        noise = [Rotation.from_rotvec(np.deg2rad(1.5) * rng.normal(size=(150, 3))) for _ in TAKES]
        trembling = [
            Demonstration(take.times, take.positions, take.name, quaternions(rotation(hand(take)) * each))
            for take, each in zip(TAKES, noise, strict=True)
        ]
        with pytest.warns(dt.DemonstrationWarning, match="turns with a jitter of 2.*smoothed"):
            motion = dt.fit(trembling)
        off = [
            apart(hand(one), hand(other)[: len(hand(one))]) for one, other in zip(clean, motion.rollouts(), strict=True)
        ]
        assert np.rad2deg(np.median(off)) < 1
        assert prepare(TAKES).warnings == ()

    def test_a_hand_that_ends_turned_away_from_the_others_is_said_and_does_not_move_the_goal(self):
        last = TAKES[-1]
        other = quaternions(rotation(hand(last)) * Rotation.from_rotvec([0.0, 0.0, 1.5]))
        takes = [*TAKES[:-1], Demonstration(last.times, last.positions, "other", other)]
        with pytest.warns(dt.DemonstrationWarning, match="'other' ends with the hand turned by 8.*turned there"):
            motion = dt.fit(takes)
        ends = np.stack([hand(take)[-1] for take in TAKES[:-1]])
        assert apart(hand(motion.rollouts()[0])[-1:], mean_orientation(ends)) < 1e-6
        turns = [np.linspace(0, 1.5 * np.pi, 4)[k] * np.array([0.0, 0.0, 1.0]) for k in range(4)]  # no mean at all
        around = [
            Demonstration(t.times, t.positions, t.name, quaternions(rotation(hand(t)) * Rotation.from_rotvec(turn)))
            for t, turn in zip(TAKES, turns, strict=False)
        ]
        assert [len(one.findings) > 0 for one in prepare(around).inspections] == [False, True, True, True]

    def test_more_than_half_a_turn_is_said(self):
        with pytest.warns(dt.DemonstrationWarning, match="turns by"):
            far = dt.fit(turning_takes(turn=4.0))
        assert "away from the orientation at the goal" in far.report()
        off = apart(hand(far.rollouts()[0])[:1], hand(turning_takes(turn=4.0)[0])[:1])
        assert np.rad2deg(off).max() < 3
