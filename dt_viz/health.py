"""Certificates: whether a stack is still a diffeomorphism and its motions still stable. Computed, never assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.collision import CollisionReport
from dt_viz.cspace import LEVERS
from dt_viz.diffeo import Diffeomorphism, Flow
from dt_viz.fields import Array, Indices
from dt_viz.integration import Integration
from dt_viz.robot import Robot
from dt_viz.rollouts import Bundle
from dt_viz.systems import DiffeomorphicSystem
from dt_viz.whole_arm import ArmSolution

MAX_ROUND_TRIP = 1e-6
"""Metres; the workspace is about one metre wide."""
NUM_CHECKED = 800
"""Samples on which the certificates are computed."""
NUM_CHECKED_POSTURES = 200
"""The same for the whole arm."""
NUM_CHECKED_LIVE = 300
"""The same for what an integrator costs that was chosen by hand."""
FOLDS, THERE_AND_BACK = "folds space", "there and back"
"""Words of the doubts that name a cause; certificates that fail for it do not repeat them."""


@dataclass(frozen=True)
class Health:
    """What is known about how far a result is to be trusted; None is what this stage does not compute."""

    clearance: float
    """Smallest distance from the obstacle of what avoids it, metres, negative inside: of the end effector, or of the
    spheres that cover the arm."""
    collision: CollisionReport | None = None
    """What the arm's meshes come near to on the motion that it shows."""
    duration: float | None = None
    """t of the end effector's avoidance flow; None where it is off."""
    layer_durations: tuple[float | None, ...] = ()
    """t of each layer's flow, in the order of `Scenario.layers`; None for those that are off."""
    arm_duration: float | None = None
    """t of the whole arm's avoidance flow; None where it is off."""
    min_det_jacobian: float | None = None
    """Smallest det J of the whole stack along the rollouts: positive where it is a diffeomorphism."""
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


def certified(health: Health, system: DiffeomorphicSystem, bundle: Bundle) -> Health:
    """Add the certificates of a stack along its rollouts, and a doubt for each that fails."""
    keep = np.unique(np.linspace(0, len(bundle.index) - 1, NUM_CHECKED).astype(int))
    y, (z, J) = bundle.positions[keep], system.transform.jacobian(bundle.positions[keep])
    det = np.linalg.det(J)
    round_trip = float(np.linalg.norm(system.transform.inverse(z) - y, axis=1).max())
    falls = _falls(system.base.potential(z), bundle.index[keep])
    return _judged(health, float(det.min()), round_trip, falls)


def certified_arm(health: Health, system: DiffeomorphicSystem, arm: ArmSolution, robot: Robot) -> Health:
    """Add the certificates of the whole arm's transform to those of the end effector's stack below it."""
    keep = np.unique(np.linspace(0, len(arm.index) - 1, NUM_CHECKED_POSTURES).astype(int))
    p, (q, J) = arm.p[keep], arm.transform.jacobian(arm.p[keep])
    round_trip = float(np.linalg.norm((arm.transform.inverse(q) - p) * LEVERS, axis=1).max())
    falls = _falls(system.lyapunov(robot.end_effector(arm.q)), arm.index)  # of all: samples far apart hide a rise
    return _judged(health, float(np.linalg.det(J).min()), round_trip, falls)


def integration_doubts(
    name: str, flow: Diffeomorphism, integration: Integration, y: Array, unit: Array | float = 1.0
) -> tuple[str, ...]:
    """What it costs that the integration of a transform's flow was chosen by hand, in words; nothing if it was not.

    Quick enough for a drag. Of the whole arm's flow folds are not looked for: the certificates find them.

    Args:
        name: of the transform.
        flow: its ψ.
        integration: of that flow.
        y: (N, d) samples of the motions with the transform.
        unit: metres for one unit of each coordinate.
    """
    if not integration.by_hand:
        return ()
    y = y[np.unique(np.linspace(0, len(y) - 1, NUM_CHECKED_LIVE).astype(int))]
    x = flow.forward(y)
    lost = float(np.linalg.norm((flow.inverse(x) - y) * unit, axis=1).max())
    doubts = []
    if isinstance(flow, Flow):
        det = min(flow.min_step_determinant(y, inverse=False), flow.min_step_determinant(x, inverse=True))
        if not det > 0:
            doubts.append(f"{name}: a step of {integration} {FOLDS} (det {det:.2g}); take more steps or less time")
    if not lost <= MAX_ROUND_TRIP:
        doubts.append(f"{name}: {integration} loses {_millimetres(lost)} {THERE_AND_BACK}")
    return tuple(doubts)


def _judged(health: Health, det: float, round_trip: float, falls: bool) -> Health:
    """Health with certificates that may be worse than those it has, and a doubt for each new failure."""
    if not det > 0 and not health.says(FOLDS):
        health = health.doubting(f"det J falls to {det:.2g}: the map {FOLDS}, the stack is no diffeomorphism there")
    if not round_trip <= MAX_ROUND_TRIP and not health.says(THERE_AND_BACK):
        health = health.doubting(f"{THERE_AND_BACK} again misses by {1e3 * round_trip:.3g} mm: steps too coarse")
    if not falls:
        health = health.doubting("the Lyapunov value does not fall all the way")
    return replace(
        health,
        min_det_jacobian=min(det, np.inf if health.min_det_jacobian is None else health.min_det_jacobian),
        round_trip_error=max(round_trip, health.round_trip_error or 0.0),
        lyapunov_falls=falls and health.lyapunov_falls is not False,
    )


def _falls(potential: Array, index: Indices) -> bool:
    """Whether the potential falls strictly between neighbouring samples of the same rollout."""
    same = np.diff(index) == 0
    return bool((np.diff(potential)[same] < 0).all())


def _millimetres(length: float) -> str:
    """A length in metres, in words."""
    return f"{1e3 * length:.0f} mm" if length >= 0.01 else f"{1e3 * length:.2g} mm"
