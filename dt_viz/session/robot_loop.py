"""The arm that moves: a simulated robot, the controller that drives it, and the round that it goes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.flows.fields import Array
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import Solved
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import scales, sized


@dataclass(frozen=True)
class RoundSettings:
    """Settings of `LiveArm`."""

    tick: float = 0.01  # shortest time from one tick of the controller to the next, seconds: 100 Hz
    most: int = 5
    """Number of ticks at once, at most: they are longer where the robot's thread is late."""
    most_calm: int = 2
    """The same while nothing but the robot moves, so that nothing is to be reacted to."""
    longest: float = 0.25
    """Longest time that the robot moves at once, seconds: a thread that was held up does not make it rush."""
    rest: float = 0.8  # time that the robot stays at the goal before it goes home, seconds
    rest_aside: float = 3.0  # the same where it has stepped aside, seconds
    rest_at_start: float = 0.3  # time that the robot stays at a start, seconds
    push_distance: float = scales(0.06)
    """Distance by which the hand is pushed, metres, for an arm as large as the JACO."""
    place_tolerance: float = 0.01
    """Distance of the hand from where it is held that is reported, metres."""


@dataclass(frozen=True)
class _Round:
    """Where in its round a robot is."""

    start: int = 0  # place of the start of this round, or of the next one while it goes there
    rested: float = 0.0  # time since it came to rest, seconds
    arrived: float = 0.0  # see `LiveArm.arrived`


