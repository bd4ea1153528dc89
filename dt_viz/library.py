"""The library: from demonstrations to a stable motion, transforms stacked on it, its paths and its velocity field.

    motion = dt.fit(dt.load_demonstrations("push_box.npz"))
    around = motion.stack(dt.Avoidance(dt.Sphere((0.10, -0.53, 0.15), diameter=0.15)))
    paths = around.rollouts(spacing=0.005)

Everything is computed by what the page is computed by; `import dt_viz` offers these names.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.avoidance.transform import Transform
from dt_viz.control import controller as control
from dt_viz.errors import FormatError, check_between
from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Rays, evenly_sampled, refined
from dt_viz.learning.augmented import unknown_label
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import ImitationSettings, Objective
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.state import State, learn
from dt_viz.motion.certificates import Certificates, DrawnSamples, certified
from dt_viz.motion.diagnostics import motion_warnings
from dt_viz.motion.following import Follower
from dt_viz.motion.nominal import NUM_SAMPLES, Learned
from dt_viz.motion.solve import Solved, solve
from dt_viz.motion.stack import FINE, LIVE, Solution, build_stack
from dt_viz.robot.inverse_kinematics import inverse_kinematics, track
from dt_viz.robot.retiming import within_velocity_limits
from dt_viz.robot.robot import Robot
from dt_viz.robot.robot import load_jaco as load_robot
from dt_viz.saving import SavedMotion, load_motion, save_motion
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task


@dataclass(frozen=True, eq=False)
class Path:
    """A motion, sampled."""

    positions: Array
    """(T, d), metres."""
    times: Array
    """(T,) seconds from the start."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """A motion of the arm's joints."""

    q: Array
    """(T, 6) joint angles, rad; continuous joints unwrapped."""
    times: Array
    """(T,) seconds, later than the path's where the joints' velocity limits ask for it."""
    error: Array
    """(T,) distances of the hand from the path, metres: what it misses, or gives way by."""


class BlockedError(Exception):
    """The whole arm finds no motion around an obstacle."""


