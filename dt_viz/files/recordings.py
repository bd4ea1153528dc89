"""Visitors' recordings: several files at once, or archives of folders, read by the process of `dt_viz.files.worker`.

What a file leaves open is guessed and asked: which of its columns are places, which topic of a bag is the hand's. What
is answered is used for files that ask, and for no others. A file that cannot be read is named, and the others are read.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dt_viz.errors import DataError, FormatError, UnclearError, parsing
from dt_viz.files.checks import check_at_most, check_finite, check_size
from dt_viz.files.columns import is_kind
from dt_viz.files.folders import bag_folder, files_of, is_bag, is_lerobot, lerobot_folder
from dt_viz.files.tables import ReadOptions, at_sample
from dt_viz.files.takes import READERS, Take, read_takes

ARCHIVE = ".zip"
"""Suffix of an archive of a folder."""
AXES = ("t", "x", "y", "z")
"""Roles of columns that are asked for; z and t may be missing."""
NO_COLUMN = "–"

Answers = Mapping[str, Any]
"""What was answered, by `UnclearError.question`: a choice, or for "columns" the choice of each of `AXES`."""
Read = Callable[[ReadOptions], tuple[list[Take], tuple[str, ...]]]
"""Function that reads the takes of one file, and notes about them."""


@dataclass(frozen=True)
class RecordingLimits:
    """The largest recordings of one visitor."""

    unpacked: int = 200 * 10**6
    """Bytes that archives unpack to."""
    files: int = 1000
    numbers: int = 4_000_000
    """Numbers in all takes: 32 MB, which are kept for the visitor."""


LIMITS = RecordingLimits()


@dataclass(frozen=True)
class Question:
    """What a file leaves open."""

    about: str
    """See `UnclearError.question`."""
    choices: tuple[str, ...]
    answer: Any
    """What is used now: a guess, or what was answered."""


@dataclass(frozen=True)
class Recordings:
    """What is read of a visitor's files."""

    takes: tuple[Take, ...] = ()
    notes: tuple[str, ...] = ()
    """What was chosen and what is not used."""
    refused: tuple[str, ...] = ()
    """A line for each file that cannot be read."""
    questions: Mapping[str, Question] = field(default_factory=dict)
    """By what they are about."""


def request(
    files: Sequence[tuple[str, bytes]], answers: Answers, joint_names: Sequence[str]
) -> tuple[bytes, dict[str, Any]]:
    """Return the content and the options with which the process reads files, each with its name."""
    options = {"files": [[name, len(content)] for name, content in files], "answers": answers}
    return b"".join(content for _, content in files), options | {"joint_names": [*joint_names]}


def recordings_of(arrays: Sequence[np.ndarray]) -> Recordings:
    """Return what the process answered. Raises exceptions of almost any kind if it gave another answer."""
    told, values = json.loads(str(arrays[0])), iter(arrays[1:])
    takes = []
    for one in told["takes"]:
        times, places, turns = next(values), next(values), next(values) if one["turns"] else None
        name, units, is_timed = (
            str(one["name"]),
            {str(k): float(v) for k, v in one["units"].items()},
            bool(one["timed"]),
        )
        joints = tuple(map(str, one["joints"]))
        given = (None, turns, places) if joints else (places, turns, None)
        takes.append(Take(name, times, *given, joints, at_sample, units, is_timed))
    questions = {
        about: Question(about, tuple(map(str, q["choices"])), q["answer"]) for about, q in told["asked"].items()
    }
    return Recordings(tuple(takes), tuple(map(str, told["notes"])), tuple(map(str, told["refused"])), questions)


def answer_recordings(
    content: bytes, _suffix: str, files: Sequence[Sequence[Any]], answers: Answers, joint_names: Sequence[str]
) -> tuple[tuple[np.ndarray, ...], tuple[str, ...]]:
    """Read recordings in the process of `dt_viz.files.worker`: an array of JSON text, and those of each take."""
    found, at = Recordings(), 0
    refused: list[DataError] = []
    options = ReadOptions(joint_names=tuple(joint_names), asks=True)
    with TemporaryDirectory() as folder:
        for number, (name, size) in enumerate(files):
            part, at = content[at : at + size], at + size
            found = _read_upload(found, part, Path(name), Path(folder, str(number)), answers, options, refused)
    if not found.takes and refused:
        first = refused[0]
        inside = f"{first.source}: " * (first.source != files[0][0] or len(files) > 1)
        raise FormatError(inside + first.field, first.found, first.accepted)
    told = {
        "takes": [
            {"name": t.name, "turns": t.orientations is not None, "joints": t.joint_names, "units": t.units}
            | {"timed": t.is_timed}
            for t in found.takes
        ],
        "notes": _grouped(found.notes),
        "refused": [str(error) for error in refused],
        "asked": {about: asdict(question) for about, question in found.questions.items()},
    }
    arrays = [(t.times, _values(t), *([] if t.orientations is None else [t.orientations])) for t in found.takes]
    return (np.array(json.dumps(told)), *(array for each in arrays for array in each)), ()


