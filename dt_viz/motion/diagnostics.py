"""Warnings about a motion: what it wants and does not get, and what integrators cost that were chosen by hand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np

from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE
from dt_viz.avoidance.avoidance import StartStatus, start_warnings
from dt_viz.avoidance.transform import Anchored, MotionBelow
from dt_viz.flows.diffeomorphisms import Chain, Conjugated, Diffeomorphism, Flow, Integration
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import MAX_SAMPLES, Bundle
from dt_viz.motion.certificates import MAX_ROUND_TRIP, DrawnSamples
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.solve import Solved
from dt_viz.motion.stack import Applied, Solution
from dt_viz.robot.collision import Nearest
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import WHOLE_ARM
from dt_viz.warning import ARM, Kind, MotionWarning, in_millimetres

MAX_GOAL_MISS = 1e-3  # distance from the goal beyond which the end of a motion has a warning, metres
NUM_CHECKED_LIVE = 300
"""Number of samples on which it is computed what an integrator costs that was chosen by hand."""


def motion_warnings(solved: Solved, drawn: DrawnSamples, robot: Robot | None = None) -> tuple[MotionWarning, ...]:
    """Why the motion that is drawn, of a robot or the hand alone, is not to be trusted, and what it does not get."""
    found = _of_motion(solved, drawn, robot)
    return found if robot is None else (*found, *_of_anchors(solved.stack, robot), *_of_targets(solved, drawn))


def _of_motion(solved: Solved, drawn: DrawnSamples, robot: Robot | None) -> tuple[MotionWarning, ...]:
    nominal, scenario, stack, arm = solved.nominal, solved.scenario, solved.stack, solved.arm
    missed = float(np.linalg.norm(drawn.positions[-1] - nominal.goal))
    found = [text for text in nominal.imitation.warnings if text not in nominal.task.seen]
    warnings = [MotionWarning(Kind.IMITATION, text) for text in found]
    warnings += stack.warnings
    if max(len(stack.bundle.index), len(arm.index) if arm else 0) >= MAX_SAMPLES:
        text = "the motions are stretched too far to be sampled closely: what is drawn cuts corners"
        warnings.append(MotionWarning(Kind.UNSAMPLED, text))
    integration = _of_integration(solved, robot)
    if scenario.warp < 1:  # wishes that are not met yet are no failures
        return (*warnings, *integration, *nominal.warnings)
    if arm is not None:
        warnings += _of_arm(solved)
    for applied in stack.built:
        top = _top(solved, applied, stack.bundle)
        warnings += applied.transform.shortfall(top, applied.made, satisfied=applied.satisfied)
    warnings += integration
    if missed > MAX_GOAL_MISS and not _moves_goal(nominal, stack):
        # what an integrator loses there and back it loses at the goal, too
        cause = "" if integration else "the obstacle leaves no way to the goal: "
        text = f"{cause}motions end {1e3 * missed:.0f} mm beside {'it' if cause else 'the goal'}"
        warnings.append(MotionWarning(Kind.GOAL_MISSED, text))
    return (*warnings, *nominal.warnings)


def _of_arm(solved: Solved) -> list[MotionWarning]:
    nominal, arm, avoidance, warnings = solved.nominal, solved.arm, solved.scenario.arm_avoidance, []
    assert arm is not None
    assert avoidance is not None
    if not arm.cleared:
        text = (
            "the arm finds no way around the obstacle: a motion comes too near to it"
            if avoidance.duration is None
            else "a motion of the arm comes too near to the obstacle at this flow time"
        )
        warnings.append(MotionWarning(Kind.ARM_BLOCKED, text, WHOLE_ARM))
    warnings += start_warnings(arm.too_near, nominal.added, Kind.ARM_BLOCKED, StartStatus.NO_WAY.value, WHOLE_ARM)
    how = "so near to the obstacle that the arm begins elsewhere"
    beside = arm.moved & ~arm.too_near
    return [*warnings, *start_warnings(beside, nominal.added, Kind.START_COVERED, how, WHOLE_ARM)]


def _of_anchors(stack: Solution, robot: Robot) -> tuple[MotionWarning, ...]:
    """Warnings about transforms that lead motions to where a robot's hand cannot be."""
    said = []
    for name, transform in ((applied.name, applied.transform) for applied in stack.built):
        if not isinstance(transform, Anchored):
            continue
        if transform.position[2] < 0:
            said.append((name, "the point is below the table"))
        away = float(np.linalg.norm(np.subtract(transform.position, robot.shoulder)))
        if not robot.reaches(transform.position):
            reach = f"which reaches {robot.working_radius:.2f} m"
            said.append((name, f"the point is {away:.2f} m from the arm's shoulder, {reach}"))
    return tuple(MotionWarning(Kind.MISPLACED, f"{name}: {text}", name) for name, text in said)


def _top(solved: Solved, applied: Applied, drawn: DrawnSamples | Bundle) -> MotionBelow:
    """Samples of the whole stack's motions, as a transform of the stack is asked about them."""
    nominal, samples = solved.nominal, (drawn.index, drawn.positions)
    told = {"name": applied.name, "shaping": nominal.shaping}
    return MotionBelow(nominal.starts, nominal.goal, *samples, **told)


