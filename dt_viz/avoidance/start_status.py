"""Whether starts have a motion, and the warnings about those that have none."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum

import numpy as np

from dt_viz.flows.fields import Mask
from dt_viz.warning import Kind, MotionWarning


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
