"""The undisturbed motion: what was learned for a task, and its rollouts from the task's starts and from added ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.avoidance import StartStatus, start_warnings
from dt_viz.avoidance.lift import NUM_CONFIGURATIONS
from dt_viz.avoidance.passing import Posture
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.flows.rollouts import Bundle, Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.augmented import AugmentedImitation, Style, fit_augmented
from dt_viz.learning.imitation import ImitationSettings, Progress
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.store import FitStore
from dt_viz.memo import cached_property
from dt_viz.scenario.scenario import Scenario, Start
from dt_viz.scenario.tasks import OWN, Task
from dt_viz.warning import MotionWarning

NUM_SAMPLES = 200
"""Samples of each rollout from the task's starts before refinement; an added one has `NUM_CONFIGURATIONS`."""


@dataclass(frozen=True, eq=False)
class NominalTrajectory:
    """One undisturbed rollout."""

    start: Array  # (3,), metres
    image: Array  # ψ of the state in which it begins, (k,)
    fraction: Array  # (n,) where on its base ray the samples are
    positions: Array  # (n, 3) samples, metres
    orientations: Array | None = None
    """(n, 4) orientations of the hand there, wxyz; None where none were learned."""


@dataclass(frozen=True, eq=False)
class Learned:
    """The learned motion of a task, wherever its rollouts start."""

    task: Task
    imitation: AnyImitation
    system: DiffeomorphicSystem
    """The system of its states: places (3,) in the plain state; see `flows.augmented_systems` for the augmented one."""
    goal: Array  # (3,), metres

    @classmethod
    def of(cls, task: Task, imitation: AnyImitation, *, imitates: bool) -> Learned:
        """The motion of a task; straight to the goal unless it `imitates`."""
        goal, system = task.to_world(imitation.goal), task.system(imitation)
        if not imitates:
            system = DiffeomorphicSystem(Identity(len(goal)), replace(system.base, goal=goal))
        return cls(task, imitation, system, goal)

    @cached_property
    def demonstrated(self) -> Nominal:
        """The rollouts from the task's starts."""
        trajectories = self._trajectories(self.system.base.demonstrated(self.task.starts), NUM_SAMPLES)
        return Nominal(self, trajectories, (StartStatus.OK,) * len(trajectories))

    def warped(self, fraction: float) -> Learned:
        """The same with the imitation's flows run for a fraction of their durations."""
        transform, base = self.system.transform.scaled(fraction), self.system.base
        base = replace(base, goal=transform.forward(self.system.transform.inverse(base.goal)))
        return replace(self, system=DiffeomorphicSystem(transform, base))

    def places(self, base_states: Array) -> Array:
        """Places (N, 3), metres, of base states (N, k): the first coordinates of ψ⁻¹."""
        return self.system.transform.inverse(base_states)[:, :3]

    @cached_property
    def poses(self) -> AugmentedImitation | None:
        """The motions of the hand's pose, in the world; None of motions without orientations."""
        predictions = getattr(self.system.base, "predictions", None)
        return getattr(predictions, "poses", None)

    @property
    def labels(self) -> tuple[float, ...]:
        """The labels that a start may have."""
        return self.imitation.known_labels

    def trajectory(self, start: Start) -> NominalTrajectory:
        """The rollout from an added start; a label that it cannot have is that of the nearest demonstrated start."""
        label = start.label if start.label in self.labels else None
        return self._trajectories(self.system.base.states(np.array([start.place]), label), NUM_CONFIGURATIONS)[0]

    def nominal(self, added: Sequence[NominalTrajectory]) -> Nominal:
        """The rollouts from the task's starts and from added ones."""
        own = self.demonstrated
        status = own.status + (StartStatus.OK,) * len(added)
        return replace(own, trajectories=(*own.trajectories, *added), status=status) if added else own

    def _trajectories(self, states: Array, num_samples: int) -> tuple[NominalTrajectory, ...]:
        images = self.system.transform.forward(states)
        rays = Rays(images, self.system.base)
        bundle = evenly_sampled(lambda i, u: self.places(rays.at(i, u))[:, None], len(states), num_samples)
        turns: Sequence[Array | None] = [None] * len(states)
        if self.poses is not None:
            turns = bundle.split(self.poses.predicted(rays.at(bundle.index, bundle.fraction)[:, 3:]))
        parts = states[:, :3], images, bundle.split(bundle.fraction), bundle.paths, turns
        return tuple(NominalTrajectory(*part) for part in zip(*parts, strict=True))


