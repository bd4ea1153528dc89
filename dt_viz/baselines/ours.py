"""Ours: the learned motion, and the same with the whole arm led around obstacles (sec. 4)."""

from __future__ import annotations

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.registry import AVOIDANCE
from dt_viz.baselines.base import Plan, Planner, Problem
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import Learned, Nominal
from dt_viz.motion.solve import solve
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.scenario.scenario import Layer, Scenario, Start


def fit_alone(problem: Problem) -> Planner:
    """Take what is learned already; motions are the same around all obstacles."""

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        nominal, places = from_starts(problem.learned, starts)
        bundle = nominal.bundle
        times = bundle.split(nominal.rays.times(bundle.index, bundle.fraction))
        return Plan(tuple(nominal.paths[place] for place in places), tuple(times[place] for place in places))

    return plan


def fit(problem: Problem) -> Planner:
    """Take what is learned already; the whole arm is led around the obstacles in configuration space.

    Motions that it finds no way for stay at their start.
    """
    follower = Follower(problem.robot)

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        nominal, places = from_starts(problem.learned, starts)
        motions = _moving(follower, nominal, obstacle)
        if stays := set(places) - set(motions):
            q = follower.undisturbed(nominal).tracked.q
            motions |= {place: (q[place, :1], np.zeros(1)) for place in stays}
        joints, times = zip(*(motions[place] for place in places), strict=True)
        return Plan(tuple(map(problem.robot.end_effector, joints)), times, joints)

    return plan


def _moving(follower: Follower, nominal: Nominal, obstacle: Union) -> dict[int, tuple[Array, Array]]:
    """Joints (N, n), rad, and times (N,), s, of the rollouts that the arm finds a way for, by their place."""
    avoidance = ArmAvoidance(obstacle.parts)
    admission = follower.admission(nominal, avoidance)
    if admission.blocked:
        return {}
    scenario = Scenario(nominal.task.name, (Layer(avoidance, name=AVOIDANCE.title),))
    solved = solve(scenario, admission.nominal, FINE, follower)
    arm = solved.arm
    if solved.blocked or arm is None:
        return {}
    due, limits, motions = solved.stack.rays.times(arm.index, arm.fraction), follower.robot.velocity_limits, {}
    for place in np.flatnonzero(solved.nominal.moving).tolist():
        q = arm.p[arm.index == place]
        motions[place] = q, within_velocity_limits(due[arm.index == place], q, limits)
    return motions


def from_starts(learned: Learned, starts: Array) -> tuple[Nominal, list[int]]:
    """The undisturbed motion from starts (R, 3), metres, and the place of each start in it.

    The task's starts are always part of it: the whole arm's avoidance is made for their motions.
    """
    known = {as_point(start): place for place, start in enumerate(learned.task.starts)}
    points = [as_point(start) for start in starts]
    added = list(dict.fromkeys(point for point in points if point not in known))
    places = {**known, **{point: len(learned.task.starts) + k for k, point in enumerate(added)}}
    return learned.nominal([learned.trajectory(Start(point)) for point in added]), [places[point] for point in points]
