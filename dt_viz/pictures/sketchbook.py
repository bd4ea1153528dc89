"""Pictures of ψ: the learned generator, the grid warped by ψ⁻¹, and panels that no obstacle changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Chain, Diffeomorphism, Flow, Placed
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.flows.rollouts import Bundle, Rays, refined
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.pictures.occupancy import OccupancyPicture
from dt_viz.pictures.panels import ARROW_SPACING, Fit, PanelPicture, base_panel, long_enough, system_panel
from dt_viz.pictures.slice_fields import ColourPicture, FieldPicture
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task

LINE_SPACING = 0.035
"""Spacing of the grid's lines in base space, metres."""
TRIAL_STEP, COARSE_TRIAL_STEP = 0.004, 0.012
"""Step along a line of the grid in base space with which its place on the slice is found, metres."""
SAMPLE_SPACING = 0.010
"""Spacing of samples along a line of the grid in the motion's space, before the transforms bend it, metres."""
STEEPEST = 4.0
"""Length of a step in base space, relative to that along the slice, beyond which a line is torn."""
FINE_SPACING, COARSE_SPACING = 0.006, 0.030
"""Distances between neighbouring samples of the drawn grid, metres."""
TOLERANCE = 1e-6
"""Tolerance of the transforms' flows for the grid, metres: a coarser one is no faster, and lines would cross."""
MAX_NEWTON, MAX_STEP, MIN_SLOPE, ON_SLICE = 6, 0.05, 0.1, 1e-6
"""Largest number of Newton steps of the grid to the slice, their largest length, metres, the smallest slope of the
preimage that they use, and the distance, metres, that counts as on the slice."""
BASE_TITLE = "base attractor"
"""What is written over the base attractor."""


@dataclass(frozen=True)
class GeneratorPicture:
    """A generator V of ψ, ψ(s) = γ(t, s), on the slice; its flow straightens the motion."""

    points: Array
    """(N, 3), metres."""
    displacements: Array
    """(N, 3) t·V, metres: approximate displacements by the flow."""
    motions: tuple[Array, ...]
    """The demonstrations on the manifold that this flow acts on, (T_i, 3), metres; empty for the mean of all flows."""
    num_flows: int
    """Number of flows that ψ is composed of."""


@dataclass(frozen=True)
class GridPicture:
    """The warped grid: ψ⁻¹ of regular planes in base space, cut with the image of the slice under the imitation.

    In a drawing's plane these are the images of a lattice of straight lines.
    """

    lines: tuple[Array, ...]
    """(T_i, 3), metres."""


@dataclass(frozen=True)
class Pictures:
    """The pictures of a view; None for those that are not shown, or not computed yet."""

    field: FieldPicture | None = None
    streamlines: tuple[Array, ...] | None = None
    """Each (T_i, 3), metres."""
    colour: ColourPicture | None = None
    generator: GeneratorPicture | None = None
    grid: GridPicture | None = None
    panels: tuple[PanelPicture, ...] = ()
    """Those that the view shows; the last is the frame of the scene's own slice, if there are any."""
    occupancy: OccupancyPicture | None = None


NO_PICTURES = Pictures()


