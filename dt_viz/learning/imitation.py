"""Imitation: a stable system whose motions are the demonstrations (sec. 4.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, real_numbers
from dt_viz.flows.diffeomorphisms import (
    MOST_STEPS,
    Chain,
    Diffeomorphism,
    Flow,
    Placed,
    min_det_jacobian,
    round_trip_error,
)
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import DIMENSIONS, MAX_DEMONSTRATIONS, Demonstration
from dt_viz.learning.flow_chain import FlowChain, FlowLayer, equally_spaced_grid, scaled_field
from dt_viz.learning.initial_guess import groups_of, layers_along, regress, unbending
from dt_viz.learning.interface import AnyImitation, State
from dt_viz.learning.preparation import ImitationError, Motions, PreparationSettings, prepare
from dt_viz.learning.timing import TimedAttractor, TimingSettings, learn_timing
from dt_viz.learning.trajectory import TrajectoryFit
from dt_viz.learning.velocity import VelocityFit
from dt_viz.memo import cached_property
from dt_viz.metrics import interpolate

Progress = Callable[[float, str], None]

Objective = Literal["trajectory", "velocity"]
"""Objective of a fit: the rollouts themselves, or the velocities at the demonstrations' points (eq. (3))."""
OBJECTIVES: tuple[Objective, ...] = get_args(Objective)
MAX_ALL_STEPS, MAX_GAUSSIANS = 1000, 2 * 10**6
"""Largest numbers of steps of all flows of a fit that is read, and of Gaussians of their fields, once for each step. A
fit has up to 160 steps; of a wound motion in space, which takes a quarter of an hour, 530,000 Gaussians."""
MAX_KNOTS = 200  # largest number of knots of the timing of a fit that is read; see `TimingSettings`


@dataclass(frozen=True)
class ImitationSettings:
    """Settings of a fit. Lengths are relative to the demonstrations' spread (RMS distance from their mean).

    Raises:
        ImitationError: there is no such objective.
    """

    objective: Objective = "trajectory"
    num_layers: int = 3
    """Smallest number of stationary flows in ψ; motions that turn far get more, the velocity objective has one."""
    max_layers: int = 10
    """Largest number of them."""
    steps: int = 4
    """Number of Euler steps of each flow."""
    step_length: float = 0.8
    """Longest Euler step of the initial guess, in σ, from which motions get more layers."""
    min_determinant: float = 0.05
    """Smallest determinant of an Euler step's derivative; at 0 space would fold. The optimiser makes no step there."""
    sigma: float | None = None
    """Width of a Gaussian. None takes 1 in the plane, 0.6 in space, less for long motions; half for velocities."""
    ell: float | None = None
    """ℓ of the Gaussians in 1/m², instead of `sigma`."""
    num_inducing: int | None = None
    """Number of inducing points of a layer, equally spaced over a box; None lets `spacing` and `reach` decide."""
    spacing: float = 1.0
    """Distance between neighbouring inducing points, in σ."""
    reach: float = 1.25
    """Distance from the data, in σ, beyond which inducing points are left out."""
    regularisation: float = 3e-5
    """Weight of the squared RKHS norm, summed over layers, against the mean squared distance."""
    velocity_regularisation: float = 3e-3
    """The same weight against the mean squared error of velocities in spreads a duration."""
    num_points: int = 30
    """Smallest number of points of a demonstration that are fitted; long motions get more."""
    max_iterations: int = 20
    """Largest number of Gauss–Newton iterations; L-BFGS, whose iterations are cheaper, takes up to ten times more."""
    max_missed: float = 0.05
    """Largest Fréchet distance of a motion from its demonstration, in extents, for "auto" to take the plain state."""
    max_strayed: float = 0.6
    """Distance of a motion from its demonstration at equal times from which a warning is given."""
    beside: float = 0.25
    """Weight of all motions beside the demonstrations against these, in the plane only; see `motions_beside`."""
    preparation: PreparationSettings = field(default_factory=PreparationSettings)
    """Settings of what is done to the demonstrations before."""
    timing: TimingSettings = field(default_factory=TimingSettings)
    """Settings of the timing, which is learned afterwards."""

    def __post_init__(self) -> None:
        if self.objective not in OBJECTIVES:
            raise ImitationError(f"objective: found {self.objective!r}; accepted: {' or '.join(OBJECTIVES)}")


