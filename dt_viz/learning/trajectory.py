"""The trajectory objective: fit the rollouts themselves, by Gauss–Newton with Levenberg–Marquardt damping.

Rollout i is ψ⁻¹ of the straight ray from z_i to z_e. The images z_i = ψ(x_i0) and z_e = ψ(goal) are unknowns beside the
coefficients of the fields, and "ψ⁻¹ of the ray's ends are the start and the goal" are heavily weighted residuals. So no
equation is solved for ψ inside the fit, and the exact ψ of the result moves the ends only by what is left of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from dt_viz.flows.fields import Array
from dt_viz.learning.flow_chain import FlowChain
from dt_viz.numerics import unit


@dataclass(frozen=True)
class TrajectoryFit:
    """The least-squares problem: mean squared distance of rollouts to demonstrations + regularisation·‖θ‖²."""

    chain: FlowChain
    targets: Array  # (R, n, d) points of the demonstrations, the last one the common goal
    importance: Array  # (R,) weights of their squared distances, relative to their mean
    regularisation: float
    min_determinant: float
    """Smallest determinant of a step's derivative; coefficients with a smaller one are refused."""
    end_weight: float = 20.0  # weight of a residual at a ray's end against one between
    along_weight: float = 0.3
    """Weight of a residual's component along the motion, where an error is one of timing only."""

    def weights(self) -> Array:
        """Return the matrices (R, n, d, d) that weight the residual vectors."""
        d = self.chain.dim
        tangents = unit(np.gradient(self.targets, axis=1))
        weights = np.eye(d) - (1 - self.along_weight) * tangents[..., :, None] * tangents[..., None, :]
        weights[:, [0, -1]] = self.end_weight * np.eye(d)
        return np.sqrt(self.importance / self.importance.mean())[:, None, None, None] * weights

    @property
    def fractions(self) -> Array:
        """(n,) place of each point on its ray, from 0 (start) to 1 (goal)."""
        return np.linspace(0.0, 1.0, self.targets.shape[1])

    def solve(
        self,
        thetas: Sequence[Array],
        ends: Array,
        *,
        max_iterations: int,
        refuses: bool,
        tolerance: float = 1e-3,
        report: Callable[[int, float], None] | None = None,
    ) -> tuple[list[Array], Array]:
        """Minimise from coefficients `thetas` and images `ends` (R + 1, d) of the starts and, last, the goal.

        Args:
            thetas: initial coefficients, one array (m_l, d) for each layer, that fold nothing.
            ends: initial images.
            max_iterations: largest number of Gauss–Newton iterations.
            refuses: whether a step that folds is refused, which is looked at after each; without, the result may fold.
            tolerance: relative decrease of the cost below which the iteration stops.
            report: called with the iteration and the root mean square distance; what it raises ends the fit.
        """
        damping = 1e-3
        weights = self.weights().reshape(-1, self.chain.dim, self.chain.dim)
        vector = np.concatenate([self.chain.join(thetas), ends.reshape(-1)])
        cost = self._cost(vector, weights)
        for iteration in range(max_iterations):
            residual, jacobian = self._linearise(vector, weights)
            if report:
                report(iteration, float(np.sqrt((residual**2).sum() / len(weights))))
            gradient = jacobian.T @ residual / len(weights) - self._prior(len(vector)) * vector
            system = _DampedSystem(jacobian / np.sqrt(len(weights)), sum(self.chain.sizes))
            before, accepted = cost, False
            for _ in range(12):
                extra = damping * self.regularisation
                # without any damping the images of the rays' ends could drift
                step = system.solve(gradient, self.regularisation + extra, 1e-7 + extra)
                if step is None:
                    damping *= 8
                    continue
                trial = self._cost(vector + step, weights)
                if trial < cost and not (refuses and self.folds(self.chain.split(vector + step))):
                    vector, cost, accepted = vector + step, trial, True
                    damping = max(damping / 5, 1e-3)
                    break
                damping *= 8
            if not accepted or before - cost < tolerance * before:
                break
        return self.chain.split(vector), vector[sum(self.chain.sizes) :].reshape(ends.shape)

    def folds(self, thetas: Sequence[Array]) -> bool:
        """Whether some step of the chain with these coefficients folds space, or nearly does."""
        return self.chain.min_step_determinant(thetas) <= self.min_determinant

    def _prior(self, size: int) -> Array:
        prior = np.full(size, self.regularisation)
        prior[sum(self.chain.sizes) :] = 0.0
        return prior

    def _rays(self, vector: Array) -> Array:
        num, d = len(self.targets), self.chain.dim
        ends = vector[-(num + 1) * d :].reshape(num + 1, d)
        goal, starts = ends[-1], ends[:-1]
        return (goal + (1 - self.fractions[:, None]) * (starts - goal)[:, None]).reshape(-1, d)

    def _cost(self, vector: Array, weights: Array) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            offset = self.targets.reshape(-1, self.chain.dim) - self.chain.images(
                self._rays(vector), self.chain.split(vector)
            )
            residual = np.matmul(weights, offset[..., None])
            cost = float((residual**2).sum() / len(weights) + (self._prior(len(vector)) * vector**2).sum())
        return cost if np.isfinite(cost) else np.inf

    def _linearise(self, vector: Array, weights: Array) -> tuple[Array, Array]:
        """Return the weighted residuals (N·d,) and the Jacobian of the weighted rollouts (N·d, P + (R + 1)·d)."""
        num, n, d = self.targets.shape
        x, by_z, by_theta = self.chain.images_with_sensitivity(self._rays(vector), self.chain.split(vector))
        residual = np.matmul(weights, (self.targets.reshape(-1, d) - x)[..., None])[..., 0]
        size = by_theta.shape[-1]
        jacobian = np.zeros((num, n, d, len(vector)))
        np.matmul(weights, by_theta, out=jacobian.reshape(-1, d, len(vector))[..., :size])
        by_ends = np.matmul(weights, by_z).reshape(num, n, d, d)
        remaining = (1 - self.fractions)[:, None, None]
        for i in range(num):
            jacobian[i, :, :, size + i * d : size + (i + 1) * d] = remaining * by_ends[i]
        jacobian[..., -d:] = (1 - remaining) * by_ends
        return residual.reshape(-1), jacobian.reshape(num * n * d, -1)


