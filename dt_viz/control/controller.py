"""The robot in the loop: one law for where it is to be, one quadratic programme a tick for how it gets there.

With q(t) the course, the undisturbed motion of the joints, and ψ_q the flow around obstacles, made for where these will
be, the robot's target is p(t) = ψ_q⁻¹(q(t)): while nothing moves, the motion of eq. (4), lifted to the joints by a
section (`control.courses`). Each tick finds the velocity nearest to ṗ + g·(p − robot) among the feasible ones
(`control.feasible`). The clock of the course waits in proportion to the gap, so that a robot that had to give way takes
up its motion where it left it. Home, hold and shove are other courses of the same loop.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.courses import Course, Progress, Section, resting, shoved, straight_to, towards
from dt_viz.control.feasible import FeasibleVelocities, Tick
from dt_viz.control.obstacle_flow import ObstacleFlow
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import Solved
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import Robot, sized

STUCK = 0.95  # part of `ControllerSettings.patience`: a robot so far from its course may be stuck
WAITING = 2.0  # seconds after which it is


class Phase(Enum):
    """What the robot is doing."""

    MOVING = "moving"  # to the goal
    HOMING = "going home"
    RESTING = "resting"
    ASIDE = "stepped aside"
    HELD = "held"
    TOUCHED = "touched"  # an obstacle touches it, or leaves no way out


@dataclass(frozen=True, eq=False)
class Activity:
    """What the robot was told to do."""

    heading: Phase = Phase.MOVING  # where it goes, to the goal or home, also once it is released
    held: bool = False  # whether its hand is held, so that it stays at the end of its course
    let_go: bool = False  # whether the hand is released there
    rollout: int | None = None
    """Number of the rollout whose start it goes home to, and whose pattern it draws from there; None draws that of the
    nearest demonstration."""
    rest: Array | None = None
    """What the state was, besides the place, when it last went to the goal: phase and condition of an augmented one;
    None where it begins anew."""

    @property
    def seeks_goal(self) -> bool:
        """Whether it is on its way to the goal."""
        return self.heading is Phase.MOVING and not self.held


class ArmController:
    """A robot's state and what it follows; `step` is for one thread, `follow` and the rest may come from another."""

    def __init__(
        self, follower: Follower, solved: Solved, settings: ControllerSettings | None = None, rollout: int | None = None
    ) -> None:
        """Take an arm and the stack that it follows first; its state is that of the first `step`.

        It begins the rollout of this number, from 0; None draws the pattern of the nearest demonstration.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        self.settings = settings = sized(settings or ControllerSettings(), follower.robot.size)
        self._follower, self._solved, self._lock = follower, solved, threading.RLock()
        self._section = _section(follower, solved)
        self._flow = ObstacleFlow(follower.whole_arm, solved.scenario.arm_avoidance, settings)
        self._feasible = FeasibleVelocities(follower.whole_arm, settings)
        self._activity = Activity(rollout=rollout)
        self._progress: Progress | None = None
        self._q: Array | None = None  # (n,) where the robot was sent, rad
        self._tick: Tick | None = None
        self._late = 0.0  # seconds for which the robot has been far from its course

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self._follower.robot

    # --- What it follows ---

    def follow(self, solved: Solved) -> None:
        """Go on with another stack from the next tick on, where the robot is then.

        The end effector's stack is taken from it, and what the whole arm is to avoid.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        section = _section(self._follower, solved)
        with self._lock:
            before, progress, activity = self._solved, self._progress, self._activity
            stays = np.array_equal(self._section.reference, section.reference) and _same_course(before, solved)
            self._solved, self._section = solved, section
            self.see(solved.scenario.arm_avoidance)
            if progress is None or activity.held or stays:
                return
            learned = before.below.system is solved.below.system
            self._take(self._onwards(progress.q, progress.image if learned and activity.seeks_goal else None))

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Take note of where the obstacles are now."""
        with self._lock:
            self._flow.see(avoidance)

    def watch(self) -> None:
        """Look at the obstacles while no time passes: what lies ahead leads around them also while the robot stands."""
        with self._lock:
            if self._progress is not None:
                self._flow.settle(self._progress)

    # --- What it is told to do ---

    def begin(self, q: ArrayLike, rollout: int | None = None) -> None:
        """Begin at a posture (n,), rad, before the first tick: what lies ahead is known from then on.

        A rollout takes the place of the one that was begun with.
        """
        with self._lock:
            self._q = np.array(q, float)
            if rollout is not None:
                self._activity = replace(self._activity, rollout=rollout)
            self._take(self._onwards(self._q))
            self.watch()

    def go(self) -> None:
        """Go to the goal from here."""
        with self._lock:
            self._change(heading=Phase.MOVING)

    def home(self, start: int) -> None:
        """Go straight to the start of a rollout, counted from 0, around what is in the way."""
        with self._lock:
            self._change(heading=Phase.HOMING, rollout=start)
            self._activity = replace(self._activity, rest=None)

    def hold(self, place: ArrayLike) -> None:
        """Take the hand to a place (3,), metres, and stay there until `release`, giving way to obstacles."""
        with self._lock:
            if self._progress is not None:
                end, limits = np.asarray(place, float), self._follower.whole_arm.limits
                course = straight_to(end, self._section, self._progress.q, limits, self.settings.holding_speed)
                self._change(course, held=True)

    def displace(self, q: ArrayLike) -> None:
        """Shove the robot towards a posture (n,), rad; it goes on from there."""
        with self._lock:
            if self._progress is not None:
                end = self._follower.whole_arm.limits.inside(self._undisturbed_of(np.asarray(q, float)))
                course = shoved(self._progress, self.robot, end, self.settings.shove_time)
                self._change(course, held=True, let_go=True)

    def release(self) -> None:
        """Let go of the hand: it goes on to where it was going."""
        with self._lock:
            if self._activity.held:
                self._change()

    # --- What it does ---

    def step(self, q: ArrayLike, dt: float, *, looks: bool = True) -> Array:
        """Compute the joint velocities (n,), rad/s, for the next `dt` seconds of a robot at `q` (n,), rad.

        The flow around obstacles is made anew where that is due, unless it is told not to look.

        Raises:
            ValueError: q is not one finite angle for each joint, or dt is not above 0.
        """
        q, num = np.array(q, float), self.robot.num_joints
        if q.shape != (num,) or not np.isfinite(q).all():
            raise ValueError(f"q: found {q}; accepted: {num} finite angles, rad")
        if not 0 < dt < np.inf:
            raise ValueError(f"dt: found {dt}; accepted: seconds, more than 0")
        with self._lock:
            flow, settings = self._flow, self.settings
            flow.time += dt
            if self._q is None:
                self.begin(q)
            elif np.abs(q - self._q).max() > settings.displaced:
                self._moved_to(q)
            assert self._progress is not None
            before = self._progress
            flow.advance(before, dt, looks=looks)
            now = flow.image(before)
            gap = float(np.abs(now - q).max())
            rate = max(0.0, 1 - gap / settings.patience) if flow.cleared else 0.0
            self._progress = progress = before.advanced(rate, dt, settings.ramp)
            wanted = (flow.image(progress) - now) / dt + min(settings.gain, 0.5 / dt) * (now - q)
            self._tick = tick = self._feasible.tick(q, wanted, dt, self._tick, flow.seen, flow.late)
            self._q = q + dt * tick.velocity
            if progress.ended and not before.ended:
                if self._activity.let_go:
                    self.release()
                else:
                    flow.make(progress)  # what was in the way of the motion need not be in that of its end
            is_late = not progress.ended and self.is_calm and gap > STUCK * settings.patience
            self._late = self._late + dt if is_late else 0.0
            if self._late > WAITING:
                self._moved_to(self._q)  # a limit keeps it from its course, and waiting changes nothing
            return tick.velocity.copy()

    def steps(self, q: ArrayLike, dt: float, num: int) -> Array:
        """Compute the joint velocities (num, n), rad/s, of some steps in a row of a robot that does as it is told.

        Nothing new is seen between them, so that obstacles are looked at before the first one only.
        """
        q, velocities = np.array(q, float), np.empty((num, self.robot.num_joints))
        for k in range(num):
            velocities[k] = self.step(q, dt, looks=k == 0)
            q = q + dt * velocities[k]
        return velocities

    @property
    def phase(self) -> Phase:
        """What it is doing."""
        progress, q, tick, activity = self._progress, self._q, self._tick, self._activity
        if progress is None or q is None:
            return Phase.RESTING
        if not self._flow.cleared or self.touched:
            return Phase.TOUCHED
        if activity.held:
            return Phase.HELD
        if tick is not None and progress.ended and self._flow.is_settled:
            target = self._flow.image(progress)
            if np.linalg.norm((target - progress.course.q[-1]) * self.robot.levers) > self.settings.aside:
                return Phase.ASIDE
            if self.rests and np.abs(q - target).max() < self.settings.at_rest:
                return Phase.RESTING
        return activity.heading

    @property
    def heading(self) -> Phase:
        """Where it goes, to the goal or home, also when its hand is let go."""
        return self._activity.heading

    @property
    def rests(self) -> bool:
        """Whether the course has ended and the robot stands still, at its end or where a limit holds it."""
        progress, tick = self._progress, self._tick
        if progress is None or tick is None or not progress.ended:
            return False
        return bool(np.abs(tick.velocity).max() < self.settings.at_rest)

    @property
    def is_calm(self) -> bool:
        """Whether nothing but the robot moves, and nobody has its hand."""
        return self._flow.is_calm and not self._activity.held

    @property
    def touched(self) -> bool:
        """Whether an obstacle touches it."""
        return self._tick is not None and self._tick.clearance < -self.settings.touching

    @property
    def held_back(self) -> str:
        """Which limit keeps it from where it is to go, in words; empty if none does."""
        return "" if self._tick is None else self._feasible.active(self._tick)

    @property
    def ahead(self) -> Array:
        """(K, n) the postures ahead, from where its motion is now on, rad."""
        with self._lock:
            if self._progress is None:
                return np.empty((0, self.robot.num_joints))
            return self._flow.transform.inverse(self._follower.whole_arm.limits.inside(self._progress.ahead))

    @property
    def left(self) -> float:
        """Part of its motion to the goal that is left, from 1 at a start to 0; 1 while it goes elsewhere."""
        with self._lock:
            rays = self._solved.stack.rays
            if self._progress is None or not self._activity.seeks_goal:
                return 1.0
            whole = float(rays.base.left(rays.z0).max())
            return min(float(rays.base.left(self._progress.image)) / max(whole, ARRIVED), 1.0)

    @property
    def undisturbed(self) -> Array:
        """The posture (n,) at this moment of the motion without what is stacked on the learned one, rad."""
        with self._lock:
            progress, solved = self._progress, self._solved
            if progress is None:
                return self._section.reference
            if not self._activity.seeks_goal or not solved.stack.built:
                return progress.q
            x = solved.below.learned.places(progress.image[None])
            return track(self.robot, x, progress.q, reference=self._section.reference).q[0]

    # --- Courses ---

    def _undisturbed_of(self, q: Array) -> Array:
        """Find the undisturbed posture ψ_q(p) (n,) of a robot at a posture."""
        return self._flow.transform.forward(self._follower.whole_arm.limits.inside(q))

    def _moved_to(self, q: Array) -> None:
        """Begin anew where somebody else has moved the robot, as the image of the undisturbed motion there."""
        self._q, undisturbed = q, self._undisturbed_of(q)
        self._remember()
        self._take(resting(self.robot, undisturbed) if self._activity.held else self._onwards(undisturbed))

    def _change(self, course: Course | None = None, **changes: Any) -> None:  # noqa: ANN401
        """Change what the robot does: it takes a course, by default the one to where it goes then."""
        self._remember()
        activity = replace(self._activity, **{"held": False, "let_go": False, **changes})
        pushed = activity.held or self._activity.held
        self._activity = activity
        if self._progress is not None:
            self._take(self._onwards(self._progress.q) if course is None else course, pushed=pushed)

    def _remember(self) -> None:
        """Take note of phase and condition before the motion to the goal is left."""
        if self._activity.seeks_goal and self._progress is not None:
            self._activity = replace(self._activity, rest=self._progress.image[3:])

    def _take(self, course: Course, *, pushed: bool = False) -> None:
        """Follow a course from its beginning; one that a push leads to comes no nearer to the table than before."""
        if not pushed:
            self._feasible.keep(course.q)
        rate = 0.0 if self._progress is None else self._progress.rate
        slowed = course.slowed(self.settings.course_speed * self.robot.velocity_limits)
        self._progress, self._flow.changed = Progress(slowed, rate=rate), True

    def _onwards(self, q: Array, z: Array | None = None) -> Course:
        """Make the undisturbed motion from a posture (n,) to where it is to go; see `towards`."""
        stack, starts, activity = self._solved.stack, self._solved.nominal.starts, self._activity
        hand, base, images = self.robot.end_effector(q), stack.rays.base, stack.rays.z0
        if activity.heading is Phase.HOMING:
            start = stack.stacked.forward(starts[(activity.rollout or 0) % len(starts)])
            home = Attractor(start, self.settings.homing_speed * base.speed, base.smoothing)
            return towards(DiffeomorphicSystem(stack.stacked, home), self._section, q, hand, self.settings, z)
        if activity.rollout is None:
            state = base.states(hand)
        else:
            state = base.states(hand, like=images[activity.rollout % len(images)])
        if activity.rest is not None and len(activity.rest) == len(state) - 3:
            state = base.caught(np.concatenate([hand, activity.rest]), stack.stacked.forward(hand))
        poses = self._solved.nominal.learned.poses
        return towards(stack.system, self._section, q, state, self.settings, z, poses)


def _section(follower: Follower, solved: Solved) -> Section:
    """Return the postures that a motion is followed with."""
    return Section(follower.robot, follower.reference(solved.nominal), follower.at_ends(solved.nominal))


def _same_course(before: Solved, after: Solved) -> bool:
    parts, others = before.stack.parts, after.stack.parts
    same = len(parts) == len(others) and all(a is b for a, b in zip(parts, others, strict=True))
    return same and before.stack.rays.base is after.stack.rays.base
