"""What is drawn of a motion: its rollouts, the arm along one of them, and the pictures of a view."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.diffeomorphisms import Chain, Identity
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.memo import Memo, kept
from dt_viz.motion.certificates import DrawnSamples
from dt_viz.motion.following import ArmMotion, Follower, arm_samples
from dt_viz.motion.nominal import Learned
from dt_viz.motion.solve import Solved
from dt_viz.motion.stack import Applied, cut_off
from dt_viz.obstacles.union import Union
from dt_viz.pictures.arm_field import Lattice
from dt_viz.pictures.occupancy import occupancy_picture
from dt_viz.pictures.panels import PanelPicture, generator_panel, system_panel
from dt_viz.pictures.sketchbook import BASE_TITLE, Pictures, Sketchbook, in_frame
from dt_viz.pictures.slice_fields import ARROW_SPACING, FieldPicture, arrows_and_colour, streamlines
from dt_viz.robot.retiming import within_velocity_limits
from dt_viz.robot.robot import Robot
from dt_viz.scenario.panels import BASE_PANEL, Panel, offsets
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.stack import IMITATION, level_of, levels
from dt_viz.warning import MotionWarning

PLAIN_TITLE, AUGMENTED_TITLE = "plain: one field for all", "augmented: remembers its phase"
"""What is written over the two states, where they are side by side."""
NUM_BOOKS = 8
"""Number of learned motions whose pictures are kept."""


def rollouts_of(motion: Solved, robot: Robot) -> DrawnSamples:
    """The end effector's rollouts, or its way along the arm's where the whole arm avoids."""
    drawn = motion.stack.bundle if motion.arm is None else motion.arm
    positions = motion.stack.bundle.positions if motion.arm is None else robot.end_effector(motion.arm.p)
    times = motion.stack.rays.times(drawn.index, drawn.fraction)
    return DrawnSamples(drawn.index, drawn.fraction, times, positions)


def arm_along(
    motion: Solved, drawn: DrawnSamples, rollout: int, follower: Follower
) -> tuple[ArmMotion, tuple[MotionWarning, ...]]:
    """The arm's motion along a rollout of those that are drawn, and what is wrong with it.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    nominal, rows = motion.nominal, np.flatnonzero(drawn.index == rollout)
    if motion.arm is not None and motion.lifted is not None:
        joints, q = motion.lifted.tracked, motion.arm.p[rows]
    else:
        rows = rows[arm_samples(len(rows))]
        joints = follower.along(nominal, drawn.positions[rows])
        q = joints.q
    warnings = follower.warnings(joints, nominal.numbers[rollout])
    without = follower.undisturbed_along(nominal, rollout).at(np.zeros(len(rows), int), drawn.fraction[rows])
    return ArmMotion(within_velocity_limits(drawn.times[rows], q, follower.robot.velocity_limits), q, without), warnings


@dataclass(frozen=True, eq=False)
class Subject:
    """What pictures show: a motion, on the slice, up to the level and at the phase that a view names."""

    motion: Solved
    view: View
    rollout: int | None
    """Index of the rollout that the arm follows."""

    @property
    def area(self) -> Slice:
        """The slice."""
        return self.motion.nominal.task.slice.posed(self.view.slice)

    @property
    def built(self) -> tuple[Applied, ...]:
        """The layers up to the level."""
        return self.motion.stack.built[: level_of(self.motion.scenario, self.view)]

    @property
    def rest(self) -> Array:
        """Phase and condition at which augmented motions are shown; empty for plain ones.

        The condition is that of the rollout which the arm follows.
        """
        held = self.motion.below.rest(self.rollout or 0)
        held[:1] *= self.view.phase
        return held

    @property
    def lattice(self) -> Array:
        """Places (M, 3) of the arrows, metres."""
        return self.area.grid(ARROW_SPACING).reshape(-1, 3)

    def system(self, level: int) -> DiffeomorphicSystem:
        """The system of places (3,) on a level, counted as in `Frame.levels`, at the phase that is shown."""
        return frozen(cut_off(self.motion.below, self.motion.stack, level), self.rest)

    def velocities(self, learned: Array) -> Array:
        """The hand's velocities (M, 3) at the lattice, m/s, of the whole stack below the arm's avoidance.

        Places inside an obstacle have none, NaN. They are `learned` (M, 3), those of the learned motion, where the
        stack moves nothing.
        """
        points, built = self.lattice, self.motion.stack.built
        free = _avoided(built).signed_distance(points) > 0
        stacked = Chain([Identity(3), *(applied.made.transform for applied in built)])
        spread = np.full_like(points, np.nan)
        below, carried = stacked.forward(points[free]), learned[free]
        moved = (below != points[free]).any(axis=1)
        carried[moved] = self.system(0).velocity(below[moved])
        spread[free] = stacked.inverse_tangents(below, carried[..., None])[1][..., 0]
        return spread


