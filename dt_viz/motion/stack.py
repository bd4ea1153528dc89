"""The stack of the end effector: its transforms, built for the motion below them, and its exact rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.detour import Detour, carried_over
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.avoidance.transform import Anchored, Built, MotionBelow, Transform
from dt_viz.flows.augmented_systems import OnPlaces, frozen, on_places
from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Identity
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Bundle, Rays, refined
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.motion.nominal import Nominal
from dt_viz.obstacles.shapes import Point
from dt_viz.scenario.scenario import Layer
from dt_viz.warning import MotionWarning

MAX_ATTEMPTS = 4
"""Attempts at a flow time that also clears the samples that refinement adds."""


@dataclass(frozen=True)
class Precision:
    """How exactly a motion is worked out, all in metres."""

    tolerance: float
    """Tolerance of a step of the transforms' flows."""
    spacing: float
    """Largest distance between neighbouring samples."""
    ends: float
    """Distance by which a rollout may miss its start and goal before the motion below is made anew."""


LIVE = Precision(tolerance=2e-5, spacing=0.012, ends=3e-4)
"""Nothing of this is seen at the size of a screen."""
FINE = Precision(tolerance=2e-9, spacing=0.005, ends=1e-7)


@dataclass(frozen=True)
class Applied:
    """A layer of a stack as it was made."""

    place: int
    """Place of the layer in the whole stack, in which some may be off."""
    name: str
    transform: Transform
    made: Built
    satisfied: bool
    """Whether it finds in the motion what it was made for."""

    @property
    def may_improve(self) -> bool:
        """Whether it is of use to try again."""
        return not (self.satisfied or self.made.hopeless)


@dataclass(frozen=True)
class Solution:
    """A stack of the end effector, and its rollouts."""

    transform: Diffeomorphism
    rays: Rays
    bundle: Bundle
    built: tuple[Applied, ...]
    """The layers that are on, from the inside out."""

    @property
    def system(self) -> DiffeomorphicSystem:
        """The dynamical system whose motions these are, of its states."""
        return DiffeomorphicSystem(self.transform, self.rays.base)

    @property
    def parts(self) -> tuple[Diffeomorphism, ...]:
        """What ψ is a chain of: the same objects wherever they stay the same."""
        parts = Chain([self.transform]).parts
        return tuple(part.transform if isinstance(part, OnPlaces) else part for part in parts)

    @property
    def stacked(self) -> Diffeomorphism:
        """The transforms on the imitation together, of places (3,)."""
        parts: list[Diffeomorphism] = [applied.made.transform for applied in self.built]
        return Chain(parts) if parts else Identity(3)

    def at_phase(self, rest: Array) -> DiffeomorphicSystem:
        """The system of places (3,), for the other coordinates (k − 3,) of the state; see `frozen`."""
        return frozen(self.system, rest)

    @property
    def warnings(self) -> tuple[MotionWarning, ...]:
        """The warnings of the transforms."""
        return tuple(warning for applied in self.built for warning in applied.made.warnings)

    def at(self, place: int) -> Applied | None:
        """The layer at this place in the whole stack, as it was made; None where it is off."""
        return next((applied for applied in self.built if applied.place == place), None)

    def positions_at(self, index: Indices, fraction: Array) -> Array:
        """End effector (N, 3), metres, of the rollouts `index` (N,) at the fractions `fraction` (N,) of their rays."""
        return self.transform.inverse(self.rays.at(index, fraction))[:, :3]

    def states(self, index: Indices, fraction: Array, positions: Array) -> Array:
        """States (N, k) at positions (N, 3) of the rollouts `index` (N,) at the fractions `fraction` (N,)."""
        return np.concatenate([positions, self.rays.at(index, fraction)[:, 3:]], axis=1)


def cut_off(nominal: Nominal, solution: Solution, level: int) -> DiffeomorphicSystem:
    """The system on the manifold of a level, counted as in `Bundle.levels`: without what is stacked on it."""
    stacked = [applied.made.transform for applied in solution.built[:level]]
    return DiffeomorphicSystem(chained(nominal, stacked), solution.rays.base)


def chained(nominal: Nominal, outer: Sequence[Diffeomorphism]) -> Chain:
    """ψ of states: of the undisturbed motion, and of transforms of places (3,) on it, from the inside out."""
    return Chain([nominal.system.transform, *on_places(outer, nominal.system.transform.dim - 3)])


def climb(positions: Array, transforms: Sequence[Diffeomorphism]) -> Array:
    """Levels (N, 1 + len(transforms), 3) above `positions` (N, 3) of a stack given from the inside out."""
    levels = [positions]
    for transform in transforms:
        levels.append(transform.inverse(levels[-1]))
    return np.stack(levels, axis=1)


