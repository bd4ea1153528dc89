"""The button "Open a file", and the folder "Your data": a visitor's recordings, seen before they are learned."""

from __future__ import annotations

import html
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import viser

from dt_viz.errors import DataError
from dt_viz.files.recordings import ARCHIVE, AXES, NO_COLUMN
from dt_viz.files.takes import READERS
from dt_viz.learning.demonstrations import WRITERS
from dt_viz.learning.inspection import FindingKind
from dt_viz.obstacles.files import MESH_SUFFIXES
from dt_viz.saving import is_motion
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.scenario.taught import MAX_TAKES, Lesson
from dt_viz.session import opening
from dt_viz.session.history import Beside
from dt_viz.session.opening import LENGTHS, USUAL_RATES, Choices, Opened, Preview
from dt_viz.session.session import Session
from dt_viz.session.teaching import Stroke, taught
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.ui.gate import MAX_UPLOAD
from dt_viz.ui.host import Host
from dt_viz.ui.pen import Kind, Pen
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scripts import drop_html
from dt_viz.ui.tabs.from_file import LANE, turn
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.takes_table import seen_html
from dt_viz.warning import Severity

FORMATS = ", ".join(suffix[1:] for suffix in (*READERS, ARCHIVE))
SWITCHES: Mapping[FindingKind, tuple[str, str, str]] = {
    "units": ("convert_units", "Convert units", "of takes that seem to be in another unit than the others"),
    "outliers": ("drop_outliers", "Drop outliers", "single samples far off"),
    "gap": ("bridge_gaps", "Bridge gaps", "times without samples, by a curve; otherwise by a straight line"),
    "jitter": ("smooth_jitter", "Smooth jitter", "faster trembling than a hand means to move"),
    "pause": ("cut_pauses", "Cut pauses", "times in which a take stands still, and most others do not"),
    "end": ("move_ends", "Move ends", "to the goal; otherwise takes that end beside it are left out"),
    "elsewhere": (
        "leave_out",
        "One goal only",
        "takes that end elsewhere are left out; otherwise their ends are moved",
    ),
}
"""What is done about a kind of finding: the field of `PreparationSettings`, label and hint of its switch."""
CHOOSING, SEEING = "opening", "preview"
"""Lanes of the session's jobs on which what is open is changed, and on which it is inspected."""
READINGS = {"t,x,y": "times", "x,y,z": "x, as the next ones are y and z"}
"""What the first of three columns without names is, by the reading of all three."""


