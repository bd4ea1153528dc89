"""Scenario → transforms → frames. Knows no browser; keeps what an edit leaves unchanged."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np

from dt_viz.avoidance import ObstacleAvoidance
from dt_viz.behaviours import Behaviour, Built, Motion
from dt_viz.diffeo import Chain, Diffeomorphism, Identity
from dt_viz.fields import Array
from dt_viz.fits import FitStore
from dt_viz.health import Health, certified
from dt_viz.imitation import Imitation, ImitationSettings, Progress
from dt_viz.metrics import maximum_collision_distance
from dt_viz.pictures import NO_PICTURES, Pictures, Sketchbook, in_frame
from dt_viz.robot import Robot
from dt_viz.rollouts import Bundle, Rays, evenly_sampled, refined
from dt_viz.scenario import Scenario
from dt_viz.systems import DiffeomorphicSystem
from dt_viz.tasks import Task, TaskEntry
from dt_viz.tracking import UnreachableError, inverse_kinematics, track

BEHAVIOURS: tuple[Behaviour, ...] = (ObstacleAvoidance(),)
"""What is stacked on the imitation, from the inside out."""

NUM_SAMPLES = 200
"""Of each rollout before refinement."""
MAX_ATTEMPTS = 4
"""At a duration that clears the samples that refinement finds, too."""
ARROW_SPACING = 0.030
"""Of the picture of the vector field, metres."""
MAX_CHORDS, IMAGE_TOLERANCE = 6, 1e-9
"""Steps towards the images of moved ends, and metres by which they may miss."""
MAX_GOAL_MISS = 1e-3
"""Metres by which motions may end beside the goal before it is said."""
NUM_ARM_SAMPLES = 200
MAX_TRACKING_ERROR = 1e-3
"""Metres by which the hand may miss its path before it is said."""


@dataclass(frozen=True)
class Precision:
    """How exactly a motion is worked out, all in metres."""

    tolerance: float
    """Of a step of the behaviours' flows."""
    spacing: float
    """Largest distance between neighbouring samples."""
    ends: float
    """By which a rollout may miss its start and goal before the motion below is worked out again between others."""


LIVE = Precision(tolerance=2e-5, spacing=0.012, ends=3e-4)
"""Nothing of this is seen at the size of a screen."""
FINE = Precision(tolerance=1e-8, spacing=0.005, ends=1e-7)


class Stage(IntEnum):
    """How far a frame is worked out; each stage holds all that the one before it holds."""

    ROLLOUTS = 0
    """Rollouts and their clearance."""
    LIVE = 1
    """Also the vector field and the arm: what follows a drag."""
    FINE = 2
    """All of it refined, for a scenario that rests."""
    CERTIFIED = 3
    """Also the certificates."""


@dataclass(frozen=True)
class FieldPicture:
    """Velocities of the system on the task's slice, outside the obstacle."""

    points: Array
    """(N, 3), metres."""
    velocities: Array
    """(N, 3), m/s."""


@dataclass(frozen=True)
class ArmMotion:
    """The joint motion along one rollout."""

    times: Array
    """(T,) seconds."""
    q: Array
    """(T, 6) joint angles at these times, rad; continuous joints unwrapped."""
    without: Array
    """(T, 6) the same at the same moments of the motion without avoidance."""


@dataclass(frozen=True)
class Frame:
    """All that the page draws for a scenario. Read only."""

    scenario: Scenario
    task: Task
    stage: Stage
    ghost: tuple[Array, ...]
    """Undeformed rollouts, (T_i, 3)."""
    rollouts: tuple[Array, ...]
    """(T_i, 3), metres."""
    times: tuple[Array, ...]
    """(T_i,) seconds of the samples of each rollout."""
    goal: Array
    """(3,) where the demonstrations end."""
    reached: Array
    """(3,) where the motions end: elsewhere where the obstacle covers the goal or leaves no way to it."""
    blocked: tuple[str, ...]
    """Why there is no motion for this scenario, in words; what is shown then is the last one that there was."""
    health: Health
    field: FieldPicture | None = None
    """None before stage LIVE."""
    arm: ArmMotion | None = None
    """None before stage LIVE, and where the arm cannot reach the start."""
    pictures: Pictures = NO_PICTURES
    """Of ψ itself, as far as the view shows them; empty before stage LIVE."""
    seconds: float = 0.0
    """From the start of the rebuild until this frame."""


