"""A visitor's own recordings, seen before they are learned: what was found, what is done about it, and their task."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.errors import Cancelled, FormatError, never, parsing
from dt_viz.files.columns import UNITS
from dt_viz.files.reading import read_upload
from dt_viz.files.recordings import Answers, Recordings
from dt_viz.files.takes import UNTIMED, Take, in_si_units
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration, DemonstrationError, demonstrations_of
from dt_viz.learning.inspection import Inspection, PreparationSettings
from dt_viz.learning.preparation import ImitationError, Motions, NoCommonGoalError, prepare
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.placement import Placement, fitting, follows, resampled
from dt_viz.robot.robot import Robot
from dt_viz.saving import sent_motion_task
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import OWN, Task, TaskEntry, own_task
from dt_viz.scenario.taught import Lesson, Taught
from dt_viz.session.history import MAX_UNDO
from dt_viz.session.tasks_in_reach import in_reach
from dt_viz.session.teaching import SETTINGS, crosses_itself, drawn_beyond
from dt_viz.warning import in_metres

LENGTHS = tuple(unit for unit, (kind, _) in UNITS.items() if kind == "length")
"""Units of positions that may be chosen."""
USUAL_RATES = (5.0, 10.0, 20.0, 25.0, 30.0, 50.0, 60.0, 100.0, 125.0, 200.0, 240.0, 250.0, 500.0, 1000.0)
"""Rates that recorders have, Hz; of takes without times the one is guessed with which they last about 5 s."""


@dataclass(frozen=True)
class Choices:
    """What a visitor chooses about the takes that are open."""

    unit: str = ""
    """Unit of lengths, of `LENGTHS`, where files do not say it; empty where it is recognised."""
    rate: float | None = None  # samples a second of takes without times, Hz; None is guessed
    left_out: frozenset[int] = frozenset()  # numbers of takes that are left out by choice
    goal: int = 0  # number of the goal, where the takes have several
    preparation: PreparationSettings = field(default_factory=PreparationSettings)
    """What is done to takes."""
    fits_reach: bool = False
    """Whether the task is scaled and moved into the arm's reach where it is not in it."""


@dataclass(frozen=True)
class Opened:
    """What a visitor has opened, and taught."""

    files: tuple[tuple[str, bytes], ...] = ()  # names and contents
    answers: Mapping[str, Any] = field(default_factory=dict)
    """What was answered to the files' questions, by what these are about."""
    recordings: Recordings = field(default_factory=Recordings)  # what was read of the files
    num_read: int = 0  # number of files of which they were read
    choices: Choices = field(default_factory=Choices)
    taught: tuple[Taught, ...] = ()
    """Takes that were taught in the page; they come after those of files."""
    past: tuple[Lesson, ...] = ()  # what was taught before each step to undo, the last one last
    future: tuple[Lesson, ...] = ()  # what was taught after each step to redo, the next one last

    @classmethod
    def again(cls, lesson: Lesson, preparation: PreparationSettings | None = None) -> Opened:
        """Return what was taught, as it was before it was learned from with settings of the preparation."""
        settings = PreparationSettings() if preparation is None else replace(preparation, goal=None)
        choices = Choices(left_out=frozenset(lesson.left_out), preparation=settings)
        return cls(choices=choices, taught=lesson.takes)

    @property
    def lesson(self) -> Lesson:
        """What is taught."""
        return Lesson(self.taught, tuple(sorted(self.choices.left_out)))

    @property
    def kept(self) -> tuple[Demonstration, ...]:
        """What is kept of the takes that were taught."""
        return tuple(each.kept for each in self.taught)

    @property
    def steps(self) -> tuple[bool, bool]:
        """Whether there is a take to undo, and to redo."""
        return bool(self.past), bool(self.future)

    def with_take(self, take: Taught) -> Opened:
        """Return this with one more take, as a step for undo."""
        return self._step(replace(self.lesson, takes=(*self.taught, take)))

    def without(self, number: int, name: str) -> Opened:
        """Return this without the take of a number among all, and of a name, if that was taught: a step for undo."""
        left = self.lesson.without(number, name)
        return self if left.takes is self.taught else self._step(left)

    def undone(self) -> Opened:
        """Return this without the last step, if there is one."""
        if not self.past:
            return self
        *past, there = self.past
        return replace(self._with(there), past=tuple(past), future=(*self.future, self.lesson))

    def redone(self) -> Opened:
        """Return this with the step that was undone last, if there is one."""
        if not self.future:
            return self
        *future, there = self.future
        return replace(self._with(there), past=(*self.past, self.lesson), future=tuple(future))

    def _step(self, there: Lesson) -> Opened:
        return replace(self._with(there), past=(*self.past, self.lesson)[-MAX_UNDO:], future=())

    def _with(self, lesson: Lesson) -> Opened:
        return replace(self, taught=lesson.takes, choices=replace(self.choices, left_out=frozenset(lesson.left_out)))


