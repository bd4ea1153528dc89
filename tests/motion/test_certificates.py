"""Certificates must recognise what they certify against: folds, bad inverses, and motions other than the stack's."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scenes import changed, frame_at, kinds

from dt_viz.arm.cspace import LEVERS
from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.engine.certify import certify
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Frame, Stage
from dt_viz.flows.diffeomorphisms import Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.flows.integrators import euler, implicit_euler
from dt_viz.flows.rollouts import Bundle, Rays, evenly_sampled
from dt_viz.flows.systems import Attractor
from dt_viz.motion.certificates import MAX_OFF_POSTURE, Certificates, Shown, certified
from dt_viz.motion.solve import Solved
from dt_viz.motion.stack import FINE, Solution
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import View
from dt_viz.warning import Kind, MotionWarning

BASE = Attractor(np.array([0.5, 0.2, 0.0]), 0.2, 0.05)
RAYS = Rays(np.array([[-0.8, -0.3, 0.1], [-0.6, 0.7, -0.2]]), BASE)
BEFORE = MotionWarning(Kind.IMITATION, "said before")
CLEAR = Certificates(clearance=0.05, found=(BEFORE,))


def field(strength):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(3)), 0.5 / 0.4**2)
    return GridRBF(grid, strength * np.random.default_rng(0).normal(size=(grid.num_points, 3)))


def bundle_of(transform):
    return evenly_sampled(lambda i, u: transform.inverse(RAYS.at(i, u))[:, None], 2, 300)


def certificates_of(transform, bundle=None):
    """Certificates of a bundle, said to be a motion of the transform between the ends of its rays."""
    bundle = bundle or bundle_of(transform)
    stack = Solution(transform, RAYS, bundle, ())
    shown = Shown(bundle.index, bundle.fraction, RAYS.times(bundle.index, bundle.fraction), bundle.positions)
    return certified(CLEAR, stack, transform.inverse(np.concatenate([RAYS.z0, BASE.goal[None]])), shown)


def both(*fractions):
    """Rollouts of the identity at these fractions of their rays, each the same for both rays."""
    fraction = np.concatenate([np.concatenate(fractions)] * 2)
    index = np.repeat([0, 1], len(fraction) // 2)
    return Bundle(index, fraction, RAYS.at(index, fraction)[:, None])


@pytest.mark.parametrize(
    "transform", [Identity(3), Flow(field(0.3), 0.5, 20), Flow(field(0.3), 0.5, 6, implicit_euler, euler)]
)
def test_a_sound_stack_gets_its_certificates_and_no_warning(transform):
    known = certificates_of(transform)
    assert known.min_det_jacobian is not None and known.min_det_jacobian > 0
    assert known.round_trip_error is not None and known.round_trip_error < 1e-6
    assert known.lyapunov_falls is True
    assert (known.clearance, known.warnings) == (0.05, (BEFORE,))


def test_the_smallest_determinant_is_that_of_the_forward_map():
    transform = Flow(field(0.5), 0.8, 6, implicit_euler, euler)
    bundle = bundle_of(transform)
    expected = np.linalg.det(transform.jacobian(bundle.positions)[1]).min()
    assert certificates_of(transform, bundle).min_det_jacobian == pytest.approx(expected, rel=1e-8)


def test_a_folding_euler_map_is_recognised():
    folding = Flow(field(6.0), 1.0, 1, euler)
    bundle = bundle_of(Identity(3))  # straight through where it folds
    known = certificates_of(folding, bundle)
    assert known.min_det_jacobian is not None and known.min_det_jacobian < 0
    assert Kind.NO_DIFFEOMORPHISM in kinds(known.warnings)


def test_a_bad_round_trip_is_recognised_and_measured():
    coarse = Flow(field(0.4), 1.0, 10, euler)  # Euler back is not the inverse of Euler there
    bundle = bundle_of(coarse)
    known = certificates_of(coarse, bundle)
    error = np.linalg.norm(coarse.inverse(coarse.forward(bundle.positions)) - bundle.positions, axis=1).max()
    assert known.round_trip_error is not None
    assert known.round_trip_error == pytest.approx(error, rel=0.05)
    assert known.warnings[0] == BEFORE
    (warning,) = (warning for warning in known.warnings if warning.kind is Kind.ROUND_TRIP)
    assert f"misses by {1e3 * known.round_trip_error:.3g} mm" in warning.text


def test_a_motion_that_turns_back_is_recognised():
    there = np.linspace(0, 1, 100)
    bundle = both(there[:60], there[40:])
    known = certificates_of(Identity(3), bundle)
    assert known.lyapunov_falls is False
    assert [warning.kind for warning in known.warnings] == [BEFORE.kind, Kind.NOT_FALLING]


@pytest.mark.parametrize(("rise", "falls"), [(1e-6, True), (1e-4, False)])
def test_samples_nearer_than_rounding_need_not_fall(rise, falls):
    bundle = both(np.linspace(0, 1, 50))
    index, fraction = np.insert(bundle.index, 20, 0), np.insert(bundle.fraction, 20, bundle.fraction[20])
    levels = np.insert(bundle.levels, 20, bundle.levels[20], axis=0)
    fraction[20] -= 1e-9
    levels[21, 0] += rise * (RAYS.z0[0] - BASE.goal) / np.linalg.norm(RAYS.z0[0] - BASE.goal)
    assert certificates_of(Identity(3), Bundle(index, fraction, levels)).lyapunov_falls is falls


def test_a_motion_that_stands_still_does_not_fall_strictly():
    assert certificates_of(Identity(3), both([0.0, 0.3, 0.3, 1.0])).lyapunov_falls is False


@pytest.mark.parametrize(("first", "last"), [(0.0, 0.9), (0.1, 1.0)])
def test_a_motion_that_is_not_shown_as_a_whole_is_recognised(first, last):
    warnings = certificates_of(Identity(3), both(np.linspace(first, last, 50))).warnings[1:]
    assert warnings == (MotionWarning(Kind.OTHER_ENDS, "a motion is not shown from its start to its goal"),)


def test_the_rise_from_the_end_of_one_rollout_to_the_start_of_the_next_is_none():
    assert certificates_of(Identity(3)).lyapunov_falls is True
    assert len(bundle_of(Identity(3)).paths) == 2


class Broken(Diffeomorphism):
    """Gives no numbers."""

    @property
    def dim(self) -> int:
        return 3

    def scaled(self, fraction: float) -> Diffeomorphism:
        return self

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return (s if inverse else np.full_like(s, np.nan)), None if U is None else np.full_like(U, np.nan)


def test_no_number_is_no_certificate():
    with np.errstate(invalid="ignore"):
        known = certificates_of(Broken(), both(np.linspace(0, 1, 5)))
    assert known.lyapunov_falls is False
    failed = {Kind.NO_DIFFEOMORPHISM, Kind.ROUND_TRIP, Kind.NOT_FALLING, Kind.OFF_MOTION, Kind.OTHER_ENDS}
    assert kinds(known.warnings) == {BEFORE.kind, *failed}


def test_what_follows_from_a_cause_that_is_said_is_not_told_beside_it_but_known():
    cause = MotionWarning(Kind.FOLDS, "a step folds", "Bias 1")
    follows = MotionWarning(Kind.NOT_FALLING, "it rises")
    known = CLEAR.warning(follows, cause, cause)
    assert known.found == (BEFORE, follows, cause, cause)
    assert known.warnings == (BEFORE, cause)
    assert CLEAR.warning(follows).warnings == (BEFORE, follows)


def test_a_cause_in_one_transform_leaves_what_fails_in_another_told():
    cause = MotionWarning(Kind.STAYS_INSIDE, "it does not leave", "Avoidance")
    its_own, other = (MotionWarning(Kind.ENTERS, "it enters", name) for name in ("Avoidance", "Avoidance 2"))
    assert CLEAR.warning(cause, its_own, other).warnings == (BEFORE, cause, other)


# --- motions other than those that were computed ---


@dataclass
class Certified:
    """A motion before it is certified."""

    engine: Engine
    frame: Frame
    solved: Solved

    def failed(self, frame: Frame | None = None, solved: Solved | None = None) -> set[Kind]:
        """The kinds of warnings that the certificates add to those of a frame."""
        frame = frame or self.frame
        warnings = certify(frame, solved or self.solved, self.engine.follower).warnings
        return kinds(warning for warning in warnings if warning not in frame.certificates.warnings)

    def with_hand(self, change) -> tuple[Frame, Solved]:
        """The same with other rollouts, everywhere: `change` takes each (T, 3) and what it is without avoidance."""
        stack, frame = self.solved.stack, self.frame
        below = stack.bundle.split(stack.bundle.levels[:, 0])
        paths = tuple(change(path, without) for path, without in zip(frame.rollouts, below, strict=True))
        levels = stack.bundle.levels.copy()
        levels[:, -1] = np.concatenate(paths)
        stack = replace(stack, bundle=replace(stack.bundle, levels=levels))
        return replace(frame, rollouts=paths, reached=paths[-1][-1], arm=None), replace(self.solved, stack=stack)

    def with_postures(self, change) -> tuple[Frame, Solved]:
        """The same with other postures, everywhere: `change` takes each (T, 6) and what it is without avoidance."""
        arm, frame, robot = self.solved.arm, self.frame, self.engine.follower.robot
        assert arm is not None and frame.arm is not None and frame.chosen is not None
        rows = [arm.index == rollout for rollout in range(len(frame.rollouts))]
        p = arm.p.copy()
        for row in rows:
            p[row] = change(arm.p[row], arm.q[row])
        paths = tuple(robot.end_effector(p[row]) for row in rows)
        q = p[rows[frame.chosen]]
        shown = replace(frame.arm, q=q, times=within_velocity_limits(frame.times[0], q, robot.velocity_limits))
        frame = replace(frame, rollouts=paths, reached=paths[-1][-1], arm=shown)
        return frame, replace(self.solved, arm=replace(arm, p=p))


def computed(engine, scenario):
    """A motion of the scenario, refined."""
    scenario = replace(scenario, view=View(field=False))
    return Certified(engine, frame_at(engine, scenario, Stage.FINE), engine.solved(scenario, FINE))


@pytest.fixture(scope="module", name="hand")
def _hand(engine, initial):
    return computed(engine, initial("draw_s"))


@pytest.fixture(scope="module", name="arm")
def _arm(engine, initial):
    return computed(engine, changed(initial("push_box"), space="cspace"))


def noise(path, size):
    return path + np.random.default_rng(0).normal(0, size, path.shape)


def displaced(path, rows, offset):
    moved = path.copy()
    moved[rows] += offset
    return moved


def sideways(postures, robot):
    """Turns of the joints (6,) that move the hand of the middle posture by 5 mm."""
    turn = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    middle = postures[len(postures) // 2]
    moved = np.linalg.norm(robot.end_effector(middle + 1e-3 * turn) - robot.end_effector(middle))
    return turn * 1e-3 * 5e-3 / moved


def bent_to(path, offset):
    """The same path, ending elsewhere."""
    return path + np.linspace(0, 1, len(path))[:, None] * offset


HAND = {
    "no avoidance": lambda y, x: x,
    "reversed": lambda y, x: y[::-1],
    "noise": lambda y, x: noise(y, 1e-3),
    "one sample off by 5 mm": lambda y, x: displaced(y, len(y) // 2, [0.0, 0.005, 0.0]),
    "goal shifted": lambda y, x: bent_to(y, [0.005, 0.0, 0.0]),
}
ARM = {
    "no avoidance": lambda p, q, robot: q,
    "reversed": lambda p, q, robot: p[::-1],
    "noise": lambda p, q, robot: noise(p, 0.2),
    "one sample off by 5 mm": lambda p, q, robot: displaced(p, len(p) // 2, sideways(p, robot)),
    "goal shifted": lambda p, q, robot: bent_to(p, sideways(p, robot)),
}


def test_the_computed_motions_pass(hand, arm):
    assert hand.failed() == arm.failed() == set()


@pytest.mark.parametrize("corruption", HAND)
def test_rollouts_of_another_motion_are_recognised(hand, corruption):
    assert Kind.OFF_MOTION in hand.failed(*hand.with_hand(HAND[corruption]))


@pytest.mark.parametrize("corruption", ARM)
def test_postures_of_another_motion_are_recognised(arm, robot, corruption):
    frame, solved = arm.with_postures(lambda p, q: ARM[corruption](p, q, robot))
    assert Kind.OFF_MOTION in arm.failed(frame, solved)


def test_each_displaced_sample_is_recognised_where_the_stack_squeezes_space_most(hand):
    transform, y = hand.solved.stack.transform, hand.solved.stack.bundle.positions
    _, s, Vt = np.linalg.svd(transform.jacobian(y)[1])
    row = int(s[:, -1].argmin())  # and the direction in which least is left of a displacement
    before = np.flatnonzero(np.diff(hand.solved.stack.bundle.index, prepend=-1))
    rollout = int(np.searchsorted(before, row, side="right")) - 1
    for sign in (1, -1):
        paths = list(hand.frame.rollouts)
        paths[rollout] = displaced(paths[rollout], row - before[rollout], sign * 5e-3 * Vt[row, -1])
        frame = replace(hand.frame, rollouts=tuple(paths), arm=None)
        assert Kind.OFF_MOTION in hand.failed(frame)


def test_postures_displaced_where_the_hand_stays_are_recognised(arm, robot):
    """What the hand does not show, the joints' motion does: 5 mm of an elbow, by their levers."""

    def elbow(p, q):
        middle = len(p) // 2
        null = np.linalg.svd(robot.chain(p[[middle]].T).position_jacobian()[..., 0].T)[2][-1]
        return displaced(p, middle, 5e-3 * null / np.linalg.norm(null * LEVERS))

    assert Kind.OFF_MOTION in arm.failed(*arm.with_postures(elbow))