@dataclass(frozen=True)
class _Ground:
    """What depends on the task and the imitation only: the undeformed motion."""

    task: Task
    imitation: Imitation
    system: DiffeomorphicSystem
    goal: Array
    rays: Rays
    bundle: Bundle

    @cached_property
    def ends(self) -> Array:
        """(R + 1, 3) starts and goal, metres."""
        return np.concatenate([self.task.starts, [self.goal]])

    @cached_property
    def sketchbook(self) -> Sketchbook:
        """Makes the pictures of ψ."""
        return Sketchbook(self.task, in_frame(self.system.transform), self.system, self.rays)

    @cached_property
    def _linearised(self) -> tuple[Array, Array]:
        return self.system.transform.jacobian(self.ends)

    def images(self, ends: Array) -> Array:
        """ψ of points (R + 1, 3) not far from `ends`: by chord steps on ψ⁻¹, which is the cheaper side of ψ."""
        images, J = self._linearised
        error = ends - self.ends
        for _ in range(MAX_CHORDS):
            images = images + (J @ error[..., None])[..., 0]
            error = ends - self.system.transform.inverse(images)
            if np.abs(error).max() <= IMAGE_TOLERANCE:
                return images
        return self.system.transform.forward(ends)


@dataclass(frozen=True)
class _Solution:
    """The stack that a scenario asks for, and its rollouts from the task's starts."""

    transform: Diffeomorphism
    rays: Rays
    bundle: Bundle
    built: tuple[Built, ...]
    satisfied: bool
    """Whether every behaviour found what it was made for."""

    @property
    def system(self) -> DiffeomorphicSystem:
        """The dynamical system whose motions these are."""
        return DiffeomorphicSystem(self.transform, self.rays.base)


_turn = threading.Lock()
"""Engines take turns. Small array operations of several threads would fight for the interpreter, and all would lose:
four sessions that drag at once get twice as many frames this way."""


