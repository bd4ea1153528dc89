"""Certificates must recognise what they certify against: folds, bad inverses, and motions other than the stack's.

What is just within a limit is certified, what is just beyond it is said.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scenes import changed, frame_at, kinds

from dt_viz.flows.diffeomorphisms import Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER
from dt_viz.flows.rollouts import ARRIVED, Bundle, Rays, evenly_sampled
from dt_viz.flows.systems import Attractor
from dt_viz.motion.certificates import MAX_OFF, MAX_OFF_POSTURE, Certificates, DrawnSamples, certified
from dt_viz.motion.following import arm_samples
from dt_viz.motion.stack import Solution
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.scenario.scenario import View
from dt_viz.session.certify import certify
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.warning import Kind, MotionWarning

BASE = Attractor(np.array([0.5, 0.2, 0.0]), 0.2, 0.05)
RAYS = Rays(np.array([[-0.8, -0.3, 0.1], [-0.6, 0.7, -0.2]]), BASE)
IDENTITY = Identity(3)
AWAY = np.eye(3)[2]
BEFORE = MotionWarning(Kind.IMITATION, "said before")
KNOWN = Certificates(clearance=0.05, found=(BEFORE,))


def field(strength):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(3)), 0.5 / 0.4**2)
    return GridRBF(grid, strength * np.random.default_rng(0).normal(size=(grid.num_points, 3)))


def bundle_of(transform):
    return evenly_sampled(lambda i, u: transform.inverse(RAYS.at(i, u))[:, None], 2, 300)


def straight(*fractions):
    """Straight motions from sample to sample at these fractions of their rays, the same for both rays."""
    fraction = np.concatenate([np.concatenate(fractions)] * 2)
    index = np.repeat([0, 1], len(fraction) // 2)
    return Bundle(index, fraction, RAYS.at(index, fraction)[:, None])


def as_shown(bundle):
    times = RAYS.times(bundle.index, bundle.fraction)
    return DrawnSamples(bundle.index, bundle.fraction, times, bundle.positions, len(RAYS.z0))


SHOWN = as_shown(bundle_of(IDENTITY))


def certificates_of(shown: DrawnSamples | Bundle = SHOWN, transform: Diffeomorphism = IDENTITY, known=KNOWN, **options):
    """Certificates of what is shown, said to be motions of the transform."""
    if isinstance(shown, Bundle):
        shown = as_shown(shown)
    return certified(known, Solution(transform, RAYS, bundle_of(transform), ()), shown, **options)


# --- the map ---


@pytest.mark.parametrize(
    "transform", [IDENTITY, Flow(field(0.3), 0.5, 20), Flow(field(0.3), 0.5, 6, IMPLICIT_EULER, EULER)]
)
def test_a_sound_stack_gets_its_certificates_and_no_warning(transform):
    bundle = bundle_of(transform)
    known = certificates_of(bundle, transform=transform)
    expected = np.linalg.det(transform.jacobian(bundle.positions)[1]).min()
    assert known.min_det_jacobian == pytest.approx(expected, rel=1e-4) and expected > 0
    assert known.round_trip_error is not None and known.round_trip_error < 1e-6
    assert known.lyapunov_falls is True
    assert (known.clearance, known.warnings) == (0.05, (BEFORE,))


def test_a_folding_euler_map_is_recognised():
    known = certificates_of(transform=Flow(field(6.0), 1.0, 1, EULER))  # straight through where it folds
    assert known.min_det_jacobian is not None and known.min_det_jacobian < 0
    assert Kind.NO_DIFFEOMORPHISM in kinds(known.warnings)


around_the_limit = pytest.mark.parametrize(("part", "said"), [(0.9, False), (1.1, True)])


@dataclass(frozen=True)
class Missing(Diffeomorphism):
    """The identity, there; back it misses by a distance in metres."""

    missed: float

    @property
    def dim(self) -> int:
        return 3

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return s + self.missed * AWAY * inverse, U


@around_the_limit
def test_a_round_trip_that_misses_is_said_with_its_length(part, said):
    known = certificates_of(transform=Missing(part * 1e-6))
    assert known.round_trip_error == pytest.approx(part * 1e-6)
    assert (Kind.ROUND_TRIP in kinds(known.warnings)) == said
    assert not said or any("misses by 0.0011 mm" in warning.text for warning in known.warnings)


def test_of_two_maps_the_worse_is_certified():
    known = certificates_of(known=replace(KNOWN, min_det_jacobian=0.2, round_trip_error=3e-7))
    assert (known.min_det_jacobian, known.round_trip_error) == (0.2, 3e-7)
    known = certificates_of(known=replace(KNOWN, min_det_jacobian=1.7, round_trip_error=1e-9), transform=Missing(2e-7))
    assert (known.min_det_jacobian, known.round_trip_error) == (1.0, pytest.approx(2e-7))


class Broken(Diffeomorphism):
    """Gives no numbers."""

    @property
    def dim(self) -> int:
        return 3

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return (s if inverse else np.full_like(s, np.nan)), None if U is None else np.full_like(U, np.nan)


def test_no_number_is_no_certificate():
    with np.errstate(invalid="ignore"):
        known = certificates_of(straight(np.linspace(0, 1, 5)), transform=Broken())
    assert known.lyapunov_falls is False
    failed = {Kind.NO_DIFFEOMORPHISM, Kind.ROUND_TRIP, Kind.NOT_FALLING, Kind.OFF_MOTION}
    assert kinds(known.warnings) == {BEFORE.kind, *failed}


# --- straight motions of the base system, and others ---


@around_the_limit
@pytest.mark.parametrize("row", [0, 17, -1])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-3])
def test_a_sample_beside_the_motion_of_the_base_system(row, tolerance, part, said):
    positions = SHOWN.positions.copy()
    positions[row] += part * tolerance * AWAY
    known = certificates_of(replace(SHOWN, positions=positions), tolerance=tolerance)
    assert (Kind.OFF_MOTION in kinds(known.warnings)) == said


@around_the_limit
@pytest.mark.parametrize("sign", [1, -1])
def test_a_sample_at_another_time(sign, part, said):
    row, times = 40, SHOWN.times.copy()
    times[row] += sign * part * 1e-6 / np.linalg.norm(BASE.velocity(SHOWN.positions[row]))
    assert (Kind.OFF_MOTION in kinds(certificates_of(replace(SHOWN, times=times)).warnings)) == said


@around_the_limit
def test_a_motion_that_is_said_to_be_at_its_goal_too_early(part, said):
    """It counts as there a tenth of a millimetre before."""
    last, times = np.flatnonzero(SHOWN.index == 0)[-1], SHOWN.times.copy()
    times[last] = BASE.arrival_time(RAYS.z0[:1], ARRIVED + part * 1e-6)[0]
    assert (Kind.OFF_MOTION in kinds(certificates_of(replace(SHOWN, times=times)).warnings)) == said


def test_motions_in_another_order_are_recognised():
    assert Kind.OFF_MOTION in kinds(certificates_of(replace(SHOWN, index=SHOWN.index[::-1])).warnings)
    only_one = replace(SHOWN, index=np.zeros_like(SHOWN.index))
    assert Kind.OFF_MOTION in kinds(certificates_of(only_one).warnings)


@pytest.mark.parametrize(
    "fractions",
    [(np.linspace(0, 0.6, 60), np.linspace(0.4, 1, 60)), ([0.0, 0.3, 0.3, 1.0],)],
    ids=["turns back", "stands still"],
)
def test_a_motion_that_does_not_go_on_is_recognised(fractions):
    known = certificates_of(straight(*fractions))
    assert known.lyapunov_falls is False
    assert [warning.kind for warning in known.warnings] == [BEFORE.kind, Kind.NOT_FALLING]


@pytest.mark.parametrize(("rise", "falls"), [(1e-6, True), (1e-4, False)])
def test_samples_nearer_than_rounding_need_not_fall(rise, falls):
    bundle = straight(np.linspace(0, 1, 50))
    index, fraction = np.insert(bundle.index, 20, 0), np.insert(bundle.fraction, 20, bundle.fraction[20])
    levels = np.insert(bundle.levels, 20, bundle.levels[20], axis=0)
    fraction[20] -= 1e-9
    levels[21, 0] += rise * (RAYS.z0[0] - BASE.goal) / np.linalg.norm(RAYS.z0[0] - BASE.goal)
    assert certificates_of(Bundle(index, fraction, levels)).lyapunov_falls is falls


# --- motions other than those that were computed ---


@dataclass
class Certified:
    """A motion before it is certified."""

    engine: Engine
    frame: Frame

    def failed(self, frame: Frame | None = None) -> set[Kind]:
        """The kinds of warnings that the certificates add to those of a frame."""
        frame = frame or self.frame
        warnings = certify(frame, self.engine.follower).warnings
        return kinds(warning for warning in warnings if warning not in frame.certificates.warnings)

    def with_hand(self, change) -> Frame:
        """The same with other rollouts, everywhere: `change` takes each (T, 3) and what it is without avoidance."""
        stack, drawn = self.frame.motion.stack, self.frame.drawn
        below = stack.bundle.split(stack.bundle.levels[:, 0])
        paths = [change(path, without) for path, without in zip(drawn.paths, below, strict=True)]
        return replace(self.frame, drawn=replace(drawn, positions=np.concatenate(paths)), arm=None)

    def with_postures(self, change) -> Frame:
        """The same with other postures, everywhere: `change` takes each (T, 6) and what it is without avoidance."""
        motion, frame, robot = self.frame.motion, self.frame, self.engine.follower.robot
        assert motion.arm is not None and frame.arm is not None and frame.chosen is not None
        p = motion.arm.p.copy()
        for rollout in range(len(frame.rollouts)):
            rows = motion.arm.index == rollout
            p[rows] = change(p[rows], motion.arm.q[rows])
        q = p[motion.arm.index == frame.chosen]
        shown = replace(frame.arm, q=q, times=within_velocity_limits(frame.times[0], q, robot.velocity_limits))
        drawn = replace(frame.drawn, positions=robot.end_effector(p))
        return replace(frame, motion=replace(motion, arm=replace(motion.arm, p=p)), drawn=drawn, arm=shown)


def computed(engine, scenario):
    """A motion of the scenario, refined."""
    return Certified(engine, frame_at(engine, replace(scenario, view=View(field=False)), Stage.FINE))


@pytest.fixture(scope="module", name="hand")
def _hand(engine, initial):
    return computed(engine, initial("draw_s"))


@pytest.fixture(scope="module", name="arm")
def _arm(engine, initial):
    return computed(engine, changed(initial("push_box"), space="cspace"))


def of_elbow(postures, robot):
    """Turns of the joints (6,) that move an elbow of the middle posture by 5 mm, by their levers, and not the hand."""
    middle = postures[[len(postures) // 2]]
    null = np.linalg.svd(robot.chain(middle.T).position_jacobian()[..., 0].T)[2][-1]
    return 5e-3 * null / np.linalg.norm(null * robot.levers)


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


HAND = {
    "no avoidance": lambda y, x: x,
    "one sample off by 5 mm": lambda y, x: displaced(y, len(y) // 2, [0.0, 0.005, 0.0]),
}
ARM = {
    "no avoidance": lambda p, q, robot: q,
    "one sample off by 5 mm": lambda p, q, robot: displaced(p, len(p) // 2, sideways(p, robot)),
    "5 mm of an elbow where the hand stays": lambda p, q, robot: displaced(p, len(p) // 2, of_elbow(p, robot)),
}


def test_the_computed_motions_pass(hand, arm):
    assert hand.failed() == arm.failed() == set()


@pytest.mark.parametrize("corruption", HAND)
def test_rollouts_of_another_motion_are_recognised(hand, corruption):
    assert Kind.OFF_MOTION in hand.failed(hand.with_hand(HAND[corruption]))


@pytest.mark.parametrize("corruption", ARM)
def test_postures_of_another_motion_are_recognised(arm, robot, corruption):
    assert Kind.OFF_MOTION in arm.failed(arm.with_postures(lambda p, q: ARM[corruption](p, q, robot)))


def test_tolerances_are_far_from_what_is_left_and_from_5_mm_where_space_is_squeezed_most(hand, arm, robot):
    of_hand, of_arm = hand.frame.motion.stack, arm.frame.motion.arm
    hand_base = of_hand.rays.at(of_hand.bundle.index, of_hand.bundle.fraction)
    for transform, y, base, units, tolerance in (
        (of_hand.transform, of_hand.bundle.positions, hand_base, np.ones(3), MAX_OFF),
        (of_arm.transform, of_arm.p, of_arm.q, robot.levers, MAX_OFF_POSTURE),
    ):
        left = np.linalg.norm((transform.forward(y) - base) * units, axis=1).max()
        stretches = np.linalg.svd(units[:, None] * transform.jacobian(y[::20])[1] / units, compute_uv=False)
        assert 10 * left < tolerance < 0.1 * 5e-3 * stretches.min()


@pytest.mark.parametrize(("whose", "factor"), [("hand", 1.02), ("arm", 0.98)])
def test_scaled_times_are_recognised(request, whose, factor):
    motion = request.getfixturevalue(whose)
    drawn = replace(motion.frame.drawn, times=factor * motion.frame.drawn.times)
    assert Kind.OFF_MOTION in motion.failed(replace(motion.frame, drawn=drawn))


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_a_goal_other_than_the_one_of_the_base_system_is_recognised(request, whose):
    motion = request.getfixturevalue(whose)
    solved, rays = motion.frame.motion, motion.frame.motion.stack.rays
    base = replace(rays.base, goal=rays.base.goal + 0.005 * np.eye(3)[0])
    shifted = replace(solved, stack=replace(solved.stack, rays=replace(rays, base=base)))
    assert Kind.OFF_MOTION in motion.failed(replace(motion.frame, motion=shifted))


# --- what is drawn, and said of it before it is certified ---


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_motions_are_drawn_from_their_starts_to_their_goal_at_their_times(request, whose):
    frame = request.getfixturevalue(whose).frame
    rays, drawn = frame.motion.stack.rays, frame.drawn
    first = np.r_[True, np.diff(drawn.index) > 0]
    last = np.append(first[1:], True)
    np.testing.assert_array_equal(drawn.index[first], range(len(frame.task.starts)))
    assert (drawn.fraction[first] == 0).all() and (drawn.fraction[last] == 1).all()
    np.testing.assert_allclose(drawn.positions[first], frame.task.starts, rtol=0, atol=1e-6)
    moved = 1e-5 if whose == "arm" else 1e-6  # by the way away from joint limits
    np.testing.assert_allclose(drawn.positions[last], [frame.goal] * last.sum(), rtol=0, atol=moved)
    off = rays.base.flow(rays.z0[drawn.index], drawn.times[:, None])[:, 0] - rays.at(drawn.index, drawn.fraction)
    assert (np.linalg.norm(off, axis=1) < np.where(last, ARRIVED, 0) + 1e-9).all()


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_the_clearance_that_is_said_is_that_of_what_is_drawn(request, whose):
    motion = request.getfixturevalue(whose)
    frame, follower = motion.frame, motion.engine.follower
    kept = frame.scenario.obstacle.signed_distance(frame.drawn.positions)
    if whose == "arm":
        kept = follower.whole_arm.clearance(frame.motion.arm.p, frame.scenario.obstacle)
    for known in (frame.certificates, certify(frame, follower)):
        assert known.clearance == pytest.approx(kept.min(), abs=1e-6)


@pytest.mark.parametrize("whose", ["hand", "arm"])
def test_the_arm_is_on_its_rollout_as_late_as_its_velocity_limits_ask_for(request, whose, robot):
    frame = request.getfixturevalue(whose).frame
    rows = slice(None) if whose == "arm" else arm_samples(len(frame.rollouts[frame.chosen]))
    path, due = frame.rollouts[frame.chosen][rows], frame.times[frame.chosen][rows]
    np.testing.assert_allclose(robot.end_effector(frame.arm.q), path, rtol=0, atol=1e-3)
    expected = within_velocity_limits(due, frame.arm.q, robot.velocity_limits)
    np.testing.assert_allclose(frame.arm.times, expected, rtol=0, atol=1e-9)
