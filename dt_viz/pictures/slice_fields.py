"""Fields of a system on a slice: velocity, streamlines, det J or the Lyapunov value, and the warped grid."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.avoidance.arm_field import JointLimits
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.flows.rollouts import Bundle, Rays, refined
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.memo import cached_property
from dt_viz.obstacles.occupancy import AvoidanceField
from dt_viz.obstacles.shapes import CloudObstacle, Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import SliceColour
from dt_viz.scenario.slices import Slice, level_line

# how densely a slice is covered; lengths in metres
ARROW_SPACING = 0.030  # spacing of the arrows
LATTICE = 0.008
"""Spacing of the lattice on which functions are sampled; a coarse picture has the arrows'."""
GRID_SPACING = 0.035  # spacing in base space of the lines whose images are the warped grid
COARSE_LATTICE = 0.012  # spacing of the lattice on which those of a coarse picture are found
LEVEL_SPACING = 0.04
"""Spacing of the base attractor's circles whose images are the level lines of the Lyapunov value."""
SEPARATION = 0.032
"""Distance from all other streamlines at which one may begin, and its least length; it ends at half of it."""
MAX_OFFSET = 0.10  # distance from the slice at which a streamline ends
LINE = 0.006  # distance between neighbouring samples of a drawn streamline
COARSE_LINE = 0.014  # the distance of a coarse picture

Clearance = Callable[[Array], Array]
"""Function from points (N, 3) to their distances (N,) from the blocked region, metres, negative inside."""


@dataclass(frozen=True)
class FieldPicture:
    """Velocities of a system on a slice."""

    points: Array  # (N, 3), metres
    velocities: Array  # (N, 3), m/s


@dataclass(frozen=True)
class ColourPicture:
    """A function on a slice."""

    what: SliceColour
    area: Slice
    values: Array
    """(n, m) det J, or Lyapunov values in m²/s, along the first and second axes of the slice, from corner to corner;
    NaN in the blocked region."""
    clearance: Array  # (n, m) distance from the blocked region, negative inside, metres
    lines: Array  # (K, 2, 3) segments of level lines, metres


class Samples:
    """A system at the free lattice points of a slice, evaluated once for several pictures."""

    def __init__(self, system: DiffeomorphicSystem, area: Slice, clearance: Clearance, spacing: float) -> None:
        """Sample the slice.

        Args:
            system: the system of ψ.
            area: the slice.
            clearance: distance from the blocked region.
            spacing: spacing of the lattice, metres.
        """
        self.system, self.area = system, area
        self.grid = area.grid(spacing)  # (n, m, 3), metres
        self.clearance = clearance(self.grid.reshape(-1, 3)).reshape(self.grid.shape[:2])
        """(n, m), metres."""
        self.free = self.clearance > 0
        self.points = self.grid[self.free]  # (N, 3) free points, metres

    @cached_property
    def jacobians(self) -> tuple[Array, Array]:
        """ψ of the free points (N, 3), and its Jacobians there (N, 3, 3)."""
        return self.system.transform.jacobian(self.points)

    @cached_property
    def images(self) -> Array:
        """ψ of the free points, (N, 3), where nobody needs the Jacobians."""
        return self.system.transform.forward(self.points)

    @property
    def field(self) -> FieldPicture:
        """The velocities at the free points."""
        images, jacobians = self.jacobians
        velocities = np.linalg.solve(jacobians, self.system.base.velocity(images)[..., None])[..., 0]
        return FieldPicture(self.points, velocities)

    def spread(self, values: Array) -> Array:
        """Return values (N,) on the whole lattice (n, m), NaN in the blocked region."""
        spread = np.full(self.free.shape, np.nan)
        spread[self.free] = values
        return spread

    def level_lines(self, values: Array, levels: Iterable[float], steepest: float = np.inf) -> Array:
        """Find segments (K, 2, 3), metres, of the lines on which values (N,) have one of the levels.

        Cells of the lattice over which the values change by the `steepest` step or more have none.
        """
        spread = self.spread(values)
        sparse = np.where(_steps(spread) < steepest, spread, np.nan)
        return np.concatenate([np.empty((0, 2, 3)), *(level_line(self.grid, sparse - level) for level in levels)])


