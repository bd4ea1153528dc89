"""The folder "Your data": recordings of a visitor's own, seen in the scene before they are learned."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import viser

from dt_viz.errors import DataError
from dt_viz.files.checks import check_at_most
from dt_viz.files.recordings import ARCHIVE, AXES, NO_COLUMN, Recordings
from dt_viz.files.takes import READERS
from dt_viz.files.uploads import make_ready
from dt_viz.learning.inspection import FindingKind
from dt_viz.scenario.tasks import Task
from dt_viz.session import opening
from dt_viz.session.opening import LENGTHS, USUAL_RATES, Choices, Preview, SeenTake
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.controls import Control, on_press
from dt_viz.ui.dropping import drop_html
from dt_viz.ui.scene.palette import LIGHT, css, ink
from dt_viz.ui.tabs.from_file import LANE, turn
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.status import COLOURS
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
HEADS: Mapping[FindingKind, tuple[str, str]] = {
    "units": ("unit", "another unit than the others’"),
    "outliers": ("outlier", "single samples far off: their distance, or their number"),
    "gap": ("gap", "longest time without samples"),
    "jitter": ("jitter", "how far it trembles"),
    "pause": ("pause", "how long it stands still"),
    "end": ("end", "distance of its end from the goal"),
    "start": ("start", "how long it stays at the goal at first"),
}
"""Heads of the table's columns, and what they mean."""
READINGS = {"t,x,y": "times", "x,y,z": "x, as the next ones are y and z"}
"""What the first of three columns without names is, by the reading of all three."""


@dataclass(frozen=True)
class Opened:
    """What a visitor has opened."""

    files: tuple[tuple[str, bytes], ...] = ()
    """Names and contents."""
    answers: Mapping[str, Any] = field(default_factory=dict)
    """What was answered to the files' questions, by what these are about."""
    recordings: Recordings = field(default_factory=Recordings)
    choices: Choices = field(default_factory=Choices)


Show = Callable[[Preview | None, int], None]
"""Function that shows a preview in the scene, and which take of it is chosen; None ends it."""


