"""A scenario's motion, at a precision: the end effector's stack, and on top of it how the whole arm avoids."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from dt_viz.arm.whole_arm import ArmSolution, Lift
from dt_viz.flows.fields import Array
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.stack import LIVE, Precision, Solution, build_stack
from dt_viz.motion.warp import warped_stack
from dt_viz.obstacles.ways import remembered, travel
from dt_viz.scenario.scenario import Scenario
from dt_viz.transforms.base import start_warnings
from dt_viz.warning import ARM, Kind, MotionWarning

NUM_ALTERNATIVES = 3
"""Number of other stances that are tried where the arm finds no way around the obstacle."""


@dataclass(frozen=True)
class Solved:
    """A scenario's motion: the end effector's stack, and how the whole arm avoids on top of it."""

    scenario: Scenario
    """It, or one that moves like it."""
    nominal: Nominal
    """The undisturbed motion."""
    below: Nominal
    """The same, warped as far as the stack is that is built on it."""
    stack: Solution
    """Stack of the end effector, before the whole arm avoids anything."""
    arm: ArmSolution | None = None
    """None where only the end effector avoids."""
    lifted: Lift | None = None
    """Joints along the stack's motion, which the arm's avoidance is made for; None where there is none."""
    blocked: tuple[MotionWarning, ...] = ()
    """Why there is no motion to show, though its ends are free; empty where there is one."""

    @property
    def cleared(self) -> bool:
        """Whether the whole arm, where it avoids, finds a way."""
        return self.arm is None or self.arm.cleared

    @property
    def ends(self) -> Array:
        """(R + 1, 3) where the end effector's motions are to begin, and where all are to end, metres."""
        goal, built = self.nominal.goal, self.stack.built
        moved = built[-1].made.goal - goal if built else np.zeros_like(goal)
        return np.concatenate([self.nominal.starts, [goal + self.scenario.warp * moved]])


def solve(
    scenario: Scenario, nominal: Nominal, precision: Precision, follower: Follower, before: Solved | None = None
) -> Solved:
    """The motion of a scenario, every flow run for its full duration.

    Args:
        scenario: whose stack it is; its `warp` is left to `warped`.
        nominal: the undisturbed motion, from starts that the arm can begin at. Where the arm finds no way, that of the
            result has another stance, or lacks the starts that have none.
        precision: how exactly.
        follower: the arm.
        before: the motion that was shown last, of the same learned motion. The sides on which it passes obstacles are
            kept while they do; and joints of LIVE are looked for from its own, which changes the result by less than a
            milliradian.

    Raises:
        UnreachableError: the whole arm is to avoid, and cannot get to where the motions start.
    """
    scenario, avoidance = replace(scenario, warp=1.0), scenario.arm_avoidance
    if avoidance is None or avoidance.duration is not None:
        return _solved(scenario, nominal, precision, follower, before)
    if precision is LIVE and before is not None and _is_dragged(scenario, before):
        return _solved(scenario, _as_many(nominal, before), precision, follower, before, follows=True)
    solved = _with_a_way(scenario, nominal, follower, before)
    if precision is not LIVE:
        solved = _solved(scenario, solved.nominal, precision, follower, before)
    return _unless_it_touches(solved, follower)


def _with_a_way(scenario: Scenario, nominal: Nominal, follower: Follower, before: Solved | None) -> Solved:
    """The motion at LIVE, in another stance or without the starts that have no way, where it finds none otherwise.

    The same choice serves each precision: it is quick at this one. A stance is also changed where the way is long,
    but not while an obstacle is dragged.
    """
    solved, avoidance = _solved(scenario, nominal, LIVE, follower, before), scenario.arm_avoidance
    if avoidance is None or solved.arm is None or solved.arm.soon:
        return solved
    for other in islice(follower.alternatives(nominal, avoidance), NUM_ALTERNATIVES):
        tried = _solved(scenario, other, LIVE, follower, before)
        if tried.arm is not None and (tried.arm.soon if solved.cleared else tried.cleared):
            return tried
    if solved.cleared:
        return solved
    others = np.setdiff1d(np.arange(len(nominal.strands)), solved.arm.stuck)
    if not (others < nominal.num_hosts).any():
        return solved
    numbers, how = np.array(nominal.numbers), "without a way around the obstacle for the arm"
    told = start_warnings(numbers[solved.arm.stuck], nominal.num_demonstrated, Kind.START_COVERED, how)
    tried = _solved(scenario, nominal.only(others, (*nominal.warnings, *told)), LIVE, follower, before)
    return tried if tried.cleared else solved


