"""The robot in the loop: one law for where it is to be, one quadratic programme a tick for how it gets there.

With q(t) the course, the undisturbed motion of the joints, and ψ_q the flow around obstacles, made for where these will
be, the robot's target is p(t) = ψ_q⁻¹(q(t)): while nothing moves, the motion of eq. (4) lifted to the joints
(`control.arm_system`). Each tick finds the velocity nearest to ṗ + g·(p − robot) among those that the limits allow
(`dt_viz.control.limits`). The clock of the course waits in proportion to the gap, so that a robot that had to give way
takes up its motion where it left it. Home, hold and shove are other courses of the same loop.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import daqp
import numpy as np
from numpy.typing import ArrayLike

from dt_viz.avoidance.arm_field import LEVERS
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.arm_system import ArmSystem, Section
from dt_viz.control.clearing import Clearing, clearing
from dt_viz.control.courses import Course, resting, towards
from dt_viz.control.dodging import Dodge
from dt_viz.control.limits import AccelerationLimit, ContactLimit, ObstacleLimit, RangeLimit, VelocityLimit
from dt_viz.control.obstacle_motion import NOTHING_SEEN
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import Solved
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import NUM_JOINTS

MOVED = 5e-3
"""Deviation of a joint from where it was sent, rad, from which on somebody else has moved the robot."""
AT_REST = 1e-3
"""Gap, rad, and velocity, rad/s, of joints that count as at rest."""
NEARLY = 0.01
"""Distance from the end of a joint's range, rad, that counts as being there."""
NUM_CLEAR, NUM_CLEAR_MOVING = 40, 10
"""Numbers of postures of the motion ahead that are to be clear of obstacles, at rest and moving."""
TOUCHING = 5e-3
"""Depth of a body point's sphere, less what it sticks out of the arm, that counts as touching, metres."""
ASIDE = 5e-3
"""Displacement, metres by `LEVERS`, from which on a robot at rest counts as having stepped aside."""
RAMP = 0.3
"""Shortest time in which the clock comes to its pace, seconds."""
SOFT = 8
"""Mark of a row of the quadratic programme that may be violated where there is no other way."""


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