def arrows_and_colour(
    system: DiffeomorphicSystem, area: Slice, clearance: Clearance, colour: SliceColour, *, arrows: bool, coarse: bool
) -> tuple[FieldPicture | None, ColourPicture | None]:
    """Compute velocities on the slice, if `arrows` are wanted, and the function that the `colour` shows, if any.

    A `coarse` picture, which is soon replaced, uses one lattice for both.
    """
    draw = {"det": det_jacobian, "lyapunov": lyapunov_value}.get(colour)
    field, samples = None, None
    if arrows or (draw and coarse):
        samples = Samples(system, area, clearance, ARROW_SPACING)
        field = samples.field if arrows else None
    if not draw:
        return field, None
    if samples is None or not coarse:
        samples = Samples(system, area, clearance, LATTICE)
    return field, draw(samples)


def grid_lines(system: DiffeomorphicSystem, area: Slice, *, coarse: bool) -> Array:
    """Find segments (K, 2, 3), metres, where coordinates of ψ along the slice are multiples of the grid's spacing.

    They are counted from the goal, so that two lines cross there. In a drawing's plane these are the images of a
    lattice of straight lines under ψ⁻¹.
    """
    samples = Samples(system, area, everywhere, COARSE_LATTICE if coarse else LATTICE)
    across, spacing = (samples.images - system.base.goal) @ area.axes, GRID_SPACING
    levels = [spacing * np.arange(np.ceil(x.min() / spacing), 1 + np.floor(x.max() / spacing)) for x in across.T]
    return np.concatenate([samples.level_lines(x, at) for x, at in zip(across.T, levels, strict=True)])


def everywhere(points: Array) -> Array:
    """Return the distance (N,) of points (N, 3) from an obstacle that is not there."""
    return np.full(len(points), np.inf)


def det_jacobian(samples: Samples) -> ColourPicture:
    """Compute det J of ψ: the ratio of a small volume in base space to the original; ≤ 0 where ψ folds."""
    values = samples.spread(np.linalg.det(samples.jacobians[1]))
    return ColourPicture("det", samples.area, values, samples.clearance, np.empty((0, 2, 3)))


def lyapunov_value(samples: Samples) -> ColourPicture:
    """Compute Φ(ψ(y)), which falls along every motion, and level lines: images of evenly spaced circles."""
    base, spacing = samples.system.base, LEVEL_SPACING
    values = base.potential(samples.images)
    highest, levels = values.max(initial=0.0), (float(base.potential_at(spacing * k)) for k in itertools.count(1))
    below = itertools.takewhile(lambda level: level < highest, levels)
    lines = samples.level_lines(values, below, base.speed * spacing)  # at most one in a cell
    return ColourPicture("lyapunov", samples.area, samples.spread(values), samples.clearance, lines)


def streamlines(system: DiffeomorphicSystem, area: Slice, clearance: Clearance, *, coarse: bool) -> tuple[Array, ...]:
    """Compute evenly spaced motions from places on the slice, each (T_i, 3), metres, as far as they stay over it.

    They are exact: by conjugacy a streamline through y is ψ⁻¹ of the ray through ψ(y). Each ends where it comes too
    close to an earlier one, and the remaining gaps are filled, after Jobard and Lefer, "Creating Evenly-Spaced
    Streamlines of Arbitrary Density" (1997).
    """
    marks, starts, trials, lengths = _Marks(area), [], [], []
    num = 64  # samples from which the end of a streamline is found
    u = np.linspace(0, 1, num)
    for finer in (0.5, 1, 2):
        seeds = area.lattice(SEPARATION / finer)
        seeds = seeds[~marks.crowded(seeds) & (clearance(seeds) > 0)]
        # from the rim inwards: those are long, and their order does not change with the motion
        seeds = seeds[np.argsort(-np.abs(area.across(seeds) / area.half_size).max(axis=1).round(6), kind="stable")]
        rays = Rays(system.transform.forward(seeds), system.base)
        index = np.repeat(np.arange(len(seeds)), num)
        lines = system.transform.inverse(rays.at(index, np.tile(u, len(seeds)))).reshape(-1, num, 3)
        starts.append(rays.z0)
        trials.append(lines)
        lengths += [marks.take(line) for line in lines]

    kept = np.arange(num) < np.reshape(lengths, (-1, 1))
    if not kept.any():
        return ()
    index, sample = np.nonzero(kept)
    rays = Rays(np.concatenate(starts), system.base)
    bundle = Bundle(index, u[sample], np.concatenate(trials)[kept][:, None])
    spacing, rounds = (COARSE_LINE, 1) if coarse else (LINE, 3)
    return refined(
        bundle, lambda i, u: system.transform.inverse(rays.at(i, u))[:, None], spacing, max_rounds=rounds
    ).paths


