"""Avoidance of obstacles: what that of the hand (sec. 4.4) and that of the whole arm (sec. 4.5) have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, ClassVar, Literal, TypeVar, get_args

import numpy as np

from dt_viz.avoidance.detour import DETOUR, DetourSettings
from dt_viz.avoidance.transform import MOST_DURATION, Built, MotionBelow, Transform
from dt_viz.errors import FormatError, check_between
from dt_viz.flows.diffeomorphisms import AUTO, Flow, Identity, Integration
from dt_viz.flows.fields import Array, Mask, VectorField
from dt_viz.memo import cached_property
from dt_viz.obstacles.occupancy import Generator
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.warning import Kind, MotionWarning

Space = Literal["task", "cspace"]
"""Space of the avoidance: that of the end effector, or configuration space."""
SPACES: tuple[Space, ...] = get_args(Space)
_Kind = TypeVar("_Kind", bound="Avoidance")


@dataclass(frozen=True, init=False, repr=False)
class Avoidance(Transform):
    """Motions are led around obstacles, by a flow on the gradient of their occupancy.

    It is the base of `HandAvoidance` and `ArmAvoidance`. Called itself it makes one of them: the one of a `space`,
    "task" (that of the hand) or "cspace".

    Raises:
        FormatError: a number makes no sense, such as a negative margin.
    """

    obstacles: tuple[Obstacle, ...]
    """Obstacles that are avoided together; there may be none."""
    generator: Generator
    temperature: float
    """T of the occupancy potential; a higher one reaches farther and bends more gently."""
    margin: float
    """Clearance that the automatic flow time keeps, metres."""
    duration: float | None
    """t of the flow; None is the shortest that clears the obstacles by the margin."""
    integration: Integration
    """Integration of the flow."""
    detour: DetourSettings
    """Choice of the side on which motions pass."""

    kinds: ClassVar[dict[Space, type[Avoidance]]] = {}
    """The kinds, by the space in which they act."""
    space: ClassVar[Space]

    def __init_subclass__(cls, space: Space | None = None) -> None:
        if space is not None:
            cls.space = space
            Avoidance.kinds[space] = cls

    def __new__(cls: type[_Kind], *_: object, space: Space = "task", **__: Any) -> _Kind:  # noqa: ANN401 - any fields
        if space not in SPACES:
            raise FormatError("space", repr(space)[:40], " or ".join(map(repr, SPACES)))
        kind: Any = cls.kinds[space] if cls is Avoidance else cls
        return object.__new__(kind)

    def __init__(
        self,
        obstacles: Obstacle | Iterable[Obstacle] | Union = (),
        *,
        generator: Generator = "free-space",
        temperature: float = 6.0,
        margin: float = 0.01,
        duration: float | None = None,
        integration: Integration = AUTO,
        detour: DetourSettings = DETOUR,
        space: Space = "task",
        plane: object = None,
    ) -> None:
        check_between("temperature", temperature, 0.1, 1000.0)
        check_between("margin", margin, 0.0, 1.0)
        if duration is not None:
            check_between("duration", duration, 0.0, MOST_DURATION)
        several = obstacles.parts if isinstance(obstacles, Union) else obstacles
        own: dict[str, object] = {"obstacles": tuple(several) if isinstance(several, Iterable) else (several,)}
        own |= {"temperature": temperature, "margin": margin, "duration": duration}
        own |= {"generator": generator, "integration": integration, "detour": detour}
        for name, value in own.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        parts = ", ".join(
            f"{type(part).__name__} at {tuple(np.round(part.position, 4).tolist())} m" for part in self.obstacles
        )
        time = "auto" if self.duration is None else f"{self.duration:g}"
        how = f"margin {1e3 * self.margin:g} mm, {self.generator}, T {self.temperature:g}, flow time {time}"
        return f"{type(self).__name__}({parts or 'no obstacles'}; {how})"

    def changed(self, space: Space | None = None, **changes: Any) -> Avoidance:  # noqa: ANN401 - any fields
        """Return the avoidance with fields replaced, of the kind that acts in a space; None keeps its kind."""
        if space is None or space == self.space:
            return replace(self, **changes)
        kept = {field.name: getattr(self, field.name) for field in fields(Avoidance) if field.name != "detour"}
        return Avoidance.kinds[space](**(kept | changes))

    @cached_property
    def avoided(self) -> Union:
        """The obstacles as one."""
        return Union(self.obstacles)

    @property
    def acts(self) -> bool:
        return False

    def build(self, motion: MotionBelow) -> Built:
        """Leave places where they are."""
        return Built(Identity(3), 0.0, motion.goal)


class ArmAvoidance(Avoidance, space="cspace"):
    """The whole arm avoids, in configuration space (sec. 4.5), see `dt_viz.avoidance.arm`."""


Lack = Callable[[Array, float], Array]
"""What points (N, d) lack to be clear, (N,), at most 0 where they are; beyond the given lack, only that."""


def clearing_duration(field: VectorField, points: Array, lack: Lack, step: float, longest: float) -> float | None:
    """Find the shortest duration after which the reverse flow of a field has carried all points (N, d) clear.

    γ is a one-parameter group, so one integration with snapshots, at each `step` of RK4, passes every duration on its
    way; points that are clear stay clear and are dropped. Between the last two snapshots the duration is interpolated.

    Returns None where some point is not clear after the longest one.
    """
    duration, before = 0.0, points
    while (lacking := lack(points, 1e-4) > 0).any():  # whether, not how much
        if duration >= longest:
            return None
        before = points[lacking]
        points = Flow(field, step, 1).inverse(before)
        duration += step
    if not duration:
        return 0.0
    lacked, left = lack(before, np.inf), lack(points, np.inf)
    return duration - step + step * float((lacked / np.maximum(lacked - left, 1e-12)).clip(0, 1).max())


class StartStatus(Enum):
    """Whether a start has a motion, or why it has none."""

    OK = "with a motion"
    OUT_OF_REACH = "out of the arm's reach"
    IN_COLLISION = "inside the obstacle: the arm there touches it"
    NO_WAY = "without a way around the obstacle for the arm"

    @property
    def kind(self) -> Kind:
        """Kind of the warning about a start that has no motion."""
        return Kind.OUT_OF_REACH if self is StartStatus.OUT_OF_REACH else Kind.START_COVERED


def start_warnings(which: Mask, added: Mask, kind: Kind, how: str, source: str = "") -> Iterator[MotionWarning]:
    """Yield warnings that starts `which` (R,) are `how`: one about the task's, one about `added` ones (R,)."""
    for group, of in ((~added, ""), (added, "added ")):
        numbers = 1 + np.flatnonzero(which[group])
        if len(numbers):
            starts = "start" if len(numbers) == 1 else "starts"
            are = "is" if len(numbers) == 1 else "are"
            yield MotionWarning(kind, f"{of}{starts} {', '.join(map(str, numbers))} {are} {how}", source)
