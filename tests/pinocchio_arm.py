"""The arm as pinocchio has it, an oracle of ours, and random configurations of it."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from functools import lru_cache

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle

from dt_viz.robot.models import load_jaco
from dt_viz.robot.robot import Robot


def random_configurations(robot: Robot, seed: int, shape: tuple[int, ...]) -> np.ndarray:
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, 2 * np.pi)
    return np.random.default_rng(seed).uniform(lower, upper, (*shape, robot.num_joints))


@lru_cache(maxsize=1)
def pinocchio_model() -> tuple:
    """The model, its collision shapes and what is computed of both; of the pairs of links those that may touch."""
    robot = load_jaco()
    path, folders = str(robot.urdf), list(map(str, robot.package_dirs))
    model = pin.buildModelFromUrdf(path)
    shapes = pin.buildGeomFromUrdf(model, path, pin.GeometryType.COLLISION, package_dirs=folders)
    for a, first in enumerate(shapes.geometryObjects):
        for b, second in enumerate(shapes.geometryObjects):
            if second.parentJoint - first.parentJoint > 1:
                shapes.addCollisionPair(pin.CollisionPair(a, b))
    return model, model.createData(), shapes, shapes.createData()


def pinocchio_configuration(q: np.ndarray) -> np.ndarray:
    joints = pinocchio_model()[0].joints
    parts = [[np.cos(angle), np.sin(angle)] if joints[i + 1].nq == 2 else [angle] for i, angle in enumerate(q)]
    return np.concatenate(parts)


def placed_vertices(q: np.ndarray) -> list[np.ndarray]:
    """Of each link, base frame, as pinocchio places them."""
    model, data, shapes, shape_data = pinocchio_model()
    pin.updateGeometryPlacements(model, data, shapes, shape_data, pinocchio_configuration(q))
    pairs = zip(shapes.geometryObjects, shape_data.oMg, strict=True)
    return [shape.geometry.vertices() @ place.rotation.T + place.translation for shape, place in pairs]
