"""The undisturbed motion: what was learned for a task, and its rollouts from the task's starts and from added ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Bundle, Rays, evenly_sampled
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.imitation import Imitation
from dt_viz.obstacles.shapes import Point
from dt_viz.properties import cached_property
from dt_viz.scenario.tasks import Task
from dt_viz.warning import MotionWarning

NUM_SAMPLES, NUM_ADDED_SAMPLES = 200, 100
"""Samples of each rollout before refinement: from the task's starts, and from added ones."""
Stance = tuple[float, float, float, float, float, float]
"""Posture that the arm stays near to along all rollouts: six joint angles, rad."""
MAX_CHORDS, IMAGE_TOLERANCE = 6, 1e-9
"""Steps towards the images of moved ends, and metres by which they may miss."""


@dataclass(frozen=True, eq=False)
class Strand:
    """One undisturbed rollout."""

    start: Array
    """(3,), metres."""
    image: Array
    """ψ(start), (3,)."""
    jacobian: Array
    """(3, 3) derivative of ψ at the start."""
    fraction: Array
    """(n,) where on its base ray the samples are."""
    positions: Array
    """(n, 3) samples, metres."""


@dataclass(frozen=True, eq=False)
class Learned:
    """The learned motion of a task, wherever its rollouts start."""

    task: Task
    imitation: Imitation
    system: DiffeomorphicSystem
    goal: Array
    """(3,), metres."""

    @classmethod
    def of(cls, task: Task, imitation: Imitation, *, imitates: bool) -> Learned:
        """The motion of a task; straight to the goal unless it `imitates`."""
        goal, system = task.to_world(imitation.goal), task.system(imitation)
        if not imitates:
            system = DiffeomorphicSystem(Identity(len(goal)), replace(system.base, goal=goal))
        return cls(task, imitation, system, goal)

    @cached_property
    def demonstrated(self) -> Nominal:
        """The rollouts from the task's starts."""
        return Nominal(self, self._strands(self.task.starts, NUM_SAMPLES))

    def warped(self, fraction: float) -> Learned:
        """The same with the imitation's flows run for a fraction of their durations."""
        transform = self.system.transform.scaled(fraction)
        base = replace(self.system.base, goal=transform.forward(self.goal))
        return replace(self, system=DiffeomorphicSystem(transform, base))

    @cached_property
    def at_goal(self) -> tuple[Array, Array]:
        """ψ (1, 3) and its derivative (1, 3, 3) at the goal."""
        return self.system.transform.jacobian(self.goal[None])

    def strand(self, start: Point) -> Strand:
        """The rollout from an added start, metres."""
        return self._strands(np.array([start]), NUM_ADDED_SAMPLES)[0]

    def nominal(self, added: Sequence[Strand]) -> Nominal:
        """The rollouts from the task's starts and from added ones."""
        return Nominal(self, (*self.demonstrated.strands, *added)) if added else self.demonstrated

    def _strands(self, starts: Array, num_samples: int) -> tuple[Strand, ...]:
        images, jacobians = self.system.transform.jacobian(starts)
        rays = Rays(images, self.system.base)
        bundle = evenly_sampled(
            lambda i, u: self.system.transform.inverse(rays.at(i, u))[:, None], len(starts), num_samples
        )
        parts = starts, images, jacobians, bundle.split(bundle.fraction), bundle.paths
        return tuple(Strand(*part) for part in zip(*parts, strict=True))


@dataclass(frozen=True, eq=False)
class Nominal:
    """The motion that transforms are stacked on: the learned one, and its rollouts from some starts."""

    learned: Learned
    strands: tuple[Strand, ...]
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
    def imitation(self) -> Imitation:
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
    def num_hosts(self) -> int:
        """Number of the rollouts, the first ones, that begin at the task's starts."""
        return len(self.strands) - self.num_added

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """Number of each rollout's start among all of the scenario's, the task's first."""
        total = len(self.strands) + len(self.left_out)
        return tuple(number for number in range(total) if number not in self.left_out)

    def rollout(self, number: int) -> int | None:
        """Index of the rollout that begins at the start of this number; None if it has none."""
        return self.numbers.index(number) if number in self.numbers else None

    def only(self, rollouts: Sequence[int] | Indices, warnings: Sequence[MotionWarning] = ()) -> Nominal:
        """Some of the rollouts, and why the others are left out."""
        kept = {self.numbers[k] for k in rollouts}
        left_out = (*self.left_out, *(number for number in self.numbers if number not in kept))
        strands = tuple(self.strands[k] for k in rollouts)
        return replace(self, strands=strands, left_out=tuple(sorted(left_out)), warnings=tuple(warnings))

    def warped(self, fraction: float) -> Nominal:
        """The rollouts with the imitation's flows run for a fraction of their durations; samples keep their places."""
        learned = self.learned.warped(fraction)
        images, jacobians = learned.system.transform.jacobian(self.starts)
        bundle = self.bundle
        samples = Rays(images, learned.system.base).at(bundle.index, bundle.fraction)
        paths = bundle.split(learned.system.transform.inverse(samples))
        strands = (
            replace(strand, image=image, jacobian=jacobian, positions=path)
            for strand, image, jacobian, path in zip(self.strands, images, jacobians, paths, strict=True)
        )
        return replace(self, learned=learned, strands=tuple(strands))

    @cached_property
    def starts(self) -> Array:
        """(R, 3), metres."""
        return np.stack([strand.start for strand in self.strands])

    @cached_property
    def rays(self) -> Rays:
        """Rays of the rollouts in base space."""
        return Rays(np.stack([strand.image for strand in self.strands]), self.system.base)

    @cached_property
    def bundle(self) -> Bundle:
        """Samples of the rollouts."""
        index = np.repeat(np.arange(len(self.strands)), [len(strand.fraction) for strand in self.strands])
        fraction = np.concatenate([strand.fraction for strand in self.strands])
        return Bundle(index, fraction, np.concatenate([strand.positions for strand in self.strands])[:, None])

    @cached_property
    def paths(self) -> tuple[Array, ...]:
        """Positions of each rollout, (T_i, 3), metres."""
        return tuple(strand.positions for strand in self.strands)

    @cached_property
    def ends(self) -> Array:
        """(R + 1, 3) starts and goal, metres."""
        return np.concatenate([self.starts, [self.goal]])

    def images(self, ends: Array) -> Array:
        """ψ of points (R + 1, 3) not far from `ends`: by chord steps on ψ⁻¹, which is the cheaper side of ψ."""
        at_goal, J_at_goal = self.learned.at_goal
        images = np.concatenate([self.rays.z0, at_goal])
        J = np.concatenate([[strand.jacobian for strand in self.strands], J_at_goal])
        error = ends - self.ends
        for _ in range(MAX_CHORDS):
            images = images + (J @ error[..., None])[..., 0]
            error = ends - self.system.transform.inverse(images)
            if np.abs(error).max() <= IMAGE_TOLERANCE:
                return images
        return self.system.transform.forward(ends)