class Engine:
    """Computes frames for one visitor. Not thread-safe: one worker thread calls it."""

    def __init__(self, tasks: Mapping[str, TaskEntry], fits: FitStore, robot: Robot) -> None:
        self._loaders = tasks
        self._fits = fits
        self._robot = robot
        self._tasks: dict[str, Task] = {}
        self._grounds: dict[tuple[str, bool, str], _Ground] = {}
        self._arm_starts: dict[tuple[str, int], Array | UnreachableError] = {}
        self._arm_before: tuple[tuple[str, int], Array] | None = None

    def task(self, name: str) -> Task:
        """The task of that name, loaded on first use. Raises DemonstrationError if its file cannot be used."""
        if name not in self._tasks:
            self._tasks[name] = self._loaders[name]()
        return self._tasks[name]

    def frames(self, scenario: Scenario, progress: Progress | None = None) -> Iterator[Frame]:
        """Frames for a scenario, one for each stage; stop iterating to skip what is not wanted any more.

        Args:
            scenario: what to show.
            progress: called while a task is fitted for the first time; see `dt_viz.imitation.fit`.

        Raises:
            DemonstrationError: the task's demonstrations cannot be read.
            ImitationError: nothing can be learned from them.
        """
        ground = self._ground(scenario, progress)
        began = time.perf_counter()
        with _turn:
            live = _solve(ground, scenario, LIVE)
            frame = _frame(ground, scenario, live)
        yield replace(frame, seconds=time.perf_counter() - began)
        with _turn:
            frame = self._with_field_and_arm(frame, live.system)
            frame = replace(frame, pictures=_pictures(ground, scenario, live, coarse=True))
        yield replace(frame, stage=Stage.LIVE, seconds=time.perf_counter() - began)

        with _turn:
            fine = _solve(ground, scenario, FINE)
        with _turn:
            frame = self._with_field_and_arm(_frame(ground, scenario, fine), fine.system)
        with _turn:
            frame = replace(frame, pictures=_pictures(ground, scenario, fine, coarse=False))
        yield replace(frame, stage=Stage.FINE, seconds=time.perf_counter() - began)
        with _turn:
            health = certified(frame.health, fine.system, fine.bundle)
        depth = max(maximum_collision_distance(path, scenario.obstacle.signed_distance) for path in frame.rollouts)
        health = replace(health, clearance=-depth if depth > 0 else health.clearance)
        yield replace(frame, stage=Stage.CERTIFIED, health=health, seconds=time.perf_counter() - began)

    def _ground(self, scenario: Scenario, progress: Progress | None) -> _Ground:
        key = (scenario.task, scenario.imitation, scenario.objective)
        if key not in self._grounds:
            task = self.task(scenario.task)
            imitation = self._fits.get(task.demonstrations, ImitationSettings(scenario.objective), progress)
            goal, system = task.to_world(imitation.goal), task.system(imitation)
            if not scenario.imitation:
                system = DiffeomorphicSystem(Identity(len(goal)), replace(system.base, goal=goal))
            rays = Rays(system.transform.forward(task.starts), system.base)
            bundle = evenly_sampled(
                lambda i, u: system.transform.inverse(rays.at(i, u))[:, None], len(rays.z0), NUM_SAMPLES
            )
            self._grounds[key] = _Ground(task, imitation, system, goal, rays, bundle)
        return self._grounds[key]

    def _with_field_and_arm(self, frame: Frame, system: DiffeomorphicSystem) -> Frame:
        lattice = frame.task.slice.lattice(ARROW_SPACING)
        lattice = lattice[frame.scenario.obstacle.signed_distance(lattice) > 0]
        picture = FieldPicture(lattice, system.velocity(lattice))
        arm, doubts = self._arm(frame)
        return replace(frame, field=picture, arm=arm, health=frame.health.doubting(*doubts))

    def _arm(self, frame: Frame) -> tuple[ArmMotion | None, tuple[str, ...]]:
        """The joint motion along the chosen rollout, and what is wrong with it."""
        chosen = frame.scenario.arm_rollout % len(frame.rollouts)
        path, times = frame.rollouts[chosen], frame.times[chosen]
        keep = np.linspace(0, len(path) - 1, NUM_ARM_SAMPLES).round().astype(int)
        path, times = path[keep], times[keep]
        key = (frame.task.name, chosen)
        if key not in self._arm_starts:
            try:
                self._arm_starts[key] = inverse_kinematics(self._robot, frame.task.starts[chosen])
            except UnreachableError as error:
                self._arm_starts[key] = error
        start = self._arm_starts[key]
        if isinstance(start, UnreachableError):
            return None, (f"the arm cannot reach the start of rollout {chosen + 1}: {start}",)
        warm = self._arm_before[1] if self._arm_before and self._arm_before[0] == key else None
        joints = track(self._robot, path, start, warm)
        self._arm_before = (key, joints.q)
        doubts: tuple[str, ...] = ()
        worst = float(joints.error.max())
        if worst > MAX_TRACKING_ERROR:
            because = ", a joint is at its limit" if joints.limits_hit.any() else ""
            doubts = (f"the arm misses the path of rollout {chosen + 1} by up to {1e3 * worst:.0f} mm{because}",)
        return ArmMotion(times, joints.q, joints.q), doubts


def _climb(positions: Array, transforms: Sequence[Diffeomorphism]) -> Array:
    """Levels (N, 1 + len(transforms), 3) above `positions` (N, 3) of a stack given from the inside out."""
    levels = [positions]
    for transform in transforms:
        levels.append(transform.inverse(levels[-1]))
    return np.stack(levels, axis=1)


