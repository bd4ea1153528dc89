"""The section x → q that the end effector's motion is lifted to the joints by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.kernels.proximity import COMPLEX_STEP
from dt_viz.robot.inverse_kinematics import soft_limits, track
from dt_viz.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Section:
    """The best postures q = Q(x) of an arm whose end effector is at x, as `inverse_kinematics.track` finds them.

    Q(x) minimises h(q), as in `track`, among the postures with x(q) = x. With the multipliers μ of that constraint it
    solves ∇h + J(q)ᵀμ = 0 and x(q) = x, whose derivative gives that of Q:

        [ ∇²h + Σ μ_k ∇²x_k   Jᵀ ] [ DQ ]   [ 0 ]
        [ J                   0  ] [ Dμ ] = [ I ].

    This is the pseudo-inverse of J in the metric of the Lagrangian's second derivative, so that J·DQ = I. It does not
    hold for joints at their limits.
    """

    robot: Robot
    reference: Array
    """(n,) reference posture of h, rad."""
    known: Array | None = None
    """(K, n) postures on it, rad, where h has several minima; None is the reference."""

    def postures(self, x: Array) -> Array:
        """Compute Q(x), (*B, T, n) rad, for paths `x` (*B, T, 3), metres."""
        n = self.robot.num_joints
        start = np.broadcast_to(self.reference, (*x.shape[:-2], n))
        q = track(self.robot, x, start, reference=start).q.reshape(-1, n)
        targets = x.reshape(-1, 3)
        for _ in range(4):  # Newton steps to the exact best posture; they converge quadratically
            slope, K = self._derivatives(q)
            miss = np.concatenate([-slope, targets - self.robot.end_effector(q)], axis=1)
            q = q + np.linalg.solve(K, miss[..., None])[:, :n, 0]
        return q.reshape(*x.shape[:-1], n)

    def nearest(self, x: Array) -> Array:
        """Return the known posture (n,) whose end effector is nearest to a place (3,), metres."""
        known = self.reference[None] if self.known is None else self.known
        return known[np.linalg.norm(self.robot.end_effector(known) - x, axis=1).argmin()]

    def _derivatives(self, q: Array) -> tuple[Array, Array]:
        """Compute ∇h + Jᵀμ with the best μ, (N, n), and the matrix above (N, n + 3, n + 3), at postures q (N, n)."""
        slope, J = self._slopes(q)
        multipliers = -np.linalg.solve(J @ J.transpose(0, 2, 1), J @ slope[..., None])  # (N, 3, 1)
        num, n = q.shape
        K = np.zeros((num, n + 3, n + 3))
        K[:, :n, n:], K[:, n:, :n] = J.transpose(0, 2, 1), J
        for joint, step in enumerate(1j * COMPLEX_STEP * np.eye(n)):
            slope_, J_ = self._slopes(q + step)
            turned = slope_ + (J_.transpose(0, 2, 1) @ multipliers)[..., 0]
            K[:, :n, joint] = turned.imag / COMPLEX_STEP
        return slope + (J.transpose(0, 2, 1) @ multipliers)[..., 0], K

    def _slopes(self, q: Any) -> tuple[Array, Array]:  # noqa: ANN401, real or complex
        """Compute ∇h (N, n) and J (N, 3, n) at postures q (N, n), real or complex."""
        chain, reference, settings = self.robot.chain(q.T), self.reference, self.robot.sized_tracking
        excess = q - np.clip(q.real, *soft_limits(self.robot, reference))
        excess = np.where(excess.real == 0, 0, excess)
        turn = chain.direction - self.robot.hand_direction(reference)[:, None]
        slope = q - reference + settings.limit_weight * excess
        slope = slope + settings.direction_weight * np.einsum("irn,rn->ni", chain.direction_jacobian(), turn)
        return slope, chain.position_jacobian().transpose(2, 1, 0)
