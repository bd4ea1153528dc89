"""Why a motion is not to be trusted, in words."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from dt_viz.avoidance import ObstacleAvoidance
from dt_viz.behaviours import Motion
from dt_viz.bias import Biasing
from dt_viz.cspace import LEVERS
from dt_viz.ground import Ground, named_starts
from dt_viz.health import integration_doubts
from dt_viz.robot import Robot
from dt_viz.solved import Solved
from dt_viz.solving import Solution
from dt_viz.stacking import WHOLE_ARM, levels

MAX_GOAL_MISS = 1e-3
"""Metres by which motions may end beside the goal before it is said."""
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
    ground, scenario, stack, arm = solved.ground, solved.scenario, solved.stack, solved.arm
    doubts = [*ground.imitation.warnings, *stack.doubts]
    integration = _of_integration(solved)
    if scenario.warp < 1:  # what does not do yet what it is made for has not failed
        return (*doubts, *integration, *ground.doubts)
    if arm is not None:
        if not arm.cleared:
            doubts.append(
                "the arm finds no way around the obstacle: a motion comes too near to it"
                if scenario.duration is None
                else "a motion of the arm comes too near to the obstacle at this flow time"
            )
        numbers, num = np.array(ground.numbers), ground.num_demonstrated
        doubts += named_starts(numbers[arm.too_near], num, "without a way around the obstacle for the arm")
        beside = np.setdiff1d(arm.moved, arm.too_near)
        doubts += named_starts(numbers[beside], num, "so near to the obstacle that the arm begins elsewhere")
    elif scenario.avoidance and clearance < 0 and not doubts:
        doubts.append(f"a motion enters the obstacle by {-1e3 * clearance:.0f} mm")
    elif any(isinstance(layer, ObstacleAvoidance) for layer in stack.unsatisfied) and not doubts:
        doubts.append(f"a motion keeps only {1e3 * clearance:.1f} mm from the obstacle")
    if not stack.doubts:
        missed_by = [layer.name for layer in scenario.layers if layer.behaviour in stack.unsatisfied]
        doubts += [f"{name or 'a layer'}: not every motion does what it asks for" for name in missed_by]
    doubts += integration
    if missed > MAX_GOAL_MISS and not doubts and not _moves_goal(ground, stack):
        doubts.append(f"the obstacle leaves no way to the goal: motions end {1e3 * missed:.0f} mm beside it")
    return (*doubts, *ground.doubts)


def target_doubts(solved: Solved, robot: Robot) -> tuple[str, ...]:
    """Which bias points the stack leads the motion to, but giving way to the obstacle leads past, in words.

    In a drawing this counts the depth, too: a motion may leave the plane to get around the obstacle.
    """
    ground, scenario, stack, arm = solved.ground, solved.scenario, solved.stack, solved.arm
    bundle = stack.bundle if arm is None else arm
    positions = stack.bundle.positions if arm is None else robot.end_effector(arm.p)
    motion = Motion(
        scenario, ground.starts, ground.goal, bundle.index, positions, num_demonstrated=ground.num_demonstrated
    )
    doubts = []
    for layer in scenario.layers:
        bias = layer.behaviour
        if (
            not layer.on
            or not isinstance(bias, Biasing)
            or bias in stack.unsatisfied
            or bias.point.strength is not None
        ):
            continue
        in_space = replace(bias, point=replace(bias.point, plane=None))
        missed = float(in_space.distances(motion).max())
        if missed > MAX_TARGET_MISS:
            who = "a motion" if arm is None else "the arm"
            doubts.append(f"{layer.name}: {who} gives way to the obstacle and passes {1e3 * missed:.0f} mm from it")
    return tuple(doubts)


def _of_integration(solved: Solved) -> tuple[str, ...]:
    """What the integrators cost that were chosen by hand, in words."""
    scenario, stack, arm = solved.scenario, solved.stack, solved.arm
    doubts, bundle = [], stack.bundle
    for level, (name, (_, made)) in enumerate(zip(levels(scenario)[1:], stack.built, strict=True), 1):
        doubts += integration_doubts(
            name, made.transform, made.integration, bundle.levels[:, level], bundle.levels[:, level - 1]
        )
    if arm is not None:
        doubts += integration_doubts(WHOLE_ARM, arm.transform, scenario.integration, arm.p, arm.q, LEVERS)
    return tuple(doubts)


def _moves_goal(ground: Ground, stack: Solution) -> bool:
    """Whether some behaviour other than avoidance means to end elsewhere."""
    goals = [ground.goal, *(made.goal for _, made in stack.built)]
    moves = (bool(np.any(a != b)) for a, b in pairwise(goals))
    return any(m and not isinstance(layer, ObstacleAvoidance) for m, (layer, _) in zip(moves, stack.built, strict=True))