class ArmController:
    """A robot's state and what it follows; `step` is for one thread, `follow` and the rest may come from another."""

    def __init__(self, follower: Follower, solved: Solved, settings: ControllerSettings | None = None) -> None:
        """Take an arm and the stack that it follows first; its state is that of the first `step`.

        Args:
            follower: the arm.
            solved: as in `follow`.
            settings: None are the defaults.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        self.settings = settings or ControllerSettings()
        self.robot = robot = follower.robot
        self._arm, self._follower = follower.whole_arm, follower
        self._limits = (
            RangeLimit(robot, self.settings.acceleration),
            VelocityLimit(robot.velocity_limits),
            AccelerationLimit(self.settings.acceleration),
        )
        self._barrier = ObstacleLimit(
            self._arm, self.settings.clearance, self.settings.barrier_gain, self.settings.barrier_reach
        )
        self._contacts = tuple(
            make(robot, follower.body, self.settings.clearance, self.settings.contact_gain)
            for make in (ContactLimit.table, ContactLimit.itself)
        )
        self._kept: tuple[Array, ...] = ()
        """Distances that are kept, for each of these limits."""
        self._dodge, self._dodging = Dodge(self._arm, self.settings), None
        self._lock = threading.RLock()
        self._solved = solved
        self._seen = NOTHING_SEEN.then(solved.scenario.arm_avoidance, 0.0, self.settings)
        self._section = Section(robot, follower.reference(solved.nominal))
        self._aim, self._then = Aim.GOAL, Aim.GOAL
        self._home: int | None = None
        """Number of the rollout whose start it goes home to, and whose pattern it draws from there; None draws that of
        the nearest demonstration."""
        self._rest: Array | None = None
        """What else the state was, besides the place, when it last went to the goal: phase and condition of an
        augmented one; None where it begins anew."""
        self._course: Course | None = None
        self._clock = self._rate = self._now = 0.0
        self._q: Array | None = None
        """Where the robot was sent."""
        self._at = self._velocity = np.zeros(NUM_JOINTS)
        """Where it was to be, rad, and its velocity, rad/s."""
        self._made_for: tuple[Course, Clearing, float, float] | None = None
        """Course, flow, duration and clock that it was to be there for."""
        self._clearing, self._duration = Clearing(), 0.0
        self._looked, self._changed = -np.inf, True
        """Time of the last look at obstacles, and whether something has changed since."""
        self._distance = np.inf
        """Distance from the nearest obstacle, about, metres."""
        self._settled = self._released = False
        self._tick: tuple[Array, Array, Array, list[tuple[Array, Array]]] | None = None
        """The last posture, the velocity that was wanted, the one that was allowed, and the rows of contacts."""

    # --- What it follows ---

    def follow(self, solved: Solved) -> None:
        """Go on with another stack from the next tick on, where the robot is then.

        The end effector's stack is taken from it, and what the whole arm is to avoid.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        section = Section(self.robot, self._follower.reference(solved.nominal))
        with self._lock:
            before, stays = self._solved, np.array_equal(self._section.reference, section.reference)
            alike = stays and _same_course(before, solved)
            self._solved, self._section, course = solved, section, self._course
            self.see(solved.scenario.arm_avoidance)
            if course is None or alike or self._aim is Aim.HAND:
                return
            learned = before.below.system is solved.below.system
            z = course.image(self._clock) if learned and self._aim is Aim.GOAL else None
            self._take(self._to_aim(course.at(self._clock), z, course if stays else None))

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Take note of where the obstacles are now."""
        with self._lock:
            self._seen, self._changed = self._seen.then(avoidance, self._now, self.settings), True

    def watch(self) -> None:
        """Look at the obstacles while no time passes: what lies ahead leads around them also while the robot stands."""
        with self._lock:
            if self._changed and self._course is not None:
                self._look()
                self._duration = self._clearing.duration

    @property
    def system(self) -> ArmSystem:
        """The system of eq. (4) whose motion it is."""
        with self._lock:
            stack, rest = self._solved.stack, self._solved.stack.rays.z0[0, 3:]
            if self._course is not None and self._aim is Aim.GOAL:
                rest = self._course.image(self._clock)[3:]
            return ArmSystem(stack.at_phase(rest), self._section, self._clearing.transform(self._arm, self._duration))

    # --- What happens to it ---

    def begin(self, q: ArrayLike, rollout: int | None = None) -> None:
        """Begin at a posture (6,), rad, before the first tick: what lies ahead is known from then on.

        Args:
            q: the posture.
            rollout: number of the one that is begun, from 0; None leaves the pattern that is drawn as it is.
        """
        with self._lock:
            self._q, self._home = np.array(q, float), self._home if rollout is None else rollout
            self._take(self._to_aim(self._q))
            self._look()
            self._duration = self._clearing.duration

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
            if self._course is None:
                return
            q = self._course.at(self._clock)
            begin, end = self.robot.end_effector(q), np.asarray(place, float)
            u = np.linspace(0, 1, 2 + int(np.linalg.norm(end - begin) / 0.02))
            path = begin + u[:, None] * (end - begin)
            joints = self._arm.limits.inside(track(self.robot, path, q, reference=self._section.reference).q)
            lengths = np.linalg.norm(np.diff(self.robot.end_effector(joints), axis=0), axis=1)
            times = np.cumsum([0.0, *np.maximum(lengths / self.settings.holding_speed, 0.01)])
            self._hand(Course(times, joints, path))

    def displace(self, q: ArrayLike) -> None:
        """Shove the robot towards a posture (6,), rad; it goes on from there."""
        with self._lock:
            if self._course is None:
                return
            inside, transform = self._arm.limits.inside, self._clearing.transform(self._arm, self._duration)
            begin, end = self._course.at(self._clock), inside(transform.forward(inside(np.asarray(q, float))))
            u = np.linspace(0, 1, 9)
            times = self.settings.shove_time * u
            goes_on = np.stack([self._course.at(self._clock + self._rate * t) for t in times])
            joints = goes_on + (u * u * (3 - 2 * u))[:, None] * (end - begin)
            self._hand(Course(times, joints, self.robot.end_effector(joints)), released=True)

    def release(self) -> None:
        """Let go of the hand: it goes on to where it was going."""
        with self._lock:
            if self._aim is Aim.HAND:
                self._set_out(self._then)

    # --- What it does ---

    def step(self, q: ArrayLike, dt: float) -> Array:
        """Compute the joint velocities (6,), rad/s, for the next `dt` seconds of a robot at `q` (6,), rad.

        Raises:
            ValueError: q is not six finite angles, or dt is not above 0.
        """
        q = np.array(q, float)
        if q.shape != (NUM_JOINTS,) or not np.isfinite(q).all():
            raise ValueError(f"q: found {q}; accepted: {NUM_JOINTS} finite angles, rad")
        if not 0 < dt < np.inf:
            raise ValueError(f"dt: found {dt}; accepted: seconds, more than 0")
        with self._lock:
            self._now += dt
            if self._q is None:
                self.begin(q)
            elif np.abs(q - self._q).max() > MOVED:
                self._moved_to(q)
            self._watch()
            self._ease(dt)
            course, now = self._begun, self._target()
            self._advance(float(np.abs(now - q).max()), dt)
            then = self._target()
            self._velocity = self._feasible(q, (then - now) / dt + min(self.settings.gain, 0.5 / dt) * (now - q), dt)
            self._q = q + dt * self._velocity
            self._settle(course)
            return self._velocity.copy()

    def steps(self, q: ArrayLike, dt: float, num: int) -> Array:
        """Compute the joint velocities (num, 6), rad/s, of some steps in a row of a robot that does as it is told."""
        q, velocities = np.array(q, float), np.empty((num, NUM_JOINTS))
        for k in range(num):
            velocities[k] = self.step(q, dt)
            q = q + dt * velocities[k]
        return velocities

    @property
    def phase(self) -> Phase:
        """What it is doing."""
        course, q = self._course, self._q
        if course is None or q is None:
            return Phase.RESTING
        if not self._clearing.cleared or self.touched:
            return Phase.TOUCHED
        if self._aim is Aim.HAND:
            return Phase.HELD
        if self._settled and np.linalg.norm((self._at - course.q[-1]) * LEVERS) > ASIDE:
            return Phase.ASIDE
        if self.rests and np.abs(q - self._at).max() < AT_REST:
            return Phase.RESTING
        return Phase.HOMING if self._aim is Aim.HOME else Phase.MOVING

    @property
    def rests(self) -> bool:
        """Whether the course has ended and the robot stands still, at its end or where a limit holds it."""
        return self._settled and bool(np.abs(self._velocity).max() < AT_REST)

    @property
    def touched(self) -> bool:
        """Whether an obstacle touches it."""
        return self._distance < -TOUCHING

    @property
    def held_back(self) -> str:
        """Which limit keeps it from where it is to go, in words; empty if none does."""
        if self._tick is None:
            return ""
        q, wanted, velocity, contacts = self._tick
        for limit, (slopes, bounds) in zip(self._contacts, contacts, strict=True):
            if ((slopes @ wanted < bounds - AT_REST) & (slopes @ velocity < bounds + AT_REST)).any():
                return f"kept from {limit.name}"
        room = np.where(wanted < 0, q - self.robot.lower, self.robot.upper - q)
        (ended,) = np.nonzero((room < NEARLY) & (np.abs(wanted) > AT_REST + np.abs(velocity)))
        return f"joint {ended[0] + 1} is at its limit" if len(ended) else ""

    @property
    def ahead(self) -> Array:
        """(K, 6) the postures ahead, from where its motion is now on, rad."""
        with self._lock:
            if self._course is None:
                return np.empty((0, NUM_JOINTS))
            transform = self._clearing.transform(self._arm, self._duration)
            return transform.inverse(self._arm.limits.inside(self._course.after(self._clock)))

    @property
    def left(self) -> float:
        """Part of its motion to the goal that is left, from 1 at a start to 0; 1 while it goes elsewhere."""
        with self._lock:
            base = self._solved.stack.rays.base
            if self._course is None or self._aim is not Aim.GOAL:
                return 1.0
            whole = float(base.left(self._solved.stack.rays.z0).max())
            return min(float(base.left(self._course.image(self._clock))) / max(whole, ARRIVED), 1.0)

    @property
    def undisturbed(self) -> Array:
        """The posture (6,) at this moment of the motion without what is stacked on the learned one, rad."""
        with self._lock:
            course, solved = self._course, self._solved
            if course is None:
                return self._section.reference
            q = course.at(self._clock)
            if self._aim is not Aim.GOAL or not solved.stack.built:
                return q
            x = solved.below.learned.places(course.image(self._clock)[None])
            return track(self.robot, x, q, reference=self._section.reference).q[0]

    @property
    def _begun(self) -> Course:
        """The course, after the first tick."""
        assert self._course is not None
        return self._course

    # --- Within a tick ---

    def _watch(self) -> None:
        """Look at the obstacles where that is due: every few ticks where they move, else after a change."""
        if self._seen.speed > 0 and self._now > self._seen.time + self.settings.stale:
            self.see(self._seen.avoidance)
        moving = self._seen.speed > 0
        if self._now >= self._looked + self.settings.look_period and (moving or self._changed):
            self._look()

    def _look(self) -> None:
        """Find the way around obstacles for the motion that is ahead."""
        course, seen, settings = self._begun, self._seen, self.settings
        turn = settings.turning * min(self._now - self._looked, 1.0)
        if seen.speed > 0:
            late = self._now - seen.time
            avoidance = seen.expected(settings.lead + late, settings.room, settings.returning)
            last = min(self._clock + settings.window, course.end)
            times = np.unique(np.linspace(self._clock, last, NUM_CLEAR_MOVING))
            ahead, end = np.stack([course.at(clock) for clock in times]), None
        else:
            avoidance, ahead = seen.avoidance, course.after(self._clock)
            ahead, end = ahead[:: max(1, len(ahead) // NUM_CLEAR)], self._arm.limits.inside(ahead[-1])
        self._clearing = clearing(self._arm, ahead, avoidance, seen.velocities, self._clearing, turn, end)
        self._looked, self._changed = self._now, False

    def _ease(self, dt: float) -> None:
        """Change the duration of the flow towards that which clears the motion ahead."""
        rise = self._clearing.duration - self._duration
        self._duration += min(max(rise, -self.settings.easing * dt), 2 * self.settings.easing * dt)

    def _target(self) -> Array:
        """The posture (6,) where the robot is to be at this time of the course."""
        made_for = self._begun, self._clearing, self._duration, self._clock
        if made_for != self._made_for:
            q, transform = self._begun.at(self._clock), self._clearing.transform(self._arm, self._duration)
            self._at = transform.inverse(self._arm.limits.inside(q)[None])[0] if self._duration > 0 else q
            self._made_for = made_for
        return self._at

    def _advance(self, gap: float, dt: float) -> None:
        """Move the clock on, at a rate that falls with the gap (rad) between the robot and its target."""
        rate = max(0.0, 1 - gap / self.settings.patience) if self._clearing.cleared else 0.0
        self._rate += min(max(rate - self._rate, -dt / RAMP), dt / RAMP)
        self._clock = min(self._clock + self._rate * dt, self._begun.end)

    def _feasible(self, q: Array, wanted: Array, dt: float) -> Array:
        """Find the velocity (6,) nearest to the wanted one that all limits allow, or that dodges what moves."""
        lower, upper = np.full(NUM_JOINTS, -np.inf), np.full(NUM_JOINTS, np.inf)
        for limit in self._limits:  # the last one's bounds, of acceleration, come first
            lowest, highest = limit.bounds(q, self._velocity, dt)
            lower, upper = _within(lower, lowest, highest), _within(upper, lowest, highest)
        contacts = [limit.rows(q, kept, dt) for limit, kept in zip(self._contacts, self._kept, strict=True)]
        seen, late = self._seen, self._now - self._seen.time
        there = replace(seen, avoidance=seen.expected(late, 0.0, self.settings.returning))
        *barrier, self._distance = self._barrier.rows(q, there, dt)
        velocity = _nearest(wanted, lower, upper, [*contacts, barrier])
        self._tick = q, wanted, velocity, contacts
        floor = float(self._kept[0].min())
        self._dodging = self._dodge.chosen(q, self._velocity, velocity, self._dodging, seen, late, floor)
        return velocity if self._dodging is None else _nearest(self._dodging, lower, upper, contacts)

    def _settle(self, course: Course) -> None:
        """Take note of the end of a course, and go on from a shove."""
        if self._settled or self._clock < course.end:
            return
        if self._released:
            self._set_out(self._then)
        else:
            self._settled = self._changed = True  # what was in the way of the motion need not be in that of its end

    # --- Courses ---

    def _moved_to(self, q: Array) -> None:
        """Begin anew where somebody else has moved the robot, as the image of the undisturbed motion there."""
        inside, transform = self._arm.limits.inside, self._clearing.transform(self._arm, self._duration)
        shadow = transform.forward(inside(q))
        self._q = q
        self._remember()
        at_hand = self._aim is Aim.HAND
        self._take(resting(shadow, self.robot.end_effector(shadow)) if at_hand else self._to_aim(shadow))

    def _set_out(self, aim: Aim) -> None:
        with self._lock:
            self._remember()
            pushed = self._aim is Aim.HAND
            self._aim, self._released = aim, False
            if self._course is not None:
                self._take(self._to_aim(self._course.at(self._clock)), pushed=pushed)

    def _hand(self, course: Course, *, released: bool = False) -> None:
        self._remember()
        if self._aim is not Aim.HAND:
            self._then = self._aim
        self._aim, self._released = Aim.HAND, released
        self._take(course, pushed=True)

    def _remember(self) -> None:
        """Take note of phase and condition before the motion to the goal is left."""
        if self._aim is Aim.GOAL and self._course is not None:
            self._rest = self._course.image(self._clock)[3:]

    def _take(self, course: Course, *, pushed: bool = False) -> None:
        """Follow a course from its beginning; one that a push leads to comes no nearer to the table than before."""
        if not pushed or not self._kept:
            self._kept = tuple(limit.kept(course.q) for limit in self._contacts)
        self._course = course.slowed(self.settings.course_speed * self.robot.velocity_limits)
        self._clock, self._settled, self._changed = 0.0, False, True

    def _to_aim(self, q: Array, z: Array | None = None, near: Course | None = None) -> Course:
        """Make the undisturbed motion from a posture (6,) to where it is to go; see `towards`."""
        stack, nominal, settings = self._solved.stack, self._solved.nominal, self.settings
        hand = self.robot.end_effector(q)
        if self._aim is Aim.HOME:
            start = stack.stacked.forward(nominal.starts[(self._home or 0) % len(nominal.starts)])
            base = Attractor(start, settings.homing_speed * stack.rays.base.speed, stack.rays.base.smoothing)
            system = DiffeomorphicSystem(stack.stacked, base)
            return towards(system, self._section, q, hand, settings.convergence, z, near)
        base, images = stack.rays.base, stack.rays.z0
        state = base.states(hand) if self._home is None else base.states_like(hand, images[self._home % len(images)])
        if self._rest is not None and len(self._rest) == len(state) - 3:
            state = base.caught(np.concatenate([hand, self._rest]), stack.stacked.forward(hand))
        return towards(stack.system, self._section, q, state, settings.convergence, z, near)


def _nearest(wanted: Array, lower: Array, upper: Array, rows: Sequence[Sequence[Array]]) -> Array:
    """Find the velocity nearest to a wanted one (6,), min ‖q̇ − q̇*‖².

    Bounds (6,) are hard; rows of slopes s and bounds b, s·q̇ ≥ b, give way where there is no other way.
    """
    nearest = _within(wanted, lower, upper)
    if all((slopes @ nearest >= bounds).all() for slopes, bounds in rows):
        return nearest
    slopes, bounds = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    solution, _, flag, _ = daqp.solve(
        np.eye(NUM_JOINTS),
        -wanted,
        np.ascontiguousarray(slopes),
        np.concatenate([upper, np.full(len(bounds), 1e30)]),
        np.concatenate([lower, bounds]),
        np.repeat(np.array([0, SOFT], np.int32), (NUM_JOINTS, len(bounds))),
    )
    return _within(solution if flag > 0 else np.zeros(NUM_JOINTS), lower, upper)


def _within(values: Array, lower: Array, upper: Array) -> Array:
    """Clip values (6,); for so few `np.clip` takes five times as long."""
    return np.minimum(np.maximum(values, lower), upper)


def _same_course(before: Solved, after: Solved) -> bool:
    """Whether the undisturbed motion is the same with another stack."""
    parts, others = before.stack.parts, after.stack.parts
    same = len(parts) == len(others) and all(a is b for a, b in zip(parts, others, strict=True))
    return same and before.stack.rays.base is after.stack.rays.base
