"""The joints along rollouts of the end effector: q = Q(x), one section of the inverse kinematics for all (sec. 4.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from dt_viz.avoidance.arm_field import WholeArmSettings
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import SELF_MARGIN
from dt_viz.robot.inverse_kinematics import TrackedPath, loses_branch, targets_of, track
from dt_viz.robot.robot import Robot

NUM_CONFIGURATIONS = 100  # samples of each rollout before refinement


@dataclass(frozen=True, eq=False)
class Lift:
    """The joints along each rollout: q = Q(x), a smooth function of the fraction of its base ray."""

    fractions: Array  # (R, T) increasing along each rollout
    tracked: TrackedPath  # joints at these fractions; its q has shape (R, T, n)
    reference: Array  # (n,) posture that the arm stays near to, rad
    moving: Mask  # (R,) rollouts that the arm moves along
    shaping: Mask  # (R,) those of them that an avoidance is made for
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


NUM_TRIED = 384  # number of random postures that they are chosen from
SPREAD = (0.2, 2.0)
"""Smallest and largest standard deviation of their joints from the usual posture, rad."""
TURNED = 0.05
"""Angle by which the hand may be turned farther beside its orientation than with the usual posture, rad."""
REACHED = 1e-4  # largest distance of the hand from a place that counts as reached, metres


@dataclass(frozen=True, eq=False)
class ReferencePostures:
    """Postures to stay near to, the usual one first, then the nearest to it."""

    robot: Robot
    body: BodyPoints  # body points of the links that can move away
    references: Array  # (K, n) the postures, rad
    at_starts: Array  # (K, R, n) postures that the arm rests in at the starts with them, rad
    on_path: Array  # (K, T, n) postures along the mean motion, rad
    away: Array
    """(K,) root mean square distance of the postures from the usual ones, metres, by `Robot.levers`."""

    @cached_property
    def _stuck(self) -> Array:
        """(K, T) weight of what is in the way on the path: near its ends, where no flow moves the arm, it is large."""
        settings = WholeArmSettings.of(self.robot)
        ends = (self.on_path[:, [0, -1], None] - self.on_path[:, None]) * self.robot.levers
        near = np.exp(-(ends**2).sum(axis=3) / (2 * settings.ends**2)).max(axis=1)
        return settings.in_the_way * (1 + settings.at_ends * near)

    def room(self, obstacle: Union | Obstacle, enough: float) -> Array:
        """Distances (K, R + 1), metres, of the arm from an obstacle at starts and goal, up to what is enough."""
        return self._clearance(np.concatenate([self.at_starts, self.on_path[:, -1:]], axis=1), obstacle, enough)

    def _clearance(self, q: Array, obstacle: Union | Obstacle, enough: float) -> Array:
        """Distances (K, N), metres, at postures (K, N, n), up to what is enough."""
        return self.body.clearance(self.robot, q.reshape(-1, q.shape[-1]), obstacle, enough).reshape(q.shape[:2])

    def alike(self, posture: int) -> Mask:
        """(K,) which postures are like one of them."""
        apart = (self.on_path - self.on_path[posture]) * self.robot.levers
        return np.sqrt((apart**2).sum(axis=2).mean(axis=1)) < WholeArmSettings.of(self.robot).alike

    def cost(self, obstacle: Union | Obstacle, asked: float) -> Array:
        """Costs (K,), metres, of the detour from the usual postures, and of what the path lacks of a clearance."""
        lacking = np.maximum(asked - self._clearance(self.on_path, obstacle, asked), 0)
        return self.away + (self._stuck * lacking).mean(axis=1)


def reference_postures(
    robot: Robot, usual: Array, starts: Array, path: Array, orientations: Array | None = None
) -> ReferencePostures:
    """Find reference postures for the motions of a task.

    Random postures are brought to the mean start, then each follows all starts and the mean motion. Those stay that do
    so on one branch, inside the joint limits, away from singularities, no lower than the usual one or the table, and
    with links that keep `SELF_MARGIN` from each other.

    Args:
        robot: the arm.
        usual: (n,) the posture that the arm usually stays near to, rad.
        starts: (R, 3) places where motions start, metres.
        path: (T, 3) the mean motion, metres; its end is the goal.
        orientations: (R + T, 4) of the hand at starts and path, wxyz; None wants none.

    Returns:
        The reference postures, whose pins are those at the starts and at the goal.
    """
    rng = np.random.default_rng(0)  # the same for each visitor
    scale = rng.uniform(*SPREAD, size=(NUM_TRIED, 1))
    tried = robot.clip(usual + scale * rng.normal(size=(NUM_TRIED, robot.num_joints)))
    wanted = None if orientations is None else np.broadcast_to(orientations[len(starts)], (NUM_TRIED, 1, 4))
    at_start = track(robot, np.broadcast_to(starts.mean(axis=0), (NUM_TRIED, 1, 3)), tried, orientations=wanted)
    reaches = (at_start.error < REACHED) & ~at_start.limits_hit & ~at_start.damped
    references = np.concatenate([usual[None], at_start.q[reaches[:, 0], 0]])
    places = np.concatenate([starts, path])
    paths = np.broadcast_to(places, (len(references), *places.shape))
    wanted = None if orientations is None else np.broadcast_to(orientations, (*paths.shape[:2], 4))
    tracked = track(robot, paths, references, reference=references, orientations=wanted)
    moving = robot.links.with_end_effector(robot)
    heights = (moving.positions(robot, tracked.q)[..., 2] - moving.radius).min(axis=(1, 2))
    follows = (tracked.error < REACHED) & ~tracked.limits_hit & ~tracked.damped
    follows &= tracked.turned <= tracked.turned[0].max() + TURNED
    lost = loses_branch(robot, tracked.q, targets_of(robot, paths, wanted))
    sound = follows.all(axis=1) & ~lost & (heights >= min(0.0, heights[0]))
    sound[sound] = [robot.self_clearance(q, SELF_MARGIN) >= SELF_MARGIN for q in tracked.q[sound]]
    sound[0] = True
    away = np.sqrt((((tracked.q - tracked.q[0]) * robot.levers) ** 2).sum(axis=2).mean(axis=1))
    order = np.argsort(np.where(sound, away, np.inf), kind="stable")[: sound.sum()]
    at_starts, on_path = np.split(tracked.q[order], [len(starts)], axis=1)
    return ReferencePostures(robot, moving, references[order], at_starts, on_path, away[order])