def _unless_it_touches(solved: Solved, follower: Follower) -> Solved:
    """The motion, marked as blocked where the arm finds no way and touches the obstacle."""
    avoidance = solved.scenario.arm_avoidance
    if solved.cleared or solved.arm is None or avoidance is None:
        return solved
    if not follower.whole_arm.touches(solved.arm, solved.nominal.num_hosts, avoidance.obstacle):
        return solved
    text = "the arm finds no way around the obstacle between starts and goal"
    return replace(solved, blocked=(MotionWarning(Kind.NO_WAY, text, ARM),))


def goes_on(scenario: Scenario, before: Solved) -> bool:
    """Whether the arm was avoiding an obstacle that is hardly anywhere else now."""
    if before.arm is None or scenario.arm_avoidance is None:
        return False
    return any(remembered(before.arm.ways, scenario.arm_avoidance.obstacle.parts))


def _is_dragged(scenario: Scenario, before: Solved) -> bool:
    """Whether an obstacle that the arm was avoiding has moved a little since."""
    if not goes_on(scenario, before) or before.arm is None or scenario.arm_avoidance is None:
        return False
    parts = scenario.arm_avoidance.obstacle.parts
    known = zip(remembered(before.arm.ways, parts), parts, strict=True)
    return any(way is not None and travel(way.obstacle, part) > 0 for way, part in known)


def _as_many(nominal: Nominal, before: Solved) -> Nominal:
    """The motion without the starts that had no way before, if any others are left."""
    without = set(before.nominal.left_out) - set(nominal.left_out)
    kept = [k for k, number in enumerate(nominal.numbers) if number not in without]
    if not without or not kept or before.nominal.stance != nominal.stance:
        return nominal
    return nominal.only(kept, before.nominal.warnings)


def _solved(
    scenario: Scenario,
    nominal: Nominal,
    precision: Precision,
    follower: Follower,
    before: Solved | None = None,
    *,
    follows: bool = False,
) -> Solved:
    """The motion in the stance of `nominal`, see `solve`; `follows` is whether it goes on from that before."""
    stack = build_stack(nominal, scenario.active, precision, before and before.stack)
    avoidance = scenario.arm_avoidance
    if avoidance is None:
        return Solved(scenario, nominal, nominal, stack)
    live = precision is LIVE
    if stack.built:
        joints = None if before is None else before.lifted
        lifted = follower.behaving(nominal, stack, exact=not live, before=joints)
    else:
        lifted = follower.undisturbed(nominal)
    spacing, last = precision.spacing, None if before is None else before.arm
    if follows and last is not None:
        arm = follower.whole_arm.followed(lifted, avoidance, spacing, last)
    else:
        arm = follower.whole_arm.avoiding(lifted, avoidance, spacing, coarse=live, before=last)
    return Solved(scenario, nominal, nominal, stack, arm, lifted)


def warped(
    full: Solved, below: Nominal, fraction: float, precision: Precision, follower: Follower, before: Lift | None = None
) -> Solved:
    """The motion with every flow run for a fraction of its duration: straight to the goal at 0, in full at 1.

    Args:
        full: the motion at 1, at the same precision.
        below: its undisturbed motion, warped as far.
        fraction: s, from 0 to 1.
        precision: how exactly.
        follower: the arm.
        before: joints to look for those of LIVE from, as shown last.

    Raises:
        UnreachableError: as `solve`.
    """
    stack, scenario = warped_stack(below, full.stack, fraction, precision), replace(full.scenario, warp=fraction)
    avoidance = scenario.arm_avoidance
    if full.arm is None or avoidance is None:
        return Solved(scenario, full.nominal, below, stack)
    lifted = follower.behaving(full.nominal, stack, exact=precision is not LIVE, before=before)
    arm = follower.whole_arm.warped(full.arm, lifted, avoidance, fraction, precision.spacing)
    return Solved(scenario, full.nominal, below, stack, arm, lifted)
