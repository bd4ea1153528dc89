"""The undisturbed motion: what was learned for a task, and its rollouts from the task's starts and from added ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dt_viz.avoidance.passing import Stance
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Bundle, Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.interface import AnyImitation
from dt_viz.memo import Memo
from dt_viz.scenario.scenario import Start
from dt_viz.scenario.tasks import Task
from dt_viz.warning import MotionWarning

NUM_SAMPLES, NUM_ADDED_SAMPLES = 200, 100
"""Samples of each rollout before refinement: from the task's starts, and from added ones."""
MAX_CHORDS, IMAGE_TOLERANCE = 6, 1e-9
"""Steps towards the images of moved ends, and metres by which they may miss."""


@dataclass(frozen=True, eq=False)
class NominalTrajectory:
    """One undisturbed rollout."""

    start: Array
    """(3,), metres."""
    image: Array
    """ψ of the state in which it begins, (k,)."""
    jacobian: Array
    """(k, 3) derivative of ψ with respect to the place, there."""
    fraction: Array
    """(n,) where on its base ray the samples are."""
    positions: Array
    """(n, 3) samples, metres."""


@dataclass(frozen=True, eq=False)
class Learned:
    """The learned motion of a task, wherever its rollouts start."""

    task: Task
    imitation: AnyImitation
    system: DiffeomorphicSystem
    """The system of its states: places (3,) in the plain state; see `flows.augmented_systems` for the augmented one."""
    goal: Array
    """(3,), metres."""

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
        return Nominal(self, self._trajectories(self.system.base.demonstrated(self.task.starts), NUM_SAMPLES))

    def warped(self, fraction: float) -> Learned:
        """The same with the imitation's flows run for a fraction of their durations."""
        transform, base = self.system.transform.scaled(fraction), self.system.base
        base = replace(base, goal=transform.forward(self.system.transform.inverse(base.goal)))
        return replace(self, system=DiffeomorphicSystem(transform, base))

    @cached_property
    def at_goal(self) -> tuple[Array, Array]:
        """ψ (1, k) and its derivative (1, k, 3) with respect to the place, at the goal."""
        return self.images(self.system.transform.inverse(self.system.base.goal[None]))

    def images(self, states: Array) -> tuple[Array, Array]:
        """ψ (N, k) of states (N, k), and its derivatives (N, k, 3) with respect to the places."""
        along = np.broadcast_to(np.eye(states.shape[1])[:, :3], (*states.shape, 3))
        return self.system.transform.forward_tangents(states, along)

    def places(self, base_states: Array) -> Array:
        """Places (N, 3), metres, of base states (N, k): the first coordinates of ψ⁻¹."""
        return self.system.transform.inverse(base_states)[:, :3]

    @property
    def labels(self) -> tuple[float, ...]:
        """The labels that a start may have."""
        return self.imitation.known_labels

    @property
    def demonstrated_labels(self) -> tuple[float, ...]:
        """The label of each demonstration; none where there are none."""
        return self.imitation.labels or ()

    def trajectory(self, start: Start) -> NominalTrajectory:
        """The rollout from an added start; a label that it cannot have is that of the nearest demonstrated start."""
        label = start.label if start.label in self.labels else None
        return self._trajectories(self.system.base.states(np.array([start.place]), label), NUM_ADDED_SAMPLES)[0]

    def nominal(self, added: Sequence[NominalTrajectory]) -> Nominal:
        """The rollouts from the task's starts and from added ones."""
        return Nominal(self, (*self.demonstrated.trajectories, *added)) if added else self.demonstrated

    def _trajectories(self, states: Array, num_samples: int) -> tuple[NominalTrajectory, ...]:
        images, jacobians = self.images(states)
        rays = Rays(images, self.system.base)
        bundle = evenly_sampled(lambda i, u: self.places(rays.at(i, u))[:, None], len(states), num_samples)
        parts = states[:, :3], images, jacobians, bundle.split(bundle.fraction), bundle.paths
        return tuple(NominalTrajectory(*part) for part in zip(*parts, strict=True))