def test_the_tolerance_of_postures_is_far_from_what_the_computation_leaves_and_from_what_is_seen(arm):
    transform, p = arm.solved.arm.transform, arm.solved.arm.p
    left = np.linalg.norm((transform.forward(p) - arm.solved.arm.q) * LEVERS, axis=1).max()
    s = np.linalg.svd(LEVERS[:, None] * transform.jacobian(p[::20])[1] / LEVERS, compute_uv=False)
    assert 10 * left < MAX_OFF_POSTURE < 0.1 * 5e-3 * s.min()


@pytest.mark.parametrize(
    ("whose", "factor"),
    [("hand", 0.98), ("hand", 1.02), ("arm", 0.98), pytest.param("arm", 1.02, marks=pytest.mark.slow)],
)
def test_scaled_times_are_recognised(request, whose, factor):
    motion = request.getfixturevalue(whose)
    frame = motion.frame
    late = replace(frame, times=tuple(factor * times for times in frame.times))
    assert Kind.OTHER_TIMES in motion.failed(late)
    slow = replace(frame, arm=replace(frame.arm, times=factor * frame.arm.times))
    assert Kind.OTHER_DELAY in motion.failed(slow)


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_a_goal_other_than_the_one_of_the_base_system_is_recognised(request, whose):
    motion = request.getfixturevalue(whose)
    rays = motion.solved.stack.rays
    base = replace(rays.base, goal=rays.base.goal + 0.005 * np.eye(3)[0])
    shifted = replace(motion.solved, stack=replace(motion.solved.stack, rays=replace(rays, base=base)))
    warnings = certify(motion.frame, shifted, motion.engine.follower).warnings
    assert any(w.kind is Kind.OTHER_ENDS and "begin or end up to 5" in w.text for w in warnings)


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_a_motion_around_another_obstacle_is_recognised(request, engine, whose):
    motion = request.getfixturevalue(whose)
    (obstacle,) = motion.frame.scenario.obstacles
    x, y, z = obstacle.position
    scenario = changed(motion.frame.scenario, obstacles=Sphere((x, y, z + 0.03), obstacle.diameter))
    other = computed(engine, scenario)
    assert other.failed() == set()
    posed = replace(other.frame, scenario=motion.frame.scenario)
    solved = replace(other.solved, scenario=motion.frame.scenario)
    assert Kind.OTHER_CLEARANCE in other.failed(posed, solved)


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_an_arm_beside_its_rollout_is_recognised(request, whose, robot):
    motion = request.getfixturevalue(whose)
    q = displaced(motion.frame.arm.q, 50, sideways(motion.frame.arm.q, robot))
    times = motion.frame.arm.times
    frame = replace(motion.frame, arm=replace(motion.frame.arm, q=q, times=times))
    assert Kind.HAND_BESIDE in motion.failed(frame)
