"""The robot in the loop: its joint velocity is that of the newest stack at the posture where it is, within limits.

With ψ_q the robot's dodge, Q the section of postures and ψ the end effector's stack, a robot at p is at q = ψ_q(p),
x = x(q) and z = ψ(x) of the base attractor (`dt_viz.arm.arm_system`). ψ is a conjugacy, so all that lies ahead is known
at once: z(t) in closed form, x(t) = ψ⁻¹(z(t)), and

    p(t) = ψ_q⁻¹(Q(x(t)) + δ·exp(−t/τ)),    δ = q − Q(x(q)),

which on the section, δ = 0, is the motion of eq. (4), and from anywhere else converges to it. It is worked out when the
stack or the state changes; a tick samples it, and closes what gap there is as fast as the limits allow.

When ψ_q changes with time, q stays and its image moves: ṗ has the part ∂ψ_q⁻¹/∂t, too, by which an obstacle that
approaches moves the robot, at rest as well, and lets it come back. A robot that is behind its image waits with z(t).
Whoever moves the robot by hand changes q, by ψ_q(p) at the place where it is then.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from dt_viz.arm.arm_system import ArmSystem, Section
from dt_viz.arm.cspace import LEVERS
from dt_viz.arm.retiming import RAMP, within_velocity_limits
from dt_viz.arm.robot import NUM_JOINTS
from dt_viz.arm.tracking import track
from dt_viz.arm.whole_arm import ROUNDING
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED, Rays, evenly_sampled
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.motion.anticipation import NOTHING_SEEN, STALE, Sighting
from dt_viz.motion.dodging import NO_DODGE, Dodge, dodge, lack
from dt_viz.motion.following import Follower
from dt_viz.motion.guarding import WINDOW, guarded, is_allowed
from dt_viz.motion.solve import Solved
from dt_viz.transforms.base import ArmAvoidance

ACCELERATION = 4.0
"""Limit of the joints' acceleration, rad/s². The arm's URDF names none; chosen so that joints reach their limits of
velocity, 0.63 and 0.84 rad/s, within about 0.2 s."""
VELOCITY_SHARE = 0.85
"""Part of the velocity limits that the motion ahead uses: the rest closes gaps."""
BRAKING_SHARE = 0.7
"""Part of the acceleration that a gap is closed with, so that braking never takes more than there is."""
STIFFNESS = 10.0
"""Rate at which a small gap closes, 1/s."""
GAP = 0.05
"""Gap of a joint, rad, at which the motion goes on at half its pace."""
LOST, LOOKING = 0.15, 0.3
"""Gap of a joint, rad, from which on the robot begins anew where it is, since the way to where it should be may lead
through the obstacle; and shortest time between two such beginnings, seconds."""
FORESEEN = 25
"""Number of steps that are foreseen at once while nothing changes."""
EXACT = 1e-9
"""Deviation of a joint from where it was sent, rad, that is rounding."""
MOVED = 5e-3
"""Deviation of a joint from where it was sent, rad, from which on somebody else has moved the robot."""
CONVERGENCE = 0.5
"""Time constant τ of the convergence to the section, seconds."""
CONVERGED = 1e-5
"""Distance from the section, rad, that counts as none."""
SETTLING = 0.1
"""Spacing of the samples, seconds, in which a robot that has arrived still converges."""
NUM_SAMPLES = 80
"""Samples of the motion ahead."""
NUM_HOSTS = 40
"""Samples of it that the dodge is made for."""
LEAD = 0.13
"""Time by which moving obstacles are anticipated, seconds: that until a stack takes over, and until the joints have the
speed at which the way out moves."""
ROOM = 0.1
"""Growth of the margin with an obstacle's speed, m per m/s."""
PASSING = 0.25
"""Way of a moving obstacle, metres, after which it counts as having passed: what the robot does later is not dodged."""
TURNING = 2.0
"""Rate at which the way out of an obstacle turns, rad/s."""
HOMING_SPEED = 2.0
"""Speed of the way home, relative to that of the base attractor."""
HOLDING_SPEED = 0.25
"""Speed at which the hand follows whoever holds it, m/s."""
SHOVE_SECONDS = 0.3
"""Duration of a shove, if the joints can be as fast."""
AT_REST = 1e-3
"""Gap, rad, and velocity, rad/s, of joints that count as at rest."""
FASTEST_POINT = 1.0
"""Speed that no point of the arm exceeds, m/s."""
TOUCHING = 5e-3
"""Depth of a body point's sphere, less what it sticks out of the arm, that counts as touching, metres."""
ASIDE = 5e-3
"""Displacement, metres by `LEVERS`, from which on a robot at rest counts as having stepped aside."""