class OpenPanel:
    """The folder of one visitor's panel, and the button that takes files."""

    def __init__(
        self,
        gui: viser.GuiApi,
        bindings: Bindings,
        page: Host,
        learn: Callable[[Session, Task], None],
        take: Callable[[str, bytes], bool],
    ) -> None:
        """Build the controls where the panel is being built; `learn` begins with a task of the visitor's own.

        `take` is given the name and the content of each file first, and returns whether it holds something else.
        """
        self._bindings, self._page, self._learn, self._take = bindings, page, learn, take
        self.pen = Pen(page)  # what a visitor teaches with
        self._changing = threading.RLock()  # one thread reads, another inspects, and handlers close what is open
        self._opened = Opened()
        self._seen: Preview | None = None  # what is shown of it
        hint = (
            "a saved scenario; a motion that the library has saved; "
            f"demonstrations of your own: {FORMATS}, several at once, or a zip of a folder; "
            f"a mesh: {', '.join(suffix[1:] for suffix in MESH_SUFFIXES)}"
        )
        self.upload = gui.add_upload_button("Open a file, or drop it here", icon=viser.Icon.FOLDER_OPEN, hint=hint)
        gui.add_html(drop_html(self.upload, MAX_UPLOAD))
        self.folder = gui.add_folder("Your data", visible=False)
        with self.folder:
            self.table = gui.add_html("")
            self.controls = self._add_controls(gui)
            start = gui.add_button(
                "Learn", color=LIGHT.brand, disabled=True, hint="a motion from the takes that are used"
            )
            cancel = gui.add_button("Cancel", color="gray", hint="lets go of what is open here")
        self.controls["learn"] = self.control(start, lambda _pressed: self._press())
        self.control(cancel, lambda _pressed: self.close())
        bindings.show(lambda s: (s.task, s.scene), lambda _chosen: self.close(keeps=True))
        bindings.show(lambda s: s.arm, lambda _arm: self._again())
        bindings.show(lambda _: None if bindings.frame is None else bindings.frame.task, self._learned)

        @self.upload.on_upload
        async def _(_event: viser.GuiEvent) -> None:
            file = self.upload.value
            self.later(partial(self.load, file.name, file.content))

    def later(self, work: Callable[[], None]) -> None:
        """Do work on what is open, one after the other, beside the server's event loop."""
        self._bindings.session.jobs.submit(CHOOSING, work)

    def control(self, handle: Any, act: Callable[[Any], None]) -> Control:  # noqa: ANN401 - handles of all kinds
        """Act on each value of an input, or press of a button."""
        return Control(handle, lambda value: self.later(partial(act, value)))

    def _add_controls(self, gui: viser.GuiApi) -> dict[str, Control]:
        """Build what is shown only where it is asked for, by names of their own."""
        at, found = self._choose, {}

        def dropdown(name: str, label: str, options: tuple[str, ...], act: Callable[[str], Any], hint: str) -> None:
            found[name] = self.control(gui.add_dropdown(label, options, hint=hint, visible=False), act)

        dropdown("take", "Take", (NO_COLUMN,), self._point, "the take that is named in the scene")
        box = gui.add_checkbox("Use this take", True, visible=False, hint="learn from it, too")
        found["chosen"] = self.control(box, self._leave_out)
        button = gui.add_button("Delete this take", icon=viser.Icon.TRASH, color="gray", visible=False)
        found["delete"] = self.control(button, lambda _pressed: self._delete())
        group = gui.add_button_group("Download", tuple(WRITERS), hint="the takes that you have taught", visible=False)
        send = lambda kind: self._page.send(f"-takes.{kind}", WRITERS[kind](self._opened.kept))  # noqa: E731
        found["download"] = self.control(group, send)
        for kind, (name, label, hint) in SWITCHES.items():
            box = gui.add_checkbox(label, True, hint=hint, visible=False)
            found[kind] = self.control(box, lambda on, name=name: at(lambda c: {"preparation": _with(c, name, on)}))
        box = gui.add_checkbox("Scale to fit", False, hint="into the arm's reach", visible=False)
        found["reach"] = self.control(box, lambda on: at(lambda _: {"fits_reach": on}))
        hint = "the place at which motions end; takes that end elsewhere are left out"
        dropdown("goal", "Goal", ("1",), lambda goal: at(lambda _: {"goal": int(goal.split()[0]) - 1}), hint)
        dropdown("unit", "Unit", LENGTHS, lambda unit: at(lambda _: {"unit": unit}), "of positions in files")
        rates = tuple(f"{rate:g} Hz" for rate in USUAL_RATES)
        hint = "samples a second of takes without times"
        dropdown("rate", "Rate", rates, lambda text: at(lambda _: {"rate": float(text.split()[0])}), hint)
        hint = "of three columns without names"
        first = {label: reading for reading, label in READINGS.items()}
        dropdown("reading", "First column", tuple(first), lambda label: self._answer("reading", first[label]), hint)
        for axis in AXES:
            hint = "the column with it; without times (t) there is a rate, without z it is a drawing in the plane"
            answer = partial(self._answer_axis, axis)
            dropdown(axis, f"Column of {axis}", (NO_COLUMN,), answer, hint)
        dropdown("topic", "Topic", (NO_COLUMN,), partial(self._answer, "topic"), "of the bag, or frame, of the hand")
        return found

    def close(self, *, keeps: bool = False, learns: bool = False) -> None:
        """Let go of what is open, and show what was shown before, or what it `learns` once that is known.

        What was taught and is not learned yet is kept for the next time if it `keeps` or `learns` it: learning may be
        cancelled, or fail.
        """
        with self._changing:
            if not self.folder.visible:
                return
            self.folder.visible = False
            kept = self._opened if (keeps or learns) and self._opened.taught else Opened()
            seen, self._seen, self._opened = self._seen, None, kept
            frame = self._bindings.frame
            self._learned(None if frame is None else frame.task)
            self._draw()
            self._put_beside()
            if seen is not None:
                self.pen.put_down()
                self._page.preview(None, None if learns else 0)

    def _learned(self, task: Task | None) -> None:
        """Let go of what was learned from, once its task is shown."""
        with self._changing:
            lesson = None if task is None else task.lesson
            if lesson is not None and lesson.takes == self._opened.taught and not self.folder.visible:
                self._opened = Opened()

    def load(self, name: str, content: bytes) -> None:
        """Have a file taken, or added to what is open; say why that cannot be."""
        session = self._bindings.session
        try:
            if self._take(name, content):
                return
        except DataError as error:
            session.say(str(error), Severity.ALARM)
            return
        with self._changing:
            files = (*self._opened.files, (name, content))
            size = sum(len(each) for _, each in files)
            if session.jobs.busy(LANE):
                session.say("A file of yours is being read; open the next one after it.", Severity.WARNING)
            elif is_motion(content):
                session.jobs.submit(LANE, partial(self._read_motion, name, content))
            elif size > MAX_UPLOAD:
                accepted = f"at most {MAX_UPLOAD / 1e6:.0f} MB; the command line takes more"
                session.say(f"{name}: files: found {size / 1e6:.1f} MB in all; accepted: {accepted}", Severity.ALARM)
            else:
                self._opened, self.folder.visible = replace(self._opened, files=files), True
                self._put_beside()
                session.jobs.submit(LANE, self._read)

    def teach(self) -> None:
        """Open the folder for takes that are taught, beside those that are open, or that the shown task is made of."""
        task = self._bindings.session.task
        with self._changing:
            if self.folder.visible:
                if self._seen is None:
                    self._put(self._opened, Preview(()))
            elif task.lesson is not None and not self._opened.taught:
                self._open(Opened.again(task.lesson, task.preparation))
            else:
                self._open(self._opened)

    def reopen(self, lesson: Lesson) -> None:
        """Open takes that were taught before, in place of what is open; Undo brings others back."""
        before = self.lesson
        self._open(replace(Opened.again(lesson), past=() if before is None else (before,)))

    @property
    def lesson(self) -> Lesson | None:
        """What is taught and not learned yet, as it is without files; None if that is nothing."""
        opened = self._opened
        return Lesson(opened.taught, () if opened.files else opened.lesson.left_out) if opened.taught else None

    def _open(self, opened: Opened) -> None:
        with self._changing:
            self._opened, self.folder.visible = opened, True
            self._put_beside()
            self._put(opened, Preview(()))
            self._bindings.session.jobs.submit(SEEING, self._see, latest=True)

    def _put_beside(self) -> None:
        undo, redo = (partial(self.later, partial(self._travel, move)) for move in (Opened.undone, Opened.redone))
        beside = Beside(self._opened.steps, undo, redo) if self.folder.visible else None
        self._bindings.session.put_beside(beside)

    def _teach(self, opened: Opened) -> None:
        """Go on with other takes that are taught, if the folder is still open."""
        if self.folder.visible and opened is not self._opened:
            self._opened = opened
            self._put_beside()
            self._bindings.session.jobs.submit(SEEING, self._see, latest=True)

    def _travel(self, moved: Callable[[Opened], Opened]) -> None:
        with self._changing:
            self._teach(moved(self._opened))

    def add(self, kind: str, stroke: Stroke, board: Slice | None) -> None:
        """Keep a stroke, on a board or in space, as a take of a kind, or say why that cannot be."""
        numbers = [int(each.name.rpartition(" ")[2]) for each in self._opened.taught]
        if len(numbers) >= MAX_TAKES:
            text = f"There are {MAX_TAKES} takes, the most for a task: delete one first."
            self._bindings.session.say(text, Severity.WARNING)
            return
        try:
            kept = taught(f"{kind} {max(numbers, default=0) + 1}", stroke, board)
        except DataError as error:
            self._bindings.session.say(str(error), Severity.WARNING)
            return
        with self._changing:
            self._teach(self._opened.with_take(kept))

    def _delete(self) -> None:
        with self._changing:
            self._teach(self._opened.without(self._number, self._named))

    def _again(self) -> None:
        """Read what is open for another arm: its joints' angles lead elsewhere, and it reaches other places."""
        with self._changing:
            if self.folder.visible and (self._opened.files or self._opened.taught):
                self._opened, self._seen = replace(self._opened), None  # what is being inspected is not put
                self._draw()
                lane, work = (LANE, self._read) if self._opened.files else (SEEING, self._see)
                self._bindings.session.jobs.submit(lane, work, latest=True)

    def _read(self) -> None:
        """Read the files of what is open with what was answered; without the newest one if it cannot be read.

        Raises:
            UnwantedError: the visitor has left, or has closed what was open.
        """
        opened, session, self.upload.disabled = self._opened, self._bindings.session, True
        unwanted = lambda: session.jobs.closed or not self.folder.visible  # noqa: E731
        try:
            with turn(session.say, unwanted):
                known = opening.read(opened.files, opened.answers, session.robot, unwanted)
            opening.preview(known, opened.choices, session.robot)
            if len(opened.files) > opened.num_read and len(known.takes) <= len(opened.recordings.takes):
                name, *_ = opened.files[-1]
                raise DataError(name, "takes", f"none ({'; '.join(known.refused)[-200:]})", "at least one")
        except DataError as error:
            session.say(str(error), Severity.ALARM)
            self._change(opened.files, files=opened.files[: opened.num_read])
            if not (self._opened.files or self._opened.taught):
                self.close()
        else:
            self._change(opened.files, recordings=known, num_read=len(opened.files))
            session.jobs.submit(SEEING, self._see, latest=True)
        finally:
            self.upload.disabled = False

    def _read_motion(self, name: str, content: bytes) -> None:
        """Begin with a saved motion, in place of what is open, or say why that cannot be.

        Raises:
            UnwantedError: the visitor has left.
        """
        session, self.upload.disabled = self._bindings.session, True
        left = partial(session.jobs.superseded, LANE)
        try:
            with turn(session.say, left):
                task = opening.read_motion(name, content, session.robot, left)
        except DataError as error:
            session.say(str(error), Severity.ALARM)
        else:
            self._learn(session, task)
        finally:
            self.upload.disabled = False

    def _change(self, of: tuple[tuple[str, bytes], ...], **changes: Any) -> None:  # noqa: ANN401 - fields of `Opened`
        """Change what is open, unless other files are meanwhile."""
        with self._changing:
            if self._opened.files is of:
                self._opened = replace(self._opened, **changes)

    def _see(self) -> None:
        """Show what is open, at first without what the arm can reach; nothing once it is changed or closed."""
        opened, robot = self._opened, self._bindings.session.robot
        if not (opened.recordings.takes or opened.taught):
            self._put(opened, Preview(()))
            return
        try:
            seen = opening.preview(opened.recordings, opened.choices, robot, opened.taught)
        except DataError as error:  # such as in another unit
            self._bindings.session.say(str(error), Severity.ALARM)
            return
        if not opened.choices.fits_reach:
            self._put(opened, seen)
        self._put(opened, opening.with_reach(seen, opened.choices, robot))

    def _put(self, opened: Opened, seen: Preview) -> None:
        with self._changing:
            if self._opened is opened and seen is not self._seen and self.folder.visible:
                self._seen = seen
                self._draw()

    def _choose(self, change: Callable[[Choices], Mapping[str, Any]]) -> None:
        with self._changing:
            choices = self._opened.choices
            self._opened = replace(self._opened, choices=replace(choices, **change(choices)))
        self._bindings.session.jobs.submit(SEEING, self._see, latest=True)

    def _answer(self, about: str, answer: Any) -> None:  # noqa: ANN401 - see `Question`
        with self._changing:
            self._opened = replace(self._opened, answers={**self._opened.answers, about: answer})
        self._bindings.session.jobs.submit(LANE, self._read, latest=True)

    def _answer_axis(self, axis: str, column: str) -> None:
        with self._changing:
            question = self._opened.recordings.questions.get("columns")
            if question is not None:
                self._answer("columns", {**question.answer, **self._opened.answers.get("columns", {}), axis: column})

    @property
    def _number(self) -> int:
        options = self.controls["take"].handle.options
        value = self.controls["take"].value
        return options.index(value) if value in options else 0

    @property
    def _named(self) -> str:
        """Name of the take that is chosen; empty if there is none."""
        takes = () if self._seen is None else self._seen.takes
        return takes[self._number].inspection.name if takes else ""

    def _point(self, _title: str) -> None:
        with self._changing:
            self._draw()

    def _leave_out(self, on: bool) -> None:
        number = frozenset([self._number])
        self._choose(lambda c: {"left_out": c.left_out - number if on else c.left_out | number})

    def _press(self) -> None:
        with self._changing:
            task = None if self._seen is None else self._seen.task
            if task is not None:
                self.close(learns=True)
        if task is not None:
            self._learn(self._bindings.session, task)

    # --- what is shown ---

    def _draw(self) -> None:
        seen, opened = self._seen, self._opened
        self.controls["learn"].handle.disabled = seen is None or seen.task is None
        if seen is None:
            self.table.content = ""
            for name, control in self.controls.items():
                control.handle.visible = control.handle.visible and name == "learn"
            return
        titles = tuple(f"{k} · {take.inspection.name}"[:40] for k, take in enumerate(seen.takes, 1))
        before = self.controls["take"]
        newest = opened.taught and len(titles) > len(before.handle.options) * before.handle.visible
        self._offer("take", titles, titles[-1] if newest else before.value)
        number, settings = self._number, opened.choices.preparation
        self._turn("chosen", not titles or seen.takes[number].is_chosen, shown=bool(titles))
        self.controls["delete"].handle.visible = self._named in [each.name for each in opened.taught]
        self.controls["download"].handle.visible = bool(opened.taught)
        found = {finding.kind for take in seen.takes for finding in take.inspection.findings}
        for kind, (name, *_) in SWITCHES.items():
            on = bool(getattr(settings, name))
            self._turn(kind, on, shown=bool(titles) and (kind in found or not on))
        self._turn("reach", opened.choices.fits_reach, shown=bool(seen.reach))
        goals = tuple(f"{k} · {text}"[:60] for k, text in enumerate(seen.goals, 1))
        self._offer("goal", goals, goals[seen.goal_number] if goals else "")
        self._offer("unit", LENGTHS if seen.unit else (), seen.unit)
        rates = tuple(f"{rate:g} Hz" for rate in USUAL_RATES)
        self._offer("rate", rates if seen.rate else (), f"{seen.rate or 0:g} Hz")
        questions = opened.recordings.questions
        for about in ("reading", "topic"):
            question = questions.get(about)
            choices = () if question is None else tuple(READINGS.get(choice, choice) for choice in question.choices)
            self._offer(about, choices, "" if question is None else READINGS.get(question.answer, str(question.answer)))
        question = questions.get("columns")
        for axis in AXES:
            choices = () if question is None else (NO_COLUMN, *question.choices)
            self._offer(axis, choices, "" if question is None else question.answer.get(axis, NO_COLUMN))
        self.table.content = seen_html(seen, number)
        self._page.preview(seen, number)

    def _offer(self, name: str, options: tuple[str, ...], value: str) -> None:
        control = self.controls[name]
        if options and control.handle.options != options:
            control.handle.options = options
        if options:
            control.value = value if value in options else options[0]
        control.handle.visible = bool(options)

    def _turn(self, name: str, on: bool, *, shown: bool) -> None:
        self.controls[name].value, self.controls[name].handle.visible = on, shown