def _choices(shown: Subject) -> tuple[Hashable, ...]:
    """What pictures depend on beside the motion."""
    return shown.rollout, *shown.view.computed.items()


def _place(shown: Subject) -> tuple[Hashable, ...]:
    """Where arrows are, and under which condition."""
    return shown.view.slice, shown.rest.tobytes()


class Drawing:
    """Makes pictures of motions; what an edit leaves unchanged is kept."""

    def __init__(self, follower: Follower, memo: Memo) -> None:
        """Draw motions of this arm."""
        self._follower, self._memo = follower, memo

    @kept(2, by=lambda shown, _, coarse: (shown.motion, *_choices(shown), coarse), of="_memo")
    def pictures(self, shown: Subject, others: Mapping[Panel, Learned], coarse: bool) -> Pictures:
        """The pictures that a view shows.

        Args:
            shown: what they show.
            others: the learned motions that panels of other tasks show.
            coarse: whether they are to follow a drag.
        """
        motion, view, area, built = shown.motion, shown.view, shown.area, shown.built
        own = self._book(motion.below.learned, shown.rest)
        books = {None: own, **{panel: self._book(each, each.demonstrated.rest(0)) for panel, each in others.items()}}
        clearance, system = _avoided(built).signed_distance, shown.system(len(built))
        avoids = view.field and motion.arm is not None and not view.level
        arrows = view.field and not avoids
        field, colour = arrows_and_colour(system, area, clearance, view.colour, arrows=arrows, coarse=coarse)
        learned_by = view.colour == "occupancy"
        return Pictures(
            field=self._carried(shown) if avoids else field,
            streamlines=streamlines(system, area, clearance, coarse=coarse) if view.streamlines else None,
            colour=colour,
            generator=own.generator(area, view.generator_layer) if view.generator else None,
            grid=own.grid(area, [layer.made.transform for layer in built], coarse=coarse) if view.grid else None,
            panels=_panels(shown, books, coarse=coarse) if view.panels else (),
            occupancy=occupancy_picture(area, motion.scenario.obstacles, coarse=coarse) if learned_by else None,
        )

    def _carried(self, shown: Subject) -> FieldPicture:
        """The hand's velocities, carried along by the whole arm's avoidance."""
        motion, robot = shown.motion, self._follower.robot
        assert motion.arm is not None
        lattice = self._lattice(shown, self._follower.reference(motion.nominal))
        velocities = self._velocities(shown)
        return lattice.carried(velocities, motion.arm.transform, robot, motion.scenario.obstacle)

    @kept(NUM_BOOKS, by=lambda learned, rest: (learned, rest.tobytes()), of="_memo")
    def _book(self, learned: Learned, rest: Array) -> Sketchbook:
        """The maker of pictures of ψ, at one phase and for one condition."""
        shown, system = learned.demonstrated, frozen(learned.system, rest)
        rays = Rays(system.transform.forward(shown.starts), system.base)
        return Sketchbook(learned.task, in_frame(learned.system.transform), system, rays, shown.paths)

    @kept(2, by=lambda shown, near: (shown.motion.scenario.task, shown.view.slice, near.tobytes()), of="_memo")
    def _lattice(self, shown: Subject, near: Array) -> Lattice:
        """The postures that hold the hand where arrows begin, `near` a posture (6,), rad."""
        return Lattice.of(shown.lattice, self._follower.robot, near)

    @kept(2, by=lambda shown: (*_made_for(shown.motion), *_place(shown)), of="_memo")
    def _velocities(self, shown: Subject) -> Array:
        """Velocities (M, 3) of the hand at the lattice, m/s."""
        return shown.velocities(self._learned_velocities(shown))

    @kept(2, by=lambda shown: (*_learned(shown.motion), *_place(shown)), of="_memo")
    def _learned_velocities(self, shown: Subject) -> Array:
        """Velocities (M, 3) of the learned motion at the lattice, m/s."""
        return shown.system(0).velocity(shown.lattice)