@dataclass(frozen=True, eq=False, kw_only=True)
class Imitation(AnyImitation):
    """A motion learned in the plain state: ψ and the base attractor, with certificates."""

    state: ClassVar[State] = "plain"
    transform: Chain  # ψ, from the space of the demonstrations to the space of the base attractor
    base: TimedAttractor  # the base system; its goal is z_e = ψ(goal)
    min_det_jacobian: float
    """Smallest det J over the demonstrations' box grown by half its size on every side."""
    round_trip_error: float  # largest ‖ψ⁻¹(ψ(x)) − x‖ over the same box

    @cached_property
    def system(self) -> DiffeomorphicSystem:
        return DiffeomorphicSystem(self.transform, self.base)

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians of all flows' fields, once for each step: what an image of ψ⁻¹ takes."""
        flows = [flow for flow in self.transform.parts if isinstance(flow, Flow)]
        return sum(flow.steps * flow.field.grid.num_points for flow in flows if isinstance(flow.field, GridRBF))

    def system_in(self, origin: Array, axes: Array, scale: float) -> DiffeomorphicSystem:
        base = self.base.placed(origin, axes[:, : len(self.goal)], scale)
        return DiffeomorphicSystem(Placed(self.transform, origin, axes, scale), base)

    def to_arrays(self) -> dict[str, Array]:
        arrays: dict[str, Any] = {
            "starts": self.starts,
            "goal": self.goal,
            "base": np.concatenate([self.base.goal, [self.base.speed, self.base.smoothing]]),
            "base_directions": self.base.directions,
            "base_knots": self.base.knots,
            "base_paces": self.base.paces,
            "certificates": np.array([self.fit_seconds, self.min_det_jacobian, self.round_trip_error]),
            "warnings": np.array(self.warnings, dtype=np.str_),
        }
        for index, flow in enumerate(self.transform.parts):
            assert isinstance(flow, Flow) and isinstance(flow.field, GridRBF)
            arrays[f"layer_{index}_weights"] = flow.field.weights
            arrays[f"layer_{index}_ell_steps_forward"] = np.array(
                [flow.field.grid.ell, flow.steps, flow.method == EULER]
            )
            for axis, coordinates in enumerate(flow.field.grid.axes):
                arrays[f"layer_{index}_axis_{axis}"] = coordinates
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Imitation:
        """Make the imitation that `to_arrays` describes. Raises FormatError on other arrays."""
        d = int(np.size(arrays.get("goal", ())))
        goal = _finite(arrays, "goal", d)
        flows: list[Diffeomorphism] = []
        num_steps = 0
        while f"layer_{len(flows)}_weights" in arrays:
            prefix = f"layer_{len(flows)}_"
            ell, steps, forward = _finite(arrays, f"{prefix}ell_steps_forward", 3)
            axes = tuple(_finite(arrays, f"{prefix}axis_{j}", None) for j in range(d))
            grid = GaussianGrid(axes, float(ell))
            for j, nodes in enumerate(axes):
                if np.abs(np.diff(nodes, 2)).max(initial=0) > 1e-9 * np.abs(nodes).max():
                    raise FormatError(f"{prefix}axis_{j}", "uneven distances", "evenly spaced numbers")
            if not (ell > 0 and 1 <= steps <= MOST_STEPS and forward in (0, 1)):
                found = f"ℓ = {ell:g} and {steps:g} steps"
                raise FormatError(f"{prefix}ell_steps_forward", found, f"ℓ above 0 and 1 to {MOST_STEPS} steps")
            num_steps += int(steps)
            check_at_most("steps of what was learned", num_steps, MAX_ALL_STEPS)
            field = GridRBF(grid, _finite(arrays, f"{prefix}weights", grid.num_points, d))
            integrators = (EULER, IMPLICIT_EULER) if forward else (IMPLICIT_EULER, EULER)
            flows.append(Flow(field, 1.0, int(steps), *integrators))
        if d not in DIMENSIONS or not flows:
            raise FormatError("imitation", f"{d} coordinates and {len(flows)} layers", "2 or 3 coordinates, layers")
        *base, speed, smoothing = _finite(arrays, "base", d + 2)
        knots, directions = _finite(arrays, "base_knots", None), _finite(arrays, "base_directions", None, d)
        check_at_most("base_knots", len(knots), MAX_KNOTS)
        check_at_most("base_directions", len(directions), MAX_DEMONSTRATIONS)
        paces = _finite(arrays, "base_paces", len(directions), len(knots))
        if not (len(knots) > 1 and (np.diff(knots) > 0).all() and min(speed, smoothing, paces.min(initial=1.0)) > 0):
            raise FormatError("base", "a pace, speed or width of 0 or below, or knots that do not increase", "above 0")
        seconds, min_det, error = (float(x) for x in _finite(arrays, "certificates", 3))
        read = cls(
            transform=Chain(flows),
            base=TimedAttractor(
                np.array(base), float(speed), float(smoothing), directions=directions, knots=knots, paces=paces
            ),
            starts=_finite(arrays, "starts", None, d),
            goal=goal,
            fit_seconds=seconds,
            min_det_jacobian=min_det,
            round_trip_error=error,
            warnings=tuple(str(w) for w in np.ravel(arrays.get("warnings", ()))),
        )
        check_at_most("Gaussians of what was learned, in all steps", read.num_gaussians, MAX_GAUSSIANS)
        return read


