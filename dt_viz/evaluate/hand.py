"""Measure the end effector's motions where the hand alone gives way to obstacles, at many places of these.

The npz file holds for each of K places, beside ``places``, ``sizes``, ``turns`` and ``shapes`` (see
`dt_viz.evaluate.places`):

``ends`` (K, R + 1)
    distance of the R starts and the goal from the obstacles, metres, negative inside.
``clearance``, ``clearance_without`` (K, R)
    smallest distance of each rollout from the obstacles with and without avoidance, metres, negative inside.
``frechet`` (K, R)
    Fréchet distance of each rollout from the one without avoidance, metres.
``turn``, ``turn_without`` (K, R)
    sharpest turn over `TURN_ARC`, degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from dt_viz.engine.engine import Engine
from dt_viz.evaluate.avoidance import TURN_ARC
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import print_table
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import refined
from dt_viz.metrics import maximum_collision_distance, sharpest_turn
from dt_viz.motion.stack import FINE, Solution
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Scenario

SPACING = 1e-3
"""Distance between samples that turns are measured at, metres."""
SHARP = 90.0
"""Turn over `TURN_ARC` beyond which it is sharp, degrees."""
ALLOWANCE = 1e-3
"""Distance, metres, by which a motion may come nearer than the margin where it counts as kept."""


@dataclass(frozen=True)
class Passed:
    """What was measured with obstacles at one place; lengths in metres, see the arrays of the file."""

    ends: Array
    clearance: Array
    clearance_without: Array
    frechet: Array
    turn: Array
    turn_without: Array

    @property
    def is_free(self) -> bool:
        """Whether the obstacles leave all starts and the goal free."""
        return bool((self.ends >= 0).all())

    def detour(self, margin: float) -> float:
        """Largest Fréchet distance relative to what the deepest rollout lacks of the margin without avoidance."""
        return float(self.frechet.max() / (margin - self.clearance_without.min()))


def passed(engine: Engine, scenario: Scenario, obstacle: Union) -> Passed:
    """Measure the end effector's motions of a scenario against obstacles, which it may avoid or not."""
    solved = engine.solved(scenario, FINE)
    without = solved.nominal.paths
    paths = _finely(solved.stack)
    return Passed(
        obstacle.signed_distance(solved.nominal.ends),
        np.array([_clearance(path, obstacle) for path in paths]),
        np.array([_clearance(path, obstacle) for path in without]),
        frechet(paths, without),
        np.array([sharpest_turn(path, TURN_ARC) for path in paths]),
        np.array([sharpest_turn(path, TURN_ARC) for path in without]),
    )


def arrays(places: Sequence[Passed]) -> dict[str, Array]:
    """What is written of the motions."""
    return {value.name: np.array([getattr(place, value.name) for place in places]) for value in fields(Passed)}


def print_places(places: Sequence[Passed], margin: float) -> None:
    """Print a table of the places and the figures over all."""
    rows = [
        (
            str(k),
            *(f"{1e3 * value.min():.1f}" for value in (p.ends, p.clearance_without, p.clearance)),
            f"{1e3 * p.frechet.max():.0f}",
            f"{p.detour(margin):.2f}" if p.clearance_without.min() < margin else "",
            f"{p.turn.max():.0f}° ({p.turn_without.max():.0f}°)",
        )
        for k, p in enumerate(places)
    ]
    header = ("place", "ends", "clearance without", "clearance", "F.D.", "F.D./forced", "turn (without)")
    print_table(header, rows)
    free = [p for p in places if p.is_free]
    print(f"\n{len(free)} of {len(places)} places leave the starts and the goal free; {_sharp(places)} at all places")
    if not (hit := [p for p in free if p.clearance_without.min() < margin]):
        return
    kept = _share(lambda p: p.clearance.min() >= margin - ALLOWANCE, free)
    print(f"at those that do: at least {1e3 * (margin - ALLOWANCE):.0f} mm kept {kept}, ", end="")
    print(f"collisions {_share(lambda p: p.clearance.min() < 0, free)}; {_sharp(free)}")
    detour = [p.detour(margin) for p in hit]
    print(f"where a motion is in the way: F.D. / forced, median {np.median(detour):.2f}, ", end="")
    print(f"95 % {np.percentile(detour, 95):.2f}; F.D. mean {1e3 * np.mean([p.frechet.mean() for p in hit]):.0f} mm")


def _finely(solution: Solution) -> tuple[Array, ...]:
    """Rollouts (T, 3) of a stack at a fine spacing."""
    bundle = replace(solution.bundle, levels=solution.bundle.positions[:, None])
    return refined(bundle, lambda i, u: solution.positions_at(i, u)[:, None], SPACING).paths


def _clearance(path: Array, obstacle: Union) -> float:
    """Smallest distance of a path (T, 3) from an obstacle, metres, negative inside."""
    depth = maximum_collision_distance(path, obstacle.signed_distance)
    return -depth if depth > 0 else float(obstacle.signed_distance(path).min())


def _sharp(places: Sequence[Passed]) -> str:
    with_avoidance = _share(lambda p: p.turn.max() > SHARP, places)
    without = _share(lambda p: p.turn_without.max() > SHARP, places)
    return f"turns sharper than {SHARP:.0f}° {with_avoidance}, without avoidance {without}"


def _share(is_so: Callable[[Passed], bool], places: Sequence[Passed]) -> str:
    num = sum(map(is_so, places))
    return f"{num} of {len(places)} ({100 * num / len(places):.1f} %)"
