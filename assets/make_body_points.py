"""Cover the JACO's links with spheres: ``python -m assets.make_body_points`` rewrites ``body_points.npz``.

It is the cover that any arm gets (`dt_viz.robot.cover`), of finer points.
"""

from pathlib import Path

import numpy as np

from dt_viz.kernels.arm import BODY_POINT
from dt_viz.robot.body_points import PROTRUSION
from dt_viz.robot.cover import CoverSettings, covering_tree
from dt_viz.robot.models import load_jaco
from dt_viz.robot.urdf import LinkMesh

FILE = Path(__file__).parent / "body_points.npz"
SETTINGS = CoverSettings(
    protrusion=PROTRUSION,
    spacing=1.5e-3,
    fine_spacing=1.5e-3,
    inner_spacing=4e-3,
    closing=0.0,
    num_starts=4,
    rounds=40,
)
MAX_RADIUS = 0.058  # metres, of a body point: the upper links are 0.041 thick
MAX_HAND_RADIUS = 0.052  # of what is near the end effector, which tight spheres let pass closer
MAX_FINGER_RADIUS = 0.033


def body_points() -> dict[str, np.ndarray]:
    """The arrays of ``dt_viz.robot.body_points.BodyPoints``, by joint."""
    spheres = covering_tree(load_jaco().meshes, max_radius, SETTINGS)
    return {name: spheres[name] for name in BODY_POINT.names or ()}


def max_radius(mesh: LinkMesh) -> float:
    """Of the body points of a link, metres, before rounding."""
    if "finger" in mesh.name:
        return MAX_FINGER_RADIUS
    return MAX_HAND_RADIUS if mesh.joint >= 3 else MAX_RADIUS


if __name__ == "__main__":
    np.savez_compressed(FILE, allow_pickle=False, **body_points())
