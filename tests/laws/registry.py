"""Named examples of everything that obeys a law: the laws are tested on all of them, and a class without one fails."""

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import dt_viz
from dt_viz.avoidance.arm_field import ArmField, GradientField, JointLimits, WholeArmField
from dt_viz.avoidance.bias import BiasPoint, Shift, unit_field
from dt_viz.avoidance.hand import Avoidance
from dt_viz.avoidance.sideways import Sideways
from dt_viz.avoidance.transform import Transform
from dt_viz.baselines.eflow import Coupling, Normalisation
from dt_viz.flows.augmented_systems import OnPlaces, PhaseCurve, PhasedAttractor, Shear, Translation
from dt_viz.flows.diffeomorphisms import Chain, Conjugated, Diffeomorphism, Flow, Identity, Placed
from dt_viz.flows.fields import GaussianGrid, GridRBF, PlacedField, Projected, Sum, VectorField
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER
from dt_viz.flows.systems import Attractor
from dt_viz.learning.timing import TimedAttractor
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.occupancy import AvoidanceField, unit_map
from dt_viz.obstacles.shapes import (
    ORIGIN,
    Box,
    Capsule,
    CloudObstacle,
    Cylinder,
    MeshObstacle,
    Obstacle,
    Quaternion,
    Sphere,
    as_point,
)
from dt_viz.obstacles.solids import Solid
from dt_viz.robot.models import HOME, load_jaco
from dt_viz.scenario.tasks import DRAWING_AXES

Points = Callable[[int], np.ndarray]  # gives so many points (num, d), always the same


def product_classes() -> Iterator[type]:
    """Every class that DT-Viz defines, but in modules that need what is not installed."""
    for module in pkgutil.walk_packages(dt_viz.__path__, "dt_viz."):
        if module.name.endswith("__main__"):
            continue
        try:
            found = importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            assert error.name in {"torch", "ompl", "matplotlib"}
            continue
        yield from (kind for _, kind in inspect.getmembers(found, inspect.isclass) if kind.__module__ == module.name)


def uniform(dim: int, reach: float = 0.8) -> Points:
    return lambda num: np.random.default_rng(0).uniform(-reach, reach, (num, dim))


def tilted_axes(dim: int = 3) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(dim, dim)))
    return q * np.sign(np.linalg.det(q)) if dim % 2 else q @ np.diag([1.0, np.linalg.det(q)])


def bent(dim: int, seed: int = 0, strength: float = 0.3) -> GridRBF:
    """A smooth field on the box from −1 to 1."""
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(dim)), 0.5 / 0.6**2)
    return GridRBF(grid, strength * np.random.default_rng(seed).normal(size=(grid.num_points, dim)))


# --- predictions for phased systems ---

TOP = 0.2


class Waves:
    """Predictions without a meaning: curves and clocks that change smoothly with the condition."""

    def __init__(self, dim, num_conditions=0, seed=0):
        self.dim, self.num_conditions = dim, num_conditions
        rng = np.random.default_rng(seed)
        self.knots = np.linspace(0, TOP, 12)
        self.points = 0.1 * rng.normal(size=(12, dim))
        self.turn = 0.3 * rng.normal(size=(12, dim, num_conditions))
        self.shift = rng.uniform(0, 6)

    def states(self, places, label=None):
        rest = np.concatenate([[TOP], 0.1 * np.ones(self.num_conditions)])
        return np.concatenate([places, np.broadcast_to(rest, (*places.shape[:-1], len(rest)))], axis=-1)

    def demonstrated(self, starts):
        return self.states(starts)

    def caught(self, state):
        return float(state[self.dim])

    def curve(self, condition):
        return PhaseCurve.through(self.knots, self.points + 0.3 * np.sin(self.turn @ condition))

    def sensitivity(self, condition):
        return PhaseCurve.through(self.knots, 0.3 * np.cos(self.turn @ condition)[..., None] * self.turn)

    def clock(self, condition):
        return timed(1, self.shift + condition.sum())


