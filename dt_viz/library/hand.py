"""A hand in the loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.library.motion import NUM_COORDINATES, Motion
from dt_viz.library.places import angular_velocity, as_places

PUSHED = 0.05
"""Distance from where the hand should be, relative to half the demonstrations' extent, from which it was pushed."""


class HandController:
    """The velocities of a hand in the loop, wherever it is, in either state.

        controller = dt.HandController(motion, start)
        velocity = controller.step(position, dt)

    In the augmented state it keeps the phase and where the motion began. Where the hand was pushed, the phase is chosen
    again, so that the rest of the motion is drawn.
    """

    def __init__(self, motion: Motion, start: ArrayLike, label: float | None = None) -> None:
        """Begin a motion in the plane or in space where the hand is, at a start (d,), metres.

        Its label is that of the nearest demonstrated start, unless one is given.

        Raises:
            FormatError: no demonstration has such a label, or the start is not d finite numbers.
        """
        self._motion = motion
        self._rest = motion.rest(1.0, start, label)
        self._top = float(self._rest[0]) if len(self._rest) else 0.0
        self._expected = motion.in_space(np.asarray(start, float)[None])[0]

    def __repr__(self) -> str:
        phase = f"phase {self.phase:.2f} of " if self._top else ""
        return f"HandController({phase}{self._motion!r})"

    @property
    def phase(self) -> float:
        """Part of the motion that is left, from 1 to 0; 0 in the plain state, which has none."""
        return float(self._rest[0]) / self._top if self._top else 0.0

    def turn(self, orientation: ArrayLike, dt: float) -> Array:
        """ω (3,), rad/s, in the base frame, for `dt` seconds, of a hand with an orientation (4,), wxyz.

        It is that of the motion at the phase which the next `step` begins from; what turned the hand aside dies away.

        Raises:
            FormatError: the orientation is none, the period is not above 0, or no orientations were learned.
        """
        _check_period(dt)
        return angular_velocity(self._motion.nominal.learned.poses, self._rest, orientation, dt)

    def step(self, position: ArrayLike, dt: float) -> Array:
        """ẏ (d,), m/s, that takes a hand at `position` (d,), metres, to where the motion is `dt` seconds later.

        It is stable at any period, also where a motion ends abruptly.

        Raises:
            FormatError: the position is not d finite numbers, or the period is not above 0.
        """
        _check_period(dt)
        motion, solution = self._motion, self._motion.solution
        place = motion.in_space(as_places(np.asarray(position, float)[None], motion.dimension, "position"))[0]
        state = np.concatenate([place, self._rest])
        if np.linalg.norm(place - self._expected) > PUSHED * self._top:
            state = solution.system.base.caught(state, solution.stacked.forward(place))
        reached = solution.system.rollout(state, np.array([dt]))[0]
        self._expected, self._rest = reached[:NUM_COORDINATES], reached[NUM_COORDINATES:]
        return (self._expected - place)[: motion.dimension] / dt


def _check_period(dt: float) -> None:
    if not 0 < dt < np.inf:
        raise FormatError("dt", f"{dt:g}", "seconds, above 0")