class _Marks:
    """Cells near streamlines, on a lattice of small cubes over the slice."""

    def __init__(self, area: Slice) -> None:
        self._area, self._shortest, self._cell, border = area, SEPARATION, SEPARATION / 3, 4
        self._half = np.array([*area.half_size, MAX_OFFSET])
        shape = np.ceil(2 * self._half / self._cell).astype(int) + 2 * border + 1
        self._stride, self._border = np.array([shape[1] * shape[2], shape[2], 1]), border
        self._near, self._nearer = np.zeros((2, shape.prod()), bool)
        self._around, self._close = (self._ball(radius) for radius in (3.0, 1.5))

    def _ball(self, radius: float) -> Indices:
        """Return the offsets of the cubes whose middles are within `radius` cubes of a cube's middle."""
        reach = np.arange(-int(radius), int(radius) + 1)
        offsets = np.stack(np.meshgrid(reach, reach, reach), axis=-1).reshape(-1, 3)
        return offsets[np.linalg.norm(offsets, axis=1) <= radius] @ self._stride

    def _cells(self, points: Array) -> tuple[Mask, Indices]:
        """Return whether points (N, 3) are over the slice, and the cubes of those that are."""
        own = np.column_stack([self._area.across(points), (points - self._area.centre) @ self._area.normal])
        over = np.asarray((np.abs(own) <= self._half + 1e-9).all(axis=1))
        return over, (np.round((own[over] + self._half) / self._cell).astype(int) + self._border) @ self._stride

    def crowded(self, points: Array) -> Mask:
        """Return whether points (N, 3) over the slice are too near to a streamline to begin another one."""
        return self._near[self._cells(points)[1]]

    def take(self, line: Array) -> int:
        """Mark the first points of a line that have room; return their number, 0 if the line would be too short."""
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        closely = np.arange(0, along[-1], self._cell)  # so densely that no cube is skipped
        over, cells = self._cells(np.stack([np.interp(closely, along, c) for c in line.T], axis=1))
        cells = cells[: _num_leading(over)]
        if not len(cells) or self._near[cells[0]]:
            return 0
        cells = cells[: _num_leading(~self._nearer[cells])]
        length = int(np.searchsorted(along, closely[len(cells) - 1], side="right")) if len(cells) else 0
        if not length or along[length - 1] < self._shortest:
            return 0
        self._near[(cells[:, None] + self._around).ravel()] = True
        self._nearer[(cells[:, None] + self._close).ravel()] = True
        return length


def _num_leading(mask: Mask) -> int:
    return len(mask) if mask.all() else int(mask.argmin())


def _steps(values: Array) -> Array:
    """Return the largest difference of each value (n, m) from its neighbours; infinite beside NaN."""
    steps = np.zeros_like(values)
    for axis in range(2):
        step = np.nan_to_num(np.abs(np.diff(values, axis=axis)), nan=np.inf)
        ahead, behind = (np.insert(step, place, 0.0, axis=axis) for place in (step.shape[axis], 0))
        steps = np.maximum(steps, np.maximum(ahead, behind))
    return steps


SPACING, COARSE_SPACING = 0.004, 0.010  # distances between neighbouring samples, metres
NEAR = 0.006  # largest distance from the slice of the labelled points that are shown on it, metres
MAX_POINTS = 300  # approximate largest number of these points


@dataclass(frozen=True)
class OccupancyPicture:
    """Learned occupancy on a slice."""

    area: Slice
    probability: Array
    """(n, m) p(o = 1 | s) along the first and second axes of the slice, from corner to corner."""
    level: Array  # (K, 2, 3) segments of the line p = 1/2, metres
    outline: Array  # (L, 2, 3) segments of the obstacles' true outline, metres
    points: Array  # (K, 3) points of clouds near the slice, projected onto it, metres
    occupied: Mask  # (K,) whether each of them is occupied