def _with(choices: Choices, name: str, on: bool) -> Any:  # noqa: ANN401 - PreparationSettings
    return replace(choices.preparation, **{name: on})


KINDS: Mapping[str, Kind] = {"Draw": "draw", "Guide the hand": "guide"}
"""Ways of teaching, by the name of their button."""
NAMES: Mapping[Kind, str] = {"draw": "drawn", "guide": "guided"}  # begin of the names of takes
TOLD: Mapping[Kind, str] = {
    "draw": "Press on the board, draw, let go: that is a take. Make two or three that end at one place, then Learn. "
    "Escape leaves.",
    "guide": "Drag the violet ball, turn the view, drag on. “Take done” ends a take. Make two or three that end at one "
    "place, then Learn. Escape leaves.",
}
"""What is to be done, by the way of teaching."""


class TeachPanel:
    """Controls of teaching at the top of the folder "Your data", which takes what was taught."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, opening: OpenPanel) -> None:
        """Build the controls where the panel is being built."""
        self._bindings, self._opening = bindings, opening
        hint = "demonstrations of your own: drawn on a board before the arm, or by guiding its hand"
        begin = gui.add_button("Draw your own", icon=viser.Icon.PENCIL, hint=hint, order=opening.upload.order + 0.5)
        with opening.folder:
            first = opening.table.order - 1
            ways = gui.add_button_group("Teach", tuple(KINDS), hint="adds takes", order=first)
            self._told = gui.add_html("", order=first + 0.2)
            self._done = gui.add_button(
                "Take done", icon=viser.Icon.CHECK, visible=False, hint="ends and keeps it", order=first + 0.5
            )
        opening.control(begin, lambda _pressed: self._begin("draw"))
        opening.control(ways, lambda name: self._begin(KINDS[name]))
        opening.control(self._done, lambda _pressed: opening.pen.finish())
        bindings.show(lambda s: s.arm, lambda _arm: opening.pen.put_down())

    def _begin(self, kind: Kind) -> None:
        self._opening.teach()
        self._done.visible, self._told.content = kind == "guide", small(html.escape(TOLD[kind]))
        self._opening.pen.take_up(kind, partial(self._finished, NAMES[kind]))
        self._bindings.session.say(TOLD[kind], Severity.NOTE)

    def _finished(self, name: str, stroke: Stroke, board: Slice | None) -> None:
        self._opening.later(partial(self._opening.add, name, stroke, board))
