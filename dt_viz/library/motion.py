"""The library: from demonstrations to a stable motion, transforms stacked on it, its paths and its velocity field.

    motion = dt.fit(dt.example("push_box"))
    around = motion.stack(dt.Avoidance(dt.Sphere((0.10, -0.53, 0.15), diameter=0.15)))
    paths = around.rollouts(spacing=0.005)

Everything is computed by what the page is computed by; `import dt_viz` offers these names.
"""

from __future__ import annotations

import os
import pathlib
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from dt_viz.avoidance.registry import entry_of
from dt_viz.avoidance.transform import Transform
from dt_viz.errors import FormatError, check_between
from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import Rays, evenly_sampled, refined
from dt_viz.folders import default_cache_folder
from dt_viz.learning.augmented import unknown_label
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import ImitationSettings, Objective
from dt_viz.learning.inspection import Inspection
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import DemonstrationWarning, prepare
from dt_viz.learning.state import State, learn
from dt_viz.learning.store import FitStore
from dt_viz.library.places import along, as_place, as_places, in_space
from dt_viz.library.takes import Demonstrations, check_goals, demonstrations_of
from dt_viz.memo import cached_property
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length
from dt_viz.motion.certificates import Certificates, DrawnSamples, certified
from dt_viz.motion.diagnostics import motion_warnings
from dt_viz.motion.nominal import NUM_SAMPLES, Learned, Nominal, augmented_of, learned_of, styled
from dt_viz.motion.solve import Solved, solve, warped
from dt_viz.motion.stack import FINE, Solution
from dt_viz.saving import SavedMotion, load_motion, save_motion, save_scenario
from dt_viz.scenario.saved import Saved, ScenarioError, check_shapes
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import OWN, STYLES, TASKS, Task
from dt_viz.warning import in_metres, in_millimetres


def many(num: int, what: str) -> str:
    """A number of things, such as "1 take" or "2 takes"."""
    return f"{num} {what}{'' if num == 1 else 's'}"


def sampled(positions: Array, times: Array) -> str:
    """Samples of a motion: their number, its length and duration."""
    return f"{len(times)} samples, {arc_length(positions)[-1]:.3g} m in {times[-1]:.3g} s"


def summaries(inspections: Sequence[Inspection]) -> list[str]:
    """One sentence for each kind of finding and remedy, about its first take and the number of others."""
    alike: dict[tuple[str, str], list[str]] = defaultdict(list)
    for inspection in inspections:
        for found, text in zip(inspection.findings, inspection.warnings, strict=True):
            alike[found.kind, found.remedy].append(text)
    more = "{} (and {} alike; see Motion.report())"
    return [more.format(first, many(len(rest), "more take")) if rest else first for first, *rest in alike.values()]


def orientation_line(imitation: AnyImitation, demonstrations: Sequence[Demonstration]) -> str:
    """What became of the orientations of demonstrations; empty where these have none."""
    without = [one.name for one in demonstrations if one.orientations is None]
    if imitation.has_orientation or len(without) == len(demonstrations):
        return ""
    why = "in the plain state" if imitation.state == "plain" else "of motions in the plane"
    return f"the hand's orientation is not learned {why if not without else f': {without[0]!r} has none'}"


def missed(path: Array, demonstration: Array) -> str:
    """Discrete Fréchet distance of a learned motion (T, d) from its demonstration (S, d)."""
    off = discrete_frechet(resample_by_arc_length(path, 200), resample_by_arc_length(demonstration, 200))
    return in_millimetres(float(off))


def learned_for(saved: Saved, source: str | pathlib.Path) -> Learned:
    """Learn what a scenario is stacked on; `source` is its file's name, for messages.

    Raises:
        ScenarioError: an obstacle is no solid, or the page has placed the task anew for the arm.
        ImitationError: nothing can be learned from the demonstrations.
    """
    scenario = saved.scenario
    check_shapes(scenario, str(source))
    if saved.own is None and scenario.arm:
        found = f"{scenario.arm!r}, in whose reach the page has placed {scenario.task!r}"
        raise ScenarioError(source, "arm", found, "the first one of a page, or demonstrations of your own")

    def task(name: str) -> Task:
        return saved.own.task if saved.own is not None and name == OWN else TASKS[name]()

    if scenario.style and scenario.imitation:
        own, usual, other = (augmented_of(task(name)) for name in (scenario.task, *STYLES[scenario.style]))
        return styled(task(scenario.task), own, usual, other, scenario.style_amount)
    return learned_of(scenario, task(scenario.task), FitStore(default_cache_folder()))


