"""What every behaviour that is stacked on the imitation has in common: each is one diffeomorphism (sec. 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from dt_viz.flows.diffeomorphisms import AUTO, Diffeomorphism, Integration
from dt_viz.flows.fields import Array, Indices
from dt_viz.scenario.scenario import Scenario


@dataclass(frozen=True)
class Motion:
    """The motion one level down, that a behaviour is to change."""

    scenario: Scenario
    starts: Array
    """(R, 3) where the robot starts, metres."""
    goal: Array
    """(3,) where the motions end, metres."""
    index: Indices
    """(N,) which rollout a sample belongs to."""
    positions: Array
    """(N, 3) samples of the rollouts, metres."""
    above: Diffeomorphism | None = None
    """ψ from the top of the stack to the manifold of the behaviour, as far as it has been built."""
    top: Array | None = None
    """(N, 3) the same samples at the top of the stack, where the robot moves, metres; None before it is built."""
    keeps_goal: bool = True
    """Whether behaviours that do not mean to move the goal leave it where it is, or may move it after all."""
    num_demonstrated: int | None = None
    """How many of the rollouts, the first ones, have a demonstration; None is all. The others begin anywhere."""

    @property
    def demonstrated(self) -> Motion:
        """The rollouts that have a demonstration, only."""
        num = self.num_demonstrated
        if num is None or num == len(self.starts):
            return self
        rows = slice(np.searchsorted(self.index, num))
        top = None if self.top is None else self.top[rows]
        samples = {"index": self.index[rows], "positions": self.positions[rows], "top": top}
        return replace(self, starts=self.starts[:num], **samples)


@dataclass(frozen=True)
class Built:
    """A behaviour made for a motion."""

    transform: Diffeomorphism
    """ψ, from the manifold with the behaviour to the one without."""
    duration: float
    """t of its flow."""
    goal: Array
    """(3,) where motions with the behaviour are to end, metres: `Motion.goal` if the behaviour respects it, else its
    image under ψ⁻¹."""
    hopeless: bool = False
    """Whether no duration does what is wanted, so that trying again is of no use."""
    doubts: tuple[str, ...] = ()
    """Why its result is not to be trusted, in words."""
    integration: Integration = AUTO
    """Of its flow; one by hand is checked for what it costs."""


class Behaviour(Protocol):
    """A kind of transform that the engine stacks. A new one is a file with such a class, and a layer of a scenario."""

    def build(self, motion: Motion, tolerance: float, at_least: float) -> Built | None:
        """The transform for this motion; None where the scenario has it switched off.

        Args:
            motion: one level down.
            tolerance: of the flow's integration, metres.
            at_least: duration to start from where it is chosen automatically.
        """
        ...

    def satisfied(self, motion: Motion) -> bool:
        """Whether the samples of `motion`, taken after the transform, behave as wanted."""
        ...


def named_starts(which: Indices, num_demonstrated: int, how: str) -> list[str]:
    """What there is to say of starts, counted from 0, the task's first: they are all `how`; empty if it is of none."""
    said = []
    for numbers, kind in ((which[which < num_demonstrated], ""), (which[which >= num_demonstrated], "added ")):
        counted = ", ".join(str(k + 1 - (num_demonstrated if kind else 0)) for k in numbers)
        if len(numbers):
            said.append(f"{kind}start {counted} is {how}" if len(numbers) == 1 else f"{kind}starts {counted} are {how}")
    return said
