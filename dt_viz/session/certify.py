"""Checks of a frame: of the motions that it shows, with the transforms that they were solved with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dt_viz.metrics import maximum_collision_distance
from dt_viz.motion.certificates import (
    MAX_OFF_POSTURE,
    NUM_POSTURES,
    Certificates,
    DrawnSamples,
    HandTurn,
    certified,
    certified_map,
)
from dt_viz.motion.diagnostics import fold_warnings, margin_warnings, motion_warnings
from dt_viz.motion.following import MAX_TRACKING_ERROR, Follower
from dt_viz.motion.solve import Solved
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import Robot
from dt_viz.scenario.stack import WHOLE_ARM
from dt_viz.session.frame import Frame
from dt_viz.warning import Kind


def uncertified(motion: Solved, drawn: DrawnSamples, follower: Follower) -> Certificates:
    """What is known of a motion at once: its clearance, and what it does not get that it wants."""
    kept = motion.arm.clearance if motion.arm else clearance(motion, drawn, motion.scenario.obstacle, follower)
    return Certificates(kept, found=motion_warnings(motion, drawn, follower.robot))


def clearance(motion: Solved, drawn: DrawnSamples, obstacle: Union, follower: Follower) -> float:
    """Smallest distance of what moves, the end effector or the spheres that cover the arm, from an obstacle, metres."""
    if motion.arm is None:
        return float(obstacle.signed_distance(drawn.positions).min())
    return float(follower.whole_arm.clearance(motion.arm.p, obstacle).min())


def certify(frame: Frame, follower: Follower) -> Certificates:
    """Certificates of the motions that a frame shows."""
    motion, known, drawn = frame.motion, frame.certificates, frame.drawn
    arm, avoidance, obstacle = motion.arm, motion.scenario.arm_avoidance, motion.scenario.obstacle
    if arm is None or avoidance is None:
        depth = max(maximum_collision_distance(path, obstacle.signed_distance) for path in frame.rollouts)
        known = replace(known, clearance=-depth if depth > 0 else known.clearance)
        return certified(known, motion.stack, drawn)
    p, undisturbed, integration = arm.p.copy(), follower.whole_arm.limits.inside(arm.q), avoidance.integration
    if frame.arm is not None:
        p[arm.index == frame.chosen] = frame.arm.q
    known = known.warning(*fold_warnings(WHOLE_ARM, arm.transform, integration, p, undisturbed))
    levers = follower.robot.levers
    known, q = certified_map(
        known, arm.transform, p, undisturbed, NUM_POSTURES, MAX_OFF_POSTURE, levers, by_hand=integration.by_hand
    )
    below = replace(drawn, positions=follower.robot.end_effector(undisturbed if integration.by_hand else q))
    # a spline between postures on the motion leaves up to 1e-5, joints at their limits leave more
    return certified(known, motion.stack, below, tolerance=MAX_TRACKING_ERROR)


def with_meshes(frame: Frame, robot: Robot) -> Certificates:
    """Certificates with distances of an arm's meshes: on the motion that it shows, and on all that it avoids along."""
    known, motion = frame.certificates, frame.motion
    if frame.arm is None:
        return known
    model, scenario, avoidance = robot.collision, motion.scenario, motion.scenario.arm_avoidance
    report = model.report(frame.arm.q, scenario.obstacle)
    # what gives way only in part may still be in the obstacle
    apart = {Kind.ARM_ENTERS} if scenario.warp < 1 else set()
    wanted = frame.arm.orientations
    turn = None if wanted is None else HandTurn.of(robot, frame.arm.q, wanted)
    known = replace(known, collision=report, turn=turn).warning(*(w for w in report.warnings if w.kind not in apart))
    if motion.arm is None or avoidance is None:
        return known
    places = np.flatnonzero(motion.nominal.shaping).tolist()
    paths = {place: motion.arm.p[motion.arm.index == place] for place in places}
    nearest = {k: model.nearest_to_obstacle(path, avoidance.avoided, avoidance.margin) for k, path in paths.items()}
    return known.warning(*margin_warnings(scenario, nearest))
