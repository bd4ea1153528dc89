"""What a frame is made of: rollouts, the arm along one of them, profiles, and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from dt_viz.flows.augmented_systems import frozen
from dt_viz.flows.diffeomorphisms import Chain, Flow, Identity
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import Bundle
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.motion.certificates import Certificates
from dt_viz.motion.diagnostics import anchor_warnings, motion_warnings, target_warnings
from dt_viz.motion.following import ArmMotion, Follower, arm_samples, far_starts, unreachable
from dt_viz.motion.nominal import Nominal
from dt_viz.motion.profiles import Profiles, body_profile, hand_profile
from dt_viz.motion.solve import Solved
from dt_viz.motion.stack import Applied, Solution, cut_off
from dt_viz.obstacles.union import Union
from dt_viz.pictures.occupancy import occupancy_picture
from dt_viz.pictures.panels import PanelPicture, generator_panel, system_panel
from dt_viz.pictures.sketchbook import BASE_TITLE, Pictures, Sketchbook, in_frame
from dt_viz.pictures.slice_fields import ARROW_SPACING, arrows_and_colour, streamlines
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.retiming import within_velocity_limits
from dt_viz.scenario.panels import BASE_PANEL, Panel, offsets
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.stack import IMITATION, levels
from dt_viz.scenario.starts import followed
from dt_viz.session.frame import Frame, Stage
from dt_viz.warning import MotionWarning

PLAIN_TITLE, AUGMENTED_TITLE = "plain: one field for all", "augmented: remembers its phase"
"""What is written over the two states, where they are side by side."""


def rollouts_frame(scenario: Scenario, solved: Solved, follower: Follower) -> Frame:
    """The frame of stage ROLLOUTS."""
    nominal, stack, arm = solved.nominal, solved.stack, solved.arm
    if arm is None:
        index, fraction, positions = stack.bundle.index, stack.bundle.fraction, stack.bundle.positions
        clearance = float(scenario.obstacle.signed_distance(positions).min())
    else:
        index, fraction, positions = arm.index, arm.fraction, follower.robot.end_effector(arm.p)
        clearance = arm.clearance
    shown = Bundle(index, fraction, positions[:, None])
    reached = positions[-1]
    warnings = motion_warnings(solved, float(np.linalg.norm(reached - nominal.goal)))
    warnings += anchor_warnings(stack)
    if scenario.avoids and scenario.warp == 1:
        warnings += target_warnings(solved, follower.robot)
    made = [stack.at(place) for place in range(len(scenario.stack))]
    return Frame(
        scenario=scenario,
        task=nominal.task,
        stage=Stage.ROLLOUTS,
        ghost=nominal.paths,
        rollouts=shown.paths,
        chosen=_chosen(scenario, nominal),
        times=shown.split(stack.rays.times(index, fraction)),
        levels=tuple(stack.bundle.split(level) for level in np.moveaxis(stack.bundle.levels, 1, 0)),
        level=level_of(scenario, stack),
        goal=nominal.goal,
        reached=reached,
        num_added=nominal.num_added,
        blocked=(),
        certificates=Certificates(clearance, found=warnings),
        remembers=nominal.imitation.state == "augmented",
        reason=nominal.imitation.reason,
        labels=nominal.learned.demonstrated_labels,
        learned_steps=_learned_steps(nominal),
        durations=tuple(applied.made.duration if applied else None for applied in made),
        chosen_values=tuple(applied.made.chosen if applied else {} for applied in made),
        arm_duration=arm.duration if arm else None,
        passing=solved.passing,
    )


def with_arm(frame: Frame, solved: Solved, follower: Follower, *, moves: bool = True) -> Frame:
    """The frame with the arm's motion along the rollout that it follows, and with the starts that it cannot get to.

    Args:
        frame: the rollouts.
        solved: the motion that they are of.
        follower: the arm.
        moves: whether its motion is wanted.
    """
    nominal = solved.nominal
    arm, warnings = None, ()
    try:
        far = follower.out_of_reach(nominal)
        if moves and frame.chosen is not None and not far[frame.chosen]:
            arm, warnings = arm_along(frame, solved, frame.chosen, follower)
        warnings += tuple(far_starts(np.array(nominal.numbers)[far], nominal.num_demonstrated))
    except UnreachableError as error:
        warnings = (unreachable(error),)
    return replace(frame, arm=arm, certificates=frame.certificates.warning(*warnings))


def arm_along(
    frame: Frame, solved: Solved, rollout: int, follower: Follower
) -> tuple[ArmMotion, tuple[MotionWarning, ...]]:
    """The arm's motion along a rollout, and what is wrong with it.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    nominal, times = solved.nominal, frame.times[rollout]
    if solved.arm is not None and solved.lifted is not None:
        rows, joints = solved.arm.index == rollout, solved.lifted.tracked
        q, fraction = solved.arm.p[rows], solved.arm.fraction[rows]
    else:
        bundle, path = solved.stack.bundle, frame.rollouts[rollout]
        keep = arm_samples(len(path))
        joints = follower.along(nominal, path[keep])
        q, times, fraction = joints.q, times[keep], bundle.split(bundle.fraction)[rollout][keep]
    warnings = follower.warnings(joints, nominal.numbers[rollout])
    without = follower.undisturbed_along(nominal, rollout).at(np.zeros(len(fraction), int), fraction)
    return ArmMotion(within_velocity_limits(times, q, follower.robot.velocity_limits), q, without), warnings