class Phase(Enum):
    """What the robot is doing."""

    MOVING = "moving"
    HOMING = "going home"
    RESTING = "resting"
    ASIDE = "stepped aside"
    HELD = "held"
    TOUCHED = "touched"
    """An obstacle touches it, or leaves no way out: it waits where it is or gives way."""


class Aim(Enum):
    """Where the robot is to go."""

    GOAL = "goal"
    HOME = "home"
    HAND = "hand"


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

    def before(self, clock: float) -> int:
        """Number of the last sample up to a time, with another one after it."""
        return int(np.clip(np.searchsorted(self.times, clock, side="right") - 1, 0, len(self.times) - 2))

    def at(self, clock: float) -> Array:
        """The posture (6,) at a time."""
        return np.array([np.interp(clock, self.times, joint) for joint in self.q.T])

    def where_left(self, distance: Array, section: Section) -> Array:
        """The postures (N, 6) at distances (N,) from the end in base coordinates, unwound to a section's."""
        along = np.linalg.norm(self.z - self.z[-1], axis=1)[::-1]
        turns = np.where(np.isinf(section.robot.lower), np.round((self.q[-1] - section.reference) / (2 * np.pi)), 0.0)
        return np.stack([np.interp(distance, along, joint) for joint in self.q[::-1].T], axis=1) - 2 * np.pi * turns


class Ahead:
    """The motion ahead: the image of a course under ψ_q⁻¹, slowed down to the joints' limits."""

    def __init__(self, course: Course, dodge: Dodge, p: Array, limits: Array) -> None:
        """Take the images p (K', 6) of the last K' samples of the course, rad."""
        self.course, self.dodge, self.p = course, dodge, p
        self.times = course.times[-len(p) :]
        slowed = within_velocity_limits(self.times, p, limits)
        self._pace = np.diff(self.times) / np.maximum(np.diff(slowed), 1e-12)
        # its coefficients instead of the spline itself: a tick asks for one moment, with hardly more than a product
        curve = CubicHermiteSpline(self.times, p, np.gradient(p, self.times, axis=0))
        self._coefficients, self._begins = curve.c.transpose(1, 0, 2), self.times[:-1].tolist()

    def at(self, clock: float) -> Array:
        """The posture (6,) at a time of the course."""
        segment = self._segment(clock)
        u = min(max(clock, self._begins[0]), self.times[-1]) - self._begins[segment]
        return np.array([u * u * u, u * u, u, 1.0]) @ self._coefficients[segment]

    def pace(self, clock: float) -> float:
        """Pace there, at most 1: seconds of the course in a second."""
        return float(self._pace[self._segment(clock)])

    def _segment(self, clock: float) -> int:
        return max(bisect_right(self._begins, clock) - 1, 0)


@dataclass(frozen=True, eq=False)
class Prepared:
    """How to go on with another stack."""

    solved: Solved
    section: Section
    sighting: Sighting
    begins: Ahead | None
    """The motion that it goes on from."""
    ahead: Ahead | None
    """None where that has to wait for the state at which it is taken."""