@dataclass(frozen=True, eq=False)
class SeenTake:
    """One take, and what becomes of it."""

    inspection: Inspection
    given: Array  # (T, 3) positions as they were recorded, placed, metres
    learned: Array | None
    """(S, 3) positions that are learned from, placed, metres; None where it is left out."""
    is_chosen: bool  # whether the visitor has not left it out
    is_far: bool = False  # whether the arm cannot follow it


@dataclass(frozen=True, eq=False)
class Preview:
    """What would be learned of takes."""

    takes: tuple[SeenTake, ...]  # all of them, in their order
    task: Task | None = None
    """The task of those that are learned from, placed; None where nothing can be learned."""
    goal: Array | None = None  # (3,) its goal, metres
    goals: tuple[str, ...] = ()  # the goals, if there are several: what ends there, and where
    goal_number: int = 0  # number of the one that is learned
    unit: str = ""  # unit of lengths that is asked for; empty if it is clear
    rate: float | None = None  # rate that is asked for, Hz; None if the files say it
    notes: tuple[str, ...] = ()
    """What is to be known about the files, and about takes that cannot be used."""
    reach: str = ""  # what is out of the arm's reach, and what would fit; empty if nothing is
    problem: str = ""  # why nothing can be learned
    drawn: tuple[Array, ...] = ()
    """Places (N_i, 3) of the pointer in takes that were taught, metres."""
    beyond: tuple[Array, ...] = ()
    """Pieces (K_i, 3) of these that are out of the arm's reach, metres."""


def read(
    files: Sequence[tuple[str, bytes]], answers: Answers, robot: Robot, cancelled: Cancelled = never
) -> Recordings:
    """Read files, each a name and its content, in another process.

    Raises:
        DemonstrationError: none of them can be read.
        UnwantedError: nobody wants it any more.
    """
    name = files[0][0] if len(files) == 1 else f"{len(files)} files"
    with parsing(DemonstrationError, name, "file", "recorded motions"):
        return read_upload(Recordings, files, cancelled, answers=answers, joint_names=[*robot.joint_names])


def read_motion(name: str, content: bytes, robot: Robot, cancelled: Cancelled = never) -> Task:
    """Read a saved motion, the name and the content of its file, as a task; a drawing is placed in the arm's reach.

    Raises:
        DataError: it cannot be read, or has what the page has not.
        UnwantedError: nobody wants it any more.
    """
    task = sent_motion_task(name, content, cancelled)
    is_drawing = task.demonstrations[0].dimension == 2
    return in_reach({OWN: TaskEntry(task.title, lambda: task, not is_drawing)}, robot)[OWN]()


