"""Every choice of the user, as one frozen value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from dt_viz.avoidance.avoidance import ArmAvoidance, Avoidance
from dt_viz.avoidance.hand import HandAvoidance
from dt_viz.avoidance.passing import Passing
from dt_viz.avoidance.registry import AVOIDANCE
from dt_viz.avoidance.transform import Transform
from dt_viz.learning.imitation import Objective
from dt_viz.learning.state import State
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle, Point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.slices import Panel, SlicePose

SliceColour = Literal["none", "det", "lyapunov", "occupancy"]
"""Quantity shown as colour on the slice: det J of the stack, its Lyapunov value, or the learned occupancy."""
SLICE_COLOURS: Mapping[SliceColour, str] = {
    "none": "None",
    "det": "det J",
    "lyapunov": "Lyapunov value",
    "occupancy": "Learned occupancy",
}
"""Colours of the slice, with their names on the page."""

MAX_OBSTACLES = 5  # largest number of obstacles on the page; each costs time during a drag
MAX_STARTS = 36  # largest number of added starts on the page
MAX_MARGIN = 0.05  # largest margin, metres
MAX_DISTANCE = 5.0  # largest coordinate of a place on the page, metres
MAX_SIGHT = 1e4  # largest coordinate of a camera and of the point it looks at, metres
MIN_TURN, MAX_TURN = 0.5, 2.0
"""Smallest and largest norm of a quaternion; browsers send unit ones, with rounding."""


@dataclass(frozen=True)
class Offer:
    """How the page offers a field of `View`, and what it costs."""

    label: str = ""
    hint: str | None = None
    limits: tuple[float, float, float] = (0.0, 1.0, 0.01)
    """Smallest and largest value and step of its slider."""
    needs: tuple[str, ...] | None = None
    """Other fields that its picture depends on, which is computed while the field is on; None where that is not."""


def _offered(default: Any, label: str = "", hint: str | None = None, **more: Any) -> Any:  # noqa: ANN401
    return field(default=default, metadata={"offer": Offer(label, hint, **more)})


@dataclass(frozen=True)
class View:
    """View of a result; changing it moves nothing."""

    demonstrations: bool = _offered(True, "Demonstrations")
    rollouts: bool = _offered(True, "Rollouts")
    ghost: bool = _offered(True, "Undisturbed motions", "what was learned, without obstacles and bias points")
    field: bool = _offered(True, "Vector field", "velocities on the slice: longer and darker is faster", needs=())
    streamlines: bool = _offered(
        False,
        "Streamlines",
        "motions from all over the slice, exact; of an augmented motion the lines of its field at one phase, which no "
        "motion follows for long",
        needs=(),
    )
    slice: SlicePose | None = None  # pose of the slice; None is the task's
    move_slice: bool = _offered(
        False, "Move the slice", "handles that move and tilt the slice, the plane on which arrows and colours are shown"
    )
    colour: SliceColour = _offered("none", "Slice colour", "quantity shown as colour on the slice", needs=())  # noqa: RUF009
    phase: float = _offered(
        1.0,
        "Phase",
        "of an augmented motion, whose field changes on the way: the part of it that is left, from 1 at its start to "
        "0 at the goal, for which vector field, streamlines, grid and colours are shown",
    )
    arm: bool = _offered(True, "Arm")
    ghost_arm: bool = _offered(False, "Arm without avoidance", "at the same moment; links that coincide are left out")
    onion: bool = _offered(
        False, "Arms along the motion", "several, from start to goal, evenly along the path of the hand"
    )
    body_points: bool = _offered(
        False, "Body points", "spheres that cover the arm; lines from where each would be without avoidance"
    )
    joint_plots: bool = _offered(False, "Joint plots", "angles and speeds over time, with their limits")
    health_plots: bool = _offered(
        False,
        "Plots along the path",
        "Lyapunov value, distance to the demonstration and clearance along the arm's rollout",
        needs=(),
    )
    large_plots: bool = _offered(False, "Large plots", "in windows over the scene, which can be moved and docked")
    compared: tuple[str, ...] = _offered((), needs=("their_arm",))
    """Names of methods whose motions are shown beside ours."""
    their_arm: str = ""  # name of the one of them whose arm is shown, too; none if empty
    table: bool = _offered(True, "Table")
    selected: int = 0
    """Number of the obstacle that the panel changes; if there are fewer, it is the last one."""
    handles: bool = _offered(
        False,
        "Handles",
        "arrows and arcs that move and turn it along axes; a click on an obstacle shows and hides them",
    )
    generator: bool = _offered(
        False, "Learned generator", "vector field whose flow is the imitation", needs=("generator_layer",)
    )
    generator_layer: int = _offered(
        0,
        "Generator of flow",
        "the imitation is several flows, one after the other: 1 is the first; 0: the mean of all",
        limits=(0, 3, 1),  # until a picture of the generator says how many there are
    )
    grid: bool = _offered(
        False,
        "Warped grid ψ⁻¹(grid)",
        "straight lines of base space, as all transforms together bend them",
        needs=(),
    )
    panels: tuple[Panel, ...] = _offered(
        (),
        "Stack side by side",
        "the base attractor, with motions straight to the goal, and each level of the stack",
        needs=(),
    )
    click_to_start: bool = _offered(
        False, "Click to start a rollout", f"on the slice, up to {MAX_STARTS}; drag a ball to move it"
    )
    start_label: float | None = None  # label that new starts get; see `Start`
    playing: bool = True  # whether the arm moves
    replay: bool = _offered(False, "Replay", "its motion, finished, instead of an arm that reacts, with a timeline")
    speed: float = _offered(1.0, "Speed", "of the arm: 1 is real time", limits=(0.25, 3.0, 0.25))
    bias: str = ""  # name of the bias point that the panel changes; the newest if empty
    bias_handles: bool = _offered(
        False,
        "Handles",
        "arrows that move it along axes, and a ring around its region; a click on it shows and hides them",
    )
    tuned: str = ""
    """Name of the transform of the stack whose settings the panel shows; the outermost if empty."""
    level: str = ""
    """Name of the level of the stack whose rollouts are shown beside those of the whole stack, and whose pictures are
    on the slice; the whole stack if empty."""

    @property
    def shows_arm_motion(self) -> bool:
        """Whether something is drawn from the arm's motion along its rollout, as replay is."""
        return self.replay or self.onion or self.joint_plots

    @property
    def computed(self) -> Mapping[str, object]:
        """What is computed only while it is shown, and the choices that it depends on beside the motion."""
        on = {name: offer.needs for name, offer in OFFERS.items() if getattr(self, name) not in (False, "none", ())}
        wanted = {name: (name, *needs) for name, needs in on.items() if needs is not None}
        wanted["place"] = "slice", "level", "phase"
        return {name: tuple(getattr(self, field) for field in fields) for name, fields in wanted.items()}


