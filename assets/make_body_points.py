"""Cover the JACO's links with spheres: ``python -m assets.make_body_points`` rewrites ``body_points.npz``.

The triangles of each link's collision mesh are parted into clusters, and each cluster gets the smallest ball around its
corners. A ball is convex, so it holds its triangles whole. As in k-means, each triangle then joins the ball whose
centre is the least far from its farthest corner, with a handicap for balls that were large, and the balls are drawn
again. The number of clusters grows until no ball of the link is larger than wanted.
"""

from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from dt_viz.robot.robot import LinkMesh, collision_meshes

FILE = Path(__file__).parent / "body_points.npz"
MAX_RADIUS = 0.055  # metres: the upper links are 0.041 thick
MAX_HAND_RADIUS = 0.047  # of what is near the end effector, which tight spheres let pass closer
MAX_FINGER_RADIUS = 0.030
NUM_STARTS = 4  # of the clustering
ROUNDS = 40
EVENING = 0.5  # of a difference in radius, by which a ball gives up triangles in the next round

Ball = tuple[np.ndarray, float]  # centre (3,) and radius, metres


def body_points() -> dict[str, np.ndarray]:
    """The arrays of ``dt_viz.robot.body_points.BodyPoints``, sorted by joint."""
    spheres = []
    for mesh in collision_meshes():
        spheres += [(mesh.joint, centre, radius) for centre, radius in _cover(mesh, max_radius(mesh))]
    spheres.sort(key=lambda sphere: sphere[0])
    joint, offset, radius = zip(*spheres, strict=True)
    return {
        "joint": np.array(joint),
        "offset": np.array(offset).round(5),
        "radius": np.ceil(1e4 * (np.array(radius) + 2e-5)) / 1e4,  # what rounding the centres costs
    }


def max_radius(mesh: LinkMesh) -> float:
    """Of the balls of a link, metres, before rounding."""
    if "finger" in mesh.name:
        return MAX_FINGER_RADIUS
    return MAX_HAND_RADIUS if mesh.joint >= 3 else MAX_RADIUS


def _cover(mesh: LinkMesh, largest: float) -> list[Ball]:
    rng = np.random.default_rng(0)
    at_least = int(np.ceil(np.ptp(mesh.vertices, axis=0).max() / (2 * largest)))
    for k in range(at_least, 64):
        covers = [balls for _ in range(NUM_STARTS) for balls in _clusterings(mesh, k, rng)]
        best = min(covers, key=_largest_radius)
        if _largest_radius(best) <= largest:
            return best
    raise ValueError(f"{mesh.name} needs more than 63 spheres of {largest} m")


def _clusterings(mesh: LinkMesh, k: int, rng: np.random.Generator) -> list[list[Ball]]:
    """Covers by at most k balls, round by round: the largest ball need not shrink in each."""
    centres, handicap, covers = _spread(mesh, k, rng), np.zeros(k), []
    for _ in range(ROUNDS):
        distance = cdist(mesh.vertices, centres)
        nearest = (distance[mesh.faces].max(axis=1) + handicap).argmin(axis=1)
        clusters = np.zeros((len(centres), len(mesh.vertices)), dtype=bool)
        clusters[nearest[:, None], mesh.faces] = True
        kept = clusters.any(axis=1)
        covers.append([_smallest_ball(mesh.vertices[cluster]) for cluster in clusters[kept]])
        centres = np.stack([centre for centre, _ in covers[-1]])
        radii = np.array([radius for _, radius in covers[-1]])
        handicap = handicap[kept] + EVENING * (radii - radii.mean())
    return covers


def _spread(mesh: LinkMesh, k: int, rng: np.random.Generator) -> np.ndarray:
    """Points (k, 3) of the surface, drawn as by k-means++: likelier the farther from those drawn before."""
    corners = mesh.vertices[mesh.faces]  # (F, 3, 3)
    middles = corners.mean(axis=1)
    weights = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    drawn = [rng.choice(middles, p=weights / weights.sum())]
    while len(drawn) < k:
        likely = weights * cdist(middles, drawn, "sqeuclidean").min(axis=1)
        drawn.append(rng.choice(middles, p=likely / likely.sum()))
    return np.stack(drawn)


def _largest_radius(balls: list[Ball]) -> float:
    return max(radius for _, radius in balls)


def _smallest_ball(points: np.ndarray) -> Ball:
    """The smallest ball around points (N, 3), from that of a few of them, which grows until it holds all."""
    support, centre, radius = points[:1], points[0], 0.0
    while True:
        distance = np.linalg.norm(points - centre, axis=1)
        farthest = int(distance.argmax())
        if distance[farthest] <= radius + 1e-9:
            return centre, float(distance[farthest])
        support, centre, radius = _smallest_ball_through(points[farthest], support)


def _smallest_ball_through(point: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The smallest ball around a point outside the ball of its support (S, 3), which therefore lies on its surface.

    Returns:
        The new support, the centre and the radius.
    """
    balls = []
    for size in range(1, min(len(support), 3) + 1):
        for others in combinations(support, size):
            # |centre − point| = |centre − other| for each other; of all such centres the nearest to the point.
            sides = np.stack(others) - point
            to_centre = np.linalg.lstsq(sides, (sides**2).sum(axis=1) / 2, rcond=None)[0]
            radius = float(np.linalg.norm(to_centre))
            if (np.linalg.norm(support - point - to_centre, axis=1) <= radius + 1e-12).all():
                balls.append((np.stack([point, *others]), point + to_centre, radius))
    return min(balls, key=lambda ball: ball[2])


if __name__ == "__main__":
    np.savez(FILE, allow_pickle=False, **body_points())
