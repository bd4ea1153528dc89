"""Every choice of the user, as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from dt_viz.flows.diffeomorphisms import AUTO, Integration
from dt_viz.obstacles.occupancy import Generator
from dt_viz.obstacles.shapes import Obstacle, Point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.slices import SlicePose

if TYPE_CHECKING:
    from dt_viz.learning.imitation import Objective
    from dt_viz.transforms.base import Behaviour

Space = Literal["task", "cspace", "both"]
"""What avoids the obstacle: the end effector (sec. 4.4), the whole arm in configuration space (sec. 4.5), or both."""
SPACES: tuple[Space, ...] = ("task", "cspace", "both")

SliceColour = Literal["none", "det", "lyapunov", "occupancy"]
"""What is shown as colour on the slice: det J of the stack, its Lyapunov value, or what the occupancy maps believe."""
SLICE_COLOURS: tuple[SliceColour, ...] = ("none", "det", "lyapunov", "occupancy")

MIN_DIAMETER, MAX_DIAMETER = 0.04, 0.30
"""Metres."""
MAX_OBSTACLES = 5
"""In the page: each costs time while a hand moves."""
MAX_STARTS = 36
"""Added ones, in the page."""
MAX_MARGIN = 0.05
"""Metres."""
MIN_TEMPERATURE, MAX_TEMPERATURE = 1.0, 20.0
MAX_MANUAL_DURATION = 2.0


COMPUTED_VIEWS = ("field", "streamlines", "generator", "grid", "base", "health_plots")
"""Fields of `View` whose pictures are computed only while they are shown."""


@dataclass(frozen=True)
class View:
    """How a result is looked at; changing it moves nothing. Pictures that are computed are so only while shown."""

    demonstrations: bool = True
    rollouts: bool = True
    ghost: bool = True
    """The undeformed rollouts."""
    field: bool = True
    """Arrows of the vector field on the slice."""
    streamlines: bool = False
    """Motions through places all over the slice."""
    slice: SlicePose | None = None
    """Where the slice lies; None is where the task has it."""
    move_slice: bool = False
    """Whether the slice has handles, instead of what else may have some."""
    colour: SliceColour = "none"
    arm: bool = True
    ghost_arm: bool = False
    """The arm where it would be without avoidance."""
    onion: bool = False
    """Union arms along the motion, fading."""
    body_points: bool = False
    """The spheres that cover the arm, and how far avoidance has moved each."""
    joint_plots: bool = False
    """Joint angles and speeds over time, with their limits."""
    health_plots: bool = False
    """Lyapunov value, distance to the demonstration and clearance along the rollout that the arm follows."""
    table: bool = True
    selected: int = 0
    """The obstacle that has handles; the last one if there are fewer."""
    generator: bool = False
    """Arrows of the learned generator, the vector field whose flow is ψ."""
    generator_layer: int = 0
    """Which of the flows that ψ is composed of; 1 is what ψ applies first, 0 their mean over time."""
    grid: bool = False
    """The warped grid: lines of base space seen through ψ⁻¹."""
    base: bool = False
    """The base attractor beside the learned system."""
    click_to_start: bool = False
    """Whether a click on the slice adds a start."""
    playing: bool = True
    """Whether the arm moves along its rollout."""
    speed: float = 1.0
    """Of the playback, times real time."""
    bias: str = ""
    """Name of the bias point that the panel changes and that has the handles."""
    tuned: str = ""
    """Name of the transform of the stack whose settings the panel shows; the outermost if empty."""
    level: str = ""
    """Name of the level of the stack whose manifold is shown: its rollouts beside those of the whole stack, and all
    that lies on the slice. The whole stack if empty."""


@dataclass(frozen=True)
class Layer:
    """A behaviour in the stack."""

    behaviour: Behaviour
    """A value: compared by what it is made of."""
    on: bool = True
    name: str = ""
    """As the page calls it."""


@dataclass(frozen=True)
class Scenario:
    """All that a picture depends on: the same scenario always gives the same frame."""

    task: str
    obstacles: tuple[Obstacle, ...]
    """All are avoided together; there may be none."""
    imitation: bool = True
    """Whether the learned transform is in the stack; without it motions are straight."""
    objective: Objective = "trajectory"
    avoidance: bool = True
    """Whether the obstacle's transforms are in the stack."""
    space: Space = "task"
    """Which of them."""
    generator: Generator = "free-space"
    temperature: float = 6.0
    """T of the occupancy potential: higher reaches farther and bends more gently."""
    margin: float = 0.01
    """Clearance that `auto` keeps, metres."""
    duration: float | None = None
    """t of the avoidance flow; None is `auto`, the shortest that clears the obstacle by the margin."""
    integration: Integration = AUTO
    """Of the avoidance flow."""
    warp: float = 1.0
    """s, from 0 to 1: every flow of the stack, the imitation's too, runs for this fraction of its duration."""
    layers: tuple[Layer, ...] = ()
    """What else the end effector's motion is to do, from the inside out."""
    avoidance_level: int | None = None
    """How many of these layers the end effector's avoidance is stacked on; None is all of them."""
    starts: tuple[Point, ...] = ()
    """Where motions begin besides the task's starts, metres."""
    arm_rollout: int = 0
    """Which rollout the arm follows: those from the task's starts come first, then those from `starts`."""
    scene: str = ""
    """Name of the scene of the paper that it began as, if any."""
    view: View = field(default_factory=View)

    @property
    def obstacle(self) -> Union:
        """All obstacles as one."""
        return Union(self.obstacles)

    @property
    def selected(self) -> int | None:
        """Which obstacle has handles; None if there is no obstacle."""
        return min(self.view.selected, len(self.obstacles) - 1) if self.obstacles else None

    def moves_like(self, other: Scenario) -> bool:
        """Whether both give the same motion, however it is looked at."""
        return replace(self, view=other.view) == other

    def learns_like(self, other: Scenario) -> bool:
        """Whether both need the same fit."""
        return (self.task, self.objective) == (other.task, other.objective)

    def begins_like(self, other: Scenario) -> bool:
        """Whether both are of one task, learned likewise, and of one scene: the others are small steps away."""
        return self.learns_like(other) and self.scene == other.scene

    def computes_like(self, other: Scenario) -> bool:
        """Whether a frame of `other` holds all that this needs."""
        before, after = other.view, self.view
        shows_no_more = all(getattr(before, name) or not getattr(after, name) for name in COMPUTED_VIEWS)
        same_layer = not after.generator or after.generator_layer == before.generator_layer
        same_colour = after.colour in {"none", before.colour}
        same_place = (after.slice, after.level) == (before.slice, before.level)
        return self.moves_like(other) and shows_no_more and same_layer and same_colour and same_place