NUM_COORDINATES = 3  # coordinates of motions in space
ALONE = Scenario("", ())  # what was learned, with nothing stacked on it


@dataclass(frozen=True, eq=False)
class Path:
    """A motion, sampled."""

    positions: Array
    """(T, d), metres."""
    times: Array
    """(T,) seconds from the start."""
    orientations: Array | None = None
    """(T, 4) orientations of the hand, unit quaternions wxyz; None where none were learned."""

    def __repr__(self) -> str:
        return f"Path({sampled(self.positions, self.times)})"


class Motion:
    """A stable motion: what was learned from demonstrations, and the transforms stacked on it. Not to be changed."""

    def __init__(
        self,
        learned: Learned,
        scenario: Scenario = ALONE,
        inspections: tuple[Inspection, ...] = (),
        opened: Saved | None = None,
    ) -> None:
        """Wrap what was learned, with what is stacked on it, and what was opened, if that was a scenario; see `fit`."""
        self._learned, self._opened = learned, opened
        self.scenario = scenario
        """The choices of a user of the page that lead to this motion."""
        self.inspections = inspections
        """What was found about each demonstration that was given, and what was done about it."""
        self.dimension = NUM_COORDINATES if learned.task.draws else len(learned.imitation.goal)
        """d: 2 of drawings, 3 of motions in space, and of drawings that the page has put there."""

    def __repr__(self) -> str:
        takes = many(len(self._learned.imitation.starts), "take")
        where = "the plane" if self.dimension == 2 else "space"
        layers = "".join(f", {layer.name}" for layer in self.scenario.stack)
        goal = in_metres(self._learned.goal[: self.dimension])
        turns = " with orientation" if self.has_orientation else ""
        return f"Motion({takes} in {where}{turns}, {self.state} state, goal {goal}{layers})"

    def report(self) -> str:
        """What was learned from which takes: a line for each with what was found, what was done, and the error.

        The error is the discrete Fréchet distance of the learned motion, without transforms, from the repaired take.
        """
        learned, lines = self._learned, [repr(self)]
        if why := self.reason or learned.imitation.choice:
            lines.append(f"{self.state} state: {why}")
        if text := orientation_line(learned.imitation, learned.task.demonstrations):
            lines.append(text)
        paths = [path[:, : self.dimension] for path in learned.demonstrated.paths]
        for inspection, own, path in zip(self.inspections, learned.task.demonstrations, paths, strict=False):
            off = f"; the learned motion is up to {missed(path, own.positions)} off" if inspection.kept else ""
            lines.append(f"{inspection}{off}")
        told = {text for inspection in self.inspections for text in inspection.warnings}
        return "\n".join([*lines, *(text for text in learned.imitation.warnings if text not in told)])

    @property
    def transforms(self) -> tuple[Transform, ...]:
        """The transforms on the imitation, from the inside out."""
        return tuple(layer.transform for layer in self.scenario.stack)

    @property
    def goal(self) -> Array:
        """(d,) where the motions end, metres."""
        return self.solution.bundle.positions[-1, : self.dimension]

    def stack(self, *transforms: Transform) -> Motion:
        """The motion with more transforms on it, the last one outermost.

        A motion in the plane stays there: what is stacked acts along the plane only, and its places may be (x, y).
        What the joints are to avoid (`Avoidance(space="cspace")`) changes the motions of the arm (`Arm.rollouts`), not
        those of the hand.

        Raises:
            FormatError: a place has not as many coordinates as the motion, or one that is not finite.
        """
        scenario = self.scenario
        for transform in transforms:
            names, title = {layer.name for layer in scenario.stack}, entry_of(transform).title
            name = next(name for k in range(1, len(names) + 2) if (name := f"{title} {k}") not in names)
            layer = Layer(in_space(transform, self.dimension), name=name)
            scenario = replace(scenario, stack=(*scenario.stack, layer))
        return Motion(self._learned, scenario, self.inspections, self._opened)

    def rollouts(
        self,
        starts: ArrayLike | None = None,
        *,
        spacing: float = 0.005,
        label: float | None = None,
        orientations: ArrayLike | None = None,
    ) -> tuple[Path, ...]:
        """Exact paths to the goal, sampled more closely where the stack stretches them.

        Args:
            starts: (R, d) where they begin, metres; None is where the demonstrations do.
            spacing: largest distance between neighbouring samples, metres.
            label: of the motions from `starts`, None takes that of the nearest demonstrated start; without starts only
                the demonstrations with this label are followed, None follows all.
            orientations: (R, 4) of the hand in which they begin, or (4,) for all, quaternions wxyz; what is beside the
                learned orientation fades. None begins with that.

        Raises:
            FormatError: no demonstration has such a label, starts are not (R, d) finite numbers, the spacing is not
                above 0, or orientations are given that are none, or none were learned.
        """
        if not spacing > 0:
            raise FormatError("spacing", f"{spacing:g}", "metres, above 0")
        solution = self.solution
        system = solution.system
        if starts is None:
            rays = solution.rays if label is None else replace(solution.rays, z0=solution.rays.z0[self.labelled(label)])
        else:
            states = self._states(as_places(np.atleast_2d(np.asarray(starts, float)), self.dimension, "starts"), label)
            rays = Rays(system.transform.forward(states), system.base)
        evaluate = lambda index, fraction: system.transform.inverse(rays.at(index, fraction))[:, None, :3]  # noqa: E731
        bundle = refined(evenly_sampled(evaluate, len(rays.z0), NUM_SAMPLES), evaluate, spacing)
        times = bundle.split(rays.times(bundle.index, bundle.fraction))
        parts = zip(bundle.paths, times, along(self._learned.poses, rays, bundle, orientations), strict=True)
        return tuple(Path(path[:, : self.dimension], t, turned) for path, t, turned in parts)

    def velocity(
        self, y: ArrayLike, phase: float | None = None, start: ArrayLike | None = None, label: float | None = None
    ) -> Array:
        """ẏ (*B, d), m/s, at the places `y` (*B, d), metres.

        It is exact to about a thousandth of its speed, and quickest for a single place. In the augmented state there is
        one such field for each phase and each start; `HandController` keeps both, and is what a robot follows.

        Args:
            y: places, metres.
            phase: part of the motion that is left in the augmented state, from 1 at its start to 0 at the goal; None
                is, for each place, that of the nearest point of the motion, which jumps where two are as near.
            start: (d,) where it began, metres; None is where the first demonstration does, without a phase any of them.
            label: of the motion; None takes that of the nearest demonstrated start.

        Raises:
            FormatError: the phase is not from 0 to 1, no demonstration has such a label, or places are not d finite
                numbers each.
        """
        points = np.asarray(y, float)
        as_places(points.reshape(-1, points.shape[-1] if points.ndim else 1), self.dimension, "y")
        places, system = self.in_space(points.reshape(-1, self.dimension)), self.solution.system
        if phase is not None or self.state == "plain":
            velocity = frozen(system, self.rest(phase, start, label)).velocity(places)
        else:
            velocity, states = np.empty_like(places), self._states_along(start, label)
            nearest = KDTree(states[:, :NUM_COORDINATES]).query(places)[1]
            for k in np.unique(nearest):
                at = nearest == k
                velocity[at] = frozen(system, states[k, NUM_COORDINATES:]).velocity(places[at])
        return velocity[:, : self.dimension].reshape(points.shape)

    def phase_rate(self, phase: float, start: ArrayLike | None = None, label: float | None = None) -> float:
        """How fast the phase falls at a phase, 1/s; 0 in the plain state, which has none. See `velocity`.

        Raises:
            FormatError: as `velocity`.
        """
        base, rest = self.solution.rays.base, self.rest(phase, start, label)
        if not len(rest):
            return 0.0
        state = np.concatenate([np.zeros(NUM_COORDINATES), rest])
        return float(-phase * base.velocity(state)[NUM_COORDINATES] / max(rest[0], 1e-12))

    @property
    def state(self) -> str:
        """The state that it was learned in, plain or augmented."""
        return self._learned.imitation.state

    @property
    def reason(self) -> str:
        """Why it was learned in the augmented state, if nobody asked for it."""
        return self._learned.imitation.reason

    @property
    def has_orientation(self) -> bool:
        """Whether the hand's orientation was learned, too."""
        return self._learned.imitation.has_orientation

    @property
    def labels(self) -> tuple[float, ...]:
        """The labels that `rollouts` and `velocity` accept, given or found; none where starts tell what follows."""
        return self._learned.labels

    @property
    def demonstrated_labels(self) -> tuple[float, ...]:
        """The label of each demonstration, given or found; none where there are none."""
        return self._learned.imitation.labels or ()

    def certificates(self) -> Certificates:
        """Checks of the paths from the demonstrations' starts, and warnings."""
        solution, bundle = self.solution, self.solution.bundle
        times, path = solution.rays.times(bundle.index, bundle.fraction), bundle.positions
        drawn = DrawnSamples(bundle.index, bundle.fraction, times, path, len(self.nominal.status))
        clearance = float(self.scenario.obstacle.signed_distance(path).min())
        return certified(Certificates(clearance, found=motion_warnings(self.solved, drawn)), solution, drawn)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the motion to a file (npz, whatever its suffix): what was learned, the demonstrations and the stack.

        One that was opened from a scenario is written as that (JSON). An existing file is only replaced by a whole one.

        Raises:
            DataError: a transform is not one of `dt_viz.avoidance.registry.KINDS`, or holds what could not be read.
            OSError: the file cannot be written.
        """
        if self._opened is not None:
            save_scenario(path, replace(self._opened, scenario=self.scenario))
            return
        demonstrations, imitation = self._learned.task.demonstrations, self._learned.imitation
        chosen = self.state == "augmented", imitation.labels, self.reason, imitation.augmented
        save_motion(path, SavedMotion(demonstrations, self.scenario.stack, *chosen, self.inspections), imitation)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Motion:
        """Read the motion that `save` wrote: its paths, velocities and certificates are the same to the last bit.

        Or read a scenario that the page has saved, whose task is learned as there: its motion is the page's, from the
        demonstrations' starts and then the added ones, in the page's frame (`dt.load_arm("jaco", frame="page")`).

        An augmented motion is learned again from its demonstrations, so that this holds for one version of DT-Viz.

        Raises:
            DataError: there is no such file, it cannot be read, or is neither. Nothing else is raised, whatever the
                file holds, but ImitationError for a scenario; nothing is unpickled.
        """
        read = load_motion(path)
        if isinstance(read, Saved):
            return cls(learned_for(read, os.fspath(path)), read.scenario, opened=read)
        saved, imitation = read
        learned = Learned.of(Task(demonstrations=saved.demonstrations), imitation, imitates=True)
        return cls(learned, Scenario("", saved.layers), saved.inspections)

    @cached_property
    def solved(self) -> Solved:
        """The motion of the hand, as exactly as it is computed."""
        full, fraction = solve(self.scenario, self.nominal, FINE), self.scenario.warp
        return full if fraction == 1 else warped(full, self.nominal.warped(fraction), fraction, FINE, None)

    @property
    def solution(self) -> Solution:
        """Its stack."""
        return self.solved.stack

    @cached_property
    def nominal(self) -> Nominal:
        """The motion without what is stacked on it, from the demonstrations' starts, and from those of a scenario."""
        return self._learned.nominal([self._learned.trajectory(start) for start in self.scenario.starts])

    def _states(self, places: Array, label: float | None) -> Array:
        """The states (R, k) in which motions from places (R, d) begin."""
        return self.solution.rays.base.states(self.in_space(places), label)

    def _states_along(self, start: ArrayLike | None, label: float | None) -> Array:
        """The states (N, k) along the motion from a start (d,), or along those of the demonstrations with a label."""
        system, rays = self.solution.system, self.solution.rays
        if start is not None:
            began = self._states(as_places(np.asarray(start, float)[None], self.dimension, "start"), label)
            rays = Rays(system.transform.forward(began), system.base)
        elif label is not None:
            rays = replace(rays, z0=rays.z0[self.labelled(label)])
        fraction = np.linspace(0.0, 1.0, NUM_SAMPLES)
        index = np.repeat(np.arange(len(rays.z0)), NUM_SAMPLES)
        return system.transform.inverse(rays.at(index, np.tile(fraction, len(rays.z0))))

    def rest(self, phase: float | None, start: ArrayLike | None, label: float | None) -> Array:
        """Find what the state of a motion from a start (d,) has besides the place, at a phase; None is at its start."""
        began = self._learned.task.starts[0, : self.dimension] if start is None else np.asarray(start, float)
        rest = self._states(as_places(began[None], self.dimension, "start"), label)[0, NUM_COORDINATES:]
        if phase is not None:
            check_between("phase", phase, 0.0, 1.0)
            rest[:1] *= phase
        return rest

    def labelled(self, label: float) -> Indices:
        """The numbers of the demonstrations with a label."""
        if label not in self.labels:
            raise unknown_label(label, self.labels)
        return np.flatnonzero(np.array(self.demonstrated_labels) == label)

    def in_space(self, points: Array) -> Array:
        """Points (N, 3) of points (N, d)."""
        return np.pad(points, ((0, 0), (0, 3 - self.dimension)))


