"""What the page knows of a kind of transform: its name, its button, and the controls of its settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from dt_viz.avoidance.transform import Transform
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Point
from dt_viz.obstacles.union import Union


@dataclass(frozen=True)
class Number:
    """A setting that is a slider on the page."""

    field: str  # name of the transform's field
    label: str
    unit: str
    low: float
    high: float
    step: float
    initial: float  # value of the slider before there is one
    scale: float = 1.0  # units of the slider in one unit of the field
    automatic: bool = False
    """Whether a switch beside the slider sets the field to None, which leaves the choice to the transform."""
    of_flow: bool = False  # whether it is t of the transform's flow
    hint: str = ""


@dataclass(frozen=True)
class Switch:
    """A setting that is on or off."""

    field: str
    label: str
    hint: str = ""


@dataclass(frozen=True, eq=False)
class Choice:
    """A setting that is one of a few values."""

    field: str
    label: str
    options: Mapping[Any, str]  # names of the values
    hint: str = ""


@dataclass(frozen=True)
class FlowIntegration:
    """The setting of a field of type `Integration`."""

    field: str = "integration"


Setting = Number | Switch | Choice | FlowIntegration


@dataclass(frozen=True)
class Surroundings:
    """The world around a transform that is added."""

    mean_path: Array  # (T, 3) the mean demonstration, evenly sampled, metres
    plane: tuple[Point, Point] | None
    """Two orthonormal vectors of a drawing's plane; None of a task in space."""
    obstacle: Union
    anchors: tuple[Point, ...]  # places of other transforms, metres


@dataclass(frozen=True, eq=False)
class PageEntry:
    """A kind of transform on the page."""

    title: str  # name on the page; numbered where there may be more than one
    hint: str = ""  # explanation of the button that adds one
    settings: tuple[Setting, ...] = ()  # settings that the page offers
    most: int = 4
    """Largest number in a stack of the page. The only one of its kind has no button and stays outermost."""
    flow_time: str = "t"  # name of t in the list of the stack
    added: Callable[[Surroundings], Transform] | None = None
    """Makes the transform that the button adds; None makes one of the kind without arguments."""