def _solve(ground: _Ground, scenario: Scenario, precision: Precision) -> _Solution:
    """Build the behaviours for the motion below them, and the exact rollouts of the whole stack.

    A behaviour is made for the samples of the motion that there are. Refinement finds new samples, and ends that the
    behaviours move change the motion a little; so look whether the behaviours still fit, and mend them if not. Where
    there is no way to the goal beside an obstacle that nearly touches it, the motions may end beside the goal.
    """
    solution = None
    for keeps_goal in (True, False):
        rays, bundle = ground.rays, ground.bundle
        ends_below = ground.ends
        durations = [0.0] * len(BEHAVIOURS)
        for _ in range(MAX_ATTEMPTS):
            lowest = Motion(scenario, ground.task.starts, ground.goal, bundle.index, bundle.levels[:, 0], keeps_goal)
            built = _build(lowest, precision.tolerance, durations)
            durations = [made.duration if made else 0.0 for _, made in built]
            outer = [made.transform for _, made in built if made]
            goal = next((made.goal for _, made in reversed(built) if made), ground.goal)

            ends = np.concatenate([ground.task.starts, [goal]])
            below = Chain(outer).forward(ends) if outer else ends
            if np.abs(below - ends_below).max() > precision.ends:
                *z0, z_e = ground.images(below)
                rays, ends_below = Rays(np.stack(z0), replace(ground.system.base, goal=z_e)), below
                positions = ground.system.transform.inverse(rays.at(bundle.index, bundle.fraction))
                bundle = replace(bundle, levels=positions[:, None])
            bundle = replace(bundle, levels=_climb(bundle.levels[:, 0], outer))
            stack = [ground.system.transform, *outer]
            bundle = refined(bundle, lambda i, u, r=rays, s=stack: _climb(r.at(i, u), s)[:, 1:], precision.spacing)
            satisfied = _satisfied(built, bundle)
            solution = _Solution(Chain(stack), rays, bundle, tuple(made for _, made in built if made), satisfied)
            if satisfied or any(made.hopeless for made in solution.built):
                return solution
    assert solution is not None
    return solution


def _build(motion: Motion, tolerance: float, durations: Sequence[float]) -> list[tuple[Motion, Built | None]]:
    """Each behaviour's transform, None where it is off, with the motion that it was made for."""
    built = []
    for k, behaviour in enumerate(BEHAVIOURS):
        made = behaviour.build(motion, tolerance, durations[k])
        built.append((motion, made))
        if made and k < len(BEHAVIOURS) - 1:
            motion = replace(motion, goal=made.goal, positions=made.transform.inverse(motion.positions))
    return built


def _satisfied(built: Sequence[tuple[Motion, Built | None]], bundle: Bundle) -> bool:
    """Whether each behaviour finds on its level of the bundle what it was made for."""
    level = 0
    for behaviour, (motion, made) in zip(BEHAVIOURS, built, strict=True):
        if made:
            level += 1
            after = replace(motion, index=bundle.index, positions=bundle.levels[:, level])
            if not behaviour.satisfied(after):
                return False
    return True


def _pictures(ground: _Ground, scenario: Scenario, solution: _Solution, *, coarse: bool) -> Pictures:
    """Those that the view shows."""
    view, book = scenario.view, ground.sketchbook
    return Pictures(
        generator=book.generator(view.generator_layer) if view.generator else None,
        grid=book.grid([made.transform for made in solution.built], coarse=coarse) if view.grid else None,
        base=book.base(solution.rays) if view.base else None,
    )


def _frame(ground: _Ground, scenario: Scenario, solution: _Solution) -> Frame:
    """The frame of stage ROLLOUTS."""
    bundle = solution.bundle
    clearance = float(scenario.obstacle.signed_distance(bundle.positions).min())
    missed = float(np.linalg.norm(bundle.positions[-1] - ground.goal))
    doubts = [*ground.imitation.warnings, *(doubt for made in solution.built for doubt in made.doubts)]
    if scenario.avoidance and clearance < 0 and not doubts:
        doubts.append(f"a motion enters the obstacle by {-1e3 * clearance:.0f} mm")
    elif not solution.satisfied and not doubts:
        doubts.append(f"a motion keeps only {1e3 * clearance:.1f} mm from the obstacle")
    if missed > MAX_GOAL_MISS and not doubts:
        doubts.append(f"the obstacle leaves no way to the goal: motions end {1e3 * missed:.0f} mm beside it")
    return Frame(
        scenario=scenario,
        task=ground.task,
        stage=Stage.ROLLOUTS,
        ghost=ground.bundle.paths,
        rollouts=bundle.paths,
        times=bundle.split(solution.rays.times(bundle.index, bundle.fraction)),
        goal=ground.goal,
        reached=bundle.positions[-1],
        blocked=(),
        health=Health(
            clearance=clearance,
            duration=solution.built[0].duration if solution.built else None,
            doubts=tuple(doubts),
        ),
    )
