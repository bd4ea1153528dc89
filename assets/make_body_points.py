"""Cover the JACO's links with spheres: ``python -m assets.make_body_points`` rewrites ``body_points.npz``.

A sphere around a place at the depth d in a link sticks out of it by no more than its radius less d. So many places in a
link and on its surface are candidates, each with the sphere that sticks out by `PROTRUSION`, and the one that covers
most of what is left of the surface is taken, again and again. Each then shrinks to what it has to cover.

Bounding spheres of clusters make a tree of them: the outermost ones are the body points, found as in k-means, with a
handicap for balls that were large; their number grows until none is larger than wanted. Below, clusters are halved.
"""

import heapq
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from dt_viz.obstacles.triangles import grid_nodes, inside_of_grid, surface_samples
from dt_viz.robot.body_points import PROTRUSION
from dt_viz.robot.meshes import LinkMesh
from dt_viz.robot.robot import load_jaco

FILE = Path(__file__).parent / "body_points.npz"
SPACING = 1.5e-3  # metres, of points on the surface
INNER_SPACING = 4e-3  # metres, of the candidates
MAX_RADIUS = 0.058  # metres, of a body point: the upper links are 0.041 thick
MAX_HAND_RADIUS = 0.052  # of what is near the end effector, which tight spheres let pass closer
MAX_FINGER_RADIUS = 0.033
NUM_STARTS = 4  # of the clustering
ROUNDS = 40
EVENING = 0.5  # of a difference in radius, by which a ball gives up spheres in the next round
LEAVES = 4  # largest number of spheres that are not parted any more

Spheres = np.ndarray  # (N, 4): centre and radius, metres


def body_points() -> dict[str, np.ndarray]:
    """The arrays of ``dt_viz.robot.body_points.BodyPoints``, by joint."""
    spheres, ends, joints, num = [], [], [], 0
    for mesh in sorted(load_jaco().meshes, key=lambda mesh: mesh.joint):
        for cluster in _clusters(cover(mesh), max_radius(mesh)):
            nodes, sizes = _tree(cluster)
            spheres.append(nodes)
            ends.append(num + np.arange(len(nodes)) + sizes)
            joints += len(nodes) * [mesh.joint]
            num += len(nodes)
    nodes = np.concatenate(spheres)
    radius = np.ceil(1e5 * (nodes[:, 3] + 1e-5)) / 1e5  # what rounding the centres costs
    return {
        "joint": np.array(joints),
        "offset": nodes[:, :3].round(5),
        "radius": radius,
        "end": np.concatenate(ends),
    }


def max_radius(mesh: LinkMesh) -> float:
    """Of the body points of a link, metres, before rounding."""
    if "finger" in mesh.name:
        return MAX_FINGER_RADIUS
    return MAX_HAND_RADIUS if mesh.joint >= 3 else MAX_RADIUS


def cover(mesh: LinkMesh) -> Spheres:
    """Spheres that cover a link."""
    triangles = mesh.vertices[mesh.faces]
    surface = np.concatenate([mesh.vertices, surface_samples(triangles, SPACING)[0]])
    lower, upper = surface.min(axis=0), surface.max(axis=0)
    shape = tuple(int(n) for n in np.ceil((upper - lower) / INNER_SPACING) + 1)
    inside = inside_of_grid(triangles, lower, INNER_SPACING, shape)
    centres = np.concatenate([grid_nodes(lower, INNER_SPACING, shape)[inside.ravel()], surface[::4]])
    tree = KDTree(surface)
    radii = tree.query(centres)[0] + PROTRUSION - SPACING / 4
    left = np.ones(len(surface), dtype=bool)
    reach = radii - SPACING / 2  # so that what lies between points is covered, too
    most = [(-num, k) for k, num in enumerate(tree.query_ball_point(centres, reach, return_length=True))]
    heapq.heapify(most)
    taken: list[int] = []
    while left.any():
        num, k = heapq.heappop(most)
        covered = tree.query_ball_point(centres[k], reach[k])
        gain = int(left[covered].sum())
        if gain == -num:
            left[covered] = False
            taken.append(k)
        elif gain:
            heapq.heappush(most, (-gain, k))
    return _shrunk(centres[taken], radii[taken], surface)


def _shrunk(centres: np.ndarray, radii: np.ndarray, surface: np.ndarray) -> Spheres:
    """Spheres that cover what of the surface is deepest in them."""
    needed = np.zeros(len(radii))
    for points in np.array_split(surface, 1 + len(surface) // 1000):
        away = np.linalg.norm(points[:, None] - centres, axis=2)
        own = (away - radii).argmin(axis=1)
        np.maximum.at(needed, own, away[np.arange(len(points)), own])
    kept = needed > 0
    return np.column_stack([centres, np.minimum(radii, needed + SPACING / 2)])[kept]


def _clusters(spheres: Spheres, largest: float) -> list[Spheres]:
    """Parts with bounding spheres that are not larger than wanted."""
    rng = np.random.default_rng(0)
    for k in range(1, 64):
        found = [clusters for _ in range(NUM_STARTS) for clusters in _clusterings(spheres, k, rng)]
        radius, best = min(found, key=lambda found: found[0])
        if radius <= largest:
            return best
    raise ValueError(f"{len(spheres)} spheres need more than 63 of {largest} m around them")


def _clusterings(spheres: Spheres, k: int, rng: np.random.Generator) -> list[tuple[float, list[Spheres]]]:
    """Partitions into at most k clusters, round by round, each after its largest radius."""
    centres, handicap, found = rng.choice(spheres[:, :3], k, replace=False), np.zeros(k), []
    for _ in range(ROUNDS):
        away = np.linalg.norm(spheres[:, None, :3] - centres, axis=2) + spheres[:, 3:]
        nearest = (away + handicap).argmin(axis=1)
        kept = np.unique(nearest)
        clusters = [spheres[nearest == cluster] for cluster in kept]
        around = np.array([_around(cluster) for cluster in clusters])
        found.append((around[:, 3].max(), clusters))
        centres, handicap = around[:, :3], handicap[kept] + EVENING * (around[:, 3] - around[:, 3].mean())
    return found


def _around(spheres: Spheres) -> np.ndarray:
    """The smallest sphere (4,) around others, about: its centre steps towards the farthest (Bădoiu and Clarkson)."""
    centre = spheres[:, :3].mean(axis=0)
    for step in range(2, 100):
        farthest = (np.linalg.norm(spheres[:, :3] - centre, axis=1) + spheres[:, 3]).argmax()
        way = spheres[farthest, :3] - centre
        length = np.linalg.norm(way)
        if length:
            centre = centre + way * (1 + spheres[farthest, 3] / length) / step
    return np.append(centre, (np.linalg.norm(spheres[:, :3] - centre, axis=1) + spheres[:, 3]).max())


def _tree(spheres: Spheres) -> tuple[Spheres, np.ndarray]:
    """The spheres and those around halves of them, depth first, and the number (M,) of those in each and itself."""
    if len(spheres) == 1:
        return spheres, np.ones(1, dtype=int)
    if len(spheres) <= LEAVES:
        parts = list(spheres[:, None])
    else:
        along = np.ptp(spheres[:, :3], axis=0).argmax()
        order = spheres[:, along].argsort()
        parts = [spheres[half] for half in np.array_split(order, 2)]
    trees = [_tree(part) for part in parts]
    nodes = np.concatenate([_around(spheres)[None], *(nodes for nodes, _ in trees)])
    return nodes, np.concatenate([[len(nodes)], *(sizes for _, sizes in trees)])


if __name__ == "__main__":
    np.savez_compressed(FILE, allow_pickle=False, **body_points())