@dataclass(frozen=True, eq=False)
class Nominal:
    """The motion that transforms are stacked on: the learned one, and its rollouts from some starts."""

    learned: Learned
    trajectories: tuple[NominalTrajectory, ...]
    """The rollouts; those from the task's starts first."""
    left_out: tuple[int, ...] = ()
    """Numbers of the starts, the task's first, that have no rollout here."""
    warnings: tuple[MotionWarning, ...] = ()
    """Why they have none."""
    stance: Stance | None = None
    """Posture that the arm stays near to; None is its usual one."""

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

    @property
    def num_demonstrated(self) -> int:
        """Number of the rollouts, the first ones, that have a demonstration."""
        return len(self.task.demonstrations)

    @property
    def num_added(self) -> int:
        """Number of the rollouts, the last ones, that have none."""
        return sum(number >= self.num_demonstrated for number in self.numbers)

    @property
    def num_shaping(self) -> int:
        """Number of the rollouts, the first ones, that begin at the task's starts: flows are made for these."""
        return len(self.trajectories) - self.num_added

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """Number of each rollout's start among all of the scenario's, the task's first."""
        total = len(self.trajectories) + len(self.left_out)
        return tuple(number for number in range(total) if number not in self.left_out)

    def rollout(self, number: int) -> int | None:
        """Index of the rollout that begins at the start of this number; None if it has none."""
        return self.numbers.index(number) if number in self.numbers else None

    def only(self, rollouts: Sequence[int] | Indices, warnings: Sequence[MotionWarning] = ()) -> Nominal:
        """Some of the rollouts, and why the others are left out: the same ones are the same object."""

        def chosen() -> Nominal:
            kept = {self.numbers[k] for k in rollouts}
            left_out = (*self.left_out, *(number for number in self.numbers if number not in kept))
            trajectories = tuple(self.trajectories[k] for k in rollouts)
            return replace(self, trajectories=trajectories, left_out=tuple(sorted(left_out)), warnings=tuple(warnings))

        return self._parts("only", (tuple(rollouts), tuple(warnings)), chosen, newest=4)

    @cached_property
    def _parts(self) -> Memo:
        return Memo()

    def warped(self, fraction: float) -> Nominal:
        """The rollouts with the imitation's flows run for a fraction of their durations; samples keep their places."""
        learned = self.learned.warped(fraction)
        images, jacobians = learned.images(self.states)
        bundle = self.bundle
        samples = Rays(images, learned.system.base).at(bundle.index, bundle.fraction)
        paths = bundle.split(learned.places(samples))
        trajectories = (
            replace(trajectory, image=image, jacobian=jacobian, positions=path)
            for trajectory, image, jacobian, path in zip(self.trajectories, images, jacobians, paths, strict=True)
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

    def states_of(self, rollout: int) -> Array:
        """(n, k) states of the samples of a rollout."""
        trajectory = self.trajectories[rollout]
        samples = self.rays.at(np.full(len(trajectory.fraction), rollout), trajectory.fraction)
        return np.concatenate([trajectory.positions, samples[:, 3:]], axis=1)

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
    def paths(self) -> tuple[Array, ...]:
        """Positions of each rollout, (T_i, 3), metres."""
        return tuple(trajectory.positions for trajectory in self.trajectories)

    @cached_property
    def ends(self) -> Array:
        """(R + 1, 3) starts and goal, metres."""
        return np.concatenate([self.starts, [self.goal]])

    def rays_between(self, ends: Array) -> Rays:
        """Rays of motions that begin and end elsewhere, not far away: `ends` (R + 1, 3), metres; see `ends`."""
        *z0, z_e = self._images(ends)
        return Rays(np.stack(z0), replace(self.system.base, goal=z_e))

    def _images(self, ends: Array) -> Array:
        """ψ of the states at `ends`: by chord steps on ψ⁻¹, which is the cheaper side of ψ."""
        at_goal, J_at_goal = self.learned.at_goal
        images = np.concatenate([self.rays.z0, at_goal])
        J = np.concatenate([[trajectory.jacobian for trajectory in self.trajectories], J_at_goal])
        error = ends - self.ends
        for _ in range(MAX_CHORDS):
            images = images + (J @ error[..., None])[..., 0]
            error = ends - self.learned.places(images)
            if np.abs(error).max() <= IMAGE_TOLERANCE:
                return images
        return self.system.transform.forward(np.concatenate([ends, images[:, 3:]], axis=1))