def build_stack(
    nominal: Nominal, layers: Sequence[tuple[int, Layer]], precision: Precision, passing: Passing = ANEW
) -> Solution:
    """Build the transforms for the motion below them, and the exact rollouts of the whole stack.

    A transform is made for the samples of the motion that there are. Refinement finds new samples, and ends that the
    transforms move change the motion a little; so look whether the transforms still fit, and mend them if not. Where
    there is no way to the goal beside an obstacle that nearly touches it, the motions may end beside the goal.

    Args:
        nominal: the undisturbed motion.
        layers: those that act, from the inside out, each with its place in the whole stack; see `Scenario.active`.
        precision: how exactly.
        passing: sides to keep while obstacles are dragged.
    """
    detours = [
        carried_over(passing.hand.get(place, ()), layer.transform.avoided.parts, turn=precision is LIVE)
        for place, layer in layers
    ]
    solution, places = None, nominal.learned.places
    for keeps_goal in (True, False):
        rays, bundle = nominal.rays, nominal.bundle
        ends_below = nominal.ends
        earlier, above = [None] * len(layers), (None,) * len(layers)
        for _ in range(MAX_ATTEMPTS):
            lowest = MotionBelow(
                nominal.starts,
                nominal.goal,
                bundle.index,
                bundle.levels[:, 0],
                tolerance=precision.tolerance,
                keeps_goal=keeps_goal,
                num_demonstrated=nominal.num_shaping,
            )
            built = _build(layers, lowest, earlier, above, detours)
            above = _above([made for _, made in built])
            earlier = [made for _, made in built]
            outer = [made.transform for _, made in built]
            goal = built[-1][1].goal if built else nominal.goal

            ends = np.concatenate([nominal.starts, [goal]])
            below = Chain(outer).forward(ends) if outer else ends
            if np.abs(below - ends_below).max() > precision.ends:
                rays, ends_below = nominal.rays_between(below), below
                bundle = replace(bundle, levels=places(rays.at(bundle.index, bundle.fraction))[:, None])
            bundle = replace(bundle, levels=climb(bundle.levels[:, 0], outer))
            bundle = refined(bundle, lambda i, u, r=rays, s=outer: climb(places(r.at(i, u)), s), precision.spacing)
            solution = Solution(chained(nominal, outer), rays, bundle, _applied(layers, built, above, bundle))
            if not any(applied.may_improve for applied in solution.built):
                return solution
        assert solution is not None
        if not any(applied.transform.avoided.parts and applied.may_improve for applied in solution.built):
            break  # the goal has nothing to do with it
    assert solution is not None
    return solution


def _build(
    layers: Sequence[tuple[int, Layer]],
    motion: MotionBelow,
    earlier: Sequence[Built | None],
    above: Sequence[Diffeomorphism | None],
    detours: Sequence[tuple[Detour | None, ...]],
) -> list[tuple[MotionBelow, Built]]:
    """Each layer's transform, with the motion that it was made for."""
    built: list[tuple[MotionBelow, Built]] = []
    targets: list[Point] = []
    for (_, layer), last, outer, known in zip(layers, earlier, above, detours, strict=True):
        told = {"name": layer.name, "earlier": last, "above": outer, "targets": tuple(targets)}
        motion = replace(motion, **told, detours=known)
        made = layer.transform.build(motion)
        built.append((motion, made))
        if isinstance(layer.transform, Anchored):
            targets.append(layer.transform.position)
        if len(built) < len(layers):
            motion = replace(motion, goal=made.goal, positions=made.transform.inverse(motion.positions))
    return built


def _above(built: Sequence[Built]) -> tuple[Diffeomorphism | None, ...]:
    """For each transform, the chain of those above it."""
    transforms = [[made.transform for made in built[k + 1 :]] for k in range(len(built))]
    return tuple(Chain(stacked) if stacked else None for stacked in transforms)


def _applied(
    layers: Sequence[tuple[int, Layer]],
    built: Sequence[tuple[MotionBelow, Built]],
    above: Sequence[Diffeomorphism | None],
    bundle: Bundle,
) -> tuple[Applied, ...]:
    """The layers as they were made, and whether they find in the bundle what they were made for."""
    found = []
    for (place, layer), (motion, made), outer in zip(layers, built, above, strict=True):
        at = {"positions": bundle.levels[:, len(found) + 1], "above": outer}
        satisfied = layer.transform.satisfied(replace(motion, index=bundle.index, **at), bundle.positions)
        found.append(Applied(place, layer.name, layer.transform, made, satisfied))
    return tuple(found)
