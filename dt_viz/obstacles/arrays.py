"""Obstacles as the records that compiled loops take."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from dt_viz.kernels.distances import BOX, CYLINDER, GRID, SHAPE, SPHERE, Shapes, Values
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, MeshObstacle, Obstacle, Sphere, rotation
from dt_viz.obstacles.solids import DistanceGrid

KINDS = {Sphere: SPHERE, Box: BOX, Cylinder: CYLINDER, MeshObstacle: GRID, CloudObstacle: GRID}


@lru_cache(maxsize=64)
def records(parts: tuple[Obstacle, ...]) -> tuple[Shapes, Values]:
    """Convert obstacles. Those of a new kind need a formula in `dt_viz.kernels.distances` first."""
    shapes = np.zeros(len(parts), SHAPE)
    grids = {part.solid.distances: 0 for part in parts if isinstance(part, (MeshObstacle, CloudObstacle))}
    values = _joined(tuple(grids))
    for grid, begin in zip(grids, np.cumsum([0, *(grid.values.size for grid in grids)]).tolist(), strict=False):
        grids[grid] = begin
    for shape, part in zip(shapes, parts, strict=True):
        shape["kind"] = KINDS[type(part)]
        shape["position"], shape["axes"] = part.position, rotation(part.wxyz)
        if isinstance(part, Sphere):
            shape["half"] = part.radius
        elif isinstance(part, Box):
            shape["half"] = np.divide(part.sizes, 2)
        elif isinstance(part, Cylinder):
            shape["half"] = part.diameter / 2, part.diameter / 2, part.height / 2
        elif isinstance(part, (MeshObstacle, CloudObstacle)):
            grid = part.solid.distances
            shape["scale"], shape["begin"] = part.scale, grids[grid]
            shape["first"], shape["cell"], shape["counts"] = grid.origin, grid.cell, grid.values.shape
            shape["margin"], shape["centre"], shape["radius"] = grid.margin, grid.centre, grid.radius
    return shapes, values


@lru_cache(maxsize=8)
def _joined(grids: tuple[DistanceGrid, ...]) -> Values:
    """Join the values of several grids, flat and in single precision, which fits the processor's cache."""
    return np.concatenate([np.empty(0, np.float32), *(grid.values.astype(np.float32).ravel() for grid in grids)])