def profiles(frame: Frame, solved: Solved, chosen: int, follower: Follower) -> Profiles:
    """Profiles of a rollout, with and without behaviours."""
    nominal = solved.nominal
    obstacle, arm, task = frame.scenario.obstacle, solved.arm, nominal.task
    path, undisturbed = frame.rollouts[chosen], nominal.paths[chosen]
    number, stack = nominal.numbers[chosen], solved.stack
    potential = nominal.system.lyapunov(nominal.states_of(chosen))
    of_mean = number >= nominal.num_demonstrated
    demonstration = task.mean_path if of_mean else task.paths[number]
    if arm is None:
        rows = stack.bundle.index == chosen
        samples = stack.bundle.index[rows], stack.bundle.fraction[rows]
        return Profiles(
            hand_profile(path, demonstration, stack.system.lyapunov(stack.states(*samples, path)), obstacle),
            hand_profile(undisturbed, demonstration, potential, obstacle),
            of_mean=of_mean,
        )
    rows, fraction = arm.index == chosen, nominal.trajectories[chosen].fraction
    p = arm.p[rows]
    below = follower.robot.end_effector(arm.transform.forward(p))
    q = follower.undisturbed_along(nominal, chosen).at(np.zeros(len(fraction), int), fraction)
    clearance = follower.whole_arm.clearance
    values = stack.system.lyapunov(stack.states(arm.index[rows], arm.fraction[rows], below))
    return Profiles(
        body_profile(path, demonstration, values, clearance(p, obstacle)),
        body_profile(undisturbed, demonstration, potential, clearance(q, obstacle)),
        of_body=True,
        of_mean=of_mean,
    )


def pictures(
    scenario: Scenario,
    solved: Solved,
    books: Mapping[Panel, Sketchbook],
    *,
    arrows: bool,
    coarse: bool,
) -> Pictures:
    """The pictures that the view shows, on its slice and of its level.

    Args:
        scenario: whose view it is.
        solved: the motion.
        books: make the pictures of ψ, by what a panel would show: for its own task as far as the motion is warped, and
            for those on its panels.
        arrows: whether the hand's velocities are among them.
        coarse: whether they are to follow a drag.
    """
    nominal, stack, view = solved.below, solved.stack, scenario.view
    area = nominal.task.slice.posed(view.slice)
    level = level_of(scenario, stack)
    built = stack.built[:level]
    system = frozen(stack.system if level is None else cut_off(nominal, stack, level), rest(scenario, solved))
    clearance, book = _avoided(built).signed_distance, books[Panel(task=scenario.task)]
    field, colour = arrows_and_colour(system, area, clearance, view.colour, arrows=arrows, coarse=coarse)
    return Pictures(
        field=field,
        streamlines=streamlines(system, area, clearance, coarse=coarse) if view.streamlines else None,
        colour=colour,
        generator=book.generator(area, view.generator_layer) if view.generator else None,
        grid=book.grid(area, [applied.made.transform for applied in built], coarse=coarse) if view.grid else None,
        panels=_panels(scenario, solved, books, coarse=coarse) if view.panels else (),
        occupancy=occupancy_picture(area, scenario.obstacles, coarse=coarse) if view.colour == "occupancy" else None,
    )


def rest(scenario: Scenario, solved: Solved) -> Array:
    """Phase and condition at which augmented motions are shown on the slice; empty for plain ones.

    The condition is that of the rollout which the arm follows.
    """
    held = solved.below.rest(_chosen(scenario, solved.below) or 0)
    held[:1] *= scenario.view.phase
    return held


def lattice(scenario: Scenario, solved: Solved) -> Array:
    """Places (M, 3) of the arrows on the view's slice, metres."""
    return solved.below.task.slice.posed(scenario.view.slice).grid(ARROW_SPACING).reshape(-1, 3)


def learned_system(scenario: Scenario, solved: Solved) -> DiffeomorphicSystem:
    """The learned motion of places (3,), without what is stacked on it, at the phase that the slice shows."""
    return frozen(cut_off(solved.below, solved.stack, 0), rest(scenario, solved))


