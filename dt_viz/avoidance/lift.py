"""The joints along rollouts of the end effector: q = Q(x), one section of the inverse kinematics for all (sec. 4.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.robot.inverse_kinematics import TrackedPath, track
from dt_viz.robot.robot import Robot

NUM_CONFIGURATIONS = 100
"""Samples of each rollout before refinement."""


@dataclass(frozen=True, eq=False)
class Lift:
    """The joints along each rollout: q = Q(x), a smooth function of the fraction of its base ray."""

    fractions: Array
    """(R, T) increasing along each rollout."""
    tracked: TrackedPath
    """Joints at these fractions; its q has shape (R, T, n)."""
    reference: Array
    """(n,) posture that the arm stays near to, rad."""
    moving: Mask
    """(R,) rollouts that the arm moves along."""
    shaping: Mask
    """(R,) those of them that an avoidance is made for."""
    exactly: Callable[[Array, Indices, Array], Array] | None = None
    """Takes postures (N, n) between the fractions onto the motion that they follow, of these rollouts (N,) at these
    fractions (N,); None is content with the spline."""

    @cached_property
    def _splines(self) -> tuple[Array, Array]:
        """Fractions (R, T − 1) at which the cubics begin, and their coefficients (4, R·(T − 1), n)."""
        coefficients = [CubicSpline(*curve).c for curve in zip(self.fractions, self.tracked.q, strict=True)]
        return self.fractions[:, :-1], np.concatenate(coefficients, axis=1)

    def at(self, index: Indices, fraction: Array) -> Array:
        """Configurations (N, n), rad, of the rollouts `index` (N,) at the fractions `fraction` (N,)."""
        begins, (a, b, c, d) = self._splines
        apart = 2 * np.arange(len(begins))[:, None]  # so that one search finds the piece of the right rollout
        piece = np.searchsorted((begins + apart).ravel(), fraction + 2 * index, side="right") - 1
        u = (fraction - begins.ravel()[piece])[:, None]
        q = d[piece] + u * (c[piece] + u * (b[piece] + u * a[piece]))
        return q if self.exactly is None else self.exactly(q, index, fraction)

    def along(self, rollout: int) -> TrackedPath:
        """The joints along one of the rollouts: its q has shape (T, n)."""
        return TrackedPath(**{name: values[rollout] for name, values in vars(self.tracked).items()})

    @cached_property
    def pins(self) -> Array:
        """(R' + 1, n) postures at the starts of the R' rollouts that shape the flow, and at the goal, rad."""
        q = self.tracked.q[self.shaping]
        return np.concatenate([q[:, 0], q[:1, -1]])

    @classmethod
    def of(cls, lifts: Sequence[Lift], moving: Mask, shaping: Mask) -> Lift:
        """The rollouts of several, one after the other, with the reference of the first."""
        tracked = zip(*(vars(part.tracked).values() for part in lifts), strict=True)
        fractions = np.concatenate([part.fractions for part in lifts])
        return cls(fractions, TrackedPath(*map(np.concatenate, tracked)), lifts[0].reference, moving, shaping)


def lift(
    robot: Robot,
    fractions: Array,
    paths: Array,
    reference: Array,
    initial: Array | None = None,
    orientations: Array | None = None,
) -> Lift:
    """Follow rollouts with the joints: paths (R, T, 3), metres, at fractions (R, T) of base rays; see `track`."""
    start, every = np.broadcast_to(reference, (len(paths), robot.num_joints)), np.ones(len(paths), bool)
    tracked = track(robot, paths, start, initial, reference=start, orientations=orientations)
    return Lift(fractions, tracked, reference, every, every)
