"""Visitors' recordings: several files at once, or archives of folders, read by the process of `dt_viz.files.reading`.

What a file leaves open is guessed and asked: which of its columns are places, which topic of a bag is the hand's. What
is answered is used for files that ask, and for no others. A file that cannot be read is named, and the others are read.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dt_viz.errors import DataError, FormatError, UnclearError, parsing
from dt_viz.files.checks import check_at_most, check_finite, check_size
from dt_viz.files.columns import is_kind
from dt_viz.files.folders import accepted_as, parts_of, read_part
from dt_viz.files.tables import ReadOptions
from dt_viz.files.takes import READERS, Take

ARCHIVE = ".zip"  # suffix of an archive of a folder
AXES = ("t", "x", "y", "z")  # roles of columns that are asked for; z and t may be missing
NO_COLUMN = "–"

Answers = Mapping[str, Any]
"""What was answered, by `UnclearError.question`: a choice, or for "columns" the choice of each of `AXES`."""


@dataclass(frozen=True)
class RecordingLimits:
    """The largest recordings of one visitor."""

    unpacked: int = 200 * 10**6  # bytes that archives unpack to
    files: int = 1000
    numbers: int = 4_000_000  # numbers in all takes: 32 MB, which are kept for the visitor


LIMITS = RecordingLimits()


@dataclass(frozen=True)
class Question:
    """What a file leaves open."""

    about: str  # see `UnclearError.question`
    choices: tuple[str, ...]
    answer: Any  # what is used now: a guess, or what was answered


@dataclass(frozen=True)
class Recordings:
    """What is read of a visitor's files."""

    takes: tuple[Take, ...] = ()
    notes: tuple[str, ...] = ()  # what was chosen and what is not used
    refused: tuple[str, ...] = ()  # a line for each file that cannot be read
    questions: Mapping[str, Question] = field(default_factory=dict)  # by what they are about


def read_recordings(files: Sequence[tuple[str, bytes]], answers: Answers, joint_names: Sequence[str]) -> Recordings:
    """Read what a visitor sent, each a name and its content, in the process of `dt_viz.files.reading`.

    They are recordings, or archives of folders of them; answers are to the questions of earlier readings.

    Raises:
        FormatError: none of them can be read; it says why the first cannot.
        Exception: of almost any kind, on hostile bytes.
    """
    found, refused = Recordings(), list[DataError]()
    options = ReadOptions(joint_names=tuple(joint_names), asks=True)
    with TemporaryDirectory() as folder:
        for number, (name, content) in enumerate(files):
            parts: list[Path] = []
            with _noting(refused, name, "a file of recorded motions, or a zip archive of such files"):
                parts, unused = _stored(Path(name), content, Path(folder, str(number)))
                found = replace(found, notes=(*found.notes, *(f"{name}: {note}" for note in unused)))
            for path in parts:
                with _noting(refused, path.name, accepted_as(path)):
                    found = _added(found, path, answers, options)
    if not found.takes and refused:
        first = refused[0]
        inside = f"{first.source}: " * (first.source != files[0][0] or len(files) > 1)
        raise FormatError(inside + first.field, first.found, first.accepted)
    return replace(found, notes=_grouped(found.notes), refused=tuple(map(str, refused)))


def _grouped(notes: Sequence[str]) -> tuple[str, ...]:
    """Notes that each name their file, those that are alike of several files as one."""
    files: dict[str, list[str]] = {}
    for name, _, note in (note.partition(": ") for note in notes):
        files.setdefault(note, []).append(name)
    more = {note: f" and {len(names) - 1} more" * (len(names) > 1) for note, names in files.items()}
    return tuple(f"{names[0]}{more[note]}: {note}" for note, names in files.items())


@contextmanager
def _noting(refused: list[DataError], source: str, accepted: str) -> Iterator[None]:
    """Add whatever is raised to what was `refused`."""
    try:
        with parsing(DataError, source, "file", accepted):
            yield
    except DataError as error:
        refused.append(error)


def _stored(name: Path, content: bytes, folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Store an upload, or what is in an archive, in a new folder; return the paths to read and what is not read."""
    folder.mkdir()
    if name.suffix.lower() != ARCHIVE:
        (folder / name.name).write_bytes(content)
        return [folder / name.name], ()
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [member for member in archive.infolist() if not member.is_dir() and not _is_hidden(member.filename)]
        check_at_most("archive", len(members), LIMITS.files, "files")
        check_size(sum(member.file_size for member in members), LIMITS.unpacked)
        others = [member.filename for member in members if Path(member.filename).suffix.lower() not in READERS]
        for member in members:
            archive.extract(member, folder / name.stem)
    if len(others) == len(members):
        raise FormatError("archive", ", ".join(others)[:200] or "no files", f"files of the kinds {', '.join(READERS)}")
    unused = [other for other in others if not other.endswith(("metadata.yaml", ".zstd"))]
    return _all_parts(folder / name.stem), (f"not read are {', '.join(unused)[:200]}",) * bool(unused)


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in Path(name).parts)


def _all_parts(folder: Path) -> list[Path]:
    """Return the paths to read in a folder and the folders in it."""
    parts = parts_of(folder)
    inner = [] if folder in parts else sorted(path for path in folder.iterdir() if path.is_dir())
    return [*parts, *(part for each in inner for part in _all_parts(each))]


def _added(found: Recordings, path: Path, answers: Answers, options: ReadOptions) -> Recordings:
    """Add what one file holds, with what was answered or is guessed where it asks."""
    questions = dict(found.questions)
    try:
        takes, notes = read_part(path, options)
    except UnclearError as error:
        answer = answers.get(error.question)
        answer = _guess(error) if answer is None or not _fits(answer, error) else answer
        questions.setdefault(error.question, Question(error.question, error.choices, answer))
        takes, notes = read_part(path, _answered(options, error.question, answer))
    for take in takes:
        check_finite(take.times[:, None], f"times of {take.name!r}", take.place)
        check_finite(take.values, f"values of {take.name!r}", take.place)
    total = sum(take.values.size for take in (*found.takes, *takes))
    if total > LIMITS.numbers:
        accepted = f"at most {LIMITS.numbers} on the page; the command line takes more"
        raise FormatError("takes", f"{total} numbers", accepted)
    noted = (f"{path.name}: {note}" for note in notes if "rate=" not in note)
    return replace(found, takes=(*found.takes, *takes), notes=(*found.notes, *noted), questions=questions)


def _fits(answer: Any, error: UnclearError) -> bool:  # noqa: ANN401 - what was answered
    """Whether an answer is one of what this file leaves open."""
    return set(answer.values() if isinstance(answer, Mapping) else [answer]) <= {*error.choices, NO_COLUMN}


def _guess(error: UnclearError) -> Any:  # noqa: ANN401 - an answer
    if error.question != "columns":
        return error.choices[0]
    times = [name for name in error.choices if is_kind(name, "time")]
    places = [name for name in error.choices if name not in times][:3]
    return dict(zip(AXES, [(times or [NO_COLUMN])[0], *places, NO_COLUMN, NO_COLUMN], strict=False))


def _answered(options: ReadOptions, about: str, answer: Any) -> ReadOptions:  # noqa: ANN401 - an answer
    if about == "topic":
        return replace(options, topic=answer)
    if about == "reading":
        return replace(options, columns=answer)
    return replace(options, columns={role: name for role, name in answer.items() if name != NO_COLUMN})
