"""Certificates of a frame: of the motions that it shows, with the transforms that they were solved with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dt_viz.avoidance.arm import ArmSolution
from dt_viz.metrics import maximum_collision_distance
from dt_viz.motion.certificates import (
    MAX_OFF,
    MAX_OFF_TRACKED,
    Certificates,
    DrawnSamples,
    certified,
    certified_arm,
    clearance_warnings,
    delay_warnings,
    hand_warnings,
)
from dt_viz.motion.diagnostics import fold_warnings, margin_warnings
from dt_viz.motion.following import Follower, arm_samples
from dt_viz.motion.solve import Solved
from dt_viz.robot.collision import load_collision_model
from dt_viz.scenario.stack import WHOLE_ARM
from dt_viz.session.frame import Frame
from dt_viz.warning import ARM, Kind


def certify(frame: Frame, fine: Solved, follower: Follower) -> Certificates:
    """Certificates of the motions that the frame shows, with the transforms that they were solved with."""
    known = _certified_hand(frame, fine) if fine.arm is None else _certified_arm(frame, fine, fine.arm, follower)
    if frame.arm is None or frame.chosen is None:
        return known
    path, due = frame.rollouts[frame.chosen], frame.times[frame.chosen]
    if fine.arm is None:
        keep = arm_samples(len(path))
        known = known.warning(*hand_warnings(follower.robot, frame.arm.q, path[keep], source=ARM))
        due = due[keep]
    return known.warning(*delay_warnings(follower.robot, frame.arm.q, frame.arm.times, due))


def _certified_hand(frame: Frame, fine: Solved) -> Certificates:
    stack, obstacle, path = fine.stack, frame.scenario.obstacle, np.concatenate(frame.rollouts)
    shown = DrawnSamples(stack.bundle.index, stack.bundle.fraction, np.concatenate(frame.times), path)
    known = certified(frame.certificates, stack, fine.ends, shown)
    known = known.warning(*clearance_warnings(known.clearance, float(obstacle.signed_distance(path).min())))
    depth = max(maximum_collision_distance(path, obstacle.signed_distance) for path in frame.rollouts)
    return replace(known, clearance=-depth if depth > 0 else known.clearance)


def _certified_arm(frame: Frame, fine: Solved, arm: ArmSolution, follower: Follower) -> Certificates:
    scenario, robot, whole_arm = frame.scenario, follower.robot, follower.whole_arm
    p, undisturbed, known = arm.p.copy(), whole_arm.limits.inside(arm.q), frame.certificates
    if frame.arm is not None:
        p[arm.index == frame.chosen] = frame.arm.q
    path, times = np.concatenate(frame.rollouts), np.concatenate(frame.times)
    avoidance = scenario.arm_avoidance
    assert avoidance is not None
    integration = avoidance.integration
    known = known.warning(
        *hand_warnings(robot, p, path, tolerance=MAX_OFF),
        *fold_warnings(WHOLE_ARM, arm.transform, integration, p, undisturbed),
    )
    known, q = certified_arm(known, arm.transform, p, undisturbed, by_hand=integration.by_hand)
    shown = DrawnSamples(arm.index, arm.fraction, times, robot.end_effector(q))
    known = certified(known, fine.stack, fine.ends, shown, tolerance=MAX_OFF_TRACKED)
    shaping = arm.index < len(frame.rollouts) - fine.nominal.num_added
    kept = float(whole_arm.clearance(p[shaping], avoidance.avoided).min())
    return known.warning(*clearance_warnings(known.clearance, kept))


def with_meshes(known: Certificates, frame: Frame, fine: Solved) -> Certificates:
    """Certificates with distances of the arm's meshes: on the motion that it shows, and on all that it avoids along."""
    assert frame.arm is not None
    model, scenario, avoidance = load_collision_model(), frame.scenario, frame.scenario.arm_avoidance
    report = model.report(frame.arm.q, scenario.obstacle)
    # what gives way only in part may still be in the obstacle
    apart = {Kind.ARM_ENTERS} if scenario.warp < 1 else set()
    known = replace(known, collision=report).warning(*(w for w in report.warnings if w.kind not in apart))
    if fine.arm is None or avoidance is None:
        return known
    shaping = range(len(frame.rollouts) - fine.nominal.num_added)
    nearest = [model.nearest_to_obstacle(fine.arm.p[fine.arm.index == k], avoidance.avoided) for k in shaping]
    return known.warning(*margin_warnings(scenario, nearest, fine.nominal.numbers))