def _of_targets(solved: Solved, drawn: DrawnSamples) -> tuple[MotionWarning, ...]:
    """Warnings about transforms that the stack satisfies, but the avoidance of obstacles does not."""
    if not solved.scenario.avoids or solved.scenario.warp < 1:
        return ()
    who = "a motion" if solved.arm is None else "the arm"
    return tuple(
        warning
        for applied in solved.stack.built
        if applied.satisfied and isinstance(applied.transform, Anchored)
        for warning in applied.transform.deflected(_top(solved, applied, drawn), applied.made, who)
    )


def margin_warnings(scenario: Scenario, nearest: Mapping[int, Nearest]) -> tuple[MotionWarning, ...]:
    """Warnings where the arm's meshes keep less than the margin, from what is nearest on each motion, by its place."""
    place, kept = min(nearest.items(), key=lambda item: item[1].distance)
    avoidance = scenario.arm_avoidance
    asks = avoidance is not None and scenario.warp == 1 and avoidance.duration is None
    if avoidance is None or not asks or kept.distance >= avoidance.margin - MARGIN_TOLERANCE:
        return ()
    where, asked = f"on rollout {place + 1} the arm's {kept.links[0]}", in_millimetres(avoidance.margin)
    if kept.distance < 0:
        text = f"{where} enters the obstacle by {-1e3 * kept.distance:.0f} mm; a margin of {asked} was asked for"
        return (MotionWarning(Kind.ROLLOUT_ENTERS, text, ARM),)
    text = f"{where} keeps {in_millimetres(kept.distance)} from the obstacle; {asked} were asked for"
    return (MotionWarning(Kind.ARM_TOO_NEAR, text, ARM),)


def _of_integration(solved: Solved, robot: Robot | None) -> tuple[MotionWarning, ...]:
    stack, arm, avoidance = solved.stack, solved.arm, solved.scenario.arm_avoidance
    warnings, bundle = [], stack.bundle
    for level, applied in enumerate(stack.built, 1):
        y, x, made = bundle.levels[:, level], bundle.levels[:, level - 1], applied.made
        warnings += integration_warnings(applied.name, made.transform, made.integration, y, x)
    if robot is not None and arm is not None and avoidance is not None:
        transform, levers = arm.transform, robot.levers
        warnings += integration_warnings(WHOLE_ARM, transform, avoidance.integration, arm.p, arm.q, levers)
    return tuple(warnings)


def _moves_goal(nominal: Nominal, stack: Solution) -> bool:
    goals = [nominal.goal, *(applied.made.goal for applied in stack.built)]
    moves = (bool(np.any(a != b)) for a, b in pairwise(goals))
    return any(m and not applied.transform.avoided.parts for m, applied in zip(moves, stack.built, strict=True))


def integration_warnings(
    name: str, flow: Diffeomorphism, integration: Integration, y: Array, x: Array, unit: Array | float = 1.0
) -> tuple[MotionWarning, ...]:
    """Warnings about the integration of a transform's flow, if it was chosen by hand.

    Quick enough for a drag: along samples y (N, d) of motions, and those below, x (N, d), which ψ⁻¹ leads to them. A
    flow in other coordinates, as the whole arm's, is too slow to be looked at for folds here: see `fold_warnings`. One
    unit of each coordinate is `unit` metres.
    """
    if not integration.by_hand:
        return ()
    keep = np.unique(np.linspace(0, len(y) - 1, NUM_CHECKED_LIVE).astype(int))
    lost = float(np.linalg.norm((flow.inverse(flow.forward(y[keep])) - y[keep]) * unit, axis=1).max())
    folds = () if isinstance(flow, Conjugated) else fold_warnings(name, flow, integration, y[keep], x[keep])
    if lost <= MAX_ROUND_TRIP:
        return folds
    text = f"{name}: {integration} loses {in_millimetres(lost)} in a round trip"
    return (*folds, MotionWarning(Kind.INEXACT_INVERSE, text, name))


def fold_warnings(
    name: str, flow: Diffeomorphism, integration: Integration, y: Array, x: Array
) -> tuple[MotionWarning, ...]:
    """Whether a step of a flow whose integration was chosen by hand folds space; see `integration_warnings`.

    Only the steps that start from or lead to the samples are looked at: what folds beside them is not found. The flow
    may be part of a chain, or in other coordinates; nothing is said of what has no steps.
    """
    if not integration.by_hand:
        return ()
    det = np.inf
    for part, above, below in _stepped(flow, y, x):
        # ψ⁻¹ is looked at on its way to the samples: after a coarse ψ it starts elsewhere
        det = min(det, part.min_step_determinant(above, inverse=False), part.min_step_determinant(below, inverse=True))
    if det > 0:
        return ()
    text = f"{name}: a step of {integration} folds space (det {det:.2g}); take more steps or less time"
    return (MotionWarning(Kind.FOLDS, text, name),)


def _stepped(flow: Diffeomorphism, y: Array, x: Array) -> Iterator[tuple[Flow, Array, Array]]:
    """The parts of ψ that take equal steps, with the samples (N, d) above and below each, in its coordinates."""
    if isinstance(flow, Flow) and not flow.tolerance:
        yield flow, y, x
    elif isinstance(flow, Conjugated):
        yield from _stepped(flow.inner, flow.by.forward(y), flow.by.forward(x))
    elif isinstance(flow, Chain):
        above = [y]
        for part in reversed(flow.parts[1:]):
            above.append(part.forward(above[-1]))
        for part, top in zip(flow.parts, reversed(above), strict=True):
            yield from _stepped(part, top, x)
            x = part.inverse(x)
