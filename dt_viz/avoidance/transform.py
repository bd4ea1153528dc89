"""Base class of the transforms: values that are built into one diffeomorphism each (sec. 4.1).

A new kind of transform is one file with a subclass of `Transform`, and one line in `dt_viz.avoidance.registry`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from dt_viz.avoidance.detour import Detour
from dt_viz.flows.diffeomorphisms import AUTO, Diffeomorphism, Flow, Integration
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Point
from dt_viz.obstacles.union import Union
from dt_viz.warning import Kind, MotionWarning

MOST_DURATION = 100.0  # longest flow time that a transform may have


@dataclass(frozen=True)
class MotionBelow:
    """The motion one level down, which a transform is to change."""

    starts: Array  # (R, 3) starts, metres
    goal: Array  # (3,) goal of the motions, metres
    index: Indices  # (N,) which rollout a sample belongs to
    positions: Array  # (N, 3) samples of the rollouts, metres
    name: str = ""  # name of the transform, for its warnings
    tolerance: float = 2e-9  # tolerance of a step of the transform's flow, metres
    earlier: Built | None = None
    """The transform as an earlier attempt made it for nearly this motion; None at the first one."""
    above: Diffeomorphism | None = None
    """ψ from the top of the stack to the manifold of the transform, as far as it has been built."""
    keeps_goal: bool = True  # whether transforms that are not meant to move the goal must keep it
    shaping: Mask | None = None
    """(R,) rollouts that the transform is made for; None is all. The others are carried along."""
    targets: tuple[Point, ...] = ()
    """Places that transforms further down lead the motions to, metres."""
    detours: tuple[Detour | None, ...] = ()
    """Detours around the transform's obstacles that are carried over from before these were dragged to where they are;
    empty without any. See `dt_viz.avoidance.detour.carried_over`."""

    @property
    def at_least(self) -> float:
        """Lower bound of an automatic flow time: what an earlier attempt needed."""
        return 0.0 if self.earlier is None else self.earlier.duration

    @property
    def demonstrated(self) -> MotionBelow:
        """The motion without rollouts that the transform is not made for."""
        shaping = self.shaping
        if shaping is None or shaping.all():
            return self
        rows = shaping[self.index]
        index = np.cumsum(shaping)[self.index[rows]] - 1
        return replace(self, starts=self.starts[shaping], shaping=None, index=index, positions=self.positions[rows])

    def warning(self, kind: Kind, text: str) -> MotionWarning:
        """Return a warning about the transform that changes this motion."""
        return MotionWarning(kind, text, self.name)


@dataclass(frozen=True)
class Built:
    """A transform built for a motion."""

    transform: Diffeomorphism  # ψ, from the manifold with the transform to the one without
    duration: float  # t of its flow
    goal: Array
    """(3,) goal of motions with the transform, metres: `MotionBelow.goal` if that is to stay, else its image under
    ψ⁻¹."""
    hopeless: bool = False
    """Whether no flow time does what is wanted, so that another attempt is useless."""
    warnings: tuple[MotionWarning, ...] = ()
    integration: Integration = AUTO
    """Integration of its flow; the error of one chosen by hand is checked."""
    chosen: Mapping[str, float] = field(default_factory=dict, compare=False)
    """Values that were chosen automatically, by the transform's fields."""
    detours: tuple[Detour | None, ...] = field(default=(), compare=False)
    """Detours around the obstacles that it avoids; None of those that are not in the way."""
    sideways: tuple[Flow, ...] = field(default=(), compare=False)
    """Flows along these, which come before its own; see `dt_viz.avoidance.sideways`."""


@lru_cache(maxsize=64)
def axes_of(plane: tuple[Point, Point] | None) -> Array:
    """Return orthonormal columns (3, 3), read only, those of a plane first, if there is one."""
    axes = np.eye(3)
    if plane is not None:
        axes[:, 0], axes[:, 1] = plane
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    axes.flags.writeable = False
    return axes


@dataclass(frozen=True)
class Transform(ABC):
    """A kind of transform that can be stacked; subclasses are frozen dataclasses, compared by their fields."""

    @abstractmethod
    def build(self, motion: MotionBelow) -> Built:
        """Build the diffeomorphism for this motion."""

    @property
    def acts(self) -> bool:
        """Whether it changes the end effector's motion; if not it is left out of the stack."""
        return True

    @cached_property
    def avoided(self) -> Union:
        """The obstacles that it leads motions around; if these leave no way to the goal, motions may end beside it."""
        return Union()

    def satisfied(self, motion: MotionBelow, top: Array) -> bool:
        """Return whether motions behave as wanted.

        Args:
            motion: their samples just above the transform.
            top: (N, 3) the same samples at the top of the stack, where the robot moves, metres.
        """
        return True

    def shortfall(self, motion: MotionBelow, made: Built, *, satisfied: bool) -> tuple[MotionWarning, ...]:
        """Return warnings about wishes of the transform that are not met.

        Args:
            motion: samples at the top of the stack.
            made: result of `build`.
            satisfied: result of `satisfied`.
        """
        if satisfied or (made.hopeless and made.warnings):
            return ()
        return (motion.warning(Kind.UNREACHED, f"{motion.name}: not every motion does what it asks for"),)


class Planar(Transform):
    """A transform that may act along a plane only."""

    plane: tuple[Point, Point] | None
    """Two orthonormal vectors of that plane; None is in space."""


class Anchored(Planar):
    """A transform that leads motions to a place, by which it is dragged in the scene; in its plane if it has one."""

    position: Point
    """The place, metres."""
    radius: float | None
    """Radius of the region around the place in which it acts, metres; None where that is chosen automatically."""
    moves_goal: bool
    """Whether motions are to end at the place."""

    def deflected(self, motion: MotionBelow, made: Built, who: str) -> tuple[MotionWarning, ...]:
        """Return warnings about wishes, satisfied by what was made, that `who` gives way to obstacles does not meet."""
        return ()
