"""The whole arm as one dynamical system: the end effector's motion, lifted to the joints and pulled back (eq. (4))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.kernels.proximity import COMPLEX_STEP
from dt_viz.robot.inverse_kinematics import soft_limits, track
from dt_viz.robot.robot import Robot

NUM_POLISHING = 4
"""Number of Newton steps from the result of `track` to the exact best posture; they converge quadratically."""


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
        for _ in range(NUM_POLISHING):
            slope, K = self._derivatives(q)
            miss = np.concatenate([-slope, targets - self.robot.end_effector(q)], axis=1)
            q = q + np.linalg.solve(K, miss[..., None])[:, :n, 0]
        return q.reshape(*x.shape[:-1], n)

    def nearest(self, x: Array) -> Array:
        """Return the known posture (n,) whose end effector is nearest to a place (3,), metres."""
        known = self.reference[None] if self.known is None else self.known
        return known[np.linalg.norm(self.robot.end_effector(known) - x, axis=1).argmin()]

    def velocities(self, q: Array, velocity: Array) -> Array:
        """Compute DQ·ẋ, (*B, n) rad/s, at postures q = Q(x) (*B, n) for the end effector's `velocity` ẋ (*B, 3), m/s.

        At other postures it is the smooth continuation with the best-fitting multipliers, which still follows ẋ.
        """
        flat, n = velocity.reshape(-1, 3), q.shape[-1]
        wanted = np.concatenate([np.zeros((len(flat), n)), flat], axis=1)
        K = self._derivatives(q.reshape(-1, n))[1]
        return np.linalg.solve(K, wanted[..., None])[:, :n, 0].reshape(q.shape)

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


@dataclass(frozen=True, eq=False)
class ArmSystem:
    """The pulled-back system ṗ = Dψ_q⁻¹(q)·q̇ = J_ψ(p)⁻¹·q̇ with q = ψ_q(p), q̇ = DQ(x)·ẋ and x = x(q).

    Sec. 4.5 and eq. (4), in exact form: the printed one drops a transpose and flips a sign, see dt_viz/README.md.
    Its states are the postures p = ψ_q⁻¹(Q(x)) of the avoiding manifold. The chain p → q → x → z is a conjugacy to the
    base attractor, hence the system is as stable as that, and its motions are images of the base's.
    """

    hand: DiffeomorphicSystem
    """System of the end effector's velocity ẋ, m/s."""
    section: Section
    """Lift x → q."""
    transform: Diffeomorphism
    """ψ_q, from the postures of the avoiding motion to those of the undisturbed one."""

    def postures(self, x: Array) -> Array:
        """Compute the states (*B, T, n), rad, whose undisturbed postures have the end effector at `x` (*B, T, 3), m."""
        return self.transform.inverse(self.section.postures(x))

    def velocity(self, p: Array) -> Array:
        """Compute ṗ, (*B, n), rad/s, at states `p` (*B, n): the derivative of ψ_q⁻¹ along q̇, without an inversion."""
        q = self.transform.forward(p)
        velocity = self.section.velocities(q, self.hand.velocity(self.section.robot.end_effector(q)))
        return self.transform.inverse_tangents(q, velocity[..., None])[1][..., 0]

    def lyapunov(self, p: Array) -> Array:
        """Compute Φ(ψ(x(ψ_q(p)))), (*B,), which strictly falls along every motion until the goal."""
        return self.hand.lyapunov(self.section.robot.end_effector(self.transform.forward(p)))

    def rollout(self, p0: Array, times: Array) -> Array:
        """Compute p(t), (*B, T, n), exactly, from states `p0` (*B, n) at `times` (T,) or (*B, T), seconds."""
        x0 = self.section.robot.end_effector(self.transform.forward(p0))
        return self.postures(self.hand.rollout(x0, times))
