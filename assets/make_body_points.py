"""Cover the JACO's links with spheres: ``python -m assets.make_body_points`` rewrites ``body_points.npz``.

The triangles of each link's collision mesh are parted into clusters (k-means of their centres, weighted by area), and
each cluster gets the smallest ball around its corners. A ball is convex, so it holds its triangles whole. The number
of clusters grows until no ball of the link is larger than wanted.
"""

from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from dt_viz.robot import LinkMesh, collision_meshes

FILE = Path(__file__).parent / "body_points.npz"
MAX_RADIUS = 0.055  # metres: the upper links are 0.041 thick
MAX_HAND_RADIUS = 0.047  # of what is near the end effector, which tight spheres let pass closer
MAX_FINGER_RADIUS = 0.030
NUM_STARTS = 5  # of k-means
NUM_SAMPLES = 3000  # triangles that k-means sees
ROUNDS = 8


def body_points() -> dict[str, np.ndarray]:
    """The arrays of ``dt_viz.body.BodyPoints``, sorted by joint."""
    spheres = []
    for mesh in collision_meshes():
        wanted = MAX_FINGER_RADIUS if "finger" in mesh.name else MAX_HAND_RADIUS if mesh.joint >= 3 else MAX_RADIUS
        spheres += [(mesh.joint, centre, radius) for centre, radius in _cover(mesh, wanted)]
    spheres.sort(key=lambda sphere: sphere[0])
    joint, offset, radius = zip(*spheres, strict=True)
    return {
        "joint": np.array(joint),
        "offset": np.array(offset).round(5),
        "radius": np.ceil(1e4 * (np.array(radius) + 2e-5)) / 1e4,  # what rounding the centres costs
    }


def _cover(mesh: LinkMesh, max_radius: float) -> list[tuple[np.ndarray, float]]:
    corners = mesh.vertices[mesh.faces]  # (F, 3, 3)
    centres = corners.mean(axis=1)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    rng = np.random.default_rng(0)
    for k in range(1, 64):
        covers = [_cluster(corners, centres, areas + 1e-12, k, rng) for _ in range(NUM_STARTS)]
        best = min(covers, key=lambda balls: max(radius for _, radius in balls))
        if max(radius for _, radius in best) <= max_radius:
            return best
    raise ValueError(f"{mesh.name} needs more than 64 spheres of {max_radius} m")


def _cluster(
    corners: np.ndarray, centres: np.ndarray, areas: np.ndarray, k: int, rng: np.random.Generator
) -> list[tuple[np.ndarray, float]]:
    sample = rng.choice(len(centres), size=NUM_SAMPLES, p=areas / areas.sum())
    means, _ = kmeans2(centres[sample], k, minit="++", rng=rng)
    balls = []
    for _ in range(ROUNDS):  # towards the middles of the balls, which evens their radii out
        nearest = np.argmin(((centres[:, None] - means) ** 2).sum(axis=2), axis=1)
        balls = [_smallest_ball(corners[nearest == i].reshape(-1, 3)) for i in np.unique(nearest)]
        means = np.stack([centre for centre, _ in balls])
    return balls


def _smallest_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of nearly the smallest ball around points (N, 3) (Bădoiu and Clarkson)."""
    centre = points.mean(axis=0)
    for i in range(1, 150):
        farthest = points[np.argmax(((points - centre) ** 2).sum(axis=1))]
        centre = centre + (farthest - centre) / (i + 1)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


if __name__ == "__main__":
    np.savez(FILE, allow_pickle=False, **body_points())
