"""The velocity objective, eq. (3): least squares between the system's velocities and the demonstrations'.

ψ is one stationary flow, integrated by Euler's method as in the paper. The gradient is exact: an adjoint pass through
the flow of the states and of one tangent each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.flows.systems import Attractor
from dt_viz.learning.flow_chain import min_step_determinant


@dataclass(frozen=True)
class VelocityFit:
    """Mean of ‖ẋ_n − J(x_n)⁻¹·f(ψ(x_n))‖² + regularisation·tr WᵀKW, f the base attractor, as a function of W."""

    grid: GaussianGrid
    positions: Array  # x_n, (N, d)
    velocities: Array  # ẋ_n, (N, d)
    goal: Array  # (d,); the base attractor's goal is its image
    speed: float
    smoothing: float
    regularisation: float
    steps: int
    min_determinant: float
    """Smallest determinant of a step's derivative; W with a smaller one are refused."""

    def solve(self, max_iterations: int, report: Callable[[int, float], None] | None = None) -> Array:
        """Minimise by L-BFGS from W = 0, as long as no step folds space; returns W, (m, d).

        `report` is called with the iteration and the cost; an exception that it raises ends the fit.
        """
        shape = (self.grid.num_points, self.grid.dim)
        kept, iteration = np.zeros(shape), 0

        def function(vector: Array) -> tuple[float, Array]:
            cost, gradient = self.cost_and_gradient(vector.reshape(shape))
            return cost, gradient.reshape(-1)

        def callback(intermediate_result: OptimizeResult) -> None:
            nonlocal iteration, kept
            weights = intermediate_result.x.reshape(shape).copy()
            if min_step_determinant(GridRBF(self.grid, weights), 1.0 / self.steps) < self.min_determinant:
                raise StopIteration
            kept, iteration = weights, iteration + 1
            if report:
                report(iteration, float(intermediate_result.fun))

        options = {"maxiter": max_iterations, "maxcor": 20}
        minimize(function, kept.reshape(-1), jac=True, method="L-BFGS-B", callback=callback, options=options)
        return kept

    def cost_and_gradient(self, weights: Array) -> tuple[float, Array]:
        """Compute the objective and its derivative by the weights W (m, d)."""
        num, d = self.positions.shape
        h = 1.0 / self.steps
        points = np.concatenate([self.positions, self.goal[None]])
        field = GridRBF(self.grid, weights)

        path, derivatives = [points], []
        jacobian = np.broadcast_to(np.eye(d), (num + 1, d, d))
        for _ in range(self.steps):
            v, DV = field.with_jacobian(path[-1])
            derivatives.append(DV)
            path.append(path[-1] + h * v)
            jacobian = jacobian + h * (DV @ jacobian)
        z = path[-1][:-1]
        base = Attractor(path[-1][-1], self.speed, self.smoothing)
        inverse = np.linalg.inv(jacobian[:-1])
        velocity = (inverse @ base.velocity(z)[..., None])[..., 0]
        error = velocity - self.velocities

        # dv = J⁻¹(df − dJ·v): q = J⁻ᵀ·∂cost/∂v is the adjoint of f, and −q that of J·v with v held.
        q = (np.swapaxes(inverse, 1, 2) @ (2 / num * error)[..., None])[..., 0]
        by_image = (np.swapaxes(base_derivative(base, z), 1, 2) @ q[..., None])[..., 0]
        by_point = np.concatenate([by_image, -by_image.sum(axis=0, keepdims=True)])
        by_tangent = np.concatenate([-q, np.zeros((1, d))])
        tangents = [np.concatenate([velocity, np.zeros((1, d))])]
        for DV in derivatives:
            tangents.append(tangents[-1] + h * (DV @ tangents[-1][..., None])[..., 0])

        smooth = self._gram_times(weights)
        gradient = 2 * self.regularisation * smooth
        for s, w, DV in zip(reversed(path[:-1]), reversed(tangents[:-1]), reversed(derivatives), strict=True):
            gradient += h * self._pull_back(s, by_point, w, by_tangent)
            bend = self._second_derivative(weights, s, by_tangent, w)
            transposed = np.swapaxes(DV, 1, 2)
            by_point = by_point + h * ((transposed @ by_point[..., None])[..., 0] + bend)
            by_tangent = by_tangent + h * (transposed @ by_tangent[..., None])[..., 0]
        cost = float((error**2).sum() / num + self.regularisation * (weights * smooth).sum())
        return cost, gradient

    def _gram_times(self, weights: Array) -> Array:
        """Compute K·W axis by axis: the kernel matrix of a grid is a Kronecker product."""
        table = weights.reshape(*self.grid.shape, -1)
        for j, axis in enumerate(self.grid.axes):
            gram = np.exp(-self.grid.ell * (axis[:, None] - axis) ** 2)
            table = np.moveaxis(np.tensordot(gram, table, axes=(1, j)), 0, j)
        return table.reshape(weights.shape)

    def _pull_back(self, s: Array, by_value: Array, w: Array, by_slope: Array) -> Array:
        """Compute the derivative (m, d) by W of Σ_n by_value·V(s) + by_slope·DV(s)·w."""
        d = self.grid.dim
        factors = self.grid.factors(s, 1)
        total = np.zeros((self.grid.num_points, d))
        cotangents = [by_value, *(w[:, [j]] * by_slope for j in range(d))]
        for order, cotangent in zip(np.eye(d + 1, d, -1, dtype=int), cotangents, strict=True):
            table = cotangent
            for axis in reversed(range(1, d)):
                table = (factors[axis][order[axis]][:, :, None] * table[:, None, :]).reshape(len(s), -1)
            total += (factors[0][order[0]].T @ table).reshape(total.shape)
        return total

    def _second_derivative(self, weights: Array, s: Array, left: Array, right: Array) -> Array:
        """Compute Σ_ab left_a·∂²V_a/∂s_b∂s_j·right_b, (N, d)."""
        d = self.grid.dim
        factors, first, bend = self.grid.factors(s, 2), np.eye(d, dtype=int), np.zeros((len(s), d))
        tables = factors[0] @ weights.reshape(self.grid.shape[0], -1)
        for j in range(d):
            for b in range(j, d):
                order = first[j] + first[b]
                table = tables[order[0]]
                for axis, n in enumerate(self.grid.shape[1:], start=1):
                    table = np.einsum("na,nar->nr", factors[axis][order[axis]], table.reshape(len(s), n, -1))
                along = (left * table).sum(axis=1)  # Σ_a left_a·∂²V_a/∂s_b∂s_j
                bend[:, j] += along * right[:, b]
                if b > j:
                    bend[:, b] += along * right[:, j]
        return bend


def base_derivative(base: Attractor, z: Array) -> Array:
    """Compute ∂ż/∂z (N, d, d) of the plain attractor: −v·(sech²(r/ρ)/ρ·r̂r̂ᵀ + tanh(r/ρ)/r·(I − r̂r̂ᵀ))."""
    offset = z - base.goal
    r = np.maximum(np.linalg.norm(offset, axis=-1)[:, None, None], 1e-9 * base.smoothing)
    along = (offset[:, :, None] / r) * (offset[:, None, :] / r)
    tanh = np.tanh(r / base.smoothing)
    return -base.speed * ((1 - tanh**2) / base.smoothing * along + tanh / r * (np.eye(base.dim) - along))