def fit(
    demonstrations: Demonstrations,
    objective: Objective = "trajectory",
    state: State = "auto",
    labels: Sequence[float] | None = None,
    settings: ImitationSettings | None = None,
    augmented: AugmentedSettings | None = None,
    *,
    rate: float | None = None,
    goal: Sequence[float] | None = None,
) -> Motion:
    """Learn a stable motion from demonstrations, all ending at (about) the same place.

    What is odd about them is repaired, and said by a `DemonstrationWarning` for each kind; `Motion.report` lists all.

    Args:
        demonstrations: of one motion, with d = 2 or 3 coordinates, metres: an array (T, d) or (N, T, d), or several of
            these; pairs of times (T,) and positions (T, d); `Demonstration`s; a pandas.DataFrame with columns x, y and
            perhaps z, t, demo; the path of a file or folder; or several of any of these, also by name.
        objective: what is fitted in the plain state: the motions, or their velocities as in eq. (3).
        state: "plain" is the paper's: one vector field of places, which needs no memory. "augmented" remembers its
            phase and where it began: it crosses itself, comes back, winds, and draws the figure from other starts,
            too, and learns the hand's orientation where all takes have it. "auto" is that then; else plain where a fit
            with the default settings misses no demonstration by more than 5 % of their extent and, with three or more,
            follows those that are left out about as well as the augmented state.
        labels: a number for each demonstration, its pattern's, where they differ although they begin at one place;
            makes the state augmented. None finds them where that is so; see `Motion.labels`.
        settings: of the plain fit, the objective included, and of the preparation; None takes the defaults.
        augmented: settings of the augmented state; None takes the defaults, and that preparation.
        rate: samples a second, Hz, of arrays and tables without times; None takes each take as 5 s long.
        goal: (d,) where the motion is to end, metres; takes that end elsewhere are left out. None is where most end.

    Raises:
        DataError: these are no demonstrations.
        ImitationError: no stable motion can be learned from them, or there is no such state.
    """
    given = demonstrations_of(demonstrations, rate)
    settings = settings or ImitationSettings(objective)
    augmented = augmented or AugmentedSettings(preparation=settings.preparation)
    if goal is not None:
        place = as_place(goal, given[0].dimension, "goal")
        settings = replace(settings, preparation=replace(settings.preparation, goal=place))
        augmented = replace(augmented, preparation=replace(augmented.preparation, goal=place))
    motions = prepare(given, settings.preparation)
    check_goals(motions.inspections, labels)
    for text in summaries(motions.inspections):
        warnings.warn(text, DemonstrationWarning, stacklevel=2)
    imitation = learn(motions.repaired, settings, state, labels, augmented=augmented)
    learned = Learned.of(Task(demonstrations=motions.repaired), imitation, imitates=True)
    return Motion(learned, inspections=motions.inspections)
