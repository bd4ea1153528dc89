"""The stack of the end effector: its transforms, built for the motion below them, and its exact rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.detour import Detour, carried_over
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.avoidance.transform import Anchored, Built, MotionBelow, Transform
from dt_viz.flows.augmented_systems import OnPlaces, on_places
from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Identity
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Bundle, Rays, refined
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.motion.nominal import Nominal
from dt_viz.obstacles.shapes import Point
from dt_viz.scenario.scenario import Layer
from dt_viz.warning import MotionWarning

MAX_ATTEMPTS = 4  # attempts at a flow time that also clears the samples that refinement adds


@dataclass(frozen=True)
class Precision:
    """How exactly a motion is worked out, all in metres."""

    tolerance: float  # tolerance of a step of the transforms' flows
    spacing: float  # largest distance between neighbouring samples
    ends: float
    """Distance by which a rollout may miss its start and goal before the motion below is made anew."""


LIVE = Precision(tolerance=2e-5, spacing=0.012, ends=3e-4)
"""Nothing of this is seen at the size of a screen."""
FINE = Precision(tolerance=2e-9, spacing=0.005, ends=1e-7)


@dataclass(frozen=True)
class Applied:
    """A layer of a stack as it was made."""

    place: int  # place of the layer in the whole stack, in which some may be off
    name: str
    transform: Transform
    made: Built
    satisfied: bool  # whether it finds in the motion what it was made for

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
    built: tuple[Applied, ...]  # the layers that are on, from the inside out

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

    @property
    def warnings(self) -> tuple[MotionWarning, ...]:
        """The warnings of the transforms."""
        return tuple(warning for applied in self.built for warning in applied.made.warnings)

    def positions_at(self, index: Indices, fraction: Array) -> Array:
        """End effector (N, 3), metres, of the rollouts `index` (N,) at the fractions `fraction` (N,) of their rays."""
        return self.transform.inverse(self.rays.at(index, fraction))[:, :3]


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

    The layers act from the inside out, each with its place in the whole stack; see `Scenario.active`. The sides of
    `passing` are kept while obstacles are dragged.
    """
    detours = [
        carried_over(passing.hand.get(place, ()), layer.transform.avoided.parts, turn=precision is LIVE)
        for place, layer in layers
    ]
    solution = None
    for keeps_goal in (True, False):
        motions = _Motions(nominal.ends, nominal.rays, nominal.bundle)
        built: list[tuple[MotionBelow, Built]] = []
        for _ in range(MAX_ATTEMPTS):
            lowest = MotionBelow(
                nominal.starts,
                nominal.goal,
                motions.bundle.index,
                motions.bundle.levels[:, 0],
                tolerance=precision.tolerance,
                keeps_goal=keeps_goal,
                shaping=nominal.shaping,
            )
            built = _build(layers, lowest, [made for _, made in built], detours)
            outer = [made.transform for _, made in built]
            motions = motions.through(nominal, outer, built[-1][1].goal if built else nominal.goal, precision)
            applied = _applied(layers, built, motions.bundle)
            solution = Solution(chained(nominal, outer), motions.rays, motions.bundle, applied)
            if not any(layer.may_improve for layer in applied):
                return solution
        assert solution is not None
        if not any(layer.transform.avoided.parts and layer.may_improve for layer in solution.built):
            break  # the goal has nothing to do with it
    assert solution is not None
    return solution


def warped_stack(nominal: Nominal, full: Solution, fraction: float, precision: Precision) -> Solution:
    """The rollouts of a stack whose flows run for a fraction of their durations, on a motion that is warped as far.

    At 0 motions are the base attractor's, straight to the goal; at 1 they are those of the stack. In between, too, each
    transform is a diffeomorphism and motions are exact: starts and goal stay, so the rays of base space are those
    between their images. Where the full stack moves the goal, motions end that fraction of the way.
    """
    outer = [applied.made.transform.scaled(fraction) for applied in full.built]
    built = tuple(
        replace(applied, made=replace(applied.made, transform=transform))
        for applied, transform in zip(full.built, outer, strict=True)
    )
    moved = built[-1].made.goal - nominal.goal if built else np.zeros_like(nominal.goal)
    motions = _Motions(nominal.ends, nominal.rays, nominal.bundle)
    motions = motions.through(nominal, outer, nominal.goal + fraction * moved, precision)
    return Solution(chained(nominal, outer), motions.rays, motions.bundle, built)


@dataclass(frozen=True, eq=False)
class _Motions:
    """Rollouts on all levels of a stack."""

    ends: Array  # (R + 1, 3) places below the stack that the rays begin and end at, metres
    rays: Rays
    bundle: Bundle

    def through(self, nominal: Nominal, outer: Sequence[Diffeomorphism], goal: Array, precision: Precision) -> _Motions:
        """The rollouts to a goal (3,), metres, through these transforms of places on the undisturbed motion."""
        ends, places = np.concatenate([nominal.starts, [goal]]), nominal.learned.places
        below, rays, bundle = Chain(outer).forward(ends) if outer else ends, self.rays, self.bundle
        moves = np.abs(below - self.ends).max() > precision.ends
        if moves:
            rays = nominal.rays_between(below)
        lowest = places(rays.at(bundle.index, bundle.fraction)) if moves else bundle.levels[:, 0]
        bundle = replace(bundle, levels=climb(lowest, outer))
        bundle = refined(bundle, lambda i, u: climb(places(rays.at(i, u)), outer), precision.spacing)
        return _Motions(below if moves else self.ends, rays, bundle)


def _build(
    layers: Sequence[tuple[int, Layer]],
    motion: MotionBelow,
    earlier: Sequence[Built],
    detours: Sequence[tuple[Detour | None, ...]],
) -> list[tuple[MotionBelow, Built]]:
    """Each layer's transform, with the motion that it was made for; `earlier` is what the last attempt made, if any."""
    built: list[tuple[MotionBelow, Built]] = []
    targets: list[Point] = []
    for k, (_, layer) in enumerate(layers):
        motion = replace(
            motion,
            name=layer.name,
            earlier=earlier[k] if earlier else None,
            above=_above(earlier, k),
            targets=tuple(targets),
            detours=detours[k],
        )
        made = layer.transform.build(motion)
        built.append((motion, made))
        if isinstance(layer.transform, Anchored):
            targets.append(layer.transform.position)
        if len(built) < len(layers):
            motion = replace(motion, goal=made.goal, positions=made.transform.inverse(motion.positions))
    return built


def _above(built: Sequence[Built], k: int) -> Diffeomorphism | None:
    """The chain of the transforms above one of them."""
    transforms = [made.transform for made in built[k + 1 :]]
    return Chain(transforms) if transforms else None


def _applied(
    layers: Sequence[tuple[int, Layer]], built: Sequence[tuple[MotionBelow, Built]], bundle: Bundle
) -> tuple[Applied, ...]:
    """The layers as they were made, and whether they find in the bundle what they were made for."""
    found, every = [], [made for _, made in built]
    for k, ((place, layer), (motion, made)) in enumerate(zip(layers, built, strict=True)):
        at = {"positions": bundle.levels[:, k + 1], "above": _above(every, k)}
        satisfied = layer.transform.satisfied(replace(motion, index=bundle.index, **at), bundle.positions)
        found.append(Applied(place, layer.name, layer.transform, made, satisfied))
    return tuple(found)
