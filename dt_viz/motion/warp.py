"""The stack on its way from the identity to full: every flow runs for the fraction s of its duration.

At s = 0 motions are the base attractor's, straight to the goal; at s = 1 they are those of the stack. Durations are
those that were chosen for the full stack. In between, too, each transform is a diffeomorphism and motions are exact:
starts and goal stay, so the rays of base space are those between ψ_s(start) and ψ_s(goal).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dt_viz.flows.diffeomorphisms import Chain
from dt_viz.flows.rollouts import refined
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.stack import Precision, Solution, chained, climb


def warped_stack(nominal: Nominal, full: Solution, fraction: float, precision: Precision) -> Solution:
    """The rollouts of a stack whose flows run for a fraction of their durations.

    Args:
        nominal: warped by the same fraction.
        full: the stack whose flows they are. Where it moves the goal, motions end that fraction of the way.
        fraction: s, from 0 to 1.
        precision: as it was solved with.
    """
    outer = [applied.made.transform.scaled(fraction) for applied in full.built]
    built = tuple(
        replace(applied, made=replace(applied.made, transform=transform))
        for applied, transform in zip(full.built, outer, strict=True)
    )
    moved = built[-1].made.goal - nominal.goal if built else np.zeros_like(nominal.goal)
    ends = np.concatenate([nominal.starts, [nominal.goal + fraction * moved]])
    below = Chain(outer).forward(ends) if outer else ends
    rays, bundle, places = nominal.rays, nominal.bundle, nominal.learned.places
    if np.abs(below - nominal.ends).max() > precision.ends:
        rays = nominal.rays_between(below)
        bundle = replace(bundle, levels=places(rays.at(bundle.index, bundle.fraction))[:, None])
    bundle = replace(bundle, levels=climb(bundle.levels[:, 0], outer))
    bundle = refined(bundle, lambda i, u: climb(places(rays.at(i, u)), outer), precision.spacing)
    return Solution(chained(nominal, outer), rays, bundle, built)
