"""Pictures of ψ: the learned generator, and panels that no obstacle changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Placed
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.memo import Memo
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


class Sketchbook:
    """Makes pictures of one learned motion; parts that do not depend on the obstacle are computed once."""

    def __init__(
        self, task: Task, flows: Chain | None, system: DiffeomorphicSystem, rays: Rays, paths: tuple[Array, ...]
    ) -> None:
        """Begin with no picture.

        Args:
            task: task of the motion.
            flows: flows that ψ is composed of, in the demonstrations' own units; None without an imitation.
            system: system of the motion without further transforms, in the world.
            rays: rays from ψ(starts) to ψ(goal).
            paths: (T_i, 3) their preimages, the rollouts, metres.
        """
        self.task = task  # task of the motion
        self._flows, self._system, self._rays, self._paths = flows, system, rays, paths
        self._memo = Memo()

    def generator(self, area: Slice, number: int) -> GeneratorPicture | None:
        """Return the generator of a flow; ψ applies number 1 first, and 0 stands for the mean over all flows."""
        if self._flows is None:
            return None
        number, flows = min(number, len(self._flows.parts)), self._flows.parts[::-1]
        return self._memo("generator", (number, area.key), lambda: self._generator(area, flows, number), newest=8)

    def _generator(self, area: Slice, flows: Sequence[Diffeomorphism], number: int) -> GeneratorPicture:
        task, chosen = self.task, [flows[number - 1]] if number else flows
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
        points, ends = self._memo("grid", (area.key, coarse), lambda: self._grid(area, coarse=coarse), newest=4)
        longest = np.linalg.norm(np.diff(points[ends], axis=1), axis=2).max(initial=0.0)
        for transform in transforms:
            points = transform.inverse(points)
        lines = points[ends]
        # nothing across an obstacle, whose two sides are neighbours below
        return lines[(np.linalg.norm(np.diff(lines, axis=1), axis=2) <= 3 * longest)[:, 0]]

    def _grid(self, area: Slice, *, coarse: bool) -> tuple[Array, Indices]:
        """Find the points (N, 3) of the imitation's grid, metres, and the numbers (K, 2) of its segments' ends."""
        lines = grid_lines(self._system, area, coarse=coarse)
        points, ends = np.unique(lines.reshape(-1, 3).round(9), axis=0, return_inverse=True)
        return points, ends.reshape(-1, 2)

    def base(self, area: Slice, *, grid: bool) -> PanelPicture:
        """Return the base attractor on a panel where the slice is, with the lattice of the warped grid or without."""
        return self._panel(
            (BASE_TITLE, grid), area, lambda: base_panel(BASE_TITLE, Fit.of(self._rays, area), grid=grid)
        )

    def imitation(self, area: Slice, title: str) -> PanelPicture:
        """Return the imitation, and what it imitates, on a panel where the slice is."""
        return self._panel(
            title,
            area,
            lambda: system_panel(title, self._system, self._paths, area, demonstrations=self.task.paths, coarse=False),
        )

    def generating(self, area: Slice, title: str) -> PanelPicture | None:
        """Return what leads the base attractor's motions to the imitation: −V of all its flows."""
        if self._flows is None:
            return None
        imitation = self._placed(self._flows)
        return self._panel(title, area, lambda: generator_panel(title, imitation, area))

    def _panel(self, key: Hashable, area: Slice, make: Callable[[], PanelPicture]) -> PanelPicture:
        """Return a panel that no obstacle changes, made once."""
        return self._memo("panel", (key, area.key), make, newest=8)


def in_frame(transform: Diffeomorphism) -> Chain | None:
    """Return the chain of flows inside a placed imitation; None for the identity."""
    return transform.inner if isinstance(transform, Placed) and isinstance(transform.inner, Chain) else None