class Motion:
    """A stable motion: what was learned from demonstrations, and the transforms stacked on it. Not to be changed."""

    def __init__(self, learned: Learned, layers: tuple[Layer, ...] = ()) -> None:
        """Wrap what was learned; see `fit`."""
        self._learned, self._layers = learned, layers
        self.dimension = len(learned.imitation.goal)
        """d: 2 of drawings, 3 of motions in space."""

    @property
    def transforms(self) -> tuple[Transform, ...]:
        """The transforms on the imitation, from the inside out."""
        return tuple(layer.transform for layer in self._layers)

    @property
    def goal(self) -> Array:
        """(d,) where the motions end, metres."""
        return self._solution.bundle.positions[-1, : self.dimension]

    def stack(self, *transforms: Transform) -> Motion:
        """The motion with more transforms on it, the last one outermost.

        A motion in the plane stays there: what is stacked acts along the plane only. What the joints are to avoid
        (`Avoidance(space="cspace")`) changes the motions of the arm (`Arm.rollouts`), not those of the hand.
        """
        scenario = self._scenario
        for transform in transforms:
            flat = transform.in_plane(PLANE) if self.dimension == 2 else transform
            names = {layer.name for layer in scenario.stack}
            name = next(name for k in range(1, len(names) + 2) if (name := f"{flat.title} {k}") not in names)
            scenario = replace(scenario, stack=(*scenario.stack, Layer(flat, name=name)))
        return Motion(self._learned, scenario.stack)

    def rollouts(
        self, starts: ArrayLike | None = None, *, spacing: float = 0.005, label: float | None = None
    ) -> tuple[Path, ...]:
        """Exact paths to the goal, sampled more closely where the stack stretches them.

        Args:
            starts: (R, d) where they begin, metres; None is where the demonstrations do.
            spacing: largest distance between neighbouring samples, metres.
            label: of the motions from `starts`, None takes that of the nearest demonstrated start; without starts only
                the demonstrations with this label are followed, None follows all.

        Raises:
            FormatError: no demonstration has such a label, starts are not (R, d) finite numbers, or the spacing is not
                above 0.
        """
        if not spacing > 0:
            raise FormatError("spacing", f"{spacing:g}", "metres, above 0")
        solution = self._solution
        system = solution.system
        if starts is None:
            rays = solution.rays if label is None else replace(solution.rays, z0=solution.rays.z0[self._with(label)])
        else:
            states = self._states(self._places(np.atleast_2d(np.asarray(starts, float)), "starts"), label)
            rays = Rays(system.transform.forward(states), system.base)
        evaluate = lambda index, fraction: system.transform.inverse(rays.at(index, fraction))[:, None, :3]  # noqa: E731
        bundle = refined(evenly_sampled(evaluate, len(rays.z0), NUM_SAMPLES), evaluate, spacing)
        times = bundle.split(rays.times(bundle.index, bundle.fraction))
        return tuple(Path(path[:, : self.dimension], t) for path, t in zip(bundle.paths, times, strict=True))

    def velocity(
        self, y: ArrayLike, phase: float | None = None, start: ArrayLike | None = None, label: float | None = None
    ) -> Array:
        """ẏ (*B, d), m/s, at the places `y` (*B, d), metres.

        It is exact to about a thousandth of its speed, and quickest for a single place. In the augmented state there is
        one such field for each phase and each start; `HandController` keeps both, and is what a robot follows.

        Args:
            y: places, metres.
            phase: part of the motion that is left, from 1 at its start to 0 at the goal; only of the augmented state,
                which needs it.
            start: (d,) where it began, metres; None is where the first demonstration does.
            label: of the motion; None takes that of the nearest demonstrated start.

        Raises:
            FormatError: the phase is missing or not from 0 to 1, no demonstration has such a label, or places are not
                d finite numbers each.
        """
        points = np.asarray(y, float)
        self._places(points.reshape(-1, points.shape[-1] if points.ndim else 1), "y")
        system = frozen(self._solution.system, self._rest(phase, start, label))
        velocity = system.velocity(self._in_space(points.reshape(-1, self.dimension)))
        return velocity[:, : self.dimension].reshape(points.shape)

    def phase_rate(self, phase: float, start: ArrayLike | None = None, label: float | None = None) -> float:
        """How fast the phase falls at a phase, 1/s; 0 in the plain state, which has none. See `velocity`.

        Raises:
            FormatError: as `velocity`.
        """
        base, rest = self._solution.rays.base, self._rest(phase, start, label)
        if not len(rest):
            return 0.0
        state = np.concatenate([np.zeros(NUM_COORDINATES), rest])
        return float(-phase * base.velocity(state)[NUM_COORDINATES] / max(rest[0], 1e-12))

    @property
    def state(self) -> str:
        """The state that it was learned in, plain or augmented."""
        return self._learned.imitation.state

    @property
    def reason(self) -> str:
        """Why it was learned in the augmented state, if nobody asked for it."""
        return self._learned.imitation.reason

    @property
    def labels(self) -> tuple[float, ...]:
        """The labels that `rollouts` and `velocity` accept, given or found; none where starts tell what follows."""
        return self._learned.labels

    @property
    def demonstrated_labels(self) -> tuple[float, ...]:
        """The label of each demonstration, given or found; none where there are none."""
        return self._learned.demonstrated_labels

    def certificates(self) -> Certificates:
        """Checks of the paths from the demonstrations' starts, and warnings."""
        nominal, solution = self._learned.demonstrated, self._solution
        scenario = self._scenario
        solved = Solved(scenario, nominal, nominal, solution, None, None)
        bundle, path = solution.bundle, solution.bundle.positions
        missed = float(np.linalg.norm(path[-1] - nominal.goal))
        known = Certificates(
            float(scenario.obstacle.signed_distance(path).min()), found=motion_warnings(solved, missed)
        )
        times = solution.rays.times(bundle.index, bundle.fraction)
        return certified(known, solution, solved.ends, DrawnSamples(bundle.index, bundle.fraction, times, path))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the motion to a file (npz, whatever its suffix): what was learned, the demonstrations and the stack.

        A file that is there is replaced, and stays as it is if something fails.

        Raises:
            DataError: a transform is not one of `dt_viz.avoidance.registry.KINDS`, or holds what could not be read.
            OSError: the file cannot be written.
        """
        learned = self._learned
        imitation = learned.imitation
        augmented = imitation.state == "augmented"
        saved = SavedMotion(
            learned.task.demonstrations, self._layers, augmented, imitation.labels, self.reason, imitation.augmented
        )
        save_motion(path, saved, imitation)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Motion:
        """Read the motion that `save` wrote: its paths, velocities and certificates are the same to the last bit.

        An augmented motion is learned again from its demonstrations, so that this holds for one version of DT-Viz.

        Raises:
            DataError: there is no such file, it cannot be read, or is no saved motion. Nothing else is raised,
                whatever the file holds; nothing is unpickled.
        """
        saved, imitation = load_motion(path)
        return cls(Learned.of(_task(saved.demonstrations), imitation, imitates=True), saved.layers)

    @cached_property
    def _solution(self) -> Solution:
        return build_stack(self._learned.demonstrated, self._scenario.active, FINE)

    @property
    def _scenario(self) -> Scenario:
        return Scenario("", self._layers)

    def _states(self, places: Array, label: float | None) -> Array:
        """The states (R, k) in which motions from places (R, d) begin."""
        return self._solution.rays.base.states(self._in_space(places), label)

    def _rest(self, phase: float | None, start: ArrayLike | None, label: float | None) -> Array:
        """What the state of a motion from a start (d,) consists of besides the place, at a phase."""
        began = self._learned.task.starts[0, : self.dimension] if start is None else np.asarray(start, float)
        rest = self._states(self._places(began[None], "start"), label)[0, NUM_COORDINATES:]
        if phase is None and len(rest):
            raise FormatError("phase", "none", "a number from 0 to 1: this motion was learned in the augmented state")
        if phase is not None:
            check_between("phase", phase, 0.0, 1.0)
            rest[:1] *= phase
        return rest

    def _with(self, label: float) -> Indices:
        """The numbers of the demonstrations with a label."""
        if label not in self.labels:
            raise unknown_label(label, self.labels)
        return np.flatnonzero(np.array(self.demonstrated_labels) == label)

    def _places(self, places: Array, field: str) -> Array:
        """Places (N, d) that were given, checked."""
        if places.ndim != 2 or places.shape[1] != self.dimension or not len(places):
            shape = "×".join(str(n) for n in places.shape)
            raise FormatError(field, f"{shape} numbers", f"places of {self.dimension} coordinates, metres")
        if not np.isfinite(places).all():
            raise FormatError(field, "a number that is not finite", "finite numbers, metres")
        return places

    def _in_space(self, points: Array) -> Array:
        """Points (N, 3) of points (N, d)."""
        return np.pad(points, ((0, 0), (0, 3 - self.dimension)))


NUM_COORDINATES = 3
"""Coordinates of motions in space."""
PLANE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
"""The plane of motions with two coordinates."""


class HandController:
    """The velocities of a hand in the loop, wherever it is, in either state.

        controller = dt.HandController(motion, start)
        velocity = controller.step(position, dt)

    In the augmented state it keeps the phase and where the motion began. Where the hand was pushed, the phase is chosen
    again, so that the rest of the motion is drawn.
    """

    def __init__(self, motion: Motion, start: ArrayLike, label: float | None = None) -> None:
        """Begin a motion.

        Args:
            motion: in the plane or in space.
            start: (d,) where the hand is, metres.
            label: of the motion; None takes that of the nearest demonstrated start.

        Raises:
            FormatError: no demonstration has such a label, or the start is not d finite numbers.
        """
        self._motion = motion
        self._rest = motion._rest(1.0, start, label)
        self._top = float(self._rest[0]) if len(self._rest) else 0.0
        self._expected = motion._in_space(np.asarray(start, float)[None])[0]

    @property
    def phase(self) -> float:
        """Part of the motion that is left, from 1 to 0; 0 in the plain state, which has none."""
        return float(self._rest[0]) / self._top if self._top else 0.0

    def step(self, position: ArrayLike, dt: float) -> Array:
        """ẏ (d,), m/s, that takes a hand at `position` (d,), metres, to where the motion is `dt` seconds later.

        It is stable at any period, also where a motion ends abruptly.

        Raises:
            FormatError: the position is not d finite numbers, or the period is not above 0.
        """
        if not 0 < dt < np.inf:
            raise FormatError("dt", f"{dt:g}", "seconds, above 0")
        motion, solution = self._motion, self._motion._solution
        place = motion._in_space(motion._places(np.asarray(position, float)[None], "position"))[0]
        state = np.concatenate([place, self._rest])
        if np.linalg.norm(place - self._expected) > PUSHED * self._top:
            state = solution.system.base.caught(state, solution.stacked.forward(place))
        reached = solution.system.rollout(state, np.array([dt]))[0]
        self._expected, self._rest = reached[:NUM_COORDINATES], reached[NUM_COORDINATES:]
        return (self._expected - place)[: motion.dimension] / dt


PUSHED = 0.05
"""Distance from where the hand should be, relative to half the demonstrations' extent, from which it was pushed."""


