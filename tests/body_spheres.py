"""The spheres of body points without their tree."""

import numpy as np

from dt_viz.robot.body_points import BodyPoints


def cover(body: BodyPoints) -> BodyPoints:
    """Those that hold no others: they cover the links."""
    spheres = body.spheres[body.spheres["end"] == np.arange(len(body.spheres)) + 1]
    spheres["end"] = np.arange(len(spheres)) + 1
    return BodyPoints(spheres)