def _finite(arrays: Mapping[str, Array], name: str, *shape: int | None) -> Array:
    """Return an array of finite numbers of this shape; None is any length but 0. Raises FormatError on another."""
    found = real_numbers(arrays[name], name) if name in arrays else np.zeros(0)
    fits = len(shape) == found.ndim and all(n in (None, m) for n, m in zip(shape, found.shape, strict=True))
    if not (fits and found.size and np.isfinite(found).all()):
        wanted = ", ".join("any length" if n is None else str(n) for n in shape)
        raise FormatError(name, f"shape {found.shape}, or numbers that are not finite", f"finite numbers ({wanted})")
    return found


def fit(
    demonstrations: Sequence[Demonstration], settings: ImitationSettings | None = None, progress: Progress | None = None
) -> Imitation:
    """Learn a stable system from demonstrations of one motion.

    Args:
        demonstrations: at least one, all ending at (about) the same place.
        settings: None takes the defaults.
        progress: called with the fraction done, from 0 to 1, and a description of the current step. An exception that
            it raises, to cancel, ends the fit and is let through.

    Raises:
        ImitationError: no stable system can be learned from these demonstrations.
    """
    settings = settings or ImitationSettings()
    progress = progress or (lambda _fraction, _message: None)
    began = time.perf_counter()
    progress(0.0, "checking the demonstrations")
    motions = prepare(demonstrations, settings.preparation)
    transform = fit_transform(motions, settings, progress)

    progress(0.92, "learning the timing")
    base = learn_timing(transform, motions, settings.timing)
    progress(0.96, "checking that the map is invertible")
    box = grown_grid(np.concatenate(motions.positions), 40 if transform.dim == 2 else 12)
    result = Imitation(
        transform=transform,
        base=base,
        starts=motions.starts,
        goal=motions.goal,
        fit_seconds=time.perf_counter() - began,
        min_det_jacobian=min_det_jacobian(transform.jacobian, box),
        round_trip_error=round_trip_error(transform, box),
        warnings=(
            *motions.warnings,
            *motions.crossing,
            *_strayed(motions, DiffeomorphicSystem(transform, base), settings.max_strayed),
        ),
    )
    if not (result.min_det_jacobian > 0 and result.round_trip_error < 1e-9 * motions.spread):
        raise ImitationError(
            f"no invertible map was found: smallest det J {result.min_det_jacobian:.2g}, round trip "
            f"{result.round_trip_error:.2g} off; more regularisation may help"
        )
    progress(1.0, "done")
    return result


