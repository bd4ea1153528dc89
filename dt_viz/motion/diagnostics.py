"""Why a motion is not to be trusted, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from dt_viz.arm.collision import Nearest
from dt_viz.arm.cspace import LEVERS
from dt_viz.arm.robot import Robot
from dt_viz.flows.rollouts import MAX_SAMPLES
from dt_viz.motion.health import in_millimetres, integration_doubts
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.solve import Applied, Solution, Solved
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import WHOLE_ARM
from dt_viz.transforms.avoidance import BESIDE, GOAL_INSIDE, ROUNDING, STAYS_INSIDE, smallest_kept
from dt_viz.transforms.base import Motion, named_starts
from dt_viz.transforms.bias import OFF_PLANE, Biasing

MAX_GOAL_MISS = 1e-3
"""Metres by which motions may end beside the goal before it is said."""
UNSAMPLED = "the motions are stretched too far to be sampled closely: what is drawn cuts corners"
MARGIN_TOLERANCE = 1e-3
"""Metres by which the arm's meshes may come nearer to the obstacle than the margin before it is said."""
MAX_TARGET_MISS = 0.013
"""Metres by which motions that avoid may miss a bias point before it is said: a centimetre, and what the arm's joints,
interpolated between samples, are off by while a hand moves."""


def motion_doubts(solved: Solved, clearance: float, missed: float) -> tuple[str, ...]:
    """Why the motion is not to be trusted, in words.

    Args:
        solved: the motion.
        clearance: of the motion, metres.
        missed: metres by which it ends beside the goal.
    """
    nominal, scenario, stack, arm = solved.nominal, solved.scenario, solved.stack, solved.arm
    doubts = [*nominal.imitation.warnings, *stack.doubts]
    if max(len(stack.bundle.index), len(arm.index) if arm else 0) >= MAX_SAMPLES:
        doubts.append(UNSAMPLED)
    integration = _of_integration(solved)
    if scenario.warp < 1:  # what does not do yet what it is made for has not failed
        return (*doubts, *integration, *nominal.doubts)
    covered = any(GOAL_INSIDE in doubt for doubt in doubts)
    if arm is not None:
        if not arm.cleared:
            doubts.append(
                "the arm finds no way around the obstacle: a motion comes too near to it"
                if scenario.duration is None
                else "a motion of the arm comes too near to the obstacle at this flow time"
            )
        numbers, num = np.array(nominal.numbers), nominal.num_demonstrated
        doubts += named_starts(numbers[arm.too_near], num, "without a way around the obstacle for the arm")
        beside = np.setdiff1d(arm.moved, arm.too_near)
        doubts += named_starts(numbers[beside], num, "so near to the obstacle that the arm begins elsewhere")
    else:
        doubts += _of_clearance(solved, clearance)
    for applied in stack.unsatisfied:
        if applied.place is not None and not (applied.made.hopeless and applied.made.doubts):
            doubts.append(f"{applied.name or 'a layer'}: not every motion does what it asks for")
    doubts += integration
    if missed > MAX_GOAL_MISS and not covered and not _moves_goal(nominal, stack):
        # what an integrator loses there and back it loses at the goal, too
        cause = "" if integration else "the obstacle leaves no way to the goal: "
        doubts.append(f"{cause}motions end {1e3 * missed:.0f} mm beside {'it' if cause else 'the goal'}")
    return (*doubts, *nominal.doubts)


def _of_clearance(solved: Solved, clearance: float) -> tuple[str, ...]:
    """What there is to say of how near the end effector comes to the obstacle that it avoids, in words."""
    avoidance = solved.stack.at(None)
    if avoidance is None or (clearance >= 0 and avoidance.satisfied):
        return ()
    nominal, bundle = solved.nominal, solved.stack.bundle
    kept = smallest_kept(Motion(solved.scenario, nominal.starts, nominal.goal, bundle.index, bundle.positions))
    # where a goal is covered, what ends nearly on the surface is beside it
    if kept < (-BESIDE if _says(avoidance, GOAL_INSIDE) else -ROUNDING):
        said = _says(avoidance, STAYS_INSIDE)
        return () if said else (f"a motion enters the obstacle by {in_millimetres(-kept)}",)
    if avoidance.satisfied or np.isinf(kept):
        return ()
    far = avoidance.made.hopeless and not avoidance.made.integration.by_hand
    why = ": the field does not reach farther; a higher T or a smaller margin helps" if far else ""
    return (f"a motion keeps only {1e3 * kept:.1f} mm from the obstacle{why}",)