class OpenPanel:
    """The folder of one visitor's panel, and the button that opens it."""

    def __init__(
        self, gui: viser.GuiApi, bindings: Bindings, show: Show, learn: Callable[[Session, Task], None], most: int
    ) -> None:
        """Build the controls where the panel is being built.

        Args:
            gui: controls of the visitor.
            bindings: bindings of the panel.
            show: shows what is open in the scene.
            learn: has a task learned.
            most: largest number of bytes of all files.
        """
        self._bindings, self._show, self._learn, self._most = bindings, show, learn, most
        self._opened = Opened()
        self._seen: Preview | None = None
        self.button = gui.add_button(
            "Open your demonstrations", icon=viser.Icon.FOLDER_OPEN, hint=f"recorded motions of your own: {FORMATS}"
        )
        self.folder = gui.add_folder("Your data", visible=False)
        with self.folder:
            hint = f"{FORMATS}; several at once, one after another, or a zip of a folder"
            self.upload = gui.add_upload_button("Choose files, or drop them here", icon=viser.Icon.UPLOAD, hint=hint)
            gui.add_html(drop_html(self.upload, most))
            self.table = gui.add_html("")
            self.controls = self._add_controls(gui)
            self.start = gui.add_button("Learn", icon=viser.Icon.SCHOOL, color=LIGHT.brand, disabled=True)
            cancel = gui.add_button("Cancel", icon=viser.Icon.X)
        on_press(self.button, self.open)
        on_press(self.start, self._press)
        on_press(cancel, self.close)
        bindings.show(lambda s: (s.task, s.scene), lambda _chosen: self.close())

        @self.upload.on_upload
        async def _(_event: viser.GuiEvent) -> None:
            file = self.upload.value
            if self.folder.visible:
                self._submit(partial(self.load, file.content, file.name))

    def _add_controls(self, gui: viser.GuiApi) -> dict[str, Control]:
        """Build what is shown only where it is asked for, by names of their own."""
        at, found = self._choose, {}

        def dropdown(name: str, label: str, options: tuple[str, ...], act: Callable[[str], Any], hint: str) -> None:
            found[name] = Control(gui.add_dropdown(label, options, hint=hint, visible=False), act)

        dropdown("take", "Take", (NO_COLUMN,), self._point, "the take that is named in the scene")
        box = gui.add_checkbox("Use this take", True, visible=False)
        found["chosen"] = Control(box, self._leave_out)
        for kind, (name, label, hint) in SWITCHES.items():
            box = gui.add_checkbox(label, True, hint=hint, visible=False)
            found[kind] = Control(box, lambda on, name=name: at(lambda c: {"preparation": _with(c, name, on)}))
        box = gui.add_checkbox("Scale to fit", False, hint="into the arm's reach", visible=False)
        found["reach"] = Control(box, lambda on: at(lambda _: {"fits_reach": on}))
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
            hint = "the column with it"
            answer = partial(self._answer_axis, axis)
            dropdown(axis, f"Column of {'times' if axis == 't' else axis}", (NO_COLUMN,), answer, hint)
        dropdown("topic", "Topic", (NO_COLUMN,), partial(self._answer, "topic"), "of the bag, or frame, of the hand")
        return found

    def open(self) -> None:
        """Show the folder, and get ready for files."""
        self.folder.visible, self.button.visible = True, False
        self._bindings.session.jobs.submit(LANE, make_ready)

    def close(self) -> None:
        """Let go of what is open, and show what was shown before. Nothing is done while nothing is open."""
        self._opened, seen, self._seen = Opened(), self._seen, None
        self.folder.visible, self.button.visible, self.start.disabled = False, True, True
        if seen is not None:
            self._show(None, 0)
            self._draw()

    def load(self, content: bytes, name: str) -> None:
        """Add a file to what is open, and show all of it; or say why that cannot be.

        Raises:
            UnwantedError: the visitor has left.
        """
        opened = self._opened
        files = (*opened.files, (name, content))
        try:
            size = sum(len(each) for _, each in files)
            check_at_most("files", size // 10**6, self._most // 10**6, "MB in all")
            self._read(replace(opened, files=files))
        except ValueError as error:
            self._bindings.session.say(str(error), Severity.ALARM)

    def _submit(self, work: Callable[[], None]) -> None:
        self._bindings.session.jobs.submit(LANE, work)

    def _read(self, opened: Opened) -> None:
        """Read the files of what is open with what was answered, and show them."""
        session, self.upload.disabled = self._bindings.session, True
        left = partial(session.jobs.superseded, LANE)
        wait = "Another visitor's file is being read; yours is read after it."
        try:
            with turn(partial(session.say, wait, Severity.WARNING), lambda: session.jobs.closed):
                known = opening.read(opened.files, opened.answers, session.robot, left)
            self._see(replace(opened, recordings=known))
        finally:
            self.upload.disabled = False

    def _see(self, opened: Opened) -> None:
        """Show what is open, at first without what the arm can reach; nothing if it was closed meanwhile."""
        session, choices = self._bindings.session, opened.choices
        seen = opening.preview(opened.recordings, choices, session.robot)
        if not self.folder.visible:
            return
        self._opened, self._seen = opened, seen
        if not choices.fits_reach:
            self._draw()
        self._seen = opening.with_reach(seen, choices, session.robot)
        if self.folder.visible and (choices.fits_reach or self._seen is not seen):
            self._draw()

    def _choose(self, change: Callable[[Choices], Mapping[str, Any]]) -> None:
        """Have choices changed."""

        def work() -> None:
            opened = self._opened
            if opened.recordings.takes:
                self._see(replace(opened, choices=replace(opened.choices, **change(opened.choices))))

        self._submit(work)

    def _answer(self, about: str, answer: Any) -> None:  # noqa: ANN401 - see `Question`
        def work() -> None:
            opened = self._opened
            try:
                self._read(replace(opened, answers={**opened.answers, about: answer}))
            except DataError as error:
                self._bindings.session.say(str(error), Severity.ALARM)

        self._submit(work)

    def _answer_axis(self, axis: str, column: str) -> None:
        question = self._opened.recordings.questions.get("columns")
        if question is not None:
            self._answer("columns", {**question.answer, axis: column})

    @property
    def _number(self) -> int:
        """Number of the take that is chosen."""
        options = self.controls["take"].handle.options
        value = self.controls["take"].value
        return options.index(value) if value in options else 0

    def _point(self, _title: str) -> None:
        self._submit(self._draw)

    def _leave_out(self, on: bool) -> None:
        number = frozenset([self._number])
        self._choose(lambda c: {"left_out": c.left_out - number if on else c.left_out | number})

    def _press(self) -> None:
        seen = self._seen
        if seen is not None and seen.task is not None:
            self.close()
            self._learn(self._bindings.session, seen.task)

    # --- what is shown ---

    def _draw(self) -> None:
        """Show what is open."""
        seen, opened = self._seen, self._opened
        if seen is None:
            self.table.content = ""
            for control in self.controls.values():
                control.handle.visible = False
            return
        titles = tuple(f"{k} · {take.inspection.name}"[:40] for k, take in enumerate(seen.takes, 1))
        self._offer("take", titles, self.controls["take"].value)
        number, settings = self._number, opened.choices.preparation
        self._turn("chosen", seen.takes[number].is_chosen, shown=True)
        found = {finding.kind for take in seen.takes for finding in take.inspection.findings}
        for kind, (name, *_) in SWITCHES.items():
            on = bool(getattr(settings, name))
            self._turn(kind, on, shown=kind in found or not on)
        self._turn("reach", opened.choices.fits_reach, shown=bool(seen.reach))
        goals = tuple(f"{k} · {text}"[:60] for k, text in enumerate(seen.goals, 1))
        self._offer("goal", goals, goals[min(opened.choices.goal, len(goals) - 1)] if goals else "")
        self._offer("unit", LENGTHS if seen.unit else (), seen.unit)
        rates = tuple(f"{rate:g} Hz" for rate in USUAL_RATES)
        self._offer("rate", rates if seen.rate else (), f"{seen.rate or 0:g} Hz")
        questions = opened.recordings.questions
        for about in ("reading", "topic"):
            question = questions.get(about)
            named = READINGS if about == "reading" else {}
            choices = () if question is None else tuple(named.get(choice, choice) for choice in question.choices)
            self._offer(about, choices, "" if question is None else named.get(question.answer, question.answer))
        question = questions.get("columns")
        for axis in AXES:
            choices = () if question is None else (NO_COLUMN, *question.choices)
            self._offer(axis, choices, "" if question is None else question.answer.get(axis, NO_COLUMN))
        self.table.content = seen_html(seen, number)
        self.start.disabled = seen.task is None
        self._show(seen, number)

    def _offer(self, name: str, options: tuple[str, ...], value: str) -> None:
        """Show a dropdown with options, if there are any."""
        control = self.controls[name]
        if options and control.handle.options != options:
            control.handle.options = options
        if options:
            control.value = value if value in options else options[0]
        control.handle.visible = bool(options)

    def _turn(self, name: str, on: bool, *, shown: bool) -> None:
        """Show a checkbox, or hide it."""
        self.controls[name].value, self.controls[name].handle.visible = on, shown


def _with(choices: Choices, name: str, on: bool) -> Any:  # noqa: ANN401 - PreparationSettings
    return replace(choices.preparation, **{name: on})


def seen_html(seen: Preview, number: int) -> str:
    """Return a table of what was found of each take, the chosen one marked, and what else is to be known."""
    several = f"The takes end at {len(seen.goals)} places, none of them that of most: “Goal” chooses one."
    alarms = [text for text in (seen.problem, seen.reach, several if seen.goals else "") if text]
    told = [f"<div style='color:{ink(COLOURS[Severity.WARNING][0])}'>{html.escape(text)}</div>" for text in alarms]
    told += [f"<div>{html.escape(note)}</div>" for note in seen.notes]
    found = {finding.kind for take in seen.takes if take.learned is not None for finding in take.inspection.findings}
    heads = [kind for kind in HEADS if kind in found]
    rows = "".join(_row(k, take, heads, chosen=k == number) for k, take in enumerate(seen.takes))
    titles = "".join(
        f"<td style='text-align:right;opacity:0.65;padding-left:0.6em' title='{hint}'>{title}</td>"
        for title, hint in (("s", "duration"), ("Hz", "samples a second"), *(HEADS[kind] for kind in heads))
    )
    table = f"<table style='width:100%;font-size:0.9em;white-space:nowrap'><tr><td></td>{titles}</tr>{rows}</table>"
    return small("".join(told)) * bool(told) + small(f"<div style='max-height:21em;overflow:auto'>{table}</div>")


def _row(number: int, take: SeenTake, heads: Sequence[FindingKind], *, chosen: bool) -> str:
    """Return the row of a take: how large what was found is, or why it is left out; tooltips have all of it."""
    own, left = take.inspection, take.learned is None
    colour = LIGHT.stale if left else LIGHT.takes[number % len(LIGHT.takes)]
    said = [f"{each.text}: {each.remedy or 'nothing is done'}" for each in own.findings]
    said += ["out of the arm's reach"] * take.is_far + ["left out by you"] * (not take.is_chosen)
    mark = f"display:inline-block;width:1.1em;border-top:0.28em {'dashed' if left else 'solid'} {css(colour)}"
    cells = [("", f"{own.duration:.2f}", False), ("", f"{own.rate:.3g}", False)]
    for kind in heads:
        of_kind = [each for each in own.findings if each.kind == kind]
        amounts = ", ".join(each.amount or "✓" for each in of_kind)
        cells.append(("; ".join(each.text for each in of_kind), amounts, any(not each.remedy for each in of_kind)))
    warned = f";font-weight:700;color:{ink(COLOURS[Severity.WARNING][0])}"
    figures = "".join(
        f"<td style='text-align:right;padding-left:0.6em{warned if is_left else ''}' title='{html.escape(title)}'>"
        f"{html.escape(text)}</td>"
        for title, text, is_left in (cells[:2] if left else cells)
    )
    why = html.escape(said[-1] if said else "left out")
    far = f"<td style='{warned[1:]}'>out of reach</td>" if take.is_far else ""
    reason = f"<td colspan='{len(heads)}' style='padding-left:0.6em;white-space:normal'>{why}</td>" if left else far
    return (
        f"<tr style='{'opacity:0.6' if left else ''}' title='{html.escape('; '.join(said))}'>"
        f"<td style='font-weight:{700 if chosen else 400};max-width:8em;overflow:hidden;text-overflow:ellipsis'>"
        f"<span style='{mark};vertical-align:0.2em;margin-right:0.4em'></span>{html.escape(own.name)}</td>"
        f"{figures}{reason}</tr>"
    )
