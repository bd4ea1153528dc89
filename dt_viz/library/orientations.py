"""The hand's orientation along learned motions, also where it begins beside what was learned."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Bundle, Rays
from dt_viz.flows.rotations import turning
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.demonstrations import checked_orientations

NOT_LEARNED = "none: no orientations were learned"


def along(
    poses: AugmentedImitation | None, rays: Rays, bundle: Bundle, begin: ArrayLike | None
) -> tuple[Array, ...] | tuple[None, ...]:
    """Orientations (T_i, 4), wxyz, of each of a bundle of motions; None where none were learned.

    They begin with those that are given, (R, 4), or (4,) for all; None begins as they were learned.

    Raises:
        FormatError: `begin` is no orientations, or none were learned.
    """
    if poses is None:
        if begin is not None:
            raise FormatError("orientations", "some", NOT_LEARNED)
        return (None,) * len(rays.z0)
    system, rest = poses.system, rays.z0[:, 3:]
    states = np.hstack([np.zeros((len(rest), poses.dim)), rest])  # on the motions that were learned
    if begin is not None:
        given = np.asarray(begin)
        given = checked_orientations(np.tile(given, (len(rest), 1)) if given.ndim == 1 else given, len(rest))
        start = system.transform.inverse(states)
        start[:, 3:6] = poses.turns(given, start[:, 3:6])
        states = system.transform.forward(start)
    z = system.base.at_fraction(states[bundle.index], (1 - bundle.fraction)[:, None])[:, 0]
    return bundle.split(poses.orientations(system.transform.inverse(z)[:, 3:6]))


def angular_velocity(poses: AugmentedImitation | None, rest: Array, orientation: ArrayLike, dt: float) -> Array:
    """ω (3,), rad/s, in the base frame, that takes a hand, of which the orientation (4,) is given, on with its motion.

    That is to the orientation `dt` seconds later than at a phase and for a condition, `rest` (1 + c,).

    Raises:
        FormatError: the orientation is none, or none were learned.
    """
    if poses is None:
        raise FormatError("orientation", "one", NOT_LEARNED)
    now, system = checked_orientations(np.asarray(orientation)[None], 1), poses.system
    learned = system.transform.inverse(np.concatenate([np.zeros(poses.dim), rest]))
    state = np.concatenate([learned[:3], poses.turns(now, learned[None, 3:6])[0], rest])
    reached = poses.orientations(system.rollout(state, np.array([dt]))[0, 3:6])
    return turning(now[0], reached) / dt
