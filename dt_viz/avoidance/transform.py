"""Base class of the transforms: values that are built into one diffeomorphism each (sec. 4.1).

A new kind of transform is one file with a subclass of `Transform`, and one line in `dt_viz.avoidance.registry`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, TypeVar

import numpy as np

from dt_viz.avoidance.detour import Detour
from dt_viz.flows.diffeomorphisms import AUTO, AdaptiveFlow, Diffeomorphism, Flow, Integration
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.obstacles.shapes import Point
from dt_viz.obstacles.union import Union
from dt_viz.warning import Kind, MotionWarning

MOST_DURATION = 100.0
"""Longest flow time that a transform may have."""
Aside = AdaptiveFlow | Flow
"""Flow along a way out of an obstacle."""


@dataclass(frozen=True)
class MotionBelow:
    """The motion one level down, which a transform is to change."""

    starts: Array
    """(R, 3) starts, metres."""
    goal: Array
    """(3,) goal of the motions, metres."""
    index: Indices
    """(N,) which rollout a sample belongs to."""
    positions: Array
    """(N, 3) samples of the rollouts, metres."""
    name: str = ""
    """Name of the transform, for its warnings."""
    tolerance: float = 2e-9
    """Tolerance of a step of the transform's flow, metres."""
    earlier: Built | None = None
    """The transform as an earlier attempt made it for nearly this motion; None at the first one."""
    above: Diffeomorphism | None = None
    """ψ from the top of the stack to the manifold of the transform, as far as it has been built."""
    top: Array | None = None
    """(N, 3) the same samples at the top of the stack, where the robot moves, metres; None before it is built."""
    keeps_goal: bool = True
    """Whether transforms that are not meant to move the goal must keep it."""
    shaping: Mask | None = None
    """(R,) rollouts that the transform is made for; None is all. The others are carried along."""
    targets: tuple[Point, ...] = ()
    """Places that transforms further down lead the motions to, metres."""
    detours: tuple[Detour | None, ...] = ()
    """Detours around the transform's obstacles to keep while these are dragged; see `dt_viz.avoidance.passing`."""
    gradual: bool = False
    """Whether these turn to where they are to be as the obstacles move on; else they are there at once."""

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
        index, top = np.cumsum(shaping)[self.index[rows]] - 1, None if self.top is None else self.top[rows]
        samples = {"index": index, "positions": self.positions[rows], "top": top}
        return replace(self, starts=self.starts[shaping], shaping=None, **samples)

    def warning(self, kind: Kind, text: str) -> MotionWarning:
        """Return a warning about the transform that changes this motion."""
        return MotionWarning(kind, text, self.name)


@dataclass(frozen=True)
class Built:
    """A transform built for a motion."""

    transform: Diffeomorphism
    """ψ, from the manifold with the transform to the one without."""
    duration: float
    """t of its flow."""
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
    """Ways around the obstacles that it avoids; None of those that are not in the way."""
    aside: tuple[Aside, ...] = field(default=(), compare=False)
    """Flows along these, which come before its own."""


@dataclass(frozen=True)
class Number:
    """A setting that is a slider on the page."""

    field: str
    """Name of the transform's field."""
    label: str
    unit: str
    low: float
    high: float
    step: float
    initial: float
    """Value of the slider before there is one."""
    scale: float = 1.0
    """Units of the slider in one unit of the field."""
    automatic: bool = False
    """Whether a switch beside the slider sets the field to None, which leaves the choice to the transform."""
    of_flow: bool = False
    """Whether it is t of the transform's flow."""
    hint: str = ""


@dataclass(frozen=True)
class Switch:
    """A setting that is on or off."""

    field: str
    label: str
    hint: str = ""


@dataclass(frozen=True, eq=False)
class Choice:
    """A setting that is one of a few values."""

    field: str
    label: str
    options: Mapping[Any, str]
    """Names of the values."""
    hint: str = ""


@dataclass(frozen=True)
class FlowIntegration:
    """The setting of a field of type `Integration`."""

    field: str = "integration"


Setting = Number | Switch | Choice | FlowIntegration


@dataclass(frozen=True)
class Surroundings:
    """The world around a transform that is added."""

    mean_path: Array
    """(T, 3) the mean demonstration, evenly sampled, metres."""
    plane: tuple[Point, Point] | None
    """Two orthonormal vectors of a drawing's plane; None of a task in space."""
    obstacle: Union
    anchors: tuple[Point, ...]
    """Places of other transforms, metres."""


@lru_cache(maxsize=64)
def axes_of(plane: tuple[Point, Point] | None) -> Array:
    """Return orthonormal columns (3, 3), read only, those of a plane first, if there is one."""
    axes = np.eye(3)
    if plane is not None:
        axes[:, 0], axes[:, 1] = plane
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    axes.flags.writeable = False
    return axes


_Transform = TypeVar("_Transform", bound="Transform")


class Transform(ABC):
    """A kind of transform that can be stacked; subclasses are frozen dataclasses, compared by their fields."""

    title: ClassVar[str] = ""
    """Name on the page; numbered where there may be more than one."""
    hint: ClassVar[str] = ""
    """Explanation of the button that adds one."""
    most: ClassVar[int] = 4
    """Largest number in a stack of the page."""
    settings: ClassVar[tuple[Setting, ...]] = ()
    """Settings that the page offers."""
    flow_time: ClassVar[str] = "t"
    """Name of t in the list of the stack."""
    stays_outermost: ClassVar[bool] = False
    """Whether transforms that are added go below it."""
    yields_goal: ClassVar[bool] = False
    """Whether motions may end elsewhere if it finds no way that keeps the goal."""

    @abstractmethod
    def build(self, motion: MotionBelow) -> Built:
        """Build the diffeomorphism for this motion."""

    def satisfied(self, motion: MotionBelow) -> bool:
        """Return whether the samples of `motion`, taken after the transform, behave as wanted."""
        return True

    @property
    def acts(self) -> bool:
        """Whether it changes the end effector's motion; if not it is left out of the stack."""
        return True

    @cached_property
    def avoided(self) -> Union:
        """The obstacles that it leads motions around."""
        return Union()

    @property
    def anchor(self) -> Point | None:
        """Place that it leads motions to and by which it is dragged, metres."""
        return None

    @property
    def anchor_plane(self) -> tuple[Point, Point] | None:
        """Two orthonormal vectors of the plane that it is dragged in; None of space."""
        return None

    @property
    def region(self) -> float | None:
        """Radius of the region around its anchor in which it acts, metres; None where that is chosen automatically."""
        return None

    def anchored(self: _Transform, place: Point) -> _Transform:
        """Return the same transform with its anchor at `place`, metres."""
        return self

    @property
    def ends_motions(self) -> bool:
        """Whether motions are to end at its anchor."""
        return False

    def in_plane(self: _Transform, plane: tuple[Point, Point]) -> _Transform:
        """Return the same transform, acting only along a plane, given by two orthonormal vectors."""
        return self

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

    def deflected(self, motion: MotionBelow, made: Built, who: str) -> tuple[MotionWarning, ...]:
        """Return warnings about wishes that are no longer met because obstacles are avoided.

        Args:
            motion: shown motions of the end effector.
            made: result of `build`, which was satisfied.
            who: name of who gives way, for the text.
        """
        return ()

    @classmethod
    def beside(cls: type[_Transform], surroundings: Surroundings) -> _Transform:
        """Return the transform that the page adds."""
        return cls()
