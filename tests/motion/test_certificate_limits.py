"""How much certificates let pass: what is just within a limit is certified, what is just beyond it is said."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scenes import kinds

from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.flows.diffeomorphisms import Diffeomorphism, Identity
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED, Rays, evenly_sampled
from dt_viz.flows.systems import Attractor
from dt_viz.motion.certificates import Certificates, Shown, certified, clearance_warnings, delay_warnings, hand_warnings
from dt_viz.motion.stack import Solution
from dt_viz.warning import Kind

BASE = Attractor(np.array([0.5, 0.2, 0.0]), 0.2, 0.05)
RAYS = Rays(np.array([[-0.8, -0.3, 0.1], [-0.6, 0.7, -0.2]]), BASE)
ENDS = np.concatenate([RAYS.z0, BASE.goal[None]])
BUNDLE = evenly_sampled(lambda i, u: RAYS.at(i, u)[:, None], 2, 300)
SHOWN = Shown(BUNDLE.index, BUNDLE.fraction, RAYS.times(BUNDLE.index, BUNDLE.fraction), BUNDLE.positions)
KNOWN = Certificates(clearance=0.05)
AWAY = np.eye(3)[2]
IDENTITY = Identity(3)
around_the_limit = pytest.mark.parametrize(("part", "said"), [(0.9, False), (1.1, True)])


def certificates_of(shown=SHOWN, ends=ENDS, transform: Diffeomorphism = IDENTITY, known=KNOWN, **options):
    """Certificates of the straight motions, said to be those of a transform."""
    return certified(known, Solution(transform, RAYS, BUNDLE, ()), ends, shown, **options)


@dataclass(frozen=True)
class Missing(Diffeomorphism):
    """The identity, there; back it misses by a distance in metres."""

    missed: float

    @property
    def dim(self) -> int:
        return 3

    def scaled(self, fraction: float) -> Diffeomorphism:
        return self

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return s + self.missed * AWAY * inverse, U


def test_the_straight_motions_of_the_base_system_are_certified():
    assert certificates_of() == Certificates(0.05, None, 1.0, 0.0, True)


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
    assert (Kind.OTHER_TIMES in kinds(certificates_of(replace(SHOWN, times=times)).warnings)) == said


@around_the_limit
def test_a_motion_that_is_said_to_be_at_its_goal_too_early(part, said):
    """It counts as there a tenth of a millimetre before."""
    last, times = np.flatnonzero(SHOWN.index == 0)[-1], SHOWN.times.copy()
    times[last] = BASE.arrival_time(RAYS.z0[:1], ARRIVED + part * 1e-6)[0]
    assert (Kind.OTHER_TIMES in kinds(certificates_of(replace(SHOWN, times=times)).warnings)) == said


@around_the_limit
@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_start_or_goal_beside_those_of_the_base_system(which, part, said):
    known = certificates_of(ends=ENDS + part * 1e-6 * np.outer(np.eye(3)[which], AWAY))
    assert (Kind.OTHER_ENDS in kinds(known.warnings)) == said


def test_motions_in_another_order_are_recognised():
    assert Kind.OTHER_ENDS in kinds(certificates_of(ends=ENDS[[1, 0, 2]]).warnings)
    only_one = replace(SHOWN, index=np.zeros_like(SHOWN.index))
    assert Kind.OTHER_ENDS in kinds(certificates_of(only_one).warnings)


@around_the_limit
def test_a_round_trip_that_misses(part, said):
    known = certificates_of(transform=Missing(part * 1e-6))
    assert known.round_trip_error == pytest.approx(part * 1e-6)
    assert (Kind.ROUND_TRIP in kinds(known.warnings)) == said


def test_of_two_maps_the_worse_is_certified():
    known = certificates_of(known=replace(KNOWN, min_det_jacobian=0.2, round_trip_error=3e-7))
    assert (known.min_det_jacobian, known.round_trip_error) == (0.2, 3e-7)
    known = certificates_of(known=replace(KNOWN, min_det_jacobian=1.7, round_trip_error=1e-9), transform=Missing(2e-7))
    assert (known.min_det_jacobian, known.round_trip_error) == (1.0, pytest.approx(2e-7))


@around_the_limit
@pytest.mark.parametrize("sign", [1, -1])
def test_a_clearance_other_than_the_one_that_is_said(sign, part, said):
    warnings = clearance_warnings(0.0532, 0.0532 + sign * part * 1e-6)
    assert kinds(warnings) == ({Kind.OTHER_CLEARANCE} if said else set())
    assert clearance_warnings(np.inf, np.inf) == ()
    (warning,) = clearance_warnings(0.0532, -0.004)
    assert warning.text == "the motions shown keep -4.0 mm from the obstacle, not 53.2 mm"


@around_the_limit
@pytest.mark.parametrize("options", [{}, {"tolerance": 1e-6}])
def test_a_hand_beside_its_rollout(robot, options, part, said):
    path = robot.end_effector(robot.home)[None].repeat(5, axis=0)
    path[3] += part * options.get("tolerance", 1e-3) * AWAY
    warnings = hand_warnings(robot, robot.home[None].repeat(5, axis=0), path, source="it", **options)
    assert [(warning.kind, warning.source) for warning in warnings] == [(Kind.HAND_BESIDE, "it")] * said


@around_the_limit
@pytest.mark.parametrize("sign", [1, -1])
def test_an_arm_at_other_times_than_its_limits_ask_for(robot, sign, part, said):
    q, due = robot.home + np.linspace(0, 1, 20)[:, None] * np.eye(6)[0], np.linspace(0.0, 1.0, 20)
    times = within_velocity_limits(due, q, robot.velocity_limits)
    assert times[-1] > 1.5  # they have something to ask for
    times[7] += sign * part * 1e-9
    assert kinds(delay_warnings(robot, q, times, due)) == ({Kind.OTHER_DELAY} if said else set())