class Arm:
    """The JACO arm."""

    def __init__(self, robot: Robot) -> None:
        """Wrap a robot; see `load_jaco`."""
        self.robot = robot
        self._follower = Follower(robot)

    def follow(self, path: Path) -> JointPath:
        """The joints along a path of the hand.

        Args:
            path: in space, in the frame of the arm's base.

        Raises:
            UnreachableError: the arm cannot get to where the path starts.
            ValueError: the path lies in a plane that has no place in space.
        """
        if path.positions.shape[1] != NUM_COORDINATES:
            raise ValueError(f"the arm follows paths in space, with 3 coordinates, not {path.positions.shape[1]}")
        start = inverse_kinematics(self.robot, path.positions[0])
        tracked = track(self.robot, path.positions, start)
        times = within_velocity_limits(path.times, tracked.q, self.robot.velocity_limits)
        return JointPath(tracked.q, times, tracked.error)

    def rollouts(self, motion: Motion, *, spacing: float = 0.005) -> tuple[JointPath, ...]:
        """Motions of the whole arm from the demonstrations' starts, around what the motion tells it to avoid.

        Args:
            motion: in space, in the frame of the arm's base.
            spacing: largest distance between neighbouring samples of the hand, metres.

        Raises:
            BlockedError: an obstacle leaves no room at a start or at the goal, or no way between them.
            UnreachableError: the arm cannot get to where the motions start.
            ValueError: the motion is one in a plane that has no place in space.
        """
        if motion.dimension != NUM_COORDINATES:
            raise ValueError(f"the arm follows motions in space, with 3 coordinates, not {motion.dimension}")
        scenario, nominal = motion._scenario, motion._learned.demonstrated
        avoidance = scenario.arm_avoidance
        if avoidance is None:
            return tuple(self.follow(path) for path in motion.rollouts(spacing=spacing))
        admission = self._follower.admission(nominal, avoidance)
        in_the_way = admission.blocked or admission.nominal.warnings
        if in_the_way:
            raise BlockedError("; ".join(warning.text for warning in in_the_way))
        solved = solve(scenario, admission.nominal, replace(FINE, spacing=spacing), self._follower)
        arm = solved.arm
        assert arm is not None
        if solved.nominal.left_out or not arm.cleared:
            raise BlockedError("the arm finds no way around the obstacle")
        due = solved.stack.rays.times(arm.index, arm.fraction)
        away = self.robot.end_effector(arm.p) - solved.stack.positions_at(arm.index, arm.fraction)
        rows = [arm.index == rollout for rollout in range(len(nominal.starts))]
        limits = self.robot.velocity_limits
        return tuple(
            JointPath(
                arm.p[row], within_velocity_limits(due[row], arm.p[row], limits), np.linalg.norm(away[row], axis=1)
            )
            for row in rows
        )


