"""Pictures of ψ: the learned generator, and panels that no obstacle changes."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field

import numpy as np

from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Placed
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.memo import Memo, kept
from dt_viz.pictures.panels import Fit, PanelPicture, base_panel, generator_arrows, generator_panel, system_panel
from dt_viz.pictures.slice_fields import ColourPicture, FieldPicture, OccupancyPicture, grid_lines
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task

BASE_TITLE = "base attractor"  # what is written over the base attractor


@dataclass(frozen=True)
class GeneratorPicture:
    """A generator V of ψ, ψ(s) = γ(t, s), on the slice; its flow straightens the motion."""

    points: Array  # (N, 3), metres
    displacements: Array  # (N, 3) t·V, metres: approximate displacements by the flow
    motions: tuple[Array, ...]
    """The demonstrations on the manifold that this flow acts on, (T_i, 3), metres; empty for the mean of all flows."""
    num_flows: int  # number of flows that ψ is composed of


@dataclass(frozen=True)
class Pictures:
    """The pictures of a view; None for those that are not shown, or not computed yet."""

    field: FieldPicture | None = None
    streamlines: tuple[Array, ...] | None = None  # each (T_i, 3), metres
    colour: ColourPicture | None = None
    generator: GeneratorPicture | None = None
    grid: Array | None = None  # segments (K, 2, 3) of the warped grid, metres
    panels: tuple[PanelPicture, ...] = ()
    """Those that the view shows; the last is the frame of the scene's own slice, if there are any."""
    occupancy: OccupancyPicture | None = None


NO_PICTURES = Pictures()


def _on_slice(area: Slice, what: Hashable) -> Hashable:
    """What a picture on a slice depends on that no obstacle changes."""
    return area.key, what


@dataclass(frozen=True, eq=False)
class Sketchbook:
    """Makes pictures of one learned motion; parts that do not depend on the obstacle are computed once."""

    task: Task  # task of the motion
    flows: Chain | None
    """Flows that ψ is composed of, in the demonstrations' own units; None without an imitation."""
    system: DiffeomorphicSystem  # system of the motion without further transforms, in the world
    rays: Rays  # rays from ψ(starts) to ψ(goal)
    paths: tuple[Array, ...]  # (T_i, 3) their preimages, the rollouts, metres
    memo: Memo = field(default_factory=Memo)

    def generator(self, area: Slice, number: int) -> GeneratorPicture | None:
        """Return the generator of a flow; ψ applies number 1 first, and 0 stands for the mean over all flows."""
        return None if self.flows is None else self._generator(area, min(number, len(self.flows.parts)))

    @kept(8, by=_on_slice)
    def _generator(self, area: Slice, number: int) -> GeneratorPicture:
        assert self.flows is not None
        task, flows = self.task, self.flows.parts[::-1]
        chosen = [flows[number - 1]] if number else flows
        motions: list[Array] = []
        for demonstration in task.demonstrations if number else ():
            num = len(demonstration.positions)
            u = demonstration.positions[np.unique(np.linspace(0, num - 1, 150).round().astype(int))]
            for flow in flows[: number - 1]:
                u = flow.forward(u)
            motions.append(task.to_world(u))
        points, vectors = generator_arrows(self._placed(Chain(chosen)), area.holding(motions))
        return GeneratorPicture(points, vectors / len(chosen), tuple(motions), len(flows))

    def _placed(self, flows: Chain) -> Placed:
        return Placed(flows, self.task.origin, self.task.axes, self.task.scale)

    def grid(self, area: Slice, transforms: Sequence[Diffeomorphism], *, coarse: bool) -> Array:
        """Return segments (K, 2, 3), metres, of the warped grid on a slice, bent by transforms from the inside out.

        Level lines of the imitation's coordinates are found once, and bent by what is stacked on it.
        """
        points, ends = self._grid(area, coarse)
        longest = np.linalg.norm(np.diff(points[ends], axis=1), axis=2).max(initial=0.0)
        for transform in transforms:
            points = transform.inverse(points)
        lines = points[ends]
        # nothing across an obstacle, whose two sides are neighbours below
        return lines[(np.linalg.norm(np.diff(lines, axis=1), axis=2) <= 3 * longest)[:, 0]]

    @kept(4, by=_on_slice)
    def _grid(self, area: Slice, coarse: bool) -> tuple[Array, Indices]:
        """Find the points (N, 3) of the imitation's grid, metres, and the numbers (K, 2) of its segments' ends."""
        lines = grid_lines(self.system, area, coarse=coarse)
        points, ends = np.unique(lines.reshape(-1, 3).round(9), axis=0, return_inverse=True)
        return points, ends.reshape(-1, 2)

    @kept(8, by=_on_slice)
    def base(self, area: Slice, grid: bool) -> PanelPicture:
        """Return the base attractor on a panel where the slice is, with the lattice of the warped grid or without."""
        return base_panel(BASE_TITLE, Fit.of(self.rays, area), grid=grid)

    @kept(8, by=_on_slice)
    def imitation(self, area: Slice, title: str) -> PanelPicture:
        """Return the imitation, and what it imitates, on a panel where the slice is."""
        return system_panel(title, self.system, self.paths, area, demonstrations=self.task.paths, coarse=False)

    @kept(8, by=_on_slice)
    def generating(self, area: Slice, title: str) -> PanelPicture | None:
        """Return what leads the base attractor's motions to the imitation: −V of all its flows."""
        return None if self.flows is None else generator_panel(title, self._placed(self.flows), area)


def in_frame(transform: Diffeomorphism) -> Chain | None:
    """Return the chain of flows inside a placed imitation; None for the identity."""
    return transform.inner if isinstance(transform, Placed) and isinstance(transform.inner, Chain) else None
