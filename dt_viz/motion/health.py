"""What is known of how far a motion is to be trusted, and what integrators cost that were chosen by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.arm.collision import CollisionReport
from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow, Integration
from dt_viz.flows.fields import Array

MAX_ROUND_TRIP = 1e-6
"""Metres; the workspace is about one metre wide."""
NUM_CHECKED_LIVE = 300
"""Samples on which it is computed what an integrator costs that was chosen by hand."""
FOLDS, THERE_AND_BACK, RISES = "folds space", "there and back", "the Lyapunov value does not fall all the way"
"""Words of the doubts that name a cause; certificates that fail for it do not repeat them."""


@dataclass(frozen=True)
class Health:
    """What is known about how far a result is to be trusted; None is what this stage does not compute."""

    clearance: float
    """Smallest distance from the obstacle of what avoids it, metres, negative inside: of the end effector, or of the
    spheres that cover the arm on the motions from the task's starts."""
    collision: CollisionReport | None = None
    """What the arm's meshes come near to on the motion that it shows."""
    duration: float | None = None
    """t of the end effector's avoidance flow, under a warp that of the full one; None where it is off."""
    layer_durations: tuple[float | None, ...] = ()
    """t of each layer's flow, in the order of `Scenario.layers`, under a warp of the full one; None for those that are
    off."""
    arm_duration: float | None = None
    """t of the whole arm's avoidance flow, under a warp that of the full one; None where it is off."""
    min_det_jacobian: float | None = None
    """Smallest det J of the whole stack along the rollouts: positive where it is a diffeomorphism. Where ψ⁻¹,
    integrated by hand, folds what is drawn, its det is taken. It is as exact as tangents are: where space is squeezed
    strongly, off by some per cent (see `AdaptiveFlow.tolerance`)."""
    round_trip_error: float | None = None
    """Largest ‖ψ⁻¹(ψ(y)) − y‖ along the rollouts, metres."""
    lyapunov_falls: bool | None = None
    """Whether Φ(ψ(y(t))) falls strictly along every rollout."""
    doubts: tuple[str, ...] = ()
    """Why the result is not to be trusted, in words."""
    arm_doubts: tuple[str, ...] = ()
    """Those of them that are about the arm that follows a rollout, not about the rollouts: nothing to who hides it."""

    def says(self, words: str) -> bool:
        """Whether some doubt has these words."""
        return any(words in doubt for doubt in self.doubts)

    def doubting(self, *doubts: str) -> Health:
        """This health with more doubts."""
        return replace(self, doubts=self.doubts + doubts)

    def doubting_arm(self, *doubts: str) -> Health:
        """This health with more doubts about the arm that follows a rollout."""
        return replace(self.doubting(*doubts), arm_doubts=self.arm_doubts + doubts)


def integration_doubts(
    name: str, flow: Diffeomorphism, integration: Integration, y: Array, x: Array, unit: Array | float = 1.0
) -> tuple[str, ...]:
    """What it costs that the integration of a transform's flow was chosen by hand, in words; nothing if it was not.

    Quick enough for a drag. A flow in other coordinates, as the whole arm's, is too slow to be looked at for folds
    here: see `fold_doubts`.

    Args:
        name: of the transform.
        flow: its ψ.
        integration: of that flow.
        y: (N, d) samples of the motions with the transform.
        x: (N, d) the samples below, which ψ⁻¹ leads to `y`.
        unit: metres for one unit of each coordinate.
    """
    if not integration.by_hand:
        return ()
    keep = np.unique(np.linspace(0, len(y) - 1, NUM_CHECKED_LIVE).astype(int))
    lost = float(np.linalg.norm((flow.inverse(flow.forward(y[keep])) - y[keep]) * unit, axis=1).max())
    doubts = fold_doubts(name, flow, integration, y[keep], x[keep]) if isinstance(flow, Flow) else ()
    if lost <= MAX_ROUND_TRIP:
        return doubts
    loses = f"loses {in_millimetres(lost)} {THERE_AND_BACK}"
    return tuple(f"{doubt}. It {loses}" for doubt in doubts) or (f"{name}: {integration} {loses}",)


def fold_doubts(name: str, flow: Diffeomorphism, integration: Integration, y: Array, x: Array) -> tuple[str, ...]:
    """Whether a step of a flow whose integration was chosen by hand folds space, in words.

    Only the steps that start from or lead to these samples are looked at: what folds beside them is not found.

    Args:
        name: of the transform.
        flow: its ψ, if it has steps in these or other coordinates; nothing is said of others.
        integration: of that flow.
        y: (N, d) samples of the motions with the transform.
        x: (N, d) the samples below, which ψ⁻¹ leads to `y`.
    """
    while isinstance(flow, Conjugated):
        flow, y, x = flow.inner, flow.by.forward(y), flow.by.forward(x)
    if not integration.by_hand or not isinstance(flow, Flow):
        return ()
    # ψ⁻¹ is looked at on its way to the samples: after a coarse ψ it starts elsewhere
    det = min(flow.min_step_determinant(y, inverse=False), flow.min_step_determinant(x, inverse=True))
    if det > 0:
        return ()
    return (f"{name}: a step of {integration} {FOLDS} (det {det:.2g}); take more steps or less time",)


def in_millimetres(length: float) -> str:
    """A length in metres, in words."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"
