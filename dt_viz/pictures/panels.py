"""Pictures of systems on panels beside the scene: the base attractor, levels of the stack, and other tasks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dt_viz.flows.augmented_systems import Frozen
from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Flow, Identity, Placed
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.obstacles.union import Union
from dt_viz.pictures.slice_fields import ARROW_SPACING, everywhere, grid_lines, streamlines
from dt_viz.scenario.slices import Slice, level_line

MARGIN = 0.18  # margin around the base attractor's rays, relative to their extent
NEGLIGIBLE = 0.03  # length of an arrow, relative to the longest, below which it is left out
OUTLINE_SPACING = 0.006  # spacing of the lattice in which an obstacle's outline is found, metres


@dataclass(frozen=True, eq=False)
class PanelPicture:
    """A system on a rectangle; all places in metres in the world, before the rectangle is moved aside."""

    title: str
    area: Slice
    goal: Array | None = None  # (3,) where its motions end
    rollouts: tuple[Array, ...] = ()  # (T_i, 3)
    streamlines: tuple[Array, ...] = ()  # (T_i, 3)
    demonstrations: tuple[Array, ...] = ()  # (T_i, 3)
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3) middles of arrows
    vectors: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3) of any unit
    outlines: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    """(K, 2, 3) segments where obstacles cross the rectangle."""
    grid: Array = field(default_factory=lambda: np.zeros((0, 2, 3)))
    """(K, 2, 3) segments of the lattice whose image is the warped grid."""
    offset: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) from all these places to where they are shown, metres."""

    @property
    def shown(self) -> Slice:
        """Its rectangle where it is shown."""
        return replace(self.area, centre=self.area.centre + self.offset)


def system_panel(
    title: str,
    system: DiffeomorphicSystem,
    rollouts: tuple[Array, ...],
    area: Slice,
    obstacle: Union | None = None,
    demonstrations: tuple[Array, ...] = (),
    *,
    coarse: bool,
) -> PanelPicture:
    """Return the picture of a system in an area, with rollouts and demonstrations (T_i, 3), metres, and an obstacle."""
    outlines, clearance = np.zeros((0, 2, 3)), everywhere
    if obstacle is not None and obstacle.parts:
        clearance, lattice = obstacle.signed_distance, area.grid(OUTLINE_SPACING)
        distance = clearance(lattice.reshape(-1, 3)).reshape(lattice.shape[:2])
        outlines = level_line(lattice, np.minimum(distance, 1e3))
    # those of an augmented system at one phase do not go where its motions go
    follows = not isinstance(system.base, Frozen)
    return PanelPicture(
        title,
        area,
        rollouts[0][-1],
        rollouts,
        streamlines(system, area, clearance, coarse=coarse) if follows else (),
        demonstrations,
        outlines=outlines,
    )


def generator_panel(title: str, transform: Diffeomorphism, area: Slice) -> PanelPicture:
    """Return the picture of what leads motions by ψ⁻¹: −t·V of the flows that ψ is composed of, added up.

    Args:
        title: what is written over it.
        transform: ψ.
        area: its rectangle.
    """
    points, vectors = generator_arrows(transform, area)
    return PanelPicture(title, area, points=points, vectors=-vectors)


def generator_arrows(transform: Diffeomorphism, area: Slice) -> tuple[Array, Array]:
    """Return places (N, 3) on a rectangle, clear of its border, and the `displacements` (N, 3) there that are seen."""
    width, height = (half - ARROW_SPACING / 2 for half in area.half_size)
    points = replace(area, half_size=(width, height)).lattice(ARROW_SPACING)
    vectors = displacements(transform, points)
    size = np.linalg.norm(vectors, axis=1)
    seen = size > NEGLIGIBLE * size.max(initial=0.0)
    return points[seen], vectors[seen]


def displacements(transform: Diffeomorphism, points: Array) -> Array:
    """Return t·V (N, d) of the flows in a transform at points (N, d), added up: roughly what they displace."""
    if isinstance(transform, Flow):
        return transform.duration * transform.field(points)
    if isinstance(transform, Placed):
        inner = transform.to_frame(points)[:, : transform.inner.dim]
        return transform.to_world(displacements(transform.inner, inner)) - transform.origin
    parts = transform.parts if isinstance(transform, Chain) else ()
    return np.zeros_like(points) + sum(displacements(part, points) for part in parts)


@dataclass(frozen=True)
class Fit:
    """Base space scaled to a rectangle: z ↦ centre + scale·(z − middle)."""

    rays: Rays
    area: Slice
    middle: Array  # (3,)
    scale: float

    @classmethod
    def of(cls, rays: Rays, area: Slice) -> Fit:
        """Return the largest scale up to 1 at which rays fit the rectangle, whose plane then holds their goal."""
        ends = area.across(np.concatenate([rays.z0, [rays.base.goal]]))
        lower, upper = ends.min(axis=0), ends.max(axis=0)
        half = (upper - lower) / 2
        half = np.maximum(half + MARGIN * half.max(), 1e-3)
        offset = (rays.base.goal - area.centre) @ area.normal
        middle = area.at((lower + upper) / 2) + offset * area.normal
        return cls(rays, area, middle, min(1.0, float((area.half_size / half).min())))

    @property
    def base_area(self) -> Slice:
        """The part of base space that is seen."""
        width, height = (half / self.scale for half in self.area.half_size)
        return replace(self.area, centre=self.middle, half_size=(width, height))

    def __call__(self, z: Array) -> Array:
        """Return places (*B, 3) on the rectangle of points `z` (*B, 3) of base space, metres."""
        return self.area.centre + self.scale * (z - self.middle)


def base_panel(title: str, fit: Fit, *, grid: bool) -> PanelPicture:
    """Return the picture of the base attractor, whose motions are straight.

    Args:
        title: what is written over it.
        fit: how base space is scaled.
        grid: whether it has the lattice of lines whose image is the warped grid.
    """
    rays, seen = fit.rays, fit.base_area
    system = DiffeomorphicSystem(Identity(rays.base.dim), rays.base)
    return PanelPicture(
        title,
        fit.area,
        fit(rays.base.goal),
        tuple(fit(np.stack([z0, rays.base.goal])) for z0 in rays.z0),
        tuple(fit(line) for line in streamlines(system, seen, everywhere, coarse=False)),
        grid=fit(grid_lines(system, seen, coarse=True)) if grid else np.zeros((0, 2, 3)),
    )