class LiveArm:
    """A robot that goes from a start to the goal and then home to the next start, around what is in its way.

    `follow` is for the thread that computes, `advance` for the one that moves the robot; the rest may come from any.
    """

    def __init__(self, follower: Follower, settings: RoundSettings | None = None) -> None:
        self._follower = follower
        self._settings = sized(settings or RoundSettings(), follower.robot.size)
        self._changing = threading.Lock()
        self._commands: dict[str, Callable[[ArmController], None]] = {}
        """Commands for the thread that moves the robot, by what they are about; the newest of a kind counts."""
        self._controller: ArmController | None = None
        self._solved: Solved | None = None
        self._chosen: int | None = None  # number of the start that was chosen
        self._q: Array | None = None
        self._held: Array | None = None  # (3,) where the hand is to be held, metres
        self._round, self._due = _Round(), 0.0
        self._rng = np.random.default_rng(0)

    # --- What it is doing ---

    @property
    def q(self) -> Array | None:
        """Its joint angles (n,), rad; None before it has something to follow."""
        return self._q

    @property
    def undisturbed(self) -> Array | None:
        """The joint angles (n,), rad, at this moment of the motion without what is stacked on the learned one."""
        controller = self._controller
        return None if controller is None else controller.undisturbed

    @property
    def left(self) -> float:
        """Part of its motion to the goal that is left, from 1 at a start to 0 at the goal."""
        controller = self._controller
        return 1.0 if controller is None else controller.left

    @property
    def ahead(self) -> Array:
        """(K, 3) the way of the hand that lies ahead, metres."""
        controller = self._controller
        return np.empty((0, 3)) if controller is None else controller.robot.end_effector(controller.ahead)

    @property
    def phase(self) -> Phase:
        """What it is doing."""
        controller = self._controller
        return Phase.RESTING if controller is None else controller.phase

    @property
    def arrived(self) -> float:
        """Time since it came to the goal, seconds; 0 from when it sets out from a start until then."""
        return self._round.arrived

    @property
    def note(self) -> str:
        """What is unusual about where it is, in words; empty if nothing is."""
        controller, phase = self._controller, self.phase
        if controller is None:
            return ""
        if phase is Phase.TOUCHED:
            return "touched" if controller.touched else "no way around the obstacle"
        if phase is Phase.ASIDE:
            return "stepped aside"
        return (self._beside(controller) if phase is Phase.HELD else "") or controller.held_back

    def _beside(self, controller: ArmController) -> str:
        """Say why the hand is not where it is held; empty if it is."""
        place, q, solved, tolerance = self._held, self._q, self._solved, self._settings.place_tolerance
        if place is None or q is None or solved is None or len(controller.ahead) > 1:
            return ""
        now, below = controller.robot.end_effector(np.stack([q, controller.undisturbed]))
        if np.linalg.norm(now - place) < tolerance:
            return ""
        if solved.scenario.obstacle.signed_distance(place) < 0:
            return "inside the obstacle"
        return "out of the arm's reach" if np.linalg.norm(below - place) > tolerance else "gives way to the obstacle"

    # --- What happens to it ---

    def follow(self, solved: Solved, chosen: int | None) -> None:
        """Go on with another motion, from where the robot is.

        Args:
            solved: the motion; of its whole arm's avoidance only what is to be avoided counts.
            chosen: place of the start that it is to go to when that, or the task, is another than before.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        before, nominal = self._solved, solved.nominal
        another = before is not None and (before.nominal.task is not nominal.task or chosen != self._chosen)
        same = before is not None and solved.stack is before.stack and solved.scenario == before.scenario
        if same and not another:
            return
        if self._controller is None:
            first, q = int(np.argmax(nominal.moving)) if chosen is None else chosen, self._q
            controller = ArmController(self._follower, solved)
            if q is None:
                q = _posture(self._follower, solved, first)
            controller.begin(q, first)
            with self._changing:
                self._q, self._controller = q, controller
                self._round = replace(self._round, start=first)
        else:
            self._controller.follow(solved)
        self._solved, self._chosen = solved, chosen
        if another and chosen is not None:
            self._command("home", lambda controller: self._go_home(controller, chosen))

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Update the obstacles that the controller keeps away from, before the motion around them is computed."""
        self._command("see", lambda controller: controller.see(avoidance))

    def stop(self) -> None:
        """Stay in this posture: there is nothing to follow."""
        self._controller = self._solved = None

    def put(self, q: Array) -> None:
        """Begin anew at joint angles q (n,), rad: somebody else has moved the robot there."""
        with self._changing:
            self._q = q

    def hold(self, place: Array) -> None:
        """Take the hand to a place (3,), metres, and keep it there until `release`; the newest place counts."""
        with self._changing:
            self._held = place
            self._commands.pop("release", None)
            self._commands["hold"] = lambda controller: controller.hold(place)

    def release(self) -> None:
        """Let go of the hand: it goes on to where it was going; in a pause, once it is where it was to be held."""
        self._command("release", self._release)

    def push(self) -> None:
        """Push the hand a few centimetres aside, in a random direction across its way; it goes on from there."""
        self._command("push", self._push)

    def advance(self, seconds: float, *, moves: bool) -> None:
        """Let some time pass.

        Args:
            seconds: of the robot's time.
            moves: whether the robot moves by itself; else it does so only while its hand is held.
        """
        controller, settings = self._controller, self._settings
        if controller is None:
            return
        with self._changing:
            commands, self._commands = self._commands, {}
        for kind, command in commands.items():
            if kind == "release" and not (moves or controller.rests):
                with self._changing:
                    if "hold" not in self._commands:
                        self._commands.setdefault(kind, command)
            else:
                command(controller)
        if not moves and controller.phase is not Phase.HELD:
            controller.watch()
            return
        self._due = min(self._due + seconds, settings.longest)
        most = settings.most_calm if controller.is_calm else settings.most
        num = min(int(self._due / settings.tick), most)
        tick = max(settings.tick, self._due / most)
        passed = num * tick
        self._due -= passed
        if num:
            q = self._q
            assert q is not None
            velocities = controller.steps(q, tick, num)
            with self._changing:
                if self._q is q:  # or it was put elsewhere meanwhile
                    self._q = q + tick * velocities.sum(axis=0)
        self._go_round(controller, passed)

    # --- On the thread that moves it ---

    def _command(self, kind: str, command: Callable[[ArmController], None]) -> None:
        with self._changing:
            self._commands[kind] = command

    def _release(self, controller: ArmController) -> None:
        self._held = None
        controller.release()

    def _push(self, controller: ArmController) -> None:
        """Push the hand as far as the controller's limits allow; they keep it off the table and the obstacles."""
        robot, q, ahead = controller.robot, self._q, controller.ahead[:2]
        if q is None or not len(ahead):
            return
        hand, along = robot.end_effector(q), np.ptp(robot.end_effector(ahead), axis=0)
        aside = self._rng.normal(size=3)
        aside -= along * (aside @ along) / max(float(along @ along), 1e-18)
        place = hand + self._settings.push_distance * aside / np.linalg.norm(aside)
        controller.displace(track(robot, np.linspace(hand, place, 4), q).q[-1])

    def _go_home(self, controller: ArmController, start: int) -> None:
        moving = [] if self._solved is None else self._solved.nominal.moving
        if start < len(moving) and moving[start]:
            self._round = replace(self._round, start=start, rested=0.0)
            controller.home(start)

    def _go_round(self, controller: ArmController, seconds: float) -> None:
        """Set out for the next start, or from there for the goal, when the robot has rested."""
        phase, homing = controller.phase, controller.heading is Phase.HOMING
        before, settings = self._round, self._settings
        rests = phase in (Phase.RESTING, Phase.ASIDE)
        rested = before.rested + seconds if rests else 0.0
        arrives = before.arrived > 0 or (rests and not homing)
        self._round = replace(before, rested=rested, arrived=before.arrived + seconds * arrives)
        if homing and rested > settings.rest_at_start:
            self._round = _Round(before.start)
            controller.go()
        elif not homing and rested > (settings.rest if phase is Phase.RESTING else settings.rest_aside):
            self._go_home(controller, self._next_start())

    def _next_start(self) -> int:
        """Place of the start after this round's that the arm can get to; the first one after the last."""
        last = self._round.start
        if self._solved is None:
            return last
        nominal = self._solved.nominal
        reached = np.flatnonzero(nominal.moving & ~self._follower.out_of_reach(nominal)).tolist()
        return min(reached, key=lambda start: (start <= last, start), default=last)


def _posture(follower: Follower, solved: Solved, rollout: int) -> Array:
    """The joint angles (n,) at the beginning of a rollout, rad."""
    if solved.arm is not None:
        return solved.arm.p[int(np.argmax(solved.arm.index == rollout))]
    return follower.undisturbed(solved.nominal).tracked.q[rollout, 0]