def _learned(motion: Solved) -> tuple[Hashable, ...]:
    """What the learned motion depends on."""
    return motion.below.learned, motion.stack.rays.base.goal.tobytes()


def _made_for(motion: Solved) -> tuple[Hashable, ...]:
    """What the stack below the arm's avoidance depends on."""
    layers = tuple(layer for _, layer in motion.scenario.active)
    made_for = motion.below if layers or motion.scenario.warp < 1 else motion.below.learned
    return made_for, layers, *motion.passing.hand.values()


def _panels(shown: Subject, books: Mapping[Panel | None, Sketchbook], *, coarse: bool) -> tuple[PanelPicture, ...]:
    """The panels of a view, side by side, and the frame of the scene's own slice."""
    scenario, panels, area, task = shown.motion.scenario, shown.view.panels, shown.area, shown.motion.nominal.task
    made = [_panel(panel, shown, books[panel.shown], coarse=coarse) for panel in panels]
    seen = [picture for picture in made if picture is not None]
    widest = np.max([area.half_size, *(picture.area.half_size for picture in seen)], axis=0)
    places = offsets(area, widest, len(seen), task.camera)
    beside = [
        replace(picture, offset=area.centre - picture.area.centre + by)
        for picture, by in zip(seen, places, strict=True)
    ]
    names = levels(scenario)
    if any(panel.state == "plain" for panel in panels):
        title = AUGMENTED_TITLE
    elif any(panel.task for panel in panels):
        amount = f"{scenario.style_amount:g}".replace("-", "−")
        title = f"{task.title}, {scenario.style} × {amount}" if scenario.style else task.title
    else:
        title = _title(names[-1]) if scenario.imitation or len(names) > 1 else BASE_TITLE
    return (*beside, PanelPicture(title, area))


def _panel(panel: Panel, shown: Subject, book: Sketchbook, *, coarse: bool) -> PanelPicture | None:
    """A panel where the slice is, whose motion is in the book; None for that of a level which is off."""
    area, stack, names = shown.area, shown.motion.stack, levels(shown.motion.scenario)
    if panel.task:
        return book.imitation(book.task.slice, PLAIN_TITLE if panel.state == "plain" else book.task.title)
    if panel == BASE_PANEL:
        return book.base(area, grid=shown.view.grid)
    if panel.level not in names:
        return None
    level, title = names.index(panel.level), f"field −V of {_name(panel.level)}"
    if level == 0:
        return book.generating(area, title) if panel.generator else book.imitation(area, _title(panel.level))
    if panel.generator:
        return generator_panel(title, stack.built[level - 1].made.transform, area)
    paths = stack.bundle.split(stack.bundle.levels[:, level])
    avoided = _avoided(stack.built[:level])
    return system_panel(_title(panel.level), shown.system(level), paths, area, avoided, coarse=coarse)


def _title(level: str) -> str:
    """What is written over the panel of a level: what is added to the one before."""
    return ("" if level == IMITATION else "+ ") + _name(level)


def _name(level: str) -> str:
    """Name of a level within a line."""
    return level[:1].lower() + level[1:]


def _avoided(built: Sequence[Applied]) -> Union:
    """What these transforms avoid: no motion comes into it."""
    return Union(tuple(part for applied in built for part in applied.transform.avoided.parts))
