"""Courses: undisturbed motions of the joints, from where the robot is to where it is to rest."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dt_viz.control.arm_system import Section
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED, Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.retiming import within_velocity_limits

CONVERGED = 1e-5
"""Distance from the section, rad, that counts as none."""
SETTLING = 0.1
"""Spacing of the samples, seconds, in which a robot that has arrived still converges."""
NUM_SAMPLES = 80
"""Number of samples of a course."""


@dataclass(frozen=True, eq=False)
class Course:
    """An undisturbed motion from where the robot is to where it is to rest."""

    times: Array
    """(K,) seconds."""
    q: Array
    """(K, 6) rad."""
    z: Array
    """(K, k) base coordinates; the hand's place where nothing is learned."""

    @property
    def end(self) -> float:
        """Time at which it ends, seconds."""
        return float(self.times[-1])

    def at(self, clock: float) -> Array:
        """Posture (6,) at a time."""
        coefficients, begins = self._curve
        segment = max(bisect_right(begins, clock) - 1, 0)
        u = min(max(clock, begins[0]), self.end) - begins[segment]
        return np.array([u * u * u, u * u, u, 1.0]) @ coefficients[segment]

    def after(self, clock: float) -> Array:
        """Postures (K', 6) from a time on, up to the end."""
        return np.concatenate([self.at(clock)[None], self.q[self.times > clock]])

    def image(self, clock: float) -> Array:
        """Base coordinates (k,) at a time."""
        return np.array([np.interp(clock, self.times, z) for z in self.z.T])

    def slowed(self, limits: Array) -> Course:
        """Return it within limits (6,) of the joints' velocities, rad/s."""
        return replace(self, times=within_velocity_limits(self.times, self.q, limits))

    def where_left(self, distance: Array, section: Section) -> Array:
        """Postures (N, 6) at distances (N,) from the end in base coordinates, unwound to a section's."""
        along = np.linalg.norm(self.z - self.z[-1], axis=1)[::-1]
        turns = np.where(np.isinf(section.robot.lower), np.round((self.q[-1] - section.reference) / (2 * np.pi)), 0.0)
        return np.stack([np.interp(distance, along, joint) for joint in self.q[::-1].T], axis=1) - 2 * np.pi * turns

    @cached_property
    def _curve(self) -> tuple[Array, list[float]]:
        """Coefficients (K − 1, 4, 6) of a cubic in each segment, and where these begin."""
        h, slopes = np.diff(self.times)[:, None], np.gradient(self.q, self.times, axis=0)
        begin, end, mean = slopes[:-1], slopes[1:], np.diff(self.q, axis=0) / h
        bend = (begin + end - 2 * mean) / h
        return np.stack([bend / h, (mean - begin) / h - bend, begin, self.q[:-1]], axis=1), self.times[:-1].tolist()


def towards(
    system: DiffeomorphicSystem,
    section: Section,
    q: Array,
    state: Array,
    convergence: float,
    z: Array | None = None,
    near: Course | None = None,
) -> Course:
    """Make the motion of a system that a robot follows on a section, onto which it converges.

    With Q the section and x(t) the exact motion of the system it is q(t) = Q(x(t)) + δ·exp(−t/τ), δ = q − Q(x(0)).

    Args:
        system: of the end effector.
        section: the postures on which it is followed.
        q: (6,) where the robot is, rad.
        state: (k,) in which the hand is.
        convergence: τ, seconds.
        z: (k,) base coordinates to begin from; None are those of the state.
        near: a motion of another system on that section, whose postures are looked for first.
    """
    robot, base = section.robot, system.base
    z0 = system.transform.forward(state) if z is None else z
    rays = Rays(z0[None], base)
    if base.distance(z0) < ARRIVED:
        times, fractions = np.zeros(1), np.ones(1)
        path = system.transform.inverse(rays.at(np.zeros(1, int), fractions))[:, :3]
    else:
        bundle = evenly_sampled(lambda i, u: system.transform.inverse(rays.at(i, u))[:, None, :3], 1, NUM_SAMPLES)
        times, fractions, path = rays.times(bundle.index, bundle.fraction), bundle.fraction, bundle.positions
    # from the end, which is near the reference, backwards: the beginning may be far from the section's branch
    along = rays.at(np.zeros(len(fractions), int), fractions)
    left = np.linalg.norm(along - along[-1], axis=1)
    initial = None if z is None or near is None else near.where_left(left[::-1], section)
    joints = track(robot, path[::-1], section.reference, initial, reference=section.reference).q[::-1]
    turns = np.where(np.isinf(robot.lower), np.round((q - joints[0]) / (2 * np.pi)), 0.0)
    offset = q - joints[0] - 2 * np.pi * turns
    converged = convergence * np.log(max(float(np.abs(offset).max()) / CONVERGED, 1.0))
    longer = times[-1] + np.arange(SETTLING, max(converged - times[-1], SETTLING) + SETTLING / 2, SETTLING)
    times = np.concatenate([times, longer])
    joints, along = (np.concatenate([part, np.repeat(part[-1:], len(longer), 0)]) for part in (joints, along))
    joints = joints + 2 * np.pi * turns + offset * np.exp(-times / convergence)[:, None]
    return Course(times, joints, along)


def resting(q: Array, hand: Array) -> Course:
    """Stay at a posture (6,), with the hand at a place (3,)."""
    return Course(np.array([0.0, 1e-2]), np.stack([q, q]), np.stack([hand, hand]))