def target_doubts(solved: Solved, robot: Robot) -> tuple[str, ...]:
    """Which bias points the stack leads the motion to, but giving way to the obstacle leads past, in words.

    In a drawing this counts the depth, too: a motion may leave the plane to get around the obstacle.
    """
    nominal, scenario, stack, arm = solved.nominal, solved.scenario, solved.stack, solved.arm
    bundle = stack.bundle if arm is None else arm
    positions = stack.bundle.positions if arm is None else robot.end_effector(arm.p)
    motion = Motion(
        scenario, nominal.starts, nominal.goal, bundle.index, positions, num_demonstrated=nominal.num_demonstrated
    )
    doubts = []
    for applied in stack.built:
        bias = applied.behaviour
        if not isinstance(bias, Biasing) or not applied.satisfied or bias.point.strength is not None:
            continue
        if not _says(applied, OFF_PLANE):
            bias = replace(bias, point=replace(bias.point, plane=None))
        missed = float(bias.distances(motion).max())
        if missed > MAX_TARGET_MISS:
            who, does = "a motion" if arm is None else "the arm", "ends" if bias.point.moves_goal else "passes"
            doubts.append(f"{applied.name}: {who} gives way to the obstacle and {does} {1e3 * missed:.0f} mm from it")
    return tuple(doubts)


def margin_doubts(scenario: Scenario, nearest: Sequence[Nearest]) -> tuple[str, ...]:
    """What the arm's meshes keep of the margin that they are to avoid the obstacle by, in words; empty if all of it.

    Args:
        scenario: whose margin it is.
        nearest: of each motion that the whole arm avoids with.
    """
    kept = min(nearest, key=lambda near: near.distance)
    asks = scenario.avoidance and scenario.warp == 1 and scenario.duration is None
    if not asks or kept.distance >= scenario.margin - MARGIN_TOLERANCE:
        return ()
    where, asked = f"on rollout {nearest.index(kept) + 1} the arm's {kept.links[0]}", in_millimetres(scenario.margin)
    if kept.distance < 0:
        return (f"{where} enters the obstacle by {-1e3 * kept.distance:.0f} mm; a margin of {asked} was asked for",)
    return (f"{where} keeps {in_millimetres(kept.distance)} from the obstacle; {asked} were asked for",)


def _says(applied: Applied, words: str) -> bool:
    """Whether what there is to say of a behaviour has these words."""
    return any(words in doubt for doubt in applied.doubts)


def _of_integration(solved: Solved) -> tuple[str, ...]:
    """What the integrators cost that were chosen by hand, in words."""
    scenario, stack, arm = solved.scenario, solved.stack, solved.arm
    doubts, bundle = [], stack.bundle
    for level, applied in enumerate(stack.built, 1):
        y, x, made = bundle.levels[:, level], bundle.levels[:, level - 1], applied.made
        doubts += integration_doubts(applied.name, made.transform, made.integration, y, x)
    if arm is not None:
        doubts += integration_doubts(WHOLE_ARM, arm.transform, scenario.integration, arm.p, arm.q, LEVERS)
    return tuple(doubts)


def _moves_goal(nominal: Nominal, stack: Solution) -> bool:
    """Whether some behaviour other than avoidance means to end elsewhere."""
    goals = [nominal.goal, *(applied.made.goal for applied in stack.built)]
    moves = (bool(np.any(a != b)) for a, b in pairwise(goals))
    return any(m and applied.place is not None for m, applied in zip(moves, stack.built, strict=True))