def velocities(scenario: Scenario, solved: Solved, learned: Array) -> Array:
    """The hand's velocities (M, 3) at the lattice, m/s, of the whole stack below the arm's avoidance.

    Places inside an obstacle have none, NaN. They are `learned` (M, 3) where the stack moves nothing.
    """
    points, built = lattice(scenario, solved), solved.stack.built
    free = _avoided(built).signed_distance(points) > 0
    stacked = Chain([Identity(3), *(applied.made.transform for applied in built)])
    spread = np.full_like(points, np.nan)
    below, carried = stacked.forward(points[free]), learned[free]
    moved = (below != points[free]).any(axis=1)
    carried[moved] = learned_system(scenario, solved).velocity(below[moved])
    spread[free] = stacked.inverse_tangents(below, carried[..., None])[1][..., 0]
    return spread


def _panels(
    scenario: Scenario, solved: Solved, books: Mapping[Panel, Sketchbook], *, coarse: bool
) -> tuple[PanelPicture, ...]:
    """The panels of a view, side by side, and the frame of the scene's own slice."""
    task, names = solved.below.task, levels(scenario)[: 1 + len(solved.stack.built)]
    area = task.slice.posed(scenario.view.slice)
    made = [_panel(panel, scenario, solved, books, area, coarse=coarse) for panel in scenario.view.panels]
    shown = [picture for picture in made if picture is not None]
    widest = np.max([area.half_size, *(picture.area.half_size for picture in shown)], axis=0)
    places = offsets(area, widest, len(shown), task.camera)
    beside = [
        replace(picture, offset=area.centre - picture.area.centre + by)
        for picture, by in zip(shown, places, strict=True)
    ]
    if any(panel.state == "plain" for panel in scenario.view.panels):
        title = AUGMENTED_TITLE
    elif any(panel.task for panel in scenario.view.panels):
        amount = f"{scenario.style_amount:g}".replace("-", "−")
        title = f"{task.title}, {scenario.style} × {amount}" if scenario.style else task.title
    else:
        title = _title(names[-1]) if scenario.imitation or len(names) > 1 else BASE_TITLE
    return (*beside, PanelPicture(title, area))


def _panel(
    panel: Panel,
    scenario: Scenario,
    solved: Solved,
    books: Mapping[Panel, Sketchbook],
    area: Slice,
    *,
    coarse: bool,
) -> PanelPicture | None:
    """A panel where the slice is; None for that of a level which is off."""
    book, stack = books[panel.shown or Panel(task=scenario.task)], solved.stack
    names = levels(scenario)[: 1 + len(stack.built)]
    if panel.task:
        return book.imitation(book.task.slice, PLAIN_TITLE if panel.state == "plain" else book.task.title)
    if panel == BASE_PANEL:
        return book.base(area, grid=scenario.view.grid)
    if panel.level not in names:
        return None
    level, title = names.index(panel.level), f"field −V of {_name(panel.level)}"
    if level == 0:
        return book.generating(area, title) if panel.generator else book.imitation(area, _title(panel.level))
    if panel.generator:
        return generator_panel(title, stack.built[level - 1].made.transform, area)
    return system_panel(
        _title(panel.level),
        frozen(cut_off(solved.below, stack, level), rest(scenario, solved)),
        stack.bundle.split(stack.bundle.levels[:, level]),
        area,
        _avoided(stack.built[:level]),
        coarse=coarse,
    )


def _title(level: str) -> str:
    """What is written over the panel of a level: what is added to the one before."""
    return ("" if level == IMITATION else "+ ") + _name(level)


def _name(level: str) -> str:
    """Name of a level within a line."""
    return level[:1].lower() + level[1:]


def _avoided(built: Sequence[Applied]) -> Union:
    """What these transforms avoid: no motion comes into it."""
    return Union(tuple(part for applied in built for part in applied.transform.avoided.parts))


def _chosen(scenario: Scenario, nominal: Nominal) -> int | None:
    """Index of the rollout that the arm follows: the first one where that from a task's start is left out."""
    number = followed(scenario, nominal.num_demonstrated)
    chosen = nominal.rollout(number)
    return 0 if chosen is None and number < nominal.num_demonstrated else chosen


def _learned_steps(nominal: Nominal) -> tuple[int, ...]:
    flows = in_frame(nominal.system.transform)
    return () if flows is None else tuple(flow.steps for flow in flows.parts if isinstance(flow, Flow))


def level_of(scenario: Scenario, stack: Solution) -> int | None:
    """Index of the level that the view names; None if that is not in the stack."""
    names = levels(scenario)[: 1 + len(stack.built)]
    return names.index(scenario.view.level) if scenario.view.level in names else None
