"""What an engine computes for a scenario, stage by stage: its motion, pictures of it, and checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from dt_viz.avoidance.passing import Passing
from dt_viz.baselines.base import Method
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.fields import Array, Mask
from dt_viz.flows.rotations import rotation
from dt_viz.memo import cached_property
from dt_viz.metrics import arc_length
from dt_viz.motion.certificates import Certificates, DrawnSamples
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import Profiles
from dt_viz.motion.solve import Solved
from dt_viz.pictures.sketchbook import NO_PICTURES, Pictures, in_frame
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.stack import WHOLE_ARM, levels
from dt_viz.scenario.tasks import Task
from dt_viz.warning import MotionWarning


class Stage(IntEnum):
    """How far a frame is worked out; each stage holds all that the one before it holds."""

    ROLLOUTS = 0  # rollouts and their clearance
    LIVE = 1
    """Also what lies on the slice, and the arm's motion if it is shown: what follows a drag."""
    FINE = 2  # all of it refined, for a scenario that rests
    CERTIFIED = 3
    """Also the certificates. Where methods are compared, more frames of this stage follow, each of which tells more of
    them."""


@dataclass(frozen=True)
class Scores:
    """Scores of a method around the obstacles of a scenario."""

    frechet: float
    """Mean over the starts of the discrete Fréchet distance to the demonstration, metres."""
    hand_depth: float  # maximum collision distance of the end effector, metres; 0 when it is clear
    goal_error: float  # largest distance of a motion's end from the goal, metres
    arm_depth: float | None = None
    """Maximum collision distance of the arm's meshes, metres; None where it is not known yet."""


@dataclass(frozen=True, eq=False)
class Compared:
    """A method's motions around the obstacles of a scenario, from the starts of the demonstrations."""

    method: Method
    paths: tuple[Array, ...] = ()
    """(N_i, 3) of the end effector, metres; none where there are no motions."""
    times: tuple[Array, ...] = ()  # (N_i,) of their samples, seconds
    joints: tuple[Array, ...] | None = None  # (N_i, n) of the arm, rad, where the method plans them
    scores: Scores | None = None
    note: str = ""  # what the motions fail at, or why there are none
    rollout: int = 0
    """Number of one motion: the one that the arm follows where that begins at a demonstrated start."""
    curves: Array | None = None
    """(`dt_viz.motion.profiles.NUM_SAMPLES`, 2) of that one, at even distances along it, metres: distance to the
    demonstration, and depth in the obstacle."""
    arm: ArmMotion | None = None  # the arm along that motion, where the view shows it