def fit_transform(motions: Motions, settings: ImitationSettings, progress: Progress) -> Chain:
    """Fit ψ alone, without the timing and the certificates; see `fit`."""
    fit_objective = _fit_trajectories if settings.objective == "trajectory" else _fit_velocities
    return fit_objective(motions, settings, progress)


def _fit_trajectories(motions: Motions, settings: ImitationSettings, progress: Progress) -> Chain:
    """Fit ψ by the trajectory objective, as closely as possible without folding space."""
    num_points = int(np.clip(4 * motions.length, settings.num_points, max(settings.num_points, 60)))
    points = motions.resampled(num_points)
    beside = motions_beside(motions, points) if settings.beside and points.shape[-1] == 2 else points[:0]
    importance = np.repeat([1.0, settings.beside * len(points) / max(1, len(beside))], [len(points), len(beside)])
    points = np.concatenate([points, beside])
    centre, scale = points.mean(axis=(0, 1)), motions.spread
    normalised = (points - centre) / scale
    progress(0.05, "unbending the mean demonstration")
    chain, thetas, ends, regularisation = _initial_guess(normalised, _width(motions, settings), settings)

    iterations = count(1)

    def report(_: int, rms: float) -> None:
        num = next(iterations)  # of all solutions: how many there will be is not known
        progress(0.1 + 0.8 * num / (num + settings.max_iterations), f"fitting, {100 * rms:.1f} % of the spread off")

    for weight in dict.fromkeys((regularisation, settings.regularisation)):  # from as smooth a fit as the guess
        problem = TrajectoryFit(chain, normalised, importance, weight, settings.min_determinant)
        solve = partial(problem.solve, thetas, ends, max_iterations=settings.max_iterations, report=report)
        found = solve(refuses=False)
        thetas, ends = solve(refuses=True) if problem.folds(found[0]) else found
    return chain.transform(thetas, centre, scale)


def motions_beside(motions: Motions, points: Array) -> Array:
    """Motions from starts on both sides of the mean of planar motions, sampled at `points` (R, n, 2).

    They are the mean motion with an offset that fades, of 1.2 standard deviations along each principal axis. They tell
    a fit that knows places alone what to do between demonstrations and beside them.
    """
    found, groups = [], groups_of((points - points.mean(axis=(0, 1))) / motions.spread)
    for own in (points[groups == group] for group in range(groups.max() + 1)):
        mean, starts = own.mean(axis=0), own[:, 0]
        axes = motions.principal_axes(starts, mean[0] - motions.goal)
        widths = np.maximum((starts @ axes).std(axis=0), 0.03 * motions.extent)
        offsets = 1.2 * np.concatenate([(widths * axes).T, -(widths * axes).T])
        found.append(mean + np.linspace(1.0, 0.0, len(mean))[:, None] * offsets[:, None])
    return np.concatenate(found)