@dataclass(frozen=True)
class _Pieces:
    """The warped grid on a slice of the imitation's manifold, before the transforms bend it."""

    area: Slice
    index: Indices
    """(N,) index of each sample's piece."""
    images: Array
    """(N, 3) images of the samples in base space."""
    positions: Array
    """(N, 3) positions of the samples on the slice, metres."""

    def images_at(self, place: Array) -> Array:
        """Interpolate points of base space (M, 3) linearly at places (M,), counted in samples."""
        before = np.minimum(place.astype(int), len(self.images) - 2)
        start, end = self.images[before], self.images[before + 1]
        return start + (place - before)[:, None] * (end - start)


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
        self.task = task
        """Task of the motion."""
        self._flows, self._system, self._rays, self._paths = flows, system, rays, paths
        self._panels: dict[tuple[str | bool, ...], PanelPicture] = {}
        self._generators: dict[int, tuple[Slice, GeneratorPicture]] = {}
        self._pieces: dict[bool, _Pieces] = {}
        """Coarse (True) and fine pieces."""

    def generator(self, area: Slice, number: int) -> GeneratorPicture | None:
        """Return the generator of a flow; ψ applies number 1 first, and 0 stands for the mean over all flows."""
        if self._flows is None:
            return None
        number = min(number, len(self._flows.parts))
        made = self._generators.get(number)
        if made is None or not made[0].lies_like(area):
            made = area, self._generator(area, self._flows.parts[::-1], number)
            self._generators[number] = made
        return made[1]

    def _generator(self, area: Slice, flows: Sequence[Diffeomorphism], number: int) -> GeneratorPicture:
        task, chosen = self.task, [flows[number - 1]] if number else flows
        motions: list[Array] = []
        if number:
            for demonstration in task.demonstrations:
                u = demonstration.positions
                keep = np.unique(np.linspace(0, len(u) - 1, 150).round().astype(int))
                u = u[keep]
                for flow in flows[: number - 1]:
                    u = flow.forward(u)
                motions.append(task.to_world(u))
        lower, upper = -np.array(area.half_size), np.array(area.half_size)
        for motion in motions:
            across = area.across(motion)
            lower, upper = np.minimum(lower, across.min(axis=0)), np.maximum(upper, across.max(axis=0))
        points = area.at(_lattice(lower, upper, ARROW_SPACING))
        k = flows[0].dim
        u = ((points - task.origin) @ task.axes / task.scale)[:, :k]
        total = np.zeros_like(u)
        for flow in chosen:
            assert isinstance(flow, Flow)
            total += flow.duration * flow.field(u)
        displacements = task.scale * (total / len(chosen)) @ task.axes[:, :k].T
        seen = long_enough(displacements)
        return GeneratorPicture(points[seen], displacements[seen], tuple(motions), len(flows))

    def grid(self, area: Slice, behaviours: Sequence[Diffeomorphism], *, coarse: bool) -> GridPicture:
        """Return the warped grid.

        Args:
            area: the slice.
            behaviours: transforms stacked on the imitation, from the inside out.
            coarse: whether to use fewer points, for a picture that is soon replaced.
        """
        pieces = self._pieces.get(coarse)
        if pieces is None or not pieces.area.lies_like(area):
            pieces = self._pieces[coarse] = self._cut(area, coarse=coarse)
        drawn = [_drawn(behaviour) for behaviour in behaviours]

        def lifted(positions: Array) -> Array:
            for transform in drawn:
                positions = transform.inverse(positions)
            return positions

        def evaluate(_: Indices, place: Array) -> Array:
            return lifted(self._system.transform.inverse(pieces.images_at(place)))[:, None]

        if not len(pieces.index):
            return GridPicture(())
        bundle = Bundle(pieces.index, np.arange(float(len(pieces.index))), lifted(pieces.positions)[:, None])
        if not coarse:
            bundle = refined(bundle, evaluate, FINE_SPACING, max_rounds=3)
        # no line between neighbours that ψ⁻¹ moves far apart
        limit = 3 * (COARSE_SPACING if coarse else FINE_SPACING)
        return GridPicture(_runs(bundle.positions, bundle.index, limit))

    def _lines(self, area: Slice) -> tuple[Array, Array]:
        """Return the ends (M, 2), along the slice, of the lattice's lines over its image; two cross at ψ(goal)."""
        across, middle = area.across(self._images(area)), area.across(self._system.base.goal)
        lower = middle + LINE_SPACING * np.floor((across.min(axis=0) - middle) / LINE_SPACING)
        upper = middle + LINE_SPACING * np.ceil((across.max(axis=0) - middle) / LINE_SPACING)
        return _lattice_lines(lower, upper, LINE_SPACING)

    def _images(self, area: Slice) -> Array:
        """Return the images (N, 3) in base space of a lattice on the slice."""
        return self._system.transform.forward(area.lattice(0.02))

    def _cut(self, area: Slice, *, coarse: bool) -> _Pieces:
        """Project the lattice's lines onto the image of the slice, and return the pieces whose preimages are on it."""
        start, end = self._lines(area)
        step = COARSE_TRIAL_STEP if coarse else TRIAL_STEP
        counts = 2 + (np.linalg.norm(end - start, axis=1) / step).astype(int)
        line = np.repeat(np.arange(len(start)), counts)
        u = np.concatenate([np.linspace(0, 1, n) for n in counts])[:, None]
        x, z, there = self._raised(area, start[line] + u * (end - start)[line])
        inside = there & (np.abs(area.across(x)) <= area.half_size).all(axis=1)
        # another line begins, or this one continues in another fold of the slice's image
        apart = (np.diff(line) > 0) | (np.linalg.norm(np.diff(z, axis=0), axis=1) > STEEPEST * step)
        samples = []
        for run in _true_runs(inside):
            for piece in np.split(run, np.flatnonzero(apart[run[:-1]]) + 1):
                if len(piece) < 3:
                    continue
                along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(x[piece], axis=0), axis=1))])
                even = np.linspace(0, along[-1], 2 + int(along[-1] / SAMPLE_SPACING))
                samples.append(piece[np.unique(np.searchsorted(along, even - 1e-12).clip(0, len(piece) - 1))])
        index = np.repeat(np.arange(len(samples)), [len(piece) for piece in samples])
        chosen = np.concatenate([np.empty(0, int), *samples])
        return _Pieces(area, index, z[chosen], x[chosen])

    def _raised(self, area: Slice, across: Array) -> tuple[Array, Array, Mask]:
        """Find points of base space over places `across` (N, 2) along the slice whose preimages lie on it.

        Newton's method moves them along the normal, from the height of the nearest image of a lattice on the slice.

        Returns:
            The preimages (N, 3), the points (N, 3), metres, and whether they were found (N,).
        """
        images, normal = self._images(area), area.normal
        nearest = KDTree(area.across(images)).query(across)[1]
        z = area.at(across) + ((images - area.centre) @ normal)[nearest, None] * normal
        x, todo = np.empty_like(z), np.arange(len(z))
        for _ in range(MAX_NEWTON):
            normals = np.broadcast_to(normal[:, None], (len(todo), 3, 1))
            x[todo], tangents = self._system.transform.inverse_tangents(z[todo], normals)
            miss = (x[todo] - area.centre) @ normal
            step = miss / np.maximum(tangents[..., 0] @ normal, MIN_SLOPE)
            off = np.abs(miss) > ON_SLICE
            todo = todo[off]
            if not len(todo):
                break
            z[todo] -= np.clip(step[off], -MAX_STEP, MAX_STEP)[:, None] * normal
        found = np.ones(len(z), bool)
        found[todo] = False
        return x, z, found

    def base(self, area: Slice, *, grid: bool) -> PanelPicture:
        """Return the base attractor on a panel where the slice is, with the lattice of the warped grid or without."""
        return self._panel(BASE_TITLE, area, lambda: self._base(area, grid=grid), (grid,))

    def imitation(self, area: Slice, title: str) -> PanelPicture:
        """Return the imitation, and what it imitates, on a panel where the slice is."""
        return self._panel(
            title,
            area,
            lambda: system_panel(title, self._system, self._paths, area, demonstrations=self.task.paths, coarse=False),
        )

    def generating(self, area: Slice, title: str) -> PanelPicture | None:
        """Return what leads the base attractor's motions to the imitation: −V, the mean of all its flows."""
        picture = self.generator(area, 0)
        if picture is None:
            return None
        inside = (np.abs(area.across(picture.points)) < np.array(area.half_size) - ARROW_SPACING / 2).all(axis=1)
        return PanelPicture(title, area, points=picture.points[inside], vectors=-picture.displacements[inside])

    def _panel(
        self, title: str, area: Slice, make: Callable[[], PanelPicture], key: tuple[bool, ...] = ()
    ) -> PanelPicture:
        """Return a panel that no obstacle changes, made once."""
        made = self._panels.get((title, *key))
        if made is None or not made.area.lies_like(area):
            made = self._panels[(title, *key)] = make()
        return made

    def _base(self, area: Slice, *, grid: bool) -> PanelPicture:
        fit, lines = Fit.of(self._rays, area), []
        seen = fit.base_area
        for ends in zip(*self._lines(area), strict=True) if grid else ():
            across = seen.across(area.at(np.stack(ends)))
            cut = np.clip(across, -np.array(seen.half_size), seen.half_size)
            fixed = np.abs(across[0] - across[1]) < 1e-9  # the coordinate along which the line does not run
            if (np.abs(across[0] - cut[0])[fixed] < 1e-9).all():
                lines.append(seen.at(cut))
        return base_panel(BASE_TITLE, self._rays, fit, lines, coarse=False)


