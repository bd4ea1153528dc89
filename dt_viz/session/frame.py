"""What an engine computes for a scenario, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.baselines.base import Method
from dt_viz.flows.fields import Array
from dt_viz.motion.certificates import Certificates
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import Profiles
from dt_viz.pictures.sketchbook import NO_PICTURES, Pictures
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.warning import MotionWarning


class Stage(IntEnum):
    """How far a frame is worked out; each stage holds all that the one before it holds."""

    ROLLOUTS = 0
    """Rollouts and their clearance."""
    LIVE = 1
    """Also what lies on the slice, and the arm's motion if it is shown: what follows a drag."""
    FINE = 2
    """All of it refined, for a scenario that rests."""
    CERTIFIED = 3
    """Also the certificates. Where methods are compared, more frames of this stage follow, each of which tells more of
    them."""


@dataclass(frozen=True)
class Scores:
    """Scores of a method around the obstacles of a scenario."""

    frechet: float
    """Mean over the starts of the discrete Fréchet distance to the demonstration, metres."""
    hand_depth: float
    """Maximum collision distance of the end effector, metres; 0 when it is clear."""
    goal_error: float
    """Largest distance of a motion's end from the goal, metres."""
    arm_depth: float | None = None
    """Maximum collision distance of the arm's meshes, metres; None where it is not known yet."""


@dataclass(frozen=True, eq=False)
class Compared:
    """A method's motions around the obstacles of a scenario, from the starts of the demonstrations."""

    method: Method
    paths: tuple[Array, ...]
    """(N_i, 3) of the end effector, metres; none where there are no motions."""
    scores: Scores | None
    curves: Array | None
    """(`dt_viz.motion.profiles.NUM_SAMPLES`, 2) of one motion, at even distances along it, metres: distance to the
    demonstration, and depth in the obstacle."""
    rollout: int
    """Number of that motion: the one that the arm follows where that begins at a demonstrated start."""
    note: str = ""
    """What the motions fail at, or why there are none."""
    arm: ArmMotion | None = None
    """The arm along that motion, where the view shows it."""


@dataclass(frozen=True)
class Frame:
    """All that the page draws for a scenario. Read only."""

    scenario: Scenario
    task: Task
    stage: Stage
    ghost: tuple[Array, ...]
    """Undeformed rollouts, (T_i, 3)."""
    rollouts: tuple[Array, ...]
    """(T_i, 3), metres: first those from the task's starts, then those from added ones."""
    times: tuple[Array, ...]
    """(T_i,) seconds of the samples of each rollout."""
    levels: tuple[tuple[Array, ...], ...]
    """Rollouts of the end effector on each manifold of its stack, from the imitation up, each (T_i, 3)."""
    goal: Array
    """(3,) where the demonstrations end."""
    reached: Array
    """(3,) where the motions end: elsewhere where the obstacle covers the goal or leaves no way to it."""
    blocked: tuple[MotionWarning, ...]
    """Why there is no motion for this scenario; what is shown then is the last one that there was."""
    certificates: Certificates
    num_added: int = 0
    """Number of rollouts, the last ones, from added starts."""
    chosen: int | None = 0
    """Index of the rollout that the arm follows: the first one where it cannot begin the one that is asked for;
    None where that begins at an added start."""
    remembers: bool = False
    """Whether the imitation is augmented: it remembers its phase and where it began."""
    reason: str = ""
    """Why it is augmented, if nobody asked for that."""
    labels: tuple[float, ...] = ()
    """Label of each demonstration; an added start may have one of them. None where no labels are needed."""
    learned_steps: tuple[int, ...] = ()
    """Euler steps of each of the flows that the imitation is composed of; none where it is off."""
    durations: tuple[float | None, ...] = ()
    """t of the flow of each layer of `Scenario.stack`, under a warp that of the full one; None where it is off."""
    chosen_values: tuple[Mapping[str, float], ...] = ()
    """Values that each layer of `Scenario.stack` chose automatically, by its fields; none where it is off."""
    arm_duration: float | None = None
    """t of the flow by which the whole arm avoids, under a warp that of the full one; None where it does not."""
    passing: Passing = ANEW
    """How its motions pass the obstacles, for a scenario that goes on from it."""
    level: int | None = None
    """Index in `levels` of the manifold that the view and the pictures show; None is the top of the stack."""
    arm: ArmMotion | None = None
    """None before stage FINE, at LIVE only unless the view shows it, and where the arm cannot reach the start."""
    pictures: Pictures = NO_PICTURES
    """Pictures of ψ and on the slice, as far as the view shows them; empty before stage LIVE."""
    profiles: Profiles | None = None
    """Along the rollout that the arm follows; None before stage FINE, and where the view does not show them."""
    comparison: tuple[Compared, ...] = ()
    """Ours and the methods beside it, as far as the view shows any; none before stage LIVE."""
    seconds: float = 0.0
    """Time that it took to compute, with the frames before it and what the robot was given, without waits, seconds."""

    @property
    def slice(self) -> Slice:
        """Where the pictures lie."""
        return self.task.slice.posed(self.scenario.view.slice)