def _grouped(notes: Sequence[str]) -> list[str]:
    """Notes that each name their file, those that are alike of several files as one."""
    files: dict[str, list[str]] = {}
    for name, _, note in (note.partition(": ") for note in notes):
        files.setdefault(note, []).append(name)
    return [f"{names[0]}{f' and {len(names) - 1} more' * (len(names) > 1)}: {note}" for note, names in files.items()]


def _values(take: Take) -> np.ndarray:
    """Places (T, d) or joint angles (T, n)."""
    values = take.joints if take.positions is None else take.positions
    assert values is not None
    return values


def _read_upload(
    found: Recordings,
    content: bytes,
    name: Path,
    folder: Path,
    answers: Answers,
    options: ReadOptions,
    refused: list[DataError],
) -> Recordings:
    """Add what one upload holds to what was found, and why files are not read to what was `refused`."""
    sources: Iterator[tuple[str, Read]] = iter([(name.name, lambda how: read_takes(content, name, how))])
    if name.suffix.lower() == ARCHIVE:
        try:
            with parsing(DataError, name, "file", "a zip archive of files of recorded motions"):
                unused, sources = _unpack(content, folder), _sources(folder)
                found = replace(found, notes=(*found.notes, *(f"{name.name}: {note}" for note in unused)))
        except DataError as error:
            refused.append(error)
            return found
    for label, read in sources:
        accepted = READERS.get(Path(label).suffix.lower(), (None, "a file of recorded motions"))[1]
        try:
            with parsing(DataError, label, "file", accepted):
                found = _added(found, label, read, answers, options)
        except DataError as error:
            refused.append(error)
    return found


def _unpack(content: bytes, folder: Path) -> tuple[str, ...]:
    """Unpack an archive into a folder, and say what of it is not read."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [member for member in archive.infolist() if not member.is_dir() and not _is_hidden(member.filename)]
        check_at_most("archive", len(members), LIMITS.files, "files")
        check_size(sum(member.file_size for member in members), LIMITS.unpacked)
        others = [member.filename for member in members if Path(member.filename).suffix.lower() not in READERS]
        for member in members:
            archive.extract(member, folder)
    if len(others) == len(members):
        raise FormatError("archive", ", ".join(others)[:200] or "no files", f"files of the kinds {', '.join(READERS)}")
    unused = [name for name in others if not name.endswith(("metadata.yaml", ".zstd"))]
    return (f"not read are {', '.join(unused)[:200]}",) if unused else ()


def _is_hidden(name: str) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in Path(name).parts)


def _sources(folder: Path) -> Iterator[tuple[str, Read]]:
    """Names of the recordings in a folder and the folders in it, and functions that read them."""
    if is_bag(folder):
        yield folder.name, lambda options: bag_folder(folder, options)
    elif is_lerobot(folder):
        yield folder.name, lambda options: lerobot_folder(folder, options)
    else:
        for path in files_of(folder):
            yield path.name, lambda options, path=path: read_takes(path.read_bytes(), path, options)
        for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
            yield from _sources(inner)


def _added(found: Recordings, name: str, read: Read, answers: Answers, options: ReadOptions) -> Recordings:
    """Add what one file holds, with what was answered or is guessed where it asks."""
    questions = dict(found.questions)
    try:
        takes, notes = read(options)
    except UnclearError as error:
        answer = answers.get(error.question)
        answer = _guess(error) if answer is None or not _fits(answer, error) else answer
        questions.setdefault(error.question, Question(error.question, error.choices, answer))
        takes, notes = read(_answered(options, error.question, answer))
    for take in takes:
        check_finite(take.times[:, None], f"times of {take.name!r}", take.place)
        check_finite(_values(take), f"values of {take.name!r}", take.place)
    total = sum(_values(take).size for take in (*found.takes, *takes))
    if total > LIMITS.numbers:
        accepted = f"at most {LIMITS.numbers} on the page; the command line takes more"
        raise FormatError("takes", f"{total} numbers", accepted)
    noted = (f"{name}: {note}" for note in notes if "rate=" not in note)
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