@dataclass(eq=False)
class Foreseen:
    """Some steps in a row in which nothing is due and nothing binds, while the motion ahead and the sighting last."""

    ahead: Ahead
    seen: Sighting
    dt: float
    """Seconds of a step."""
    postures: Array
    """(K, 6) before each step, rad."""
    velocities: Array
    """(K, 6) in each, rad/s."""
    clocks: list[float]
    """K + 1 times of the course, from before the first step to after the last one, seconds."""
    rates: list[float]
    """K + 1 rates at which these pass, in the same order."""
    rooms: Array | None
    """(K,) distance from the nearest obstacle at each posture, metres; None where none can be near."""
    done: int = 0
    """Number of steps that have been made."""


class Controller:
    """A robot's state and what it follows; `step` is for one thread, `follow` and the rest may come from another."""

    def __init__(
        self,
        follower: Follower,
        solved: Solved,
        acceleration: float = ACCELERATION,
        lead: float = LEAD,
        room: float = ROOM,
    ) -> None:
        """Take an arm and the stack that it follows first; its state is that of the first `step`.

        Args:
            follower: the arm.
            solved: as in `follow`.
            acceleration: limit for all joints, rad/s².
            lead: time by which moving obstacles are anticipated, seconds.
            room: growth of the margin with their speed, m per m/s.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        self.robot = follower.robot
        self.acceleration, self.lead, self.room = acceleration, lead, room
        self._arm, self._follower = follower.whole_arm, follower
        self._lock = threading.RLock()
        self._solved = solved
        self._sighting = self._seen = NOTHING_SEEN.then(solved.scenario.arm_avoidance, 0.0)
        """The obstacles that the dodge is made for, and where they were seen last."""
        self._section = Section(self.robot, follower.reference(solved.nominal))
        self._aim, self._then = Aim.GOAL, Aim.GOAL
        self._home: int | None = None
        """Number of the rollout whose start it goes home to, and whose pattern it draws from there; None draws that of
        the nearest demonstration."""
        self._rest: Array | None = None
        """What else the state was, besides the place, when it last went to the goal: phase and condition of an
        augmented one; None where it begins anew."""
        self._ahead: Ahead | None = None
        self._q: Array | None = None
        self._velocity = np.zeros(NUM_JOINTS)
        self._clock = self._rate = 0.0
        self._now = self._dodged = self._began = self._safe_until = 0.0
        self._room = np.inf
        """Distance from the nearest obstacle when it was last looked at, about, metres."""
        self._settled = self._released = False
        self._known: Foreseen | None = None
        """The steps that were foreseen last."""

    # --- What it follows ---

    def follow(self, solved: Solved) -> None:
        """Go on with another stack from the next tick on, where the robot is then.

        The end effector's stack is taken from it, and what the whole arm is to avoid; the arm's dodge is made for the
        robot's own motion.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        self.take(self.prepared(solved))

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Take note of where the obstacles are, which is quick: nothing is touched before a stack takes over."""
        with self._lock:
            self._seen = self._seen.then(avoidance, self._now)
            self._safe_until, self._room = 0.0, np.inf

    def prepared(self, solved: Solved) -> Prepared:
        """Work out how to go on with another stack, while ticks go on; see `follow`."""
        section = Section(self.robot, self._follower.reference(solved.nominal))
        with self._lock:
            begins, clock, alike = self._ahead, self._clock, self._goes_on(solved, section)
            turn = TURNING * (self._now - self._dodged)
            sighting = self._sighting.then(solved.scenario.arm_avoidance, self._now)
        if begins is None or not alike:
            return Prepared(solved, section, sighting, None, None)
        ahead = self._around(begins.course, clock, sighting, begins.dodge, turn)
        return Prepared(solved, section, sighting, begins, ahead)

    def take(self, prepared: Prepared) -> None:
        """Go on with what was prepared from the next tick on; what does not fit any more is worked out again."""
        with self._lock:
            before, solved = self._solved, prepared.solved
            alike = self._goes_on(solved, prepared.section)
            stays = np.array_equal(self._section.reference, prepared.section.reference)
            self._solved, self._section, self._sighting = solved, prepared.section, prepared.sighting
            if self._sighting.time >= self._seen.time:
                self._seen = self._sighting
                self._safe_until, self._room = 0.0, np.inf
            if self._ahead is None:
                return
            if prepared.ahead is not None and self._ahead is prepared.begins:
                self._ahead, self._dodged = prepared.ahead, self._now
            elif self._aim is Aim.HAND or alike:
                self._take(self._ahead.course)
            else:
                learned, course = before.below.system is solved.below.system, self._ahead.course
                z = self._image() if learned and self._aim is Aim.GOAL else None
                course = self._course(course.at(self._clock), z, course if stays else None)
                self._clock, self._settled = 0.0, False
                self._take(course)

    def _goes_on(self, solved: Solved, section: Section) -> bool:
        """Whether the undisturbed motion is the same with another stack."""
        before, after = self._solved.stack, solved.stack
        parts, others = (stack.parts for stack in (before, after))
        same = len(parts) == len(others) and all(a is b for a, b in zip(parts, others, strict=True))
        same = same and before.rays.base is after.rays.base
        return same and np.array_equal(self._section.reference, section.reference)

    @property
    def system(self) -> ArmSystem:
        """The system of eq. (4) whose motion it is."""
        with self._lock:
            stack, transform = self._solved.stack, Identity(NUM_JOINTS)
            rest = stack.rays.z0[0, 3:]
            if self._ahead is not None:
                transform = self._ahead.dodge.transform
                rest = self._image()[3:] if self._aim is Aim.GOAL else rest
            return ArmSystem(stack.at_phase(rest), self._section, transform)

    # --- What happens to it ---

    def begin(self, q: ArrayLike, rollout: int | None = None) -> None:
        """Begin at a posture (6,), rad, before the first tick: what lies ahead is known from then on.

        Args:
            q: the posture.
            rollout: number of the one that is begun, from 0; None leaves the pattern that is drawn as it is.
        """
        with self._lock:
            self._q, self._home = np.array(q, float), self._home if rollout is None else rollout
            self._anchor(self._q, NO_DODGE)

    def go(self) -> None:
        """Go to the goal from here."""
        self._set_out(Aim.GOAL)

    def home(self, start: int) -> None:
        """Go straight to the start of a rollout, counted from 0, around what is in the way."""
        with self._lock:
            self._home = start
            self._set_out(Aim.HOME)
            self._rest = None

    def hold(self, place: ArrayLike) -> None:
        """Take the hand to a place (3,), metres, and stay there until `release`, giving way to obstacles."""
        with self._lock:
            if self._ahead is None:
                return
            q = self._ahead.course.at(self._clock)
            begin, end = self.robot.end_effector(q), np.asarray(place, float)
            u = np.linspace(0, 1, 2 + int(np.linalg.norm(end - begin) / 0.02))
            path = begin + u[:, None] * (end - begin)
            joints = self._arm.limits.inside(track(self.robot, path, q, reference=self._section.reference).q)
            lengths = np.linalg.norm(np.diff(self.robot.end_effector(joints), axis=0), axis=1)
            times = np.concatenate([[0.0], np.cumsum(np.maximum(lengths / HOLDING_SPEED, 0.01))])
            self._held(Course(times, joints, path))

    def displace(self, q: ArrayLike) -> None:
        """Shove the robot towards a posture (6,), rad; it goes on from there."""
        with self._lock:
            if self._ahead is None:
                return
            begin = self._ahead.course.at(self._clock)
            end = self._arm.limits.inside(self._ahead.dodge.transform.forward(self._arm.limits.inside(np.asarray(q))))
            u = np.linspace(0, 1, 9)
            times, pace = SHOVE_SECONDS * u, self._rate * self._ahead.pace(self._clock)
            goes_on = np.stack([self._ahead.course.at(self._clock + pace * t) for t in times])
            joints = goes_on + (u * u * (3 - 2 * u))[:, None] * (end - begin)
            self._held(Course(times, joints, self.robot.end_effector(joints)), released=True)

    def release(self) -> None:
        """Let go of the hand: it goes on to where it was going."""
        with self._lock:
            if self._aim is Aim.HAND:
                self._set_out(self._then)

    # --- What it does ---

    def step(self, q: ArrayLike, dt: float) -> Array:
        """The joint velocities (6,), rad/s, for the next `dt` seconds of a robot at `q` (6,), rad.

        Raises:
            ValueError: q is not six finite angles, or dt is not above 0.
        """
        q = np.asarray(q, float)
        if q.shape != (NUM_JOINTS,) or not np.isfinite(q).all():
            raise ValueError(f"q: found {q}; accepted: {NUM_JOINTS} finite angles, rad")
        if not 0 < dt < np.inf:
            raise ValueError(f"dt: found {dt}; accepted: seconds, more than 0")
        with self._lock:
            self._known = None
            self._now += dt
            if self._q is None or np.abs(q - self._q).max() > MOVED:
                self._anchor(q, self._ahead.dodge if self._ahead is not None else NO_DODGE)
            if self._sighting.speed > 0 and self._now > self._sighting.time + STALE:
                self._sighting = self._sighting.then(self._sighting.avoidance, self._now)
                self._take(self._begun.course)
            self._advance(q, dt)
            ahead = self._begun
            before = ahead.at(self._clock)
            self._clock = min(self._clock + self._rate * ahead.pace(self._clock) * dt, ahead.course.end)
            wanted = (ahead.at(self._clock) - before) / dt + self._closing(before - q, dt)
            self._velocity = self._within_limits(q, self._guarded(q, wanted), dt)
            self._q = q + dt * self._velocity
            return self._velocity.copy()

    def steps(self, q: ArrayLike, dt: float, num: int) -> Array:
        """The joint velocities (num, 6), rad/s, of some steps in a row of a robot that does as it is told; see `step`.

        What goes on as foreseen is sampled, and held against limits and obstacles, all at once.
        """
        q = np.asarray(q, float)
        with self._lock:
            velocities = self._sampled(q, dt, num)
            if velocities is None:
                velocities = np.empty((num, NUM_JOINTS))
                for k in range(num):
                    velocities[k] = self.step(q, dt)
                    q = q + dt * velocities[k]
            return velocities

    @property
    def phase(self) -> Phase:
        """What it is doing."""
        ahead = self._ahead
        if ahead is None or self._q is None:
            return Phase.RESTING
        if not ahead.dodge.cleared or self._room < -TOUCHING:
            return Phase.TOUCHED
        if self._aim is Aim.HAND:
            return Phase.HELD
        if self._settled and np.linalg.norm((ahead.p[-1] - ahead.course.q[-1]) * LEVERS) > ASIDE:
            return Phase.ASIDE
        if self._settled and max(np.abs(self._velocity).max(), self._behind(self._q)) < AT_REST:
            return Phase.RESTING
        return Phase.HOMING if self._aim is Aim.HOME else Phase.MOVING

    @property
    def ahead(self) -> Array:
        """(K, 6) the postures ahead, from where its motion is now on, rad."""
        with self._lock:
            if self._ahead is None:
                return np.empty((0, NUM_JOINTS))
            later = self._ahead.p[self._ahead.times > self._clock]
            return np.concatenate([self._ahead.at(self._clock)[None], later])

    @property
    def left(self) -> float:
        """Part of its motion to the goal that is left, from 1 at a start to 0; 1 while it goes elsewhere."""
        with self._lock:
            base = self._solved.stack.rays.base
            if self._ahead is None or self._aim is not Aim.GOAL:
                return 1.0
            whole = float(base.left(self._solved.stack.rays.z0).max())
            return min(float(base.left(self._image())) / max(whole, ARRIVED), 1.0)

    @property
    def undisturbed(self) -> Array:
        """The posture (6,) at this moment of the motion without what is stacked on the learned one, rad."""
        with self._lock:
            ahead, solved = self._ahead, self._solved
            if ahead is None:
                return self._section.reference
            q = ahead.course.at(self._clock)
            if self._aim is not Aim.GOAL or not solved.stack.built:
                return q
            x = solved.below.learned.places(self._image()[None])
            return track(self.robot, x, q, reference=self._section.reference).q[0]

    @property
    def _begun(self) -> Ahead:
        """The motion ahead, after the first tick."""
        assert self._ahead is not None
        return self._ahead

    def _advance(self, q: Array, dt: float) -> None:
        """Begin what is due at a tick, and change the rate of the motion towards what the gap allows."""
        if not self._settled and self._clock >= self._begun.course.end:
            if self._released:
                self._set_out(self._then)
            else:
                self._settled = True
                self._take(self._begun.course)  # what was in the way of the motion need not be in that of its end
        behind = self._behind(q)
        if behind > LOST and self._now > self._began + LOOKING and self._aim is not Aim.HAND:
            self._anchor(q, NO_DODGE)
            self._began, behind = self._now, self._behind(q)
        target = 1 / (1 + (behind / GAP) ** 2) if self._begun.dodge.cleared else 0.0
        self._rate += min(max(target - self._rate, -dt / RAMP), dt / RAMP)

    def _behind(self, q: Array) -> float:
        """The largest gap of a joint, rad."""
        return float(np.abs(self._begun.at(self._clock) - q).max())

    def _closing(self, gap: Array, dt: float) -> Array:
        """Velocities (6,) that close a gap (6,), all joints together, so that the way is straight."""
        size = float(np.abs(gap).max())
        fastest = np.sqrt(2 * BRAKING_SHARE * self.acceleration * size)
        return gap * (min(min(STIFFNESS, 0.5 / dt) * size, fastest) / max(size, 1e-12))

    def _guarded(self, q: Array, wanted: Array) -> Array:
        """The velocities nearest to those wanted at which the arm comes into no obstacle."""
        sighting = self._seen
        if self._now < self._safe_until or not (wanted.any() or sighting.speed > 0 or np.isinf(self._room)):
            return wanted
        now = sighting.expected(min(self._now - sighting.time, STALE), 0.0)
        if now is None:
            return wanted
        wanted, room = guarded(self._arm, q, wanted, now, sighting.velocities)
        self._seen_from(room, self._now)
        return wanted

    def _within_limits(self, q: Array, wanted: Array, dt: float) -> Array:
        """The velocities nearest to those wanted that all limits allow."""
        lowest, highest = self._range(q, self._velocity, dt)
        change = np.minimum(np.maximum(wanted, lowest), highest) - self._velocity
        # all joints together: what lies between two velocities that touch nothing touches nothing
        return self._velocity + change * min(1.0, self.acceleration * dt / max(float(np.abs(change).max()), 1e-12))

    def _range(self, q: Array, velocity: Array, dt: float) -> tuple[Array, Array]:
        """The lowest and highest velocities (*B, 6) after others (*B, 6) at postures (*B, 6) that can stop in time."""
        braking, limits = 2 * BRAKING_SHARE * self.acceleration, self.robot.velocity_limits
        above = self.robot.upper - q - dt * np.maximum(velocity, 0)
        below = q + dt * np.minimum(velocity, 0) - self.robot.lower
        highest, lowest = (np.sqrt(braking * np.maximum(room, 0)) for room in (above, below))
        return -np.minimum(lowest, limits), np.minimum(highest, limits)

    def _sampled(self, q: Array, dt: float, num: int) -> Array | None:
        """The velocities (num, 6) of steps that go on as foreseen, which are made; None where something may be due."""
        known, at = self._known, self._q
        goes_on = known is not None and known.ahead is self._ahead and known.seen is self._seen and known.dt == dt
        as_told = at is not None and np.abs(q - at).max() < EXACT
        if known is None or not (goes_on and as_told and known.done + num <= len(known.velocities)):
            self._known = known = (self._foreseen(q, dt, FORESEEN) if goes_on else None) or self._foreseen(q, dt, num)
            if known is None:
                return None
        first = known.done
        known.done = last = first + num
        velocities = known.velocities[first:last]
        self._now, self._clock, self._rate = self._now + num * dt, known.clocks[last], known.rates[last]
        self._velocity, self._q = velocities[-1], known.postures[last - 1] + dt * velocities[-1]
        if known.rooms is not None and self._now >= self._safe_until:
            self._seen_from(float(known.rooms[last - 1]), self._now)
        return velocities.copy()

    def _foreseen(self, q: Array, dt: float, num: int) -> Foreseen | None:
        """Steps in which nothing is due and nothing binds; None where something may be."""
        ahead, seen = self._ahead, self._seen
        if ahead is None or self._q is None or not ahead.dodge.cleared or max(seen.speed, self._sighting.speed) > 0:
            return None
        stiffness, gap = min(STIFFNESS, 0.5 / dt), ahead.at(self._clock) - q
        size, linear = float(np.abs(gap).max()), 2 * BRAKING_SHARE * self.acceleration / stiffness**2
        if np.abs(q - self._q).max() > MOVED or not size < min(LOST, linear):
            return None
        closed = (1 - stiffness * dt) ** np.arange(num)
        rates, clocks = [self._rate], [self._clock]
        for part in closed.tolist():
            rate = rates[-1]
            rates.append(rate + min(max(1 / (1 + (part * size / GAP) ** 2) - rate, -dt / RAMP), dt / RAMP))
            clocks.append(min(clocks[-1] + rates[-1] * ahead.pace(clocks[-1]) * dt, ahead.course.end))
        if not self._settled and clocks[-1] >= ahead.course.end:
            return None
        p, gaps = np.array([ahead.at(clock) for clock in clocks]), closed[:, None] * gap
        postures, velocities = p[:-1] - gaps, np.diff(p, axis=0) / dt + stiffness * gaps
        before = np.concatenate([self._velocity[None], velocities[:-1]])
        lowest, highest = self._range(postures, before, dt)
        binds = np.abs(velocities - before).max() > self.acceleration * dt
        if binds or (velocities < lowest).any() or (velocities > highest).any():
            return None
        rooms, now = None, self._now + num * dt
        if seen.avoidance is not None and now >= self._safe_until and (velocities.any() or np.isinf(self._room)):
            allowed, rooms = is_allowed(self._arm, postures, velocities, seen.avoidance, seen.velocities)
            if not allowed:
                return None
        return Foreseen(ahead, seen, dt, postures, velocities, clocks, rates, rooms)

    def _seen_from(self, room: float, now: float) -> None:
        """Take note of the distance from the nearest obstacle, metres, and of how long none can be near for sure."""
        self._room = room
        self._safe_until = now + (room - WINDOW) / (FASTEST_POINT + self._seen.speed)

    # --- The motion ahead ---

    def _anchor(self, q: Array, known: Dodge) -> None:
        """Begin at a posture (6,) that nobody foresaw, as the image of another under a dodge."""
        shadow = known.transform.forward(self._arm.limits.inside(q))
        resting = self._aim is Aim.HAND
        self._remember()
        course = _resting(shadow, self.robot.end_effector(shadow)) if resting else self._course(shadow)
        self._clock, self._settled = 0.0, False
        self._take(course, known)
        avoidance = self._sighting.avoidance
        if avoidance is not None and lack(self._arm, self._begun.p, avoidance, course.q[-1]).max() > ROUNDING:
            self._take(course)  # it was made for another motion

    def _set_out(self, aim: Aim) -> None:
        with self._lock:
            self._remember()
            self._aim, self._settled, self._released = aim, False, False
            if self._ahead is not None:
                course = self._course(self._ahead.course.at(self._clock))
                self._clock = 0.0
                self._take(course)

    def _held(self, course: Course, *, released: bool = False) -> None:
        self._remember()
        if self._aim is not Aim.HAND:
            self._then = self._aim
        self._aim, self._settled, self._released = Aim.HAND, False, released
        self._clock = 0.0
        self._take(course)

    def _image(self) -> Array:
        """The base coordinates (k,) at which the motion is."""
        course = self._begun.course
        return np.array([np.interp(self._clock, course.times, z) for z in course.z.T])

    def _remember(self) -> None:
        """Take note of phase and condition before the motion to the goal is left."""
        if self._aim is Aim.GOAL and self._ahead is not None:
            self._rest = self._image()[3:]

    def _take(self, course: Course, known: Dodge | None = None) -> None:
        """Follow a course from the clock on, around what is in the way."""
        before = self._ahead.dodge if self._ahead is not None else NO_DODGE
        if known is None:
            turn = TURNING * (self._now - self._dodged)
            self._ahead, self._dodged = self._around(course, self._clock, self._sighting, before, turn), self._now
        else:
            p = known.transform.inverse(self._arm.limits.inside(course.q))
            self._ahead = Ahead(course, known, p, VELOCITY_SHARE * self.robot.velocity_limits)

    def _around(self, course: Course, clock: float, sighting: Sighting, before: Dodge, turn: float) -> Ahead:
        """The motion ahead on a course, with a dodge that is made for it."""
        first, speed = course.before(clock), sighting.speed
        times = course.times[first:]
        hosts = times <= max(clock + (PASSING / speed if speed > 0 else np.inf), times[1])
        hosts[2:] &= np.arange(2, len(times)) % max(1, int(hosts.sum()) // NUM_HOSTS) == 0
        avoidance = sighting.expected(self.lead, self.room)
        known, p = dodge(self._arm, course.q[first:], hosts, avoidance, sighting.velocities, before, turn)
        return Ahead(course, known, p, VELOCITY_SHARE * self.robot.velocity_limits)

    def _course(self, q: Array, z: Array | None = None, near: Course | None = None) -> Course:
        """The undisturbed motion from a posture (6,) to where it is to go; see `_towards`."""
        stack, nominal = self._solved.stack, self._solved.nominal
        stacked = stack.stacked
        hand = self.robot.end_effector(q)
        if self._aim is Aim.HOME:
            start = stacked.forward(nominal.starts[(self._home or 0) % len(nominal.starts)])
            base = Attractor(start, HOMING_SPEED * stack.rays.base.speed, stack.rays.base.smoothing)
            return _towards(DiffeomorphicSystem(stacked, base), self._section, q, hand, z, near)
        base, images = stack.rays.base, stack.rays.z0
        state = base.states(hand) if self._home is None else base.states_like(hand, images[self._home % len(images)])
        if self._rest is not None and len(self._rest) == len(state) - 3:
            state = base.caught(np.concatenate([hand, self._rest]), stacked.forward(hand))
        return _towards(stack.system, self._section, q, state, z, near)


def _towards(
    system: DiffeomorphicSystem,
    section: Section,
    q: Array,
    state: Array,
    z: Array | None = None,
    near: Course | None = None,
) -> Course:
    """The motion of a system that a robot follows on a section, onto which it converges.

    Args:
        system: of the end effector.
        section: the postures on which it is followed.
        q: (6,) where the robot is, rad.
        state: (k,) in which the hand is.
        z: (k,) base coordinates to begin from; None are those of the state.
        near: a motion of another system on that section, whose postures are looked for first.
    """
    robot, base = section.robot, system.base
    lower = robot.lower
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
    turns = np.where(np.isinf(lower), np.round((q - joints[0]) / (2 * np.pi)), 0.0)
    offset = q - joints[0] - 2 * np.pi * turns
    converged = CONVERGENCE * np.log(max(float(np.abs(offset).max()) / CONVERGED, 1.0))
    longer = times[-1] + np.arange(SETTLING, max(converged - times[-1], SETTLING) + SETTLING / 2, SETTLING)
    times = np.concatenate([times, longer])
    joints, along = (np.concatenate([part, np.repeat(part[-1:], len(longer), 0)]) for part in (joints, along))
    joints = joints + 2 * np.pi * turns + offset * np.exp(-times / CONVERGENCE)[:, None]
    return Course(times, joints, along)


def _resting(q: Array, hand: Array) -> Course:
    return Course(np.array([0.0, 1e-2]), np.stack([q, q]), np.stack([hand, hand]))
