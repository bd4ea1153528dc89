"""Symmetric matrices of three rows for the lanes of a block, by their entries 00, 11, 22, 12, 02, 01."""

from __future__ import annotations

from dt_viz.kernels.arm import Array
from dt_viz.kernels.blocks import LANES
from dt_viz.kernels.compiled import compiled
from dt_viz.kernels.distances import Record


@compiled
def times(matrix: Array, lane: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Multiply the symmetric matrix of a lane by a vector."""
    a, b, c = matrix[0, lane], matrix[1, lane], matrix[2, lane]
    f, g, h = matrix[3, lane], matrix[4, lane], matrix[5, lane]
    return a * x + h * y + g * z, h * x + b * y + f * z, g * x + f * y + c * z


@compiled
def product(n: int, A: Array, B: Array, block: Record) -> None:
    """Find the symmetric matrix AᵀB of arrays (n, 3, LANES)."""
    matrix = block.matrix
    matrix[:] = 0
    for i in range(n):
        for lane in range(LANES):
            matrix[0, lane] += A[i, 0, lane] * B[i, 0, lane]
            matrix[1, lane] += A[i, 1, lane] * B[i, 1, lane]
            matrix[2, lane] += A[i, 2, lane] * B[i, 2, lane]
            matrix[3, lane] += A[i, 1, lane] * B[i, 2, lane]
            matrix[4, lane] += A[i, 0, lane] * B[i, 2, lane]
            matrix[5, lane] += A[i, 0, lane] * B[i, 1, lane]


@compiled
def invert(block: Record) -> None:
    """Find the inverse of `matrix` + `damping`·I by cofactors."""
    matrix, inverse, damping = block.matrix, block.inverse, block.damping
    for lane in range(LANES):
        a, b, c = matrix[0, lane] + damping[lane], matrix[1, lane] + damping[lane], matrix[2, lane] + damping[lane]
        f, g, h = matrix[3, lane], matrix[4, lane], matrix[5, lane]
        x, y, z = b * c - f * f, f * g - h * c, h * f - g * b
        scale = 1 / (a * x + h * y + g * z)
        inverse[0, lane], inverse[1, lane], inverse[2, lane] = (
            x * scale,
            (a * c - g * g) * scale,
            (a * b - h * h) * scale,
        )
        inverse[3, lane], inverse[4, lane], inverse[5, lane] = (g * h - a * f) * scale, z * scale, y * scale
