"""What every learned motion is, in whichever state it was learned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.memo import cached_property
from dt_viz.numerics import ZERO

State = Literal["auto", "plain", "augmented"]  # state that a motion is learned in
STATES: tuple[State, ...] = get_args(State)


@dataclass(frozen=True)
class StateChoice:
    """How far demonstrations that were left out are from what the others teach: mean Fréchet distances, metres."""

    plain: float  # in the plain state; infinite where that fails
    augmented: float
    shifted_mean: float
    """Of the mean of the others, shifted to the start by an offset that fades: what takes no learning."""
    num: int  # number of demonstrations that were left out, before it was clear

    def __str__(self) -> str:
        off = ", ".join(
            f"{state} {1e3 * distance:.1f} mm ({distance / max(self.shifted_mean, ZERO):.2f} × the shifted mean)"
            for state, distance in (("plain", self.plain), ("augmented", self.augmented))
        )
        return f"{self.num} demonstration{'s' * (self.num != 1)} left out: {off}"


@dataclass(frozen=True, eq=False, kw_only=True)
class AnyImitation(ABC):
    """A learned motion, in the demonstrations' own units."""

    state: ClassVar[State]  # state that it was learned in
    starts: Array  # (R, d) starts of the demonstrations, metres
    goal: Array  # (d,) common end of the demonstrations, metres
    fit_seconds: float
    warnings: tuple[str, ...] = ()
    reason: str = ""
    """Why it was learned in this state, where that was not asked for; see `dt_viz.learning.state`."""
    choice: StateChoice | None = None
    """What it was chosen by, where that was done by leaving demonstrations out."""
    labels: tuple[float, ...] | None = None
    """Label of each demonstration that was given; None without labels."""
    augmented: AugmentedSettings = field(default_factory=AugmentedSettings)
    """Settings of the augmented state."""
    goal_orientation: Array | None = None
    """(4,) orientation of the hand at the goal, wxyz; None where orientations were not learned."""

    @property
    def known_labels(self) -> tuple[float, ...]:
        """Different labels, increasing, that a motion may have; none where starts tell what follows."""
        return ()

    @property
    def has_orientation(self) -> bool:
        """Whether the hand's orientation was learned, too."""
        return self.goal_orientation is not None

    @cached_property
    @abstractmethod
    def system(self) -> DiffeomorphicSystem:
        """The learned dynamical system, of its states."""

    @abstractmethod
    def system_in(self, origin: Array, axes: Array, scale: float) -> DiffeomorphicSystem:
        """The system in R^D, where a place y becomes origin + scale·axes·y, metres.

        Of the orthonormal columns axes (D, D), y has the first d coordinates.
        """

    def to_arrays(self) -> dict[str, Array]:
        """What is kept in a file, as plain arrays; none of a motion that is learned again when the file is read."""
        return {}