@dataclass(frozen=True)
class Nominal:
    """The motion that transforms are stacked on: the learned one, and its rollouts from all starts of a scenario.

    A start keeps its place in the order of the scenario, the task's first, then added ones; so does all that belongs to
    it, here and in what is made of this.
    """

    learned: Learned
    trajectories: tuple[NominalTrajectory, ...]  # (R) the rollouts
    status: tuple[StartStatus, ...]  # (R) whether each start has a motion, or why it has none
    posture: Posture | None = None  # posture that the arm stays near to; None is its usual one

    @property
    def task(self) -> Task:
        """The task of the demonstrations."""
        return self.learned.task

    @property
    def imitation(self) -> AnyImitation:
        """The imitation of the demonstrations."""
        return self.learned.imitation

    @property
    def system(self) -> DiffeomorphicSystem:
        """The system that the rollouts are motions of."""
        return self.learned.system

    @property
    def goal(self) -> Array:
        """(3,), metres."""
        return self.learned.goal

    @cached_property
    def moving(self) -> Mask:
        """(R,) starts that have a motion."""
        return np.array([status is StartStatus.OK for status in self.status])

    @cached_property
    def added(self) -> Mask:
        """(R,) starts that are added ones: they have no demonstration."""
        return np.arange(len(self.status)) >= len(self.task.starts)

    @cached_property
    def shaping(self) -> Mask:
        """(R,) starts whose motions transforms are made for: the task's that have one."""
        return self.moving & ~self.added

    @cached_property
    def warnings(self) -> tuple[MotionWarning, ...]:
        """Why starts have no motion."""
        return tuple(
            warning
            for why in StartStatus
            if why is not StartStatus.OK
            for warning in start_warnings(
                np.array([status is why for status in self.status]), self.added, why.kind, why.value
            )
        )

    def without(self, which: Mask, why: StartStatus) -> Nominal:
        """The same with a status of those of the starts `which` (R,) that had a motion."""
        left_out = which & self.moving
        status = tuple(why if out else before for out, before in zip(left_out, self.status, strict=True))
        return replace(self, status=status) if left_out.any() else self

    def warped(self, fraction: float) -> Nominal:
        """The rollouts with the imitation's flows run for a fraction of their durations; samples keep their places."""
        learned = self.learned.warped(fraction)
        images = learned.system.transform.forward(self.states)
        bundle = self.bundle
        samples = Rays(images, learned.system.base).at(bundle.index, bundle.fraction)
        paths = bundle.split(learned.places(samples))
        trajectories = (
            replace(trajectory, image=image, positions=path)
            for trajectory, image, path in zip(self.trajectories, images, paths, strict=True)
        )
        return replace(self, learned=learned, trajectories=tuple(trajectories))

    @cached_property
    def starts(self) -> Array:
        """(R, 3), metres."""
        return np.stack([trajectory.start for trajectory in self.trajectories])

    @property
    def states(self) -> Array:
        """(R, k) states in which the rollouts begin."""
        return np.concatenate([self.starts, self.rays.z0[:, 3:]], axis=1)

    def rest(self, rollout: int) -> Array:
        """(k − 3,) what the state in which a rollout begins consists of besides the place."""
        return self.rays.z0[rollout, 3:].copy()

    @cached_property
    def rays(self) -> Rays:
        """Rays of the rollouts in base space."""
        return Rays(np.stack([trajectory.image for trajectory in self.trajectories]), self.system.base)

    @cached_property
    def bundle(self) -> Bundle:
        """Samples of the rollouts."""
        fractions, positions = zip(*((each.fraction, each.positions) for each in self.trajectories), strict=True)
        index = np.repeat(np.arange(len(fractions)), [len(fraction) for fraction in fractions])
        return Bundle(index, np.concatenate(fractions), np.concatenate(positions)[:, None])

    @cached_property
    def orientations(self) -> tuple[Array, ...] | None:
        """Orientations of the hand along each rollout, (T_i, 4), wxyz; None where none were learned."""
        turns = tuple(each.orientations for each in self.trajectories if each.orientations is not None)
        return turns or None

    @cached_property
    def paths(self) -> tuple[Array, ...]:
        """Positions of each rollout, (T_i, 3), metres."""
        return tuple(trajectory.positions for trajectory in self.trajectories)

    @cached_property
    def ends(self) -> Array:
        """(R + 1, 3) starts and goal, metres."""
        return np.concatenate([self.starts, [self.goal]])

    def orientations_at(self, index: Indices, fraction: Array) -> Array | None:
        """Orientations (N, 4) of the hand, wxyz, of rollouts (N,) at fractions (N,) of their rays.

        What is stacked moves places and leaves them as they are. None of motions without orientations.
        """
        poses = self.learned.poses
        return None if poses is None else poses.predicted(self.rays.at(index, fraction)[:, 3:])

    def rays_between(self, ends: Array) -> Rays:
        """Rays of motions that begin and end elsewhere: `ends` (R + 1, 3), metres; see `ends`."""
        rest = np.concatenate([self.rays.z0[:, 3:], [self.system.base.goal[3:]]])
        *z0, z_e = self.system.transform.forward(np.concatenate([ends, rest], axis=1))
        return Rays(np.stack(z0), replace(self.system.base, goal=z_e))


def learned_of(scenario: Scenario, task: Task, fits: FitStore, progress: Progress | None = None) -> Learned:
    """Learn the scenario's task without a style.

    Raises:
        ImitationError: nothing can be learned from its demonstrations.
    """
    state = task.state if scenario.state == "auto" else scenario.state
    state = state if scenario.imitation else "plain"  # without it there is nothing to remember
    settings, imitation = ImitationSettings(scenario.objective, preparation=task.preparation), task.imitation
    if imitation is None or imitation.state != state or scenario.objective != "trajectory":
        imitation = fits.learned(task.demonstrations, settings, state, progress)
    if imitation.state == "augmented" and scenario.state == "auto" and not imitation.reason:
        own = task.name.startswith(OWN)
        why = "it is learned at once" if own else "the plain state misses a demonstration of this task"
        imitation = replace(imitation, reason=why)
    return Learned.of(task, imitation, imitates=scenario.imitation)


def augmented_of(task: Task) -> AugmentedImitation:
    """Learn a task in the augmented state, to take or put on a style. Raises ImitationError."""
    return fit_augmented(task.demonstrations, settings=AugmentedSettings(preparation=task.preparation))


def styled(
    task: Task, own: AugmentedImitation, usual: AugmentedImitation, other: AugmentedImitation, amount: float
) -> Learned:
    """Put a part of what leads from the usual hand to the other one on what was learned of a task."""
    return Learned.of(task, Style.between(usual, other).on(own, amount), imitates=True)
