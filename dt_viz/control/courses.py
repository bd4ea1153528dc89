"""Courses: undisturbed motions of the joints, from where the robot is to where it is to rest."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.arm_field import JointLimits
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED, Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.kernels.proximity import COMPLEX_STEP
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.memo import cached_property
from dt_viz.robot.inverse_kinematics import soft_limits, track
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Section:
    """The best postures q = Q(x) of an arm whose end effector is at x, as `inverse_kinematics.track` finds them.

    Q(x) minimises h(q), as in `track`, among the postures with x(q) = x. With the multipliers μ of that constraint it
    solves ∇h + J(q)ᵀμ = 0 and x(q) = x, whose derivative gives that of Q:

        [ ∇²h + Σ μ_k ∇²x_k   Jᵀ ] [ DQ ]   [ 0 ]
        [ J                   0  ] [ Dμ ] = [ I ].

    This is the pseudo-inverse of J in the metric of the Lagrangian's second derivative, so that J·DQ = I. It does not
    hold for joints at their limits.
    """

    robot: Robot
    reference: Array  # (n,) reference posture of h, rad
    known: Array | None = None
    """(K, n) postures on it, rad, where h has several minima; None is the reference."""

    def postures(self, x: Array) -> Array:
        """Compute Q(x), (*B, T, n) rad, for paths `x` (*B, T, 3), metres."""
        n = self.robot.num_joints
        start = np.broadcast_to(self.reference, (*x.shape[:-2], n))
        q = track(self.robot, x, start, reference=start).q.reshape(-1, n)
        targets = x.reshape(-1, 3)
        for _ in range(4):  # Newton steps to the exact best posture; they converge quadratically
            slope, K = self._derivatives(q)
            miss = np.concatenate([-slope, targets - self.robot.end_effector(q)], axis=1)
            q = q + np.linalg.solve(K, miss[..., None])[:, :n, 0]
        return q.reshape(*x.shape[:-1], n)

    def nearest(self, x: Array) -> Array:
        """Return the known posture (n,) whose end effector is nearest to a place (3,), metres."""
        known = self.reference[None] if self.known is None else self.known
        return known[np.linalg.norm(self.robot.end_effector(known) - x, axis=1).argmin()]

    def _derivatives(self, q: Array) -> tuple[Array, Array]:
        """Compute ∇h + Jᵀμ with the best μ, (N, n), and the matrix above (N, n + 3, n + 3), at postures q (N, n)."""
        slope, J = self._slopes(q)
        multipliers = -np.linalg.solve(J @ J.transpose(0, 2, 1), J @ slope[..., None])  # (N, 3, 1)
        num, n = q.shape
        K = np.zeros((num, n + 3, n + 3))
        K[:, :n, n:], K[:, n:, :n] = J.transpose(0, 2, 1), J
        for joint, step in enumerate(1j * COMPLEX_STEP * np.eye(n)):
            slope_, J_ = self._slopes(q + step)
            turned = slope_ + (J_.transpose(0, 2, 1) @ multipliers)[..., 0]
            K[:, :n, joint] = turned.imag / COMPLEX_STEP
        return slope + (J.transpose(0, 2, 1) @ multipliers)[..., 0], K

    def _slopes(self, q: Any) -> tuple[Array, Array]:  # noqa: ANN401, real or complex
        """Compute ∇h (N, n) and J (N, 3, n) at postures q (N, n), real or complex."""
        chain, reference, settings = self.robot.chain(q.T), self.reference, self.robot.sized_tracking
        excess = q - np.clip(q.real, *soft_limits(self.robot, reference))
        excess = np.where(excess.real == 0, 0, excess)
        turn = chain.direction - self.robot.hand_direction(reference)[:, None]
        slope = q - reference + settings.limit_weight * excess
        slope = slope + settings.direction_weight * np.einsum("irn,rn->ni", chain.direction_jacobian(), turn)
        return slope, chain.position_jacobian().transpose(2, 1, 0)


@dataclass(frozen=True, eq=False)
class Course:
    """An undisturbed motion from where the robot is to where it is to rest."""

    times: Array  # (K,) seconds
    q: Array  # (K, n) rad
    z: Array  # (K, k) base coordinates; the hand's place where nothing is learned

    @property
    def end(self) -> float:
        """Time at which it ends, seconds."""
        return float(self.times[-1])

    def at(self, clock: float) -> Array:
        """Posture (n,) at a time."""
        coefficients, begins = self._curve
        segment = max(bisect_right(begins, clock) - 1, 0)
        u = min(max(clock, begins[0]), self.end) - begins[segment]
        return np.array([u * u * u, u * u, u, 1.0]) @ coefficients[segment]

    def after(self, clock: float) -> Array:
        """Postures (K', n) from a time on, up to the end."""
        return np.concatenate([self.at(clock)[None], self.q[self.times > clock]])

    def between(self, clock: float, num: int) -> Array:
        """Postures (K', n) from a time on: `num` for each of its own samples."""
        samples = np.arange(len(self.times))
        times = np.interp(np.linspace(0, samples[-1], num * samples[-1] + 1), samples, self.times)
        return np.stack([self.at(time) for time in (clock, *times[times > clock])])

    def image(self, clock: float) -> Array:
        """Base coordinates (k,) at a time."""
        return np.array([np.interp(clock, self.times, z) for z in self.z.T])

    def slowed(self, limits: Array) -> Course:
        """Return it within limits (n,) of the joints' velocities, rad/s."""
        return replace(self, times=within_velocity_limits(self.times, self.q, limits))

    @cached_property
    def _curve(self) -> tuple[Array, list[float]]:
        """Coefficients (K − 1, 4, n) of a cubic in each segment, and where these begin."""
        h, slopes = np.diff(self.times)[:, None], np.gradient(self.q, self.times, axis=0)
        begin, end, mean = slopes[:-1], slopes[1:], np.diff(self.q, axis=0) / h
        bend = (begin + end - 2 * mean) / h
        return np.stack([bend / h, (mean - begin) / h - bend, begin, self.q[:-1]], axis=1), self.times[:-1].tolist()


@dataclass(frozen=True, eq=False)
class Progress:
    """How far a robot has come on its course."""

    course: Course
    clock: float = 0.0  # time of the course, seconds
    rate: float = 0.0  # that of its clock, relative to real time

    @property
    def q(self) -> Array:
        """(n,) undisturbed posture now, rad."""
        return self.course.at(self.clock)

    @property
    def image(self) -> Array:
        """(k,) base coordinates now."""
        return self.course.image(self.clock)

    @property
    def ahead(self) -> Array:
        """(K, n) undisturbed postures from now on, rad."""
        return self.course.after(self.clock)

    @property
    def ended(self) -> bool:
        """Whether it is at the end of its course."""
        return self.clock >= self.course.end

    def advanced(self, rate: float, dt: float, ramp: float) -> Progress:
        """Let `dt` seconds pass; the clock's rate approaches another one, and takes `ramp` seconds from 0 to 1."""
        rate = self.rate + min(max(rate - self.rate, -dt / ramp), dt / ramp)
        return replace(self, clock=min(self.clock + rate * dt, self.course.end), rate=rate)


def towards(
    system: DiffeomorphicSystem,
    section: Section,
    q: Array,
    state: Array,
    settings: ControllerSettings,
    z: Array | None = None,
    poses: AugmentedImitation | None = None,
) -> Course:
    """Make the motion of a system that a robot follows on a section, onto which it converges.

    With Q the section and x(t) the exact motion of the system it is q(t) = Q(x(t)) + δ·exp(−t/τ), δ = q − Q(x(0)).

    Args:
        system: of the end effector.
        section: the postures on which it is followed.
        q: (n,) where the robot is, rad.
        state: (k,) in which the hand is.
        settings: τ, and how a course is sampled.
        z: (k,) base coordinates to begin from; None are those of the state.
        poses: gives the orientations of the hand; None wants none.
    """
    robot, base, convergence = section.robot, system.base, settings.convergence
    z0 = system.transform.forward(state) if z is None else z
    rays = Rays(z0[None], base)
    if base.distance(z0) < ARRIVED:
        times, fractions = np.zeros(1), np.ones(1)
        path = system.transform.inverse(rays.at(np.zeros(1, int), fractions))[:, :3]
    else:
        evaluate = lambda i, u: system.transform.inverse(rays.at(i, u))[:, None, :3]  # noqa: E731
        bundle = evenly_sampled(evaluate, 1, settings.num_samples)
        times, fractions, path = rays.times(bundle.index, bundle.fraction), bundle.fraction, bundle.positions
    # from the end, which is near a known posture, backwards: the beginning may be far from the section's branch
    along = rays.at(np.zeros(len(fractions), int), fractions)
    wanted = None if poses is None else poses.predicted(along[::-1, 3:])
    near = section.nearest(path[-1])
    joints = track(robot, path[::-1], near, reference=section.reference, orientations=wanted).q[::-1]
    turns = np.where(np.isinf(robot.lower), np.round((q - joints[0]) / (2 * np.pi)), 0.0)
    offset = q - joints[0] - 2 * np.pi * turns
    converged = convergence * np.log(max(float(np.abs(offset).max()) / settings.converged, 1.0))
    period = settings.settling_period
    longer = times[-1] + np.arange(period, max(converged - times[-1], period) + period / 2, period)
    times = np.concatenate([times, longer])
    joints, along = (np.concatenate([part, np.repeat(part[-1:], len(longer), 0)]) for part in (joints, along))
    joints = joints + 2 * np.pi * turns + offset * np.exp(-times / convergence)[:, None]
    return Course(times, joints, along)


def resting(robot: Robot, q: Array) -> Course:
    """Stay at a posture (n,)."""
    joints = np.stack([q, q])
    return Course(np.array([0.0, 1e-2]), joints, robot.end_effector(joints))


def straight_to(place: Array, section: Section, q: Array, limits: JointLimits, speed: float) -> Course:
    """Take the hand from a posture (n,) straight to a place (3,), metres, at a speed, m/s."""
    robot = section.robot
    begin = robot.end_effector(q)
    u = np.linspace(0, 1, 2 + int(np.linalg.norm(place - begin) / 0.02))  # a sample every 2 cm
    path = begin + u[:, None] * (place - begin)
    joints = limits.inside(track(robot, path, q, reference=section.reference).q)
    lengths = np.linalg.norm(np.diff(robot.end_effector(joints), axis=0), axis=1)
    return Course(np.cumsum([0.0, *np.maximum(lengths / speed, 0.01)]), joints, path)


def shoved(progress: Progress, robot: Robot, end: Array, seconds: float) -> Course:
    """Go on for some seconds, and meanwhile be displaced from the posture now to another one (n,)."""
    u = np.linspace(0, 1, 9)
    goes_on = np.stack([progress.course.at(progress.clock + progress.rate * t) for t in seconds * u])
    joints = goes_on + (u * u * (3 - 2 * u))[:, None] * (end - progress.q)
    return Course(seconds * u, joints, robot.end_effector(joints))