def preview(recordings: Recordings, choices: Choices, robot: Robot, taught: Sequence[Taught] = ()) -> Preview:
    """Inspect takes, recorded and taught, and place their task; `with_reach` asks the arm afterwards.

    Raises:
        DemonstrationError: no take can be used.
    """
    recordings = replace(recordings, takes=(*recordings.takes, *(each.take for each in taught)))
    takes = [_copied(take) for take in recordings.takes]
    rate = _rate(takes, choices)
    if choices.unit:
        takes = [replace(take, units={"length": UNITS[choices.unit][1]} | take.units) for take in takes]
    is_open = any(take.positions is not None and "length" not in take.units for take in recordings.takes)
    takes, note = in_si_units(takes, len(robot.joint_names))
    note = note.replace("unit=…", "“Unit”")
    used, refused = _usable(takes, robot)
    recognised = next((unit for unit in LENGTHS if note.startswith(f"taken as in {unit} ")), "m")
    wide = max(float(np.abs(own.positions).max()) for own in used) > robot.reach
    unit = (choices.unit or recognised) if is_open and (note or choices.unit or wide) else ""
    said = tuple(dict.fromkeys([*recordings.refused, *refused, *recordings.notes, *([note] if note else [])]))
    board = next((each.board for each in taught if each.board is not None), None)
    seen = _inspected(used, choices, robot, board)
    drawn = tuple(each.drawn for each in taught)
    beyond = tuple(drawn_beyond(robot, drawn))
    long = [f"{each.name} ({each.kept.duration:.0f} s)" for each in taught if each.kept.duration > SETTINGS.longest]
    kept = f"{SETTINGS.most_points} points are used, evenly chosen: what is quicker than these is lost"
    said += (f"of takes longer than {SETTINGS.longest:.0f} s, {', '.join(long)}, {kept}",) * bool(long)
    if taught and seen.task is not None:  # the plain state takes seconds, and cannot cross
        left_out = () if recordings.takes[: -len(taught)] else tuple(sorted(choices.left_out))
        seen = replace(seen, task=replace(seen.task, state="augmented", lesson=Lesson(tuple(taught), left_out)))
        crossing = [each.name for each in taught if crosses_itself(each.kept.positions)]
        which = "the augmented state, which remembers the phase, can"
        said += (f"what crosses itself ({', '.join(crossing)}) no plain motion follows: {which}",) * bool(crossing)
    return replace(seen, unit=unit, rate=rate, notes=said, drawn=drawn, beyond=beyond)


def with_reach(seen: Preview, choices: Choices, robot: Robot) -> Preview:
    """Say which takes the arm cannot follow, and at which scale it can; scale them so if that is chosen."""
    if seen.task is None:
        return seen
    paths = [resampled(take.learned, 40) for take in seen.takes if take.learned is not None]
    far = [not follows(robot, path[None]) for path in paths]
    if not any(far):
        return seen
    is_far = iter(far)
    takes = tuple(replace(take, is_far=take.learned is not None and next(is_far)) for take in seen.takes)
    some = f"{sum(far)} of {len(far)} takes leave the reach of {robot.title}"
    try:
        fits = fitting(robot, np.array(paths), 1.0)
    except UnreachableError as error:
        return replace(seen, takes=takes, reach=f"{some}; {error}")
    where = f"{fits.scale:.2g} × their size, moved by {in_metres(fits.shift)}"
    if not choices.fits_reach:
        return replace(seen, takes=takes, reach=f"{some}; the largest that fits is {where}")
    return replace(_moved(seen, fits), reach=f"{some}; they are learned at {where}")


def _moved(seen: Preview, fits: Placement) -> Preview:
    assert seen.task is not None and seen.goal is not None
    takes = tuple(
        replace(take, given=fits(take.given), learned=None if take.learned is None else fits(take.learned))
        for take in seen.takes
    )
    drawn = tuple(fits(path) for path in seen.drawn)
    task = seen.task.placed(fits.scale, fits.shift)
    return replace(seen, takes=takes, task=task, goal=fits(seen.goal), drawn=drawn, beyond=())


def _copied(take: Take) -> Take:
    copies = {name: np.array(value) for name in ("positions", "joints") if (value := getattr(take, name)) is not None}
    return replace(take, **copies)


def _rate(takes: list[Take], choices: Choices) -> float | None:
    """Rate of takes without times, which these are given; None where all have times."""
    untimed = [k for k, take in enumerate(takes) if not take.is_timed]
    if not untimed:
        return None
    usual = np.log(max(np.median([len(takes[k].times) for k in untimed]) - 1, 1) / UNTIMED)
    rate = choices.rate or min(USUAL_RATES, key=lambda rate: abs(np.log(rate) - usual))
    for k in untimed:
        takes[k] = replace(takes[k], times=np.arange(len(takes[k].times)) / rate)
    return rate


