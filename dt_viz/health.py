"""Certificates: whether a stack is still a diffeomorphism and its motions still stable. Computed, never assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.collision import CollisionReport
from dt_viz.cspace import LEVERS
from dt_viz.diffeo import Conjugated, Diffeomorphism, Flow
from dt_viz.fields import Array, Indices
from dt_viz.integration import Integration
from dt_viz.robot import Robot
from dt_viz.rollouts import Bundle
from dt_viz.systems import Attractor, DiffeomorphicSystem
from dt_viz.whole_arm import ArmSolution

MAX_ROUND_TRIP = 1e-6
"""Metres; the workspace is about one metre wide."""
NUM_CHECKED = 800
"""Samples on which the certificates are computed."""
NUM_CHECKED_POSTURES = 200
"""The same for the whole arm."""
NUM_CHECKED_LIVE = 300
"""The same for what an integrator costs that was chosen by hand."""
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

    def says(self, words: str) -> bool:
        """Whether some doubt has these words."""
        return any(words in doubt for doubt in self.doubts)

    def doubting(self, *doubts: str) -> Health:
        """This health with more doubts."""
        return replace(self, doubts=self.doubts + doubts)


def certified(health: Health, system: DiffeomorphicSystem, bundle: Bundle, drawn_from: Array | None = None) -> Health:
    """Add the certificates of a stack along its rollouts, and a doubt for each that fails.

    Args:
        health: what is known already.
        system: whose transform the stack is.
        bundle: its rollouts.
        drawn_from: (N, 3) the base points that ψ⁻¹ leads to the samples, where it is integrated by hand: coarse steps
            there and back are no inverses, and ψ⁻¹, which is what is drawn, may fold space where ψ does not.
    """
    keep = np.unique(np.linspace(0, len(bundle.index) - 1, NUM_CHECKED).astype(int))
    y, (z, J) = bundle.positions[keep], system.transform.jacobian(bundle.positions[keep])
    det = _determinant(system.transform, J, None if drawn_from is None else drawn_from[keep])
    round_trip = float(np.linalg.norm(system.transform.inverse(z) - y, axis=1).max())
    falls = _falls(system.base.potential(z), bundle.index[keep], system.base)
    return _judged(health, det, round_trip, falls)


def certified_arm(
    health: Health, system: DiffeomorphicSystem, arm: ArmSolution, robot: Robot, drawn_from: Array | None = None
) -> Health:
    """Add the certificates of the whole arm's transform to those of the end effector's stack below it.

    Args:
        health: of that stack.
        system: the end effector's.
        arm: the arm's motions.
        robot: whose arm it is.
        drawn_from: (N, 6) postures that ψ_q⁻¹ leads to the samples, where it is integrated by hand.
    """
    keep = np.unique(np.linspace(0, len(arm.index) - 1, NUM_CHECKED_POSTURES).astype(int))
    p, (q, J) = arm.p[keep], arm.transform.jacobian(arm.p[keep])
    det = _determinant(arm.transform, J, None if drawn_from is None else drawn_from[keep])
    round_trip = float(np.linalg.norm((arm.transform.inverse(q) - p) * LEVERS, axis=1).max())
    potential = system.lyapunov(robot.end_effector(arm.q))  # of all samples: those far apart hide a rise
    falls = _falls(potential, arm.index, system.base)
    return _judged(health, det, round_trip, falls)


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


def _determinant(transform: Diffeomorphism, J: Array, drawn_from: Array | None) -> float:
    """Smallest det J, or of ψ⁻¹'s derivative where that is not positive at what the samples are `drawn_from`."""
    det = np.linalg.det(J)
    if drawn_from is not None:
        inverse = np.linalg.det(transform.inverse_jacobian(drawn_from)[1])
        det = np.append(det, inverse[~(inverse > 0)])
    return float(det.min())


def _judged(health: Health, det: float, round_trip: float, falls: bool) -> Health:
    """Health with certificates that may be worse than those it has, and a doubt for each new failure.

    Where a step is known to fold space, that the Lyapunov value does not fall is none.
    """
    folds = health.says(FOLDS)
    if not (det > 0 or folds):
        health = health.doubting(f"det J falls to {det:.2g}: the map {FOLDS}, the stack is no diffeomorphism there")
    if not round_trip <= MAX_ROUND_TRIP and not health.says(THERE_AND_BACK):
        health = health.doubting(f"{THERE_AND_BACK} again misses by {1e3 * round_trip:.3g} mm: steps too coarse")
    if not (falls or folds or health.says(RISES)):
        health = health.doubting(RISES)
    return replace(
        health,
        min_det_jacobian=min(det, np.inf if health.min_det_jacobian is None else health.min_det_jacobian),
        round_trip_error=max(round_trip, health.round_trip_error or 0.0),
        lyapunov_falls=falls and health.lyapunov_falls is not False,
    )


def _falls(potential: Array, index: Indices, base: Attractor) -> bool:
    """Whether the potential falls strictly between neighbouring samples of the same rollout, until that has arrived."""
    same = np.diff(index) == 0
    arrived = potential[1:] <= base.potential(base.goal + MAX_ROUND_TRIP * np.eye(base.dim)[0])  # the rest is rounding
    return bool((arrived | (np.diff(potential) < 0))[same].all())


def in_millimetres(length: float) -> str:
    """A length in metres, in words."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"
