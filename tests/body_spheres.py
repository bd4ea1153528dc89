"""The spheres of body points without their tree."""

import numpy as np

from dt_viz.robot.body_points import BodyPoints


def _alone(spheres: np.ndarray) -> BodyPoints:
    spheres = spheres.copy()
    spheres["end"] = np.arange(len(spheres)) + 1
    return BodyPoints(spheres)


def cover(body: BodyPoints) -> BodyPoints:
    """Those that hold no others: they cover the links."""
    return _alone(body.spheres[body.spheres["end"] == np.arange(len(body.spheres)) + 1])


def flat(body: BodyPoints) -> BodyPoints:
    """The outermost ones."""
    return _alone(body.spheres[body.outermost])