class Controller(control.ArmController):
    """The joint velocities of an arm in the loop, wherever it is: see `dt_viz.control.controller`.

        controller = dt.Controller(motion, arm)
        q_velocity = controller.step(q, dt)

    The arm goes to the goal around what the motion avoids by hand, and by the whole arm (`Avoidance(space="cspace")`).
    """

    def __init__(self, motion: Motion, arm: Arm, label: float | None = None) -> None:
        """Take a motion and the arm.

        Args:
            motion: in space, in the frame of the arm's base.
            arm: the arm that follows it.
            label: of the pattern that is drawn; None takes that of the demonstration that begins nearest to the hand.

        Raises:
            FormatError: no demonstration has such a label.
            UnreachableError: the arm cannot get to where the motion starts.
            ValueError: the motion is one in a plane that has no place in space.
        """
        super().__init__(arm._follower, _live(motion))
        self._motion = motion
        self._home = None if label is None else int(motion._with(label)[0])

    @property
    def motion(self) -> Motion:
        """What it follows; another one, such as one with its obstacle elsewhere, takes over at the next `step`.

        Raises:
            UnreachableError, ValueError: as `Controller`.
        """
        return self._motion

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self.follow(_live(motion))
        self._motion = motion


def _live(motion: Motion) -> Solved:
    """The stack of a motion in space, as exactly as a controller needs it."""
    if motion.dimension != NUM_COORDINATES:
        raise ValueError(f"the arm follows motions in space, with 3 coordinates, not {motion.dimension}")
    scenario, nominal = motion._scenario, motion._learned.demonstrated
    return Solved(scenario, nominal, nominal, build_stack(nominal, scenario.active, LIVE))