OFFERS: Mapping[str, Offer] = {
    name: declared.metadata["offer"] for name, declared in View.__dataclass_fields__.items() if declared.metadata
}
"""How the page offers fields of `View`, by their names."""


@dataclass(frozen=True)
class Start:
    """A place where a motion begins that nobody demonstrated."""

    place: Point  # place, metres
    label: float | None = None
    """Label of the motion, in the augmented state; None is that of the nearest demonstrated start."""


@dataclass(frozen=True)
class Layer:
    """A transform in the stack."""

    transform: Transform
    on: bool = True
    name: str = ""  # name on the page, unique in the stack


AVOIDING = (Layer(ArmAvoidance(), name=AVOIDANCE.title),)
"""The stack that a scenario begins with: the whole arm avoids."""


@dataclass(frozen=True)
class Scenario:
    """All choices that a frame depends on: scenarios that are equal and have one passing give equal frames."""

    task: str
    stack: tuple[Layer, ...] = AVOIDING  # the transforms on the imitation, from the inside out
    imitation: bool = True
    """Whether the learned transform is in the stack; without it motions are straight."""
    objective: Objective = "trajectory"  # what is fitted in the plain state
    state: State = "auto"  # whether motions are learned in the plain state or in the augmented one
    style: str = ""
    """Name of the style that is put on motions, of `STYLES`; none if empty. They are augmented then."""
    style_amount: float = 1.0  # part of it that is put on
    warp: float = 1.0
    """s, from 0 to 1: every flow of the stack, the imitation's too, runs for this fraction of its duration."""
    starts: tuple[Start, ...] = ()  # those from which motions begin besides the task's
    arm_rollout: int = 0
    """Number of the rollout that the arm follows: those from the task's starts come first, then those from `starts`."""
    scene: str = ""  # name of the paper's scene that it began as, if any
    arm: str = ""  # name of the arm, of those that are offered; the first one if empty
    view: View = field(default_factory=View)
    passing: Passing | None = field(default=None, compare=False)
    """Detours and reference posture of motions, kept while an obstacle is dragged; None until the session decides."""

    @cached_property
    def active(self) -> tuple[tuple[int, Layer], ...]:
        """The layers that change the end effector's motion, from the inside out, each with its place in the stack."""
        return tuple((k, layer) for k, layer in enumerate(self.stack) if layer.on and layer.transform.acts)

    @property
    def learned(self) -> tuple[object, ...]:
        """What the motion that transforms are stacked on depends on."""
        if self.style and self.imitation:
            return self.arm, self.task, self.style, self.style_amount
        return self.arm, self.task, self.imitation, self.objective, self.state

    @cached_property
    def avoidance(self) -> Avoidance:
        """The transform that the page's obstacles belong to; one without obstacles if the stack has none."""
        of_stack = (layer.transform for layer in self.stack if isinstance(layer.transform, Avoidance))
        return next(of_stack, HandAvoidance())

    @cached_property
    def arm_avoidance(self) -> ArmAvoidance | None:
        """Avoidance by the whole arm in configuration space; None where only the end effector gives way.

        Where several layers ask for one, all their obstacles are avoided, with the settings of the outermost.
        """
        asked = [layer.transform for layer in self.stack if layer.on and isinstance(layer.transform, ArmAvoidance)]
        if len(asked) < 2:
            return asked[0] if asked else None
        return replace(asked[-1], obstacles=tuple(part for avoidance in asked for part in avoidance.obstacles))

    @property
    def avoids(self) -> bool:
        """Whether some layer that is on leads motions around its obstacles."""
        return any(layer.on and bool(layer.transform.avoided.parts) for layer in self.stack)

    @cached_property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles of all layers, also of those that are off."""
        return tuple(part for layer in self.stack for part in layer.transform.avoided.parts)

    @cached_property
    def obstacle(self) -> Union:
        """All obstacles as one."""
        return Union(self.obstacles)

    @property
    def selected(self) -> int | None:
        """Number of the obstacle that has handles; None if there is no obstacle."""
        return min(self.view.selected, len(self.obstacles) - 1) if self.obstacles else None

    @cached_property
    def choices(self) -> Scenario:
        """All that is chosen but how it is looked at: the same scenario with the view that it begins with."""
        return replace(self, view=View())

    @cached_property
    def motion(self) -> Scenario:
        """What the motions depend on: the choices without that of the rollout that the arm follows."""
        return replace(self, view=View(), arm_rollout=0, scene="")

    @cached_property
    def full(self) -> Scenario:
        """What the motions depend on when every flow has run for its full duration."""
        return replace(self.motion, warp=1.0)

    @property
    def fit(self) -> tuple[str, str, Objective, State]:
        """What is to be loaded and learned before there are motions."""
        return self.arm, self.task, self.objective, self.state

    def begins_like(self, other: Scenario) -> bool:
        """Return whether both have the same task, fit and scene, so that one is a small edit of the other."""
        return (self.fit, self.scene) == (other.fit, other.scene)

    def computes_like(self, other: Scenario) -> bool:
        """Return whether a frame of `other` holds all that this scenario needs."""
        return self.choices == other.choices and self.view.computed.items() <= other.view.computed.items()