def timed(dim: int, shift: float = 0.3) -> TimedAttractor:
    """An attractor in whose paces is a wave."""
    knots = np.linspace(-1.0, 2.5, 120)
    paces = 1 + 0.5 * np.sin(1.5 * knots + shift)[None]
    return TimedAttractor(np.zeros(dim), 0.1, 0.02, directions=np.eye(dim)[:1], knots=knots, paces=paces)


def phased(dim: int, num_conditions: int = 0, power: float = 3.0, seed: int = 0) -> PhasedAttractor:
    waves, goal = Waves(dim, num_conditions, seed), np.zeros(dim + 1 + num_conditions)
    return PhasedAttractor(goal=goal, speed=0.1, smoothing=0.02, predictions=waves, power=power)


def states(dim: int, num_conditions: int = 0, seed: int = 2) -> Points:
    """Places, phases and conditions; each condition comes twice."""

    def some(num):
        rng = np.random.default_rng(seed)
        conditions = np.repeat(rng.uniform(-1, 1, ((num + 1) // 2, num_conditions)), 2, axis=0)[:num]
        return np.column_stack([rng.uniform(-0.3, 0.3, (num, dim)), rng.uniform(0.02, TOP, num), conditions])

    return some


def bump(dim: int) -> Flow:
    """A flow of R^dim that moves space by a few centimetres."""
    grid = GaussianGrid(tuple(np.linspace(-0.2, 0.2, 4) for _ in range(dim)), 0.5 / 0.1**2)
    weights = 0.04 * np.random.default_rng(1).normal(size=(grid.num_points, dim))
    return Flow(GridRBF(grid, weights), 1.0, 16)


# --- the arm ---

ROBOT = load_jaco()
BODY = load_jaco().links
READY = np.array(HOME)
LIMITS = JointLimits(ROBOT.lower, ROBOT.upper)
LIMITED = np.isfinite(ROBOT.lower)
UP = np.array([0.48, -0.6, 0.64])
REACH = 0.08
PINS = READY + np.array([[0.9, 0.1, -0.2, 0.3, 0.1, 0.0], [-0.9, -0.1, 0.1, -0.2, 0.2, 0.5]])


def beside_hand(dx=0.0, dy=0.0, dz=0.0, diameter=0.15) -> Sphere:
    return Sphere(as_point(ROBOT.end_effector(READY) + np.array([dx, dy, dz])), diameter)


HAND, ELBOW = beside_hand(0.02, 0.03, -0.01), Sphere((0.0, -0.05, 0.6), 0.12)


def near_ready(num: int, spread: float = 0.15, seed: int = 0) -> np.ndarray:
    """Postures around the ready one, (num, 6) rad."""
    return READY + np.random.default_rng(seed).normal(scale=spread, size=(num, ROBOT.num_joints))


def beside_limits(num: int, closest: float = 0.012, seed: int = 0) -> np.ndarray:
    """Postures anywhere inside the limits, many of them near one."""
    rng = np.random.default_rng(seed)
    q, lower, upper = rng.uniform(-7, 7, (num, ROBOT.num_joints)), ROBOT.lower[LIMITED], ROBOT.upper[LIMITED]
    margin = closest + rng.uniform(0, 2 * LIMITS.zone, (num, LIMITED.sum()))
    anywhere = rng.uniform(lower + closest, upper - closest, (num, LIMITED.sum()))
    q[:, LIMITED] = np.choose(rng.integers(0, 3, (num, LIMITED.sum())), [lower + margin, upper - margin, anywhere])
    return q


# --- diffeomorphisms ---


@dataclass(frozen=True)
class Map:
    """A diffeomorphism, and how exactly it is one."""

    transform: Diffeomorphism
    back: float  # largest error of there and back
    group: float | None = None
    """Largest difference of scaled(a)∘scaled(b) from scaled(a + b); None where that is not promised."""
    points: Points | None = None  # points where it is known; None is the box from −0.8 to 0.8
    step: float = 1e-3  # step of the differences that its Jacobian is compared with
    scales: bool = True  # whether scaled(0) is the identity: changes of units stay

    def some(self, num: int) -> np.ndarray:
        return (self.points or uniform(self.transform.dim))(num)


def coupling(seed: int = 0) -> Coupling:
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.normal(size=(2, 5, 2)), rng.uniform(0, 6, (2, 5))
    return Coupling.of(slice(0, 2), slice(2, 3), frequencies, phases, 0.2 * rng.normal(size=(2, 5, 1)))


EXACT = Flow(bent(2), 0.8, 6, IMPLICIT_EULER, EULER)
PLANE = Placed(Flow(bent(2), 0.8, 12), np.array([0.1, -0.2, 0.3]), tilted_axes(), 0.7)
IN_SPACE = Flow.adaptive(PlacedField(bent(3), np.array([0.2, 0.1, -0.1]), 0.5 * tilted_axes()), -0.6, 1e-9)
MAPS: dict[str, Map] = {
    "flow rk4": Map(Flow(bent(2), 1.0, 16), 1e-6, 1e-5),
    "flow rk4 in space": Map(Flow(bent(3), 0.7, 16), 1e-6, 1e-5),
    "flow backwards": Map(Flow(bent(2), -1.0, 16), 1e-6, 1e-5),
    "flow in a region": Map(Flow(unit_field(3), -0.6, 24), 1e-6, 1e-5, step=1e-4),
    "flow euler": Map(Flow(bent(2), 0.5, 50, EULER), 2e-2),
    "flow euler, implicit inverse": Map(Flow(bent(2), 0.8, 6, EULER, IMPLICIT_EULER), 1e-13),
    "flow implicit, euler inverse": Map(EXACT, 1e-13),
    "flow implicit in space": Map(Flow(bent(3), 0.8, 6, IMPLICIT_EULER, EULER), 1e-13),
    "adaptive flow": Map(Flow.adaptive(bent(2), 1.0, 1e-9), 1e-7, 1e-7),
    "adaptive flow of a placed field": Map(IN_SPACE, 1e-7, 1e-7),
    "chain": Map(Chain([Flow(bent(2, 1), 0.4), Flow(bent(2, 2), -0.5), Flow.adaptive(bent(2, 3), 0.3)]), 1e-6),
    "chain with a placed": Map(Chain([PLANE, Identity(3), Flow.adaptive(bent(3, 4), 0.4)]), 1e-6),
    "placed, plane in space": Map(PLANE, 1e-6, 1e-5),
    "placed, space in space": Map(Placed(Flow(bent(3), 0.5), np.ones(3), tilted_axes(), 2.0), 1e-6, 1e-5),
    "identity": Map(Identity(3), 1e-15, 1e-15),
    "conjugated": Map(Conjugated(Flow(bent(2, 5), 0.6, 12), EXACT), 1e-6, 1e-5),
    "shear": Map(Shear(Waves(2)), 1e-14, 1e-14, states(2), 1e-6),
    "shear for each condition": Map(Shear(Waves(3, 3)), 1e-14, 1e-14, states(3, 3), 1e-6),
    "translation": Map(Translation(np.array([0.1, -0.2])), 1e-15, 1e-15),
    "on places": Map(OnPlaces(bump(2), 3), 1e-6, 1e-5, states(2, 2)),
    "coupling": Map(coupling(), 1e-14),
    "normalisation": Map(Normalisation(np.array([2.0, 0.5]), np.array([0.3, -1.0])), 1e-14, scales=False),
    "joint limits": Map(LIMITS, 1e-9, 1e-9, beside_limits, 1e-4),
}

# --- fields ---


@dataclass(frozen=True)
class Generator:
    """A vector field, and where and how exactly it is looked at."""

    field: VectorField
    points: Points
    step: float = 1e-3
    exact: float = 1e-8
    """Largest error of its derivative against differences, relative to the largest derivative."""


def sideways() -> Sideways:
    rng = np.random.default_rng(0)
    ends, radii = rng.uniform(-0.5, 0.5, (3, 3)), np.array([0.2, 0.3, 0.1])
    return Sideways(
        np.array([0.1, 0.0, -0.1]), tilted_axes() * [2.0, 1.5, 3.0], np.array([0.5, -0.3, 0.2]), ends, radii
    )


PLACES = tuple(PlacedField(bent(3), o, c * tilted_axes()) for o, c in ((np.zeros(3), 0.5), (np.full(3, 0.4), 2.0)))
BALL_MAP = unit_map(Sphere(ORIGIN, 2.0))
BALL_FIELD = AvoidanceField(BALL_MAP, "free-space", 3.0)
FIELDS: dict[str, Generator] = {
    "grid in the plane": Generator(bent(2), uniform(2)),
    "grid in space": Generator(bent(3), uniform(3)),
    "placed": Generator(PlacedField(bent(3), np.array([0.2, 0.1, -0.1]), 0.5 * tilted_axes()), uniform(3)),
    "in a plane": Generator(Projected(bent(3), tilted_axes()[:, :2] @ tilted_axes()[:, :2].T), uniform(3)),
    "sum": Generator(Sum((bent(3), PLACES[1])), uniform(3)),
    "free space": Generator(AvoidanceField(BALL_MAP, "free-space", 1.0), uniform(3, 2.0), 1e-4, 1e-6),
    "free space, hot": Generator(AvoidanceField(BALL_MAP, "free-space", 12.0), uniform(3, 2.0), 1e-4, 1e-6),
    "probability": Generator(AvoidanceField(BALL_MAP, "probability"), uniform(3, 2.0), 1e-4, 1e-6),
    "stretched": Generator(
        PlacedField(BALL_FIELD, np.zeros(3), tilted_axes() * [1.0, 0.4, 2.0]), uniform(3), 1e-4, 1e-6
    ),
    "bias": Generator(unit_field(3), uniform(3, 0.7), 1e-4, 1e-6),
    "bias in a plane": Generator(
        BiasPoint((0.1, 0.2, 0.3), plane=(as_point(DRAWING_AXES[:, 0]), as_point(DRAWING_AXES[:, 1]))).field(0.8),
        uniform(3),
        1e-4,
        1e-6,
    ),
    "shift": Generator(Shift(np.array([0.6, 0.0, 0.8]), 3), uniform(3, 0.7), 1e-4, 1e-6),
    "sideways": Generator(sideways(), uniform(3, 0.5)),
    "escape of the hand": Generator(WholeArmField(ROBOT, BODY, (HAND,), UP[None], PINS, REACH), near_ready),
    "escape of the elbow": Generator(WholeArmField(ROBOT, BODY, (ELBOW,), UP[None], PINS, REACH), near_ready),
    "escape from a small ball": Generator(
        WholeArmField(ROBOT, BODY, (beside_hand(0.01, diameter=0.04),), UP[None], PINS, REACH), near_ready
    ),
    "gradient at the hand": Generator(GradientField(ROBOT, BODY, (HAND,), REACH), near_ready),
    "gradient at the elbow": Generator(GradientField(ROBOT, BODY, (ELBOW,), REACH), near_ready),
}
ARM_FIELDS = {name: case.field for name, case in FIELDS.items() if isinstance(case.field, ArmField)}

# --- base systems ---

BASES: dict[str, tuple[Attractor, Points]] = {
    "attractor": (Attractor(np.array([0.2, -0.1]), speed=0.3, smoothing=0.2), uniform(2)),
    "attractor in space": (Attractor(np.array([0.2, -0.1, 0.3]), speed=0.1, smoothing=0.05), uniform(3)),
    "timed": (timed(3), uniform(3, 0.15)),
    "phased": (phased(3), states(3)),
    "phased for each condition": (phased(2, 3, 1.5), states(2, 3)),
}
ONLY_AT_A_MOMENT = {"Frozen"}  # base systems that are the true one at a moment only

# --- obstacles ---

TILTED: Quaternion = tuple(np.roll(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_quat(), 1).tolist())
PLACE = (0.1, -0.4, 0.3)


def as_solid(mesh: trimesh.Trimesh) -> Solid:
    return Solid(mesh.vertices, mesh.faces)


def extruded(corners: list[tuple[float, float]], cap: list[tuple[int, int, int]], height: float) -> Solid:
    """A prism around the origin, from its floor's corners and triangles, both counterclockwise."""
    flat, n = np.array(corners) - np.mean([np.min(corners, axis=0), np.max(corners, axis=0)], axis=0), len(corners)
    vertices = np.concatenate([np.insert(flat, 2, z, axis=1) for z in (-height / 2, height / 2)])
    walls = [[[k, (k + 1) % n, (k + 1) % n + n], [k, (k + 1) % n + n, k + n]] for k in range(n)]
    return Solid(vertices, np.concatenate([np.array(cap)[:, ::-1], np.array(cap) + n, np.reshape(walls, (-1, 3))]))


ANGLE = extruded(
    [(0.05, 0.05), (0.05, 0.15), (0.0, 0.15), (0.0, 0.0), (0.15, 0.0), (0.15, 0.05)],
    [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)],
    0.06,
)
U_SHAPE = extruded(
    [(0, 0), (0.15, 0), (0.15, 0.15), (0.11, 0.15), (0.11, 0.04), (0.04, 0.04), (0.04, 0.15), (0, 0.15)],
    [(0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7)],
    0.1,
)
SCAN = Cloud(trimesh.sample.sample_surface(trimesh.creation.icosphere(4, 0.075), 3000, seed=0)[0])
SAMPLES = np.random.default_rng(0).uniform(-0.12, 0.12, (6000, 3))
LABELLED = Cloud(SAMPLES, np.abs(SAMPLES).max(axis=1) < 0.06)  # pyright: ignore[reportArgumentType]
OBSTACLES: dict[str, Obstacle] = {
    "sphere": Sphere(PLACE),
    "cube": Box(PLACE, wxyz=TILTED),
    "box 3:1": Box(PLACE, (0.3, 0.1, 0.1), TILTED),
    "plate": Box(PLACE, (0.2, 0.2, 0.03), TILTED),
    "cylinder": Cylinder(PLACE, 0.12, 0.2),
    "disc": Cylinder(PLACE, 0.2, 0.03, TILTED),
    "round mesh": MeshObstacle(PLACE, as_solid(trimesh.creation.icosphere(4, 0.075)), TILTED),
    "capsule": Capsule(PLACE, 0.08, 0.18, TILTED),
    "long capsule": Capsule(PLACE, 0.04, 0.3, TILTED),
    "torus": MeshObstacle(PLACE, as_solid(trimesh.creation.torus(0.06, 0.025)), TILTED),
    "angle": MeshObstacle(PLACE, ANGLE),
    "U": MeshObstacle(PLACE, U_SHAPE, TILTED),
    "smaller U": MeshObstacle(PLACE, U_SHAPE, TILTED, 0.6),
    "scan": CloudObstacle(PLACE, SCAN, TILTED),
    "labelled cloud": CloudObstacle(PLACE, LABELLED),
    "larger cloud": CloudObstacle(PLACE, LABELLED, TILTED).resized(0.2),
}
SIMILAR = {"round mesh", "labelled cloud"}
"""Obstacles that behave as others do; they are swept over only."""

# --- transforms ---

DRAWING = as_point(DRAWING_AXES[:, 0]), as_point(DRAWING_AXES[:, 1])
TRANSFORMS: dict[str, Transform] = {
    "avoidance of a sphere": Avoidance(Sphere((0.0, -0.42, 0.32), 0.12)),
    "avoidance of a box and a cylinder": Avoidance(
        (Box((0.05, -0.4, 0.3), (0.08, 0.1, 0.06), TILTED), Cylinder((-0.1, -0.43, 0.31), 0.06, 0.1)), temperature=3.0
    ),
    "avoidance in a plane": Avoidance(Sphere((0.0, -0.41, 0.31), 0.12), plane=DRAWING),
    "avoidance by the paper's field": Avoidance(Sphere((0.0, -0.45, 0.31), 0.12), generator="probability"),
    "bias": BiasPoint((0.02, -0.32, 0.36)),
    "bias in a plane": BiasPoint((0.02, -0.4, 0.38), plane=DRAWING),
    "bias of the goal": BiasPoint((0.2, -0.3, 0.35), moves_goal=True),
    "bias of a chosen strength": BiasPoint((0.02, -0.34, 0.34), 0.2, strength=0.4),
}
