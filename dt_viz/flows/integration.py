"""How the flow of a transform is integrated: as the transform knows best, or as the user wants it (sec. 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, overload

from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Flow
from dt_viz.flows.integrators import Step, euler, rk4

Method = Literal["auto", "rk4", "euler"]
"""`auto` keeps the result exact to a tolerance; the others take equal steps, Euler's being the paper's."""
METHODS: tuple[Method, ...] = ("auto", "rk4", "euler")
STEPS: Mapping[Method, Step] = {"rk4": rk4, "euler": euler}
MAX_STEPS = 50


@dataclass(frozen=True)
class Integration:
    """A method and, where it is not `auto`, its number of steps."""

    method: Method = "auto"
    steps: int = 8

    @property
    def by_hand(self) -> bool:
        """Whether the user chose the steps, so that nobody vouches for them."""
        return self.method != "auto"

    @overload
    def of(self, flow: Flow) -> Flow: ...

    @overload
    def of(self, flow: AdaptiveFlow) -> Flow | AdaptiveFlow: ...

    def of(self, flow: Flow | AdaptiveFlow) -> Flow | AdaptiveFlow:
        """The flow integrated this way; `flow` is how it is with `auto`."""
        if self.method == "auto":
            return flow
        return Flow(flow.field, flow.duration, self.steps, STEPS[self.method])

    def __str__(self) -> str:
        """As the page calls it, "Euler in 3 steps"."""
        steps = "1 step" if self.steps == 1 else f"{self.steps} steps"
        return {"auto": "auto", "rk4": f"RK4 in {steps}", "euler": f"Euler in {steps}"}[self.method]


AUTO = Integration()