def load_jaco() -> Arm:
    """The JACO arm, from its URDF."""
    return Arm(load_robot())


def fit(
    demonstrations: Sequence[Demonstration],
    objective: Objective = "trajectory",
    state: State = "auto",
    labels: Sequence[float] | None = None,
    settings: ImitationSettings | None = None,
    augmented: AugmentedSettings | None = None,
) -> Motion:
    """Learn a stable motion from demonstrations, all ending at (about) the same place.

    Args:
        demonstrations: of one motion, with 2 or 3 coordinates; see `load_demonstrations`.
        objective: what is fitted in the plain state: the motions, or their velocities as in eq. (3).
        state: "plain" is the paper's: one vector field of places, which needs no memory. "augmented" remembers its
            phase and where it began: it crosses itself, comes back, winds, and draws the figure from other starts,
            too. "auto" is plain unless a fit with the default settings misses a demonstration by more than 5 % of their
            extent.
        labels: a number for each demonstration, where they differ although they begin at one place: those with one
            number are of one pattern; makes the state augmented. None finds them where that is so; see `Motion.labels`.
        settings: of the plain fit, the objective included; None takes the defaults.
        augmented: settings of the augmented state; None takes the defaults.

    Raises:
        ImitationError: no stable motion can be learned from them, or there is no such state.
    """
    given = tuple(demonstrations)
    imitation = learn(given, settings or ImitationSettings(objective), state, labels, augmented=augmented)
    return Motion(Learned.of(_task(given), imitation, imitates=True))


def _task(demonstrations: tuple[Demonstration, ...]) -> Task:
    """The demonstrations in their own frame."""
    flat = Slice(np.zeros(3), np.eye(3)[:, :2], (1.0, 1.0))
    nowhere = (0.0, 0.0, 0.0)
    return Task("", "", "", demonstrations, np.zeros(3), np.eye(3), 1.0, flat, (nowhere, nowhere), nowhere)