@dataclass(frozen=True, eq=False)
class Frame:
    """A motion, what is drawn of it, and its checks: all that the page shows for a scenario. Read only."""

    scenario: Scenario
    stage: Stage
    motion: Solved  # the scenario's motion, or where it has none the last one that its task had
    drawn: DrawnSamples
    """Its rollouts, by the places of their starts: first the task's, then added ones."""
    certificates: Certificates
    blocked: tuple[MotionWarning, ...] = ()  # why there is no motion for this scenario
    arm: ArmMotion | None = None
    """None before stage FINE, at LIVE only unless the view shows it, and where the arm cannot reach the start."""
    pictures: Pictures = NO_PICTURES
    """Pictures of ψ and on the slice, as far as the view shows them; empty before stage LIVE."""
    profiles: Profiles | None = None
    """Along the rollout that the arm follows; None before stage FINE, and where the view does not show them."""
    comparison: tuple[Compared, ...] = ()
    """Ours and the methods beside it, as far as the view shows any; none before stage LIVE."""

    @property
    def task(self) -> Task:
        """The task of the motion."""
        return self.motion.nominal.task

    @property
    def slice(self) -> Slice:
        """Where the pictures lie."""
        return self.task.slice.posed(self.scenario.view.slice)

    @property
    def ghost(self) -> tuple[Array, ...]:
        """Undeformed rollouts from all starts, (T_i, 3), metres."""
        return self.motion.nominal.paths

    @property
    def rollouts(self) -> tuple[Array, ...]:
        """Rollouts of the end effector from all starts, (T_i, 3), metres; empty where a start has none."""
        return self.drawn.paths

    @property
    def times(self) -> tuple[Array, ...]:
        """(T_i,) seconds of the samples of each rollout."""
        return self.drawn.split(self.drawn.times)

    @property
    def levels(self) -> tuple[tuple[Array, ...], ...]:
        """Rollouts of the end effector on each manifold of its stack, from the imitation up, each (T_i, 3) as above."""
        levels = self.motion.stack.bundle.levels
        return tuple(self.motion.rollouts_of(level) for level in np.moveaxis(levels, 1, 0))

    @property
    def level(self) -> int | None:
        """Index in `levels` of the manifold that the view and the pictures show; None is the top of the stack."""
        names, level = levels(self.motion.scenario), self.scenario.view.level
        return names.index(level) if level in names else None

    @property
    def goal(self) -> Array:
        """(3,) where the demonstrations end, metres."""
        return self.motion.nominal.goal

    @property
    def reached(self) -> Array:
        """(3,) where the motions end: elsewhere where the obstacle covers the goal or leaves no way to it."""
        return self.drawn.positions[-1]

    @property
    def shaping(self) -> Mask:
        """(R,) rollouts that shape the flow: those from the task's starts, where these have any."""
        return self.motion.nominal.shaping

    @cached_property
    def chosen(self) -> int | None:
        """Place of the rollout that the arm follows.

        The first one that there is where it cannot begin the one that is asked for; None where that is an added one.
        """
        nominal, scenario = self.motion.nominal, self.motion.scenario
        place = self.scenario.arm_rollout % (len(self.task.starts) + len(scenario.starts))
        if nominal.moving[place]:
            return place
        return None if nominal.added[place] else int(np.argmax(nominal.moving))

    @property
    def passing(self) -> Passing:
        """How the motions pass the obstacles, for a scenario that goes on from them."""
        return self.motion.passing

    @property
    def remembers(self) -> bool:
        """Whether the imitation is augmented: it remembers its phase and where it began."""
        return self.motion.nominal.imitation.state == "augmented"

    @property
    def has_orientation(self) -> bool:
        """Whether the hand's orientation was learned, too."""
        return self.motion.nominal.learned.poses is not None

    def hand_frames(self, num: int) -> tuple[Array, Array] | None:
        """Places (num, 3), metres, evenly along the rollout that the arm follows, and orientations (num, 3, 3) there.

        None where none were learned, or the arm follows no rollout.
        """
        if not self.has_orientation or self.chosen is None:
            return None
        rows = np.flatnonzero(self.drawn.index == self.chosen)
        length = arc_length(self.drawn.positions[rows])
        kept = rows[np.searchsorted(length, np.linspace(0, length[-1], num)).clip(0, len(rows) - 1)]
        turned = self.motion.nominal.orientations_at(self.drawn.index[kept], self.drawn.fraction[kept])
        assert turned is not None
        return self.drawn.positions[kept], rotation(turned).as_matrix()

    @property
    def reason(self) -> str:
        """Why it is augmented, if nobody asked for that."""
        return self.motion.nominal.imitation.reason

    @property
    def labels(self) -> tuple[float, ...]:
        """Label of each demonstration; an added start may have one of them. None where no labels are needed."""
        return self.motion.nominal.imitation.labels or ()

    @property
    def learned_steps(self) -> tuple[int, ...]:
        """Euler steps of each of the flows that the imitation is composed of; none where it is off."""
        flows = in_frame(self.motion.nominal.system.transform)
        return () if flows is None else tuple(flow.steps for flow in flows.parts if isinstance(flow, Flow))

    @property
    def durations(self) -> Mapping[str, float]:
        """Flow time t of each layer that is on, by its name, and of the whole arm; of the full one under a warp."""
        found = {applied.name: applied.made.duration for applied in self.motion.stack.built}
        return found if self.motion.arm is None else {**found, WHOLE_ARM: self.motion.arm.duration}

    @property
    def chosen_values(self) -> Mapping[str, Mapping[str, float]]:
        """Values that each of them chose automatically, by its name and their fields."""
        found = {applied.name: applied.made.chosen for applied in self.motion.stack.built}
        return found if self.motion.arm is None else {**found, WHOLE_ARM: {"duration": self.motion.arm.duration}}