def _initial_guess(
    points: Array, sigma: float, settings: ImitationSettings
) -> tuple[FlowChain, list[Array], Array, float]:
    """The chain that is fitted to motions `points` (R, n, d), coefficients, images of the ends, and regularisation.

    Where the guess folds, it gets smoother, and then more steps, too.
    """
    for attempt in range(6):
        steps = settings.steps * min(2 ** max(attempt - 1, 0), 4)
        longest = settings.step_length * sigma * steps
        shapes = unbending(points, settings.num_layers - 1, longest, settings.max_layers - 1)
        if settings.num_inducing is None:
            layers = layers_along(shapes, sigma, spacing=settings.spacing, reach=settings.reach)
        else:
            flat = np.concatenate(shapes).reshape(-1, points.shape[-1])
            layer = FlowLayer.of(equally_spaced_grid(flat, settings.num_inducing, 0.5 / sigma**2))
            layers = (layer,) * (len(shapes) - 1)
        chain = FlowChain(layers, steps)
        regularisation = settings.regularisation * 10.0**attempt
        thetas = regress(chain, shapes, regularisation)
        if chain.min_step_determinant(thetas) > settings.min_determinant:
            return chain, thetas, np.concatenate([shapes[0][:, 0], shapes[0][:1, -1]]), regularisation
    raise ImitationError("no invertible map follows these demonstrations; do they contradict each other?")


def _fit_velocities(motions: Motions, settings: ImitationSettings, progress: Progress) -> Chain:
    """Fit ψ by the velocity objective: one flow in explicit Euler steps, as in the paper, inverted exactly."""
    scale, duration = motions.spread, float(np.mean([t[-1] for t in motions.times]))
    centre = motions.resampled(settings.num_points).mean(axis=(0, 1))
    positions, velocities = [], []
    for t, path in zip(motions.times, motions.positions, strict=True):
        even = np.linspace(0.0, t[-1], 2 * settings.num_points)
        positions.append(interpolate(even, t, path))
        velocities.append(interpolate(even, t, np.gradient(path, t, axis=0)))
    x, v = (np.concatenate(positions) - centre) / scale, np.concatenate(velocities) * duration / scale
    sigma = _width(motions, settings)
    if settings.num_inducing is None:
        grid = GaussianGrid.covering(x, sigma, spacing=settings.spacing, pad=settings.reach)
    else:
        grid = equally_spaced_grid(x, settings.num_inducing, 0.5 / sigma**2)
    max_iterations, steps = 10 * settings.max_iterations, settings.num_layers * settings.steps

    def report(iteration: int, cost: float) -> None:
        progress(0.05 + 0.85 * iteration / max_iterations, f"fitting velocities, mean square error {cost:.3g}")

    problem = VelocityFit(
        grid,
        x,
        v,
        (motions.goal - centre) / scale,
        speed=motions.length,
        smoothing=0.1 * motions.length,
        regularisation=settings.velocity_regularisation,
        steps=steps,
        min_determinant=settings.min_determinant,
    )
    field = scaled_field(GridRBF(grid, problem.solve(max_iterations, report)), centre, scale)
    return Chain([Flow(field, 1.0, steps, EULER, IMPLICIT_EULER)])


def _width(motions: Motions, settings: ImitationSettings) -> float:
    """Return σ of the Gaussians in units of the spread."""
    if settings.ell is not None:
        return float(np.sqrt(0.5 / settings.ell)) / motions.spread
    if settings.sigma is not None:
        return settings.sigma
    width = (1.0 if len(motions.goal) == 2 else 0.6) * min(1.0, 7.5 / motions.length)
    return width if settings.objective == "trajectory" else 0.5 * width


def _strayed(motions: Motions, system: DiffeomorphicSystem, most: float) -> list[str]:
    warnings = []
    for name, times, path in zip(motions.names, motions.times, motions.positions, strict=True):
        at = np.linspace(0, len(times) - 1, min(len(times), 100)).astype(int)
        off = np.linalg.norm(system.rollout(path[0], times[at]) - path[at], axis=1).max()
        if off > most * motions.spread:
            warnings.append(f"the learned motion strays up to {off:.2g} from '{name}'")
    return warnings


def grown_grid(points: Array, num: int) -> Array:
    """Return a regular grid (num^d, d) over the box of `points` (N, d) grown by half its size on every side."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    margin = (upper - lower) / 2
    axes = [np.linspace(a, b, num) for a, b in zip(lower - margin, upper + margin, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, points.shape[1])
