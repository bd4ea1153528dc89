"""The arm that moves: a simulated robot, the controller that drives it, and the round that it goes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.flows.fields import Array
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import Solved
from dt_viz.robot.inverse_kinematics import track

TICK = 0.01
"""Time between two ticks of the controller, seconds: 100 Hz."""
LONGEST = 0.25
"""Longest time that the robot moves at once, seconds: a thread that was held up does not make it rush."""
REST, REST_ASIDE = 0.8, 3.0
"""Times that the robot stays at the goal before it goes home, seconds; the second where it has stepped aside."""
REST_AT_START = 0.3
"""Time that the robot stays at a start, seconds."""
DISTANCES = (0.06, 0.03, 0.015)
"""Distances by which the hand is pushed, metres: less where there is no room for more."""
NUM_DIRECTIONS = 4
"""Number of directions that are tried at each distance."""
TABLE_ROOM = 0.025
"""Height above the table that a push leaves to the hand, metres, where it has as much."""
BESIDE = 0.01
"""Distance of the hand from where it is held that is worth a word, metres."""

_Wish = Callable[[ArmController], None]


class LiveArm:
    """A robot that goes from a start to the goal and then home to the next start, around what is in its way.

    `follow` is for the thread that computes, `advance` for the one that moves the robot; the rest may come from any.
    """

    def __init__(self, follower: Follower) -> None:
        """Take an arm; it begins to move once it has something to follow.

        Args:
            follower: the arm.
        """
        self._follower = follower
        self._changing = threading.Lock()
        self._wishes: list[_Wish] = []
        self._controller: ArmController | None = None
        self._solved: Solved | None = None
        self._chosen: int | None = None
        self._starts: tuple[int, ...] = ()
        """Numbers of the starts that it can go to."""
        self._number = 0
        """Number of the start of this round, or of the next one while it goes there."""
        self._q: Array | None = None
        self._held: Array | None = None
        """Where the hand is to be held, (3,), metres."""
        self._homing = self._let_go = False
        self._due = self._rested = self._arrived = 0.0
        self._seen: tuple[ArmAvoidance | None] | None = None
        """What was seen since the last tick."""
        self._rng = np.random.default_rng(0)

    # --- What it is doing ---

    @property
    def q(self) -> Array | None:
        """Its joint angles (6,), rad; None before it has something to follow."""
        return self._q

    @property
    def undisturbed(self) -> Array | None:
        """The joint angles (6,), rad, at this moment of the motion without what is stacked on the learned one."""
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
        return self._arrived

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
        return self._beside or controller.held_back

    @property
    def _beside(self) -> str:
        """Why the hand is not where it is held, in words; empty if it is."""
        place, q, solved, below = self._held, self._q, self._solved, self.undisturbed
        if self.phase is not Phase.HELD or place is None or q is None or solved is None or below is None:
            return ""
        robot = self._follower.robot
        if len(self.ahead) > 1 or np.linalg.norm(robot.end_effector(q) - place) < BESIDE:
            return ""
        if solved.scenario.obstacle.signed_distance(place) < 0:
            return "inside the obstacle"
        far = np.linalg.norm(robot.end_effector(below) - place) > BESIDE
        return "out of the arm's reach" if far else "gives way to the obstacle"

    # --- What happens to it ---

    def follow(self, solved: Solved, chosen: int | None) -> None:
        """Go on with another motion, from where the robot is.

        Args:
            solved: the motion; of its whole arm's avoidance only what is to be avoided counts.
            chosen: index of the rollout whose start it is to go to when that, or the task, is another than before.

        Raises:
            UnreachableError: the arm cannot get to where the motions start.
        """
        before, nominal = self._solved, solved.nominal
        number = None if chosen is None else nominal.numbers[chosen]
        same = before is not None and solved.stack is before.stack and solved.scenario == before.scenario
        if same and number == self._chosen:
            return
        reached = ~self._follower.out_of_reach(nominal)
        starts = tuple(np.array(nominal.numbers)[reached].tolist())
        if self._controller is None:
            first = chosen or 0
            controller, q = ArmController(self._follower, solved), self._q
            if q is None:
                q = _posture(self._follower, solved, first)
            controller.begin(q, first)
            with self._changing:
                self._q, self._number, self._controller = q, nominal.numbers[first], controller
                self._homing = False
        else:
            self._controller.follow(solved)
        another = before is not None and (before.nominal.task is not nominal.task or number != self._chosen)
        self._solved, self._starts, self._chosen = solved, starts, number
        if another and number is not None:
            self._wish(lambda controller: self._go_home(controller, number))

    def see(self, avoidance: ArmAvoidance | None) -> None:
        """Update the obstacles that the controller keeps away from, before the motion around them is computed."""
        self._seen = (avoidance,)

    def stop(self) -> None:
        """Stay in this posture: there is nothing to follow."""
        self._controller = self._solved = None

    def put(self, q: Array) -> None:
        """Begin anew at joint angles q (6,), rad: somebody else has moved the robot there."""
        with self._changing:
            self._q = q

    def hold(self, place: Array) -> None:
        """Take the hand to a place (3,), metres, and keep it there until `release`; the newest place counts."""
        with self._changing:
            self._held, self._let_go = place, False
            if self._hold not in self._wishes:
                self._wishes.append(self._hold)

    def release(self) -> None:
        """Let go of the hand: it goes on to where it was going; in a pause, once it is where it was to be held."""
        self._let_go = True

    def push(self) -> None:
        """Push the hand a few centimetres aside, in a random direction across its way; it goes on from there."""
        self._wish(self._push)

    def advance(self, seconds: float, *, moves: bool) -> None:
        """Let some time pass.

        Args:
            seconds: of the robot's time.
            moves: whether the robot moves by itself; else it does so only while its hand is held.
        """
        controller = self._controller
        if controller is None:
            return
        with self._changing:
            wishes, self._wishes = self._wishes, []
        for wish in wishes:
            wish(controller)
        if self._let_go and (moves or controller.rests):
            self._held, self._let_go = None, False
            controller.release()
        seen, self._seen = self._seen, None
        if seen is not None:
            controller.see(*seen)
        if not moves and controller.phase is not Phase.HELD:
            controller.watch()
            return
        self._due = min(self._due + seconds, LONGEST)
        ticks = int(self._due / TICK)
        self._due -= ticks * TICK
        if ticks:
            q = self._q
            assert q is not None
            velocities = controller.steps(q, TICK, ticks)
            with self._changing:
                if self._q is q:  # or it was put elsewhere meanwhile
                    self._q = q + TICK * velocities.sum(axis=0)
        self._go_round(controller, ticks * TICK)

    # --- On the thread that moves it ---

    def _wish(self, wish: _Wish) -> None:
        with self._changing:
            self._wishes.append(wish)

    def _hold(self, controller: ArmController) -> None:
        place = self._held
        if place is not None:
            controller.hold(place)

    def _push(self, controller: ArmController) -> None:
        robot, q = self._follower.robot, self._q
        if q is None or self._solved is None or not len(controller.ahead):
            return
        best, most = q, -np.inf
        for place in self._places_aside(controller, q):
            tracked = track(robot, np.linspace(robot.end_effector(q), place, 4), q)
            room = self._room(tracked.q[-1]) - float(tracked.error.max())
            if room > most:
                best, most = tracked.q[-1], room
            if room > 0:
                break
        controller.displace(best)

    def _places_aside(self, controller: ArmController, q: Array) -> Iterator[Array]:
        """Places (3,), metres, to push the hand to, the farthest first."""
        robot, ahead = self._follower.robot, controller.ahead[:2]
        hand, along = robot.end_effector(q), np.ptp(robot.end_effector(ahead), axis=0)
        along /= max(float(np.linalg.norm(along)), 1e-9)
        directions = self._rng.normal(size=(NUM_DIRECTIONS, 3))
        directions -= np.outer(directions @ along, along)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        for distance in DISTANCES:
            yield from hand + distance * directions

    def _room(self, q: Array) -> float:
        """Room of the hand above the table and beside the obstacle, metres; below 0 there is too little."""
        assert self._solved is not None and self._q is not None
        robot, scenario = self._follower.robot, self._solved.scenario
        hand, now = robot.end_effector(q), robot.end_effector(self._q)
        table = float(hand[2] - min(TABLE_ROOM, now[2]))
        return min(table, float(scenario.obstacle.signed_distance(hand))) if scenario.avoids else table

    def _go_home(self, controller: ArmController, number: int) -> None:
        solved = self._solved
        rollout = None if solved is None else solved.nominal.rollout(number)
        if rollout is not None:
            self._number, self._homing, self._rested = number, True, 0.0
            controller.home(rollout)

    def _go_round(self, controller: ArmController, seconds: float) -> None:
        """Set out for the next start, or from there for the goal, when the robot has rested."""
        phase = controller.phase
        rests = phase in (Phase.RESTING, Phase.ASIDE)
        self._rested = self._rested + seconds if rests else 0.0
        if self._arrived > 0 or (rests and not self._homing):
            self._arrived += seconds
        if self._homing and self._rested > REST_AT_START:
            self._homing, self._arrived, self._rested = False, 0.0, 0.0
            controller.go()
        elif not self._homing and self._rested > (REST if phase is Phase.RESTING else REST_ASIDE) and self._starts:
            later = [number for number in self._starts if number > self._number]
            self._go_home(controller, later[0] if later else self._starts[0])


def _posture(follower: Follower, solved: Solved, rollout: int) -> Array:
    """The joint angles (6,) at the beginning of a rollout, rad."""
    if solved.arm is not None:
        return solved.arm.p[int(np.argmax(solved.arm.index == rollout))]
    return follower.undisturbed_along(solved.nominal, rollout).tracked.q[0, 0]