def _usable(takes: Sequence[Take], robot: Robot) -> tuple[list[Demonstration], list[str]]:
    """Demonstrations of the takes that are of the kind of most, and a line for each that cannot be used."""
    used: list[tuple[bool, Demonstration]] = []
    refused: list[str] = []
    errors: list[DemonstrationError] = []
    for take in takes:
        try:
            (own,) = demonstrations_of([(Path(take.name), [take], ())], take.name, robot)
            used.append((take.joints is None, own))
        except DemonstrationError as error:
            errors.append(error)
            refused.append(f"not used: {error}")
    kinds = Counter((of_hand, own.dimension) for of_hand, own in used)
    if not kinds:
        raise errors[0] if errors else DemonstrationError("recordings", "takes", "none", "at least one motion")
    (kind, _), *_ = kinds.most_common(1)
    words = {True: "places of the hand", False: "joint angles"}
    for of_hand, own in used:
        if (of_hand, own.dimension) != kind:
            what = f"{words[of_hand]} of {own.dimension} coordinates"
            accepted = f"{words[kind[0]]} of {kind[1]} coordinates, as in most takes"
            refused.append(f"not used: {FormatError(repr(own.name), what, accepted)}")
    return [own for of_hand, own in used if (of_hand, own.dimension) == kind], refused


def _inspected(used: Sequence[Demonstration], choices: Choices, robot: Robot, board: Slice | None) -> Preview:
    chosen = [k for k in range(len(used)) if k not in choices.left_out]
    settings, goals, goal_number, problem = choices.preparation, (), 0, ""
    found: dict[int, Inspection] = {}
    numbers, motions = chosen, None
    try:
        try:
            numbers, motions = _prepared(used, chosen, settings, found)
        except NoCommonGoalError as error:
            goals = tuple(text for text, _ in error.goals)
            goal_number = min(choices.goal, len(goals) - 1)
            settings = replace(settings, goal=error.goals[goal_number][1])
            numbers, motions = _prepared(used, chosen, settings, found)
    except ImitationError as error:
        problem = str(error) if chosen else "Every take is left out; choose at least one."
    kept = numbers if motions is not None else range(len(used))
    given = replace(
        own_task(tuple(used[k] for k in kept)), preparation=settings, seen=() if motions is None else motions.warnings
    )
    # drawings of files are placed; those on the board, and positions in space, are where they are
    task = given
    if used[0].dimension == 2 and board is None:
        task = in_reach({OWN: TaskEntry(given.title, lambda: given)}, robot)[OWN]()
    elif used[0].dimension == 2 and board is not None:
        task = given.placed(1 / given.scale, board.centre - given.origin / given.scale)
    learned = {} if motions is None else dict(zip(numbers, motions.positions, strict=True))
    takes = tuple(
        SeenTake(
            found.get(k) or Inspection(own.name, own.duration, len(own.times), kept=False),
            task.to_world(own.positions),
            task.to_world(learned[k]) if k in learned else None,
            is_chosen=k not in choices.left_out,
        )
        for k, own in enumerate(used)
    )
    if motions is None:
        return Preview(takes, goals=goals, goal_number=goal_number, problem=problem)
    return Preview(takes, task, task.to_world(motions.goal), goals, goal_number)


def _prepared(
    used: Sequence[Demonstration], numbers: list[int], settings: PreparationSettings, found: dict[int, Inspection]
) -> tuple[list[int], Motions]:
    """Prepare takes, again without those that are left out: what is seen is what is learned from. `found` gets all."""
    while True:
        motions = prepare([used[k] for k in numbers], settings)
        found.update(zip(numbers, motions.inspections, strict=True))
        if len(motions.numbers) == len(numbers):
            return numbers, motions
        numbers = [numbers[k] for k in motions.numbers]
