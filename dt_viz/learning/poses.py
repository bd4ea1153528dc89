"""Poses of the hand: its place and its orientation as one stable motion in the augmented state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Protocol, TypeVar

import numpy as np

from dt_viz.flows.augmented_systems import PhaseCurve, PhasedAttractor, Predictions, Shear
from dt_viz.flows.fields import Array
from dt_viz.flows.rotations import exponential, nearest
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning.patterns import Pattern

_T = TypeVar("_T")


class Oriented(Predictions, Protocol):
    """What was learned of places, and of the hand's turns over the same phase."""

    @property
    def radius(self) -> float:
        """Length that a turn of the hand by one radian counts, metres."""
        ...

    @property
    def base(self) -> PhasedAttractor:
        """The base system of states (y, s, a)."""
        ...

    def pattern(self, condition: Array) -> Pattern:
        """The pattern of a condition (c,)."""
        ...

    def over_phase(self, values: Array) -> PhaseCurve:
        """Values (K, …) at the knots, from the start, over the phase."""
        ...


@dataclass(frozen=True, eq=False)
class Poses:
    """Motions of the hand's pose in the augmented state: they are `dt_viz.flows.augmented_systems.Predictions`.

    A pose is (y, r): the place, and the rotation vector at the goal's orientation times the length that a radian
    counts, metres. The shear (y, r, s, a) ↦ (y − c(s; a), r − ρ(s; a), s, a) takes the predicted motion of both away;
    so what pushes the hand, or turns it, dies away along one stable system. Its places are those of the imitation.
    """

    imitation: Oriented
    goal_orientation: Array
    """(4,) orientation of the hand at the goal, wxyz."""

    @property
    def dim(self) -> int:
        """Dimension of the poses, d + 3."""
        return self.imitation.dim + 3

    @property
    def num_conditions(self) -> int:
        """Number of coordinates of a condition, as of the imitation."""
        return self.imitation.num_conditions

    @cached_property
    def system(self) -> DiffeomorphicSystem:
        """The learned dynamical system, of states (y, r, s, a)."""
        base = self.imitation.base
        goal = np.zeros(self.dim + 1 + self.num_conditions)
        return DiffeomorphicSystem(Shear(self), replace(base, goal=goal, predictions=self))

    def states(self, places: Array, label: float | None = None) -> Array:
        """The states (*B, d + 4 + c) in which motions from poses (*B, d + 3) begin; see the imitation's."""
        dim = self.imitation.dim
        own = self.imitation.states(places[..., :dim], label)
        return np.concatenate([places, own[..., dim:]], axis=-1)

    def demonstrated(self, starts: Array) -> Array:
        """The same of all demonstrations, from the poses (R, d + 3) in which they begin."""
        dim = self.imitation.dim
        return np.concatenate([starts, self.imitation.demonstrated(starts[:, :dim])[:, dim:]], axis=-1)

    def caught(self, state: Array) -> float:
        """The phase at which a motion goes on that was pushed to a state; a turn of the hand does not change it."""
        return self.imitation.caught(np.delete(state, np.s_[self.imitation.dim : self.dim]))

    def curve(self, condition: Array) -> PhaseCurve:
        """The poses (d + 3,), metres, that are predicted for a condition (c,), over the phase."""
        return self._curves(condition.tobytes())

    def sensitivity(self, condition: Array) -> PhaseCurve:
        """Its derivative (d + 3, c) with respect to the condition."""
        own = self.imitation
        slopes = own.pattern(condition).pose_slopes(condition[: own.dim])
        return own.over_phase(np.concatenate([slopes, np.zeros_like(slopes[..., :1])], axis=-1))

    def clock(self, condition: Array) -> Attractor:
        """The clock of the phase, as of the imitation."""
        return self.imitation.clock(condition)

    def predicted(self, rest: Array) -> Array:
        """Orientations (N, 4), wxyz, that are predicted for phases and conditions (N, 1 + c)."""
        d = self.imitation.dim
        still = np.zeros((len(rest), self.dim))  # poses in base space: nothing leads off the motion
        return self.orientations(self.system.transform.inverse(np.hstack([still, rest]))[:, d : d + 3])

    def orientations(self, turns: Array) -> Array:
        """Orientations (*B, 4), wxyz, of the coordinates r (*B, 3) of states."""
        return exponential(self.goal_orientation, turns / self.imitation.radius)

    def turns(self, orientations: Array, near: Array) -> Array:
        """The coordinates r (N, 3) of states with orientations (N, 4), wxyz: of all of one, those nearest to others.

        Args:
            orientations: of the hand.
            near: (N, 3) coordinates r, metres.
        """
        radius = self.imitation.radius
        pairs = zip(near / radius, orientations, strict=True)
        return radius * np.stack([nearest(self.goal_orientation, turned, to) for to, turned in pairs])

    @cached_property
    def _curves(self) -> Callable[[bytes], PhaseCurve]:
        own = self.imitation
        return latest(lambda condition: own.over_phase(own.pattern(condition).poses(condition[: own.dim])))


def latest(compute: Callable[[Array], _T]) -> Callable[[bytes], _T]:
    """A function of a condition's bytes whose latest results are kept."""
    return lru_cache(64)(lambda content: compute(np.frombuffer(content)))
