"""The Dormand–Prince 5(4) pair, and the lengths of its steps."""

from __future__ import annotations

import numpy as np

from dt_viz.kernels.compiled import compiled

STAGES = np.array(
    [
        (0, 0, 0, 0, 0, 0),
        (1 / 5, 0, 0, 0, 0, 0),
        (3 / 40, 9 / 40, 0, 0, 0, 0),
        (44 / 45, -56 / 15, 32 / 9, 0, 0, 0),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0),
        (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ]
)
"""Coefficients of the stages; the last is the result of order five, so that its velocity begins the next step."""
ERROR = np.array((71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40))
"""Coefficients of the estimated error."""
SHORT = 1 / 15
"""Motion of a step, in the unit of the points, from which on its error may be the whole tolerance. In the core of an
obstacle space is squeezed ten thousand times; the inverse magnifies errors as much, so the relative error counts."""
ROUNDING = 1e-15
"""Difference of coordinates, in their unit, below which rounding hides it."""
STRAIGHT = 0.1
"""Largest relative change of the velocity along a motion that counts as straight."""
LONGEST_TURN, TURN_ERROR = 0.8, 3e-4
"""Length of a first step, in units of the time in which the velocity changes by its own size, and the error of such a
step relative to its motion, about."""


@compiled
def allowed_error(motion: float, tolerance: float) -> float:
    """Largest error allowed for a step of this motion."""
    return min(max(tolerance / SHORT * motion, ROUNDING), tolerance)


@compiled
def is_straight(speed: float, turning: float, total: float, tolerance: float) -> bool:
    """Return whether one Euler step over the whole time `total` is accurate enough.

    A weak field is not enough for that: it is weak beside a rest point, too, where motions grow from nothing.

    Args:
        speed: of the point.
        turning: relative rate at which it changes.
        total: time.
        tolerance: largest error.
    """
    return total * speed <= tolerance and turning * total <= STRAIGHT


@compiled
def first_step(speed: float, turning: float, total: float, tolerance: float) -> float:
    """Length of the first step at a speed that changes at the relative rate `turning`.

    The error grows as its fifth power.
    """
    motion = total * speed
    caution = (allowed_error(motion, tolerance) / max(TURN_ERROR * motion, ROUNDING)) ** 0.2
    return min(total, LONGEST_TURN * caution / max(turning, ROUNDING))


@compiled
def next_step(h: float, error: float) -> float:
    """Length of the step after one of length h with this error, relative to what is allowed."""
    return h * min(max(0.9 * max(error, 1e-10) ** -0.2, 0.1), 5.0)