def in_frame(transform: Diffeomorphism) -> Chain | None:
    """Return the chain of flows inside a placed imitation; None for the identity."""
    return transform.inner if isinstance(transform, Placed) and isinstance(transform.inner, Chain) else None


def _lattice(lower: Array, upper: Array, spacing: float) -> Array:
    """Return points (N, 2) over a rectangle at about this spacing."""
    axes = [np.linspace(a, b, max(2, round((b - a) / spacing) + 1)) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _lattice_lines(lower: Array, upper: Array, spacing: float) -> tuple[Array, Array]:
    """Return the ends (M, 2) of a lattice's lines over a rectangle, whose sides are multiples of the spacing."""
    starts, ends = [], []
    for axis in range(2):
        for c in np.linspace(lower[axis], upper[axis], round((upper[axis] - lower[axis]) / spacing) + 1):
            start, end = lower.copy(), upper.copy()
            start[axis] = end[axis] = c
            starts.append(start)
            ends.append(end)
    return np.stack(starts), np.stack(ends)


def _true_runs(mask: Mask) -> list[Indices]:
    """Return the indices of each run of true values."""
    return [run for run in np.split(np.arange(len(mask)), np.flatnonzero(np.diff(mask)) + 1) if mask[run[0]]]


def _runs(positions: Array, index: Indices, limit: float) -> tuple[Array, ...]:
    """Return polylines (T_i, 3) of samples of the same piece that lie within `limit` of their neighbours."""
    far = np.linalg.norm(np.diff(positions, axis=0), axis=1) > limit
    pieces = np.split(positions, np.flatnonzero(far | (np.diff(index) > 0)) + 1)
    return tuple(piece for piece in pieces if len(piece) > 1)


def _drawn(behaviour: Diffeomorphism) -> Diffeomorphism:
    """A transform, its flows as exact as a picture needs them."""
    if isinstance(behaviour, Chain):
        return Chain([_drawn(part) for part in behaviour.parts])
    return replace(behaviour, tolerance=TOLERANCE) if isinstance(behaviour, AdaptiveFlow) else behaviour