def occupancy_picture(area: Slice, obstacles: Sequence[Obstacle], *, coarse: bool) -> OccupancyPicture:
    """Compute the learned occupancy of all obstacles together.

    Args:
        area: the slice.
        obstacles: any number of obstacles.
        coarse: whether to use fewer samples, for a picture that is soon replaced.
    """
    world = area.grid(COARSE_SPACING if coarse else SPACING)
    points, shape = world.reshape(-1, 3), world.shape[:2]
    free = np.ones(len(points))
    for obstacle in obstacles:
        free *= 1 - learned_occupancy(obstacle, points)
    probability = 1 - free.reshape(shape)
    distance = Union(tuple(obstacles)).signed_distance(points).reshape(shape)
    return OccupancyPicture(
        area,
        probability,
        level_line(world, probability - 0.5),
        level_line(world, -np.minimum(distance, 1e3)),
        *_known(area, obstacles),
    )


def _known(area: Slice, obstacles: Sequence[Obstacle]) -> tuple[Array, Mask]:
    """Return points (K, 3) of clouds on the slice, and whether they are occupied (K,)."""
    clouds = [obstacle.labelled() for obstacle in obstacles if isinstance(obstacle, CloudObstacle)]
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in clouds)])
    occupied = np.concatenate([np.zeros(0, dtype=bool), *(labels for _, labels in clouds)])
    above, across = (points - area.centre) @ area.normal, area.across(points)
    near = np.flatnonzero((np.abs(above) < NEAR) & (np.abs(across) < area.half_size).all(axis=1))
    near = near[:: -(-len(near) // MAX_POINTS) or 1]
    return area.at(across[near]), occupied[near]


def learned_occupancy(obstacle: Obstacle, s: Array) -> Array:
    """Compute p(o = 1 | s), (N,), of the map learned from an obstacle, at world points `s` (N, 3)."""
    placed = obstacle.field("free-space", 1.0)
    assert isinstance(placed.inner, AvoidanceField)
    return placed.inner.occupancy.probability(placed.to_frame(s))


STEP = 4e-3  # length of the steps that derivatives are taken from, metres at the hand
MAX_MISS = 1e-3  # distance by which the hand may miss a place that still has an arrow, metres


@dataclass(frozen=True, eq=False)
class Lattice:
    """Postures that hold the hand at the places where arrows begin: they depend on no motion, and on no obstacle."""

    reached: Mask  # (M,) which of the places are within the arm's reach
    postures: Array  # (N, n) Q at the reached ones, rad
    derivatives: Array  # (N, n, 3) DQ there, rad/m

    @classmethod
    def of(cls, points: Array, robot: Robot, reference: Array) -> Lattice:
        """Find the postures.

        Args:
            points: (M, 3) places of the hand, metres.
            robot: the arm.
            reference: (n,) posture that it stays near to, rad.
        """
        paths = points[:, None] + np.concatenate([np.zeros((1, 3)), STEP * np.eye(3)])
        start = np.broadcast_to(reference, (len(paths), robot.num_joints))
        tracked = track(robot, paths, start, reference=start)
        reached = tracked.error.max(axis=1) <= MAX_MISS
        q = tracked.q[reached]
        return cls(reached, q[:, 0], np.moveaxis(q[:, 1:] - q[:, :1], 1, 2) / STEP)

    def carried(self, velocities: Array, transform: Diffeomorphism, robot: Robot, obstacle: Union) -> FieldPicture:
        """Carry arrows (M, 3), m/s, NaN where there is none, along by the whole arm's avoidance ψ_q.

        That was made for the motions, and may leave arrows far from them in the obstacle: these are left out.
        """
        limits, speed = JointLimits(robot.lower, robot.upper), np.linalg.norm(velocities[self.reached], axis=1)
        moving = speed > 0
        seconds, ahead = STEP / speed[moving], velocities[self.reached][moving]
        q = self.postures[moving]
        step = (self.derivatives[moving] @ (seconds[:, None] * ahead)[..., None])[..., 0]
        p = transform.inverse(limits.inside(np.concatenate([q, q + step])))
        begin, end = robot.end_effector(p).reshape(2, -1, 3)
        free = obstacle.signed_distance(begin) > 0
        return FieldPicture(begin[free], ((end - begin) / seconds[:, None])[free])
