"""What is drawn of a motion: its rollouts, the arm along one of them, and the pictures of a view."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

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
from dt_viz.pictures.panels import PanelPicture, generator_panel, system_panel
from dt_viz.pictures.sketchbook import BASE_TITLE, Pictures, Sketchbook, in_frame
from dt_viz.pictures.slice_fields import (
    ARROW_SPACING,
    FieldPicture,
    Lattice,
    arrows_and_colour,
    occupancy_picture,
    streamlines,
)
from dt_viz.robot.joint_trajectory import within_velocity_limits
from dt_viz.robot.robot import Robot
from dt_viz.scenario.slices import BASE_PANEL, Panel, offsets
from dt_viz.scenario.stack import IMITATION, levels
from dt_viz.session.frame import Frame
from dt_viz.warning import MotionWarning

PLAIN_TITLE, AUGMENTED_TITLE = "plain: one field for all", "augmented: remembers its phase"
"""What is written over the two states, where they are side by side."""
NUM_BOOKS = 8  # number of learned motions whose pictures are kept


def rollouts_of(motion: Solved, robot: Robot) -> DrawnSamples:
    """The end effector's rollouts, or its way along the arm's where the whole arm avoids."""
    drawn = motion.stack.bundle if motion.arm is None else motion.arm
    positions = motion.stack.bundle.positions if motion.arm is None else robot.end_effector(motion.arm.p)
    times = motion.stack.rays.times(drawn.index, drawn.fraction)
    return DrawnSamples(drawn.index, drawn.fraction, times, positions, len(motion.nominal.status))


def arm_along(frame: Frame, rollout: int, follower: Follower) -> tuple[ArmMotion, tuple[MotionWarning, ...]]:
    """The arm's motion along a rollout of a frame, and what is wrong with it.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    motion, drawn = frame.motion, frame.drawn
    nominal, rows = motion.nominal, np.flatnonzero(drawn.index == rollout)
    avoids = motion.arm is not None and motion.lifted is not None
    rows = rows if avoids else rows[arm_samples(len(rows))]
    wanted = nominal.orientations_at(drawn.index[rows], drawn.fraction[rows])
    if motion.arm is not None and motion.lifted is not None:
        joints, q = motion.lifted.along(rollout), motion.arm.p[rows]
    else:
        joints = follower.along(nominal, drawn.positions[rows], wanted)
        q = joints.q
    warnings = follower.warnings(joints, rollout)
    without = follower.undisturbed(nominal).at(drawn.index[rows], drawn.fraction[rows])
    times = within_velocity_limits(drawn.times[rows], q, follower.robot.velocity_limits)
    return ArmMotion(times, q, without, wanted), warnings


def rest(frame: Frame) -> Array:
    """Phase and condition at which augmented motions are shown; empty for plain ones.

    The condition is that of the rollout which the arm follows.
    """
    held = frame.motion.below.rest(frame.chosen or 0)
    held[:1] *= frame.scenario.view.phase
    return held


def system_of(frame: Frame, level: int) -> DiffeomorphicSystem:
    """The system of places (3,) on a level, counted as in `Frame.levels`, at the phase that is shown."""
    return frozen(cut_off(frame.motion.below, frame.motion.stack, level), rest(frame))


def lattice(frame: Frame) -> Array:
    """Places (M, 3) of the arrows on the slice, metres."""
    return frame.slice.lattice(ARROW_SPACING)


def velocities(frame: Frame, learned: Array) -> Array:
    """The hand's velocities (M, 3) at the lattice, m/s, of the whole stack below the arm's avoidance.

    Places inside an obstacle have none, NaN. They are `learned` (M, 3), those of the learned motion, where the stack
    moves nothing.
    """
    points, built = lattice(frame), frame.motion.stack.built
    free = _avoided(built).signed_distance(points) > 0
    stacked = Chain([Identity(3), *(applied.made.transform for applied in built)])
    spread = np.full_like(points, np.nan)
    below, carried = stacked.forward(points[free]), learned[free]
    moved = (below != points[free]).any(axis=1)
    carried[moved] = system_of(frame, 0).velocity(below[moved])
    spread[free] = stacked.inverse_tangents(below, carried[..., None])[1][..., 0]
    return spread


def _seen(frame: Frame, *given: Hashable) -> tuple[Hashable, ...]:
    """What pictures depend on beside what is given: the motion, and what the view shows of it."""
    return frame.motion, frame.chosen, *frame.scenario.view.computed.items(), *given


def _learned(frame: Frame) -> tuple[Hashable, ...]:
    """What the learned motion's arrows depend on."""
    motion = frame.motion
    return motion.below.learned, motion.stack.rays.base.goal.tobytes(), frame.scenario.view.slice, rest(frame).tobytes()


def _stacked(frame: Frame) -> tuple[Hashable, ...]:
    """What the arrows of the stack below the arm's avoidance depend on."""
    motion, layers = frame.motion, tuple(layer for _, layer in frame.motion.scenario.active)
    below = motion.below if layers or motion.scenario.warp < 1 else None
    return *_learned(frame), below, layers, *motion.passing.hand.values()


