"""A scenario's motion, at a precision: the end effector's stack, and on top of it how the whole arm avoids."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from dt_viz.avoidance.arm_solver import ArmSolution
from dt_viz.avoidance.avoidance import StartStatus
from dt_viz.avoidance.lift import Lift
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.flows.fields import Array
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.stack import LIVE, Precision, Solution, build_stack, warped_stack
from dt_viz.scenario.scenario import Scenario
from dt_viz.warning import ARM, Kind, MotionWarning

NUM_ALTERNATIVES = 3
"""Number of other reference postures that are tried where the arm finds no way around the obstacle."""


@dataclass(frozen=True, eq=False)
class Solved:
    """A scenario's motion: the end effector's stack, and how the whole arm avoids on top of it."""

    scenario: Scenario  # it, or one that moves like it
    nominal: Nominal  # the undisturbed motion
    below: Nominal  # the same, warped as far as the stack is that is built on it
    stack: Solution  # stack of the end effector, before the whole arm avoids anything
    arm: ArmSolution | None = None  # None where only the end effector avoids
    lifted: Lift | None = None
    """Joints along the stack's motion, which the arm's avoidance is made for; None where there is none."""
    blocked: tuple[MotionWarning, ...] = ()
    """Why there is no motion to show, though its ends are free; empty where there is one."""
    passing: Passing = ANEW
    """Detours and reference posture of the motion, under a warp those of the full one."""

    def rollouts_of(self, samples: Array) -> tuple[Array, ...]:
        """Values (N, …) of the samples of the end effector's stack for each start; none where it has no motion."""
        moving = zip(self.stack.bundle.split(samples), self.nominal.moving, strict=True)
        return tuple(values if moves else values[:0] for values, moves in moving)

    @property
    def cleared(self) -> bool:
        """Whether the whole arm, where it avoids, finds a way."""
        return self.arm is None or self.arm.cleared


def solve(scenario: Scenario, nominal: Nominal, precision: Precision, follower: Follower | None = None) -> Solved:
    """The motion of a scenario, every flow run for its full duration; see `warped`.

    Sides on which the motions of its `passing` pass obstacles are kept while these are dragged. The nominal motion is
    from starts that the arm can begin at; where the arm finds no way, that of the result has another reference posture,
    or lacks the starts that have none. Without a follower it is that of the end effector alone.

    Raises:
        UnreachableError: the whole arm is to avoid, and cannot get to where the motions start.
    """
    scenario, avoidance = replace(scenario, warp=1.0), scenario.arm_avoidance
    if follower is None or avoidance is None or avoidance.duration is not None:
        return _solved(scenario, nominal, precision, follower)
    passing = scenario.passing or ANEW
    if precision is LIVE and passing.follows(avoidance.avoided.parts):
        return _solved(scenario, _as_many(nominal, passing), precision, follower, follows=True)
    solved = _with_a_way(scenario, nominal, follower)
    if precision is not LIVE:
        solved = _solved(scenario, solved.nominal, precision, follower)
    return _unless_it_touches(solved)


def _with_a_way(scenario: Scenario, nominal: Nominal, follower: Follower) -> Solved:
    """The motion at LIVE, with another reference posture or without the starts that have no way, where it finds none.

    The same choice serves each precision: it is quick at this one. A posture is also changed where the way is long,
    but not while an obstacle is dragged.
    """
    solved, avoidance = _solved(scenario, nominal, LIVE, follower), scenario.arm_avoidance
    if avoidance is None or solved.arm is None or solved.arm.soon:
        return solved
    for other in islice(follower.alternatives(nominal, avoidance), NUM_ALTERNATIVES):
        tried = _solved(scenario, other, LIVE, follower)
        if tried.arm is not None and (tried.arm.soon if solved.cleared else tried.cleared):
            return tried
    if solved.cleared:
        return solved
    others = nominal.without(solved.arm.stuck, StartStatus.NO_WAY)
    if not others.shaping.any():
        return solved
    tried = _solved(scenario, others, LIVE, follower)
    return tried if tried.cleared else solved


def _unless_it_touches(solved: Solved) -> Solved:
    """The motion, marked as blocked where the arm finds no way and touches the obstacle."""
    if solved.cleared or solved.arm is None or solved.arm.clearance >= 0:
        return solved
    text = "the arm finds no way around the obstacle between starts and goal"
    return replace(solved, blocked=(MotionWarning(Kind.NO_WAY, text, ARM),))


def _as_many(nominal: Nominal, passing: Passing) -> Nominal:
    """The motion without the starts that had none just before, if any others that shape it are left."""
    if passing.posture != nominal.posture:
        return nominal
    before = dict(enumerate(passing.status))
    had_none = [before.get(place, StartStatus.OK) is not StartStatus.OK for place in range(len(nominal.status))]
    others = nominal.without(np.array(had_none), StartStatus.NO_WAY)
    return others if others.shaping.any() else nominal


def _solved(
    scenario: Scenario, nominal: Nominal, precision: Precision, follower: Follower | None, *, follows: bool = False
) -> Solved:
    """The motion with the reference posture of `nominal`, see `solve`; `follows` is whether it goes on in a drag."""
    passing = scenario.passing or ANEW
    stack = build_stack(nominal, scenario.active, precision, passing)
    avoidance = scenario.arm_avoidance
    hand = {applied.place: applied.made.detours for applied in stack.built if any(applied.made.detours)}
    passed = Passing(hand, posture=nominal.posture, status=nominal.status)
    if avoidance is None or follower is None:
        return Solved(scenario, nominal, nominal, stack, passing=passed)
    live = precision is LIVE
    lifted = follower.behaving(nominal, stack, exact=not live) if stack.built else follower.undisturbed(nominal)
    arm, spacing = follower.whole_arm, precision.spacing
    if follows:
        found = arm.followed(lifted, avoidance, spacing, passing)
    else:
        found = arm.avoiding(lifted, avoidance, spacing, coarse=live, passing=passing)
    passed = replace(passed, arm=found.detours, duration=found.duration, cleared=found.cleared)
    return Solved(scenario, nominal, nominal, stack, found, lifted, passing=passed)


def warped(full: Solved, below: Nominal, fraction: float, precision: Precision, follower: Follower | None) -> Solved:
    """The motion with every flow run for a fraction of its duration: straight to the goal at 0, in full at 1.

    It takes the full motion, at the same precision, and its undisturbed motion, `below`, warped as far.

    Raises:
        UnreachableError: as `solve`.
    """
    stack, scenario = warped_stack(below, full.stack, fraction, precision), replace(full.scenario, warp=fraction)
    avoidance = scenario.arm_avoidance
    if full.arm is None or avoidance is None or follower is None:
        return Solved(scenario, full.nominal, below, stack, passing=full.passing)
    lifted = follower.behaving(full.nominal, stack, exact=precision is not LIVE)
    arm = follower.whole_arm.warped(full.arm, lifted, avoidance, fraction, precision.spacing)
    return Solved(scenario, full.nominal, below, stack, arm, lifted, passing=full.passing)