class _DampedSystem:
    """(JᵀJ + D)·step = gradient with a diagonal D of two values, solved in the smaller of the two spaces.

    With more unknowns than residuals by Woodbury's identity: step = D⁻¹(g − Jᵀ(I + J·D⁻¹·Jᵀ)⁻¹·J·D⁻¹·g).
    """

    def __init__(self, jacobian: Array, num_first: int) -> None:
        self._jacobian = jacobian
        self._num_first = num_first
        self._dual = jacobian.shape[1] > 1.2 * jacobian.shape[0]
        if self._dual:
            first, second = jacobian[:, :num_first], jacobian[:, num_first:]
            self._grams = first @ first.T, second @ second.T
        else:
            self._normal = jacobian.T @ jacobian

    def solve(self, gradient: Array, first: float, second: float) -> Array | None:
        """Solve for D = (first, …, first, second, …); None where rounding makes the matrix indefinite."""
        diagonal = np.full(len(gradient), second)
        diagonal[: self._num_first] = first
        try:
            if not self._dual:
                matrix = self._normal.copy()
                matrix[np.diag_indices_from(matrix)] += diagonal
                return cho_solve(cho_factor(matrix, overwrite_a=True, check_finite=False), gradient)
            matrix = self._grams[0] / first + self._grams[1] / second
            matrix[np.diag_indices_from(matrix)] += 1.0
            scaled = gradient / diagonal
            inner = cho_solve(cho_factor(matrix, overwrite_a=True, check_finite=False), self._jacobian @ scaled)
            return scaled - (self._jacobian.T @ inner) / diagonal
        except LinAlgError:
            return None