class Drawing:
    """Makes the pictures of frames; what an edit leaves unchanged is kept."""

    def __init__(self, follower: Follower, memo: Memo) -> None:
        self._follower, self.memo = follower, memo

    @kept(2, by=lambda frame, _, coarse: _seen(frame, coarse))
    def pictures(self, frame: Frame, others: Mapping[Panel, Learned], coarse: bool) -> Pictures:
        """The pictures that the view of a frame shows, on its slice and of its level, coarse where they follow a drag.

        The `others` are the learned motions that panels of other tasks show.
        """
        motion, view, area = frame.motion, frame.scenario.view, frame.slice
        built = motion.stack.built[: frame.level]
        own = self._book(motion.below.learned, rest(frame))
        books = {None: own, **{panel: self._book(each, each.demonstrated.rest(0)) for panel, each in others.items()}}
        clearance, system = _avoided(built).signed_distance, system_of(frame, len(built))
        avoids = view.field and motion.arm is not None and not view.level
        arrows = view.field and not avoids
        field, colour = arrows_and_colour(system, area, clearance, view.colour, arrows=arrows, coarse=coarse)
        by_map = view.colour == "occupancy"
        return Pictures(
            field=self._carried(frame) if avoids else field,
            streamlines=streamlines(system, area, clearance, coarse=coarse) if view.streamlines else None,
            colour=colour,
            generator=own.generator(area, view.generator_layer) if view.generator else None,
            grid=own.grid(area, [layer.made.transform for layer in built], coarse=coarse) if view.grid else None,
            panels=_panels(frame, books, coarse=coarse) if view.panels else (),
            occupancy=occupancy_picture(area, motion.scenario.obstacles, coarse=coarse) if by_map else None,
        )

    def _carried(self, frame: Frame) -> FieldPicture:
        motion, robot = frame.motion, self._follower.robot
        assert motion.arm is not None
        postures = self._postures(frame, self._follower.reference(motion.nominal))
        return postures.carried(self._velocities(frame), motion.arm.transform, robot, motion.scenario.obstacle)

    @kept(NUM_BOOKS, by=lambda learned, at: (learned, at.tobytes()))
    def _book(self, learned: Learned, at: Array) -> Sketchbook:
        """The maker of pictures of ψ, at one phase and for one condition."""
        shown, system = learned.demonstrated, frozen(learned.system, at)
        rays = Rays(system.transform.forward(shown.starts), system.base)
        return Sketchbook(learned.task, in_frame(learned.system.transform), system, rays, shown.paths)

    @kept(2, by=lambda frame, near: (frame.motion.scenario.task, frame.scenario.view.slice, near.tobytes()))
    def _postures(self, frame: Frame, near: Array) -> Lattice:
        """The postures that hold the hand at the lattice, `near` one (n,), rad."""
        return Lattice.of(lattice(frame), self._follower.robot, near)

    @kept(2, by=_stacked)
    def _velocities(self, frame: Frame) -> Array:
        return velocities(frame, self._learned_velocities(frame))

    @kept(2, by=_learned)
    def _learned_velocities(self, frame: Frame) -> Array:
        """Velocities (M, 3) of the learned motion at the lattice, m/s."""
        return system_of(frame, 0).velocity(lattice(frame))


def _panels(frame: Frame, books: Mapping[Panel | None, Sketchbook], *, coarse: bool) -> tuple[PanelPicture, ...]:
    """The panels of a view, side by side, and the frame of the scene's own slice."""
    scenario, panels, area, task = frame.motion.scenario, frame.scenario.view.panels, frame.slice, frame.task
    made = [_panel(panel, frame, books[panel.shown], coarse=coarse) for panel in panels]
    shown = [picture for picture in made if picture is not None]
    widest = np.max([area.half_size, *(picture.area.half_size for picture in shown)], axis=0)
    places = offsets(area, widest, len(shown), task.camera)
    beside = [
        replace(picture, offset=area.centre - picture.area.centre + by)
        for picture, by in zip(shown, places, strict=True)
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


def _panel(panel: Panel, frame: Frame, book: Sketchbook, *, coarse: bool) -> PanelPicture | None:
    """A panel where the slice is, whose motion is in the book; None for that of a level which is off."""
    area, stack, names = frame.slice, frame.motion.stack, levels(frame.motion.scenario)
    if panel.task:
        return book.imitation(book.task.slice, PLAIN_TITLE if panel.state == "plain" else book.task.title)
    if panel == BASE_PANEL:
        return book.base(area, frame.scenario.view.grid)
    if panel.level not in names:
        return None
    level, title = names.index(panel.level), f"field −V of {_name(panel.level)}"
    if level == 0:
        return book.generating(area, title) if panel.generator else book.imitation(area, _title(panel.level))
    if panel.generator:
        return generator_panel(title, stack.built[level - 1].made.transform, area)
    paths = tuple(path for path in frame.levels[level] if len(path))
    avoided = _avoided(stack.built[:level])
    return system_panel(_title(panel.level), system_of(frame, level), paths, area, avoided, coarse=coarse)


def _title(level: str) -> str:
    """What is written over the panel of a level: what is added to the one before."""
    return ("" if level == IMITATION else "+ ") + _name(level)


def _name(level: str) -> str:
    return level[:1].lower() + level[1:]


def _avoided(built: Sequence[Applied]) -> Union:
    """What these transforms avoid: no motion comes into it."""
    return Union(tuple(part for applied in built for part in applied.transform.avoided.parts))
