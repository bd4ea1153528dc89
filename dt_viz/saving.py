"""Saved motions: npz files of all that a motion is made of, read back to the last bit, and never unpickled.

`motion` (text)
    JSON: the version, the demonstrations and the layers: objects by their fields, with the name of their class, and
    arrays by their names.
`imitation.…`
    What was learned in the plain state, as `Imitation.to_arrays` gives it.
others
    The arrays that the text names, such as the vertices of meshes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.avoidance import registry
from dt_viz.avoidance.avoidance import SPACES, Avoidance
from dt_viz.avoidance.transform import Transform
from dt_viz.errors import Cancelled, DataError, FormatError, check_between, naming, parsing
from dt_viz.files.checks import check_at_most, read_bytes
from dt_viz.files.npz import MAX_ARRAYS, Archive, arrays_of, check_types, npz_bytes, write_whole
from dt_viz.files.reading import read_upload
from dt_viz.files.values import CLASS, packed, unpacked
from dt_viz.learning.augmented import AugmentedImitation, fit_augmented
from dt_viz.learning.demonstrations import MAX_COORDINATE, Demonstration, check_demonstrations
from dt_viz.learning.imitation import Imitation
from dt_viz.learning.inspection import Inspection, PreparationSettings
from dt_viz.learning.interface import AnyImitation
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import ImitationError
from dt_viz.obstacles.files import measured_apart
from dt_viz.obstacles.shapes import SHAPES, Obstacle
from dt_viz.scenario.own import Own
from dt_viz.scenario.relocation import in_world
from dt_viz.scenario.saved import MAX_BYTES as MAX_SCENARIO
from dt_viz.scenario.saved import MAX_PLAIN, Known, Saved, ScenarioError, check_shapes, decode, encode, is_saved
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import OWN, TASKS, Task, own_task

FORMAT = 1
"""Version of the file; raised where files from before cannot be read any more, also by a change of the imitation's
arrays. A new field that has a default does not need that."""
MAX_BYTES = 40 * 10**6  # largest number of bytes of a file, and of what it unpacks to
MAX_TEXT, MAX_LAYERS = 3 * 10**6, 100
"""Largest numbers of characters of the text, and of layers: a thousand demonstrations have up to 2 million."""
KNOWN = Known(tuple(TASKS), arms=None, methods=None)  # what scenarios may name
MAX_SCENARIOS = 100  # largest number of scenarios that a server offers
TEXT, LEARNED = "motion", "imitation."
"""Name of the array that holds the text, and prefix of those of the imitation."""
FIRST = f"{TEXT}.npy".encode()  # name of a file's first member


class MotionError(DataError):
    """A motion that cannot be saved, or a file that is no saved motion."""


@dataclass(frozen=True)
class SavedMotion:
    """What a motion is made of."""

    demonstrations: tuple[Demonstration, ...]
    layers: tuple[Layer, ...]  # the transforms on the imitation, from the inside out
    augmented: bool = False
    """Whether it was learned in the augmented state: then it is learned again from the demonstrations when it is
    read, which takes milliseconds; by another version of DT-Viz perhaps otherwise."""
    labels: tuple[float, ...] | None = None  # labels of the demonstrations, of the augmented state
    reason: str = ""  # why it was learned in the augmented state where none was chosen
    settings: AugmentedSettings = field(default_factory=AugmentedSettings)
    """Settings of the augmented state."""
    inspections: tuple[Inspection, ...] = ()
    """What was found about the demonstrations before they were repaired."""


def save_motion(path: str | os.PathLike[str], motion: SavedMotion, imitation: AnyImitation) -> None:
    """Write a motion to a file, whatever its suffix; an existing one is replaced only by a whole one.

    Raises:
        DataError: a transform is not registered, or something could not be read again.
        OSError: the file cannot be written.
    """
    path, arrays = Path(path), dict[str, np.ndarray]()
    with parsing(MotionError, path, "motion", "what Motion.load can read"):
        plain = {"version": FORMAT, **packed(motion, "motion", arrays)}
        text = json.dumps(plain, default=lambda number: number.item())  # numpy's
    learned = {LEARNED + name: array for name, array in imitation.to_arrays().items()}
    content = npz_bytes({TEXT: np.array(text)} | learned | arrays)
    read_motion(content, path)  # what could not be read is refused now
    write_whole(path, content)


def save_scenario(path: str | os.PathLike[str], saved: Saved) -> None:
    """Write a scenario to a file, as the page does; an existing one is replaced only by a whole one.

    Raises:
        DataError: the page could not open it.
        OSError: the file cannot be written.
    """
    path, content = Path(path), encode(saved).encode()
    decode(content, KNOWN, str(path))  # what could not be read is refused now
    write_whole(path, content)


def is_scenario(path: Path) -> bool:
    """Return whether a file says that it is a saved scenario, whether or not it can be read."""
    is_small = path.is_file() and path.stat().st_size <= MAX_SCENARIO
    return is_small and path.suffix.lower() == ".json" and is_saved(path.read_bytes())


def read_scenario(path: Path, known: Known) -> Saved:
    """Read a scenario from a file, with the surfaces of its obstacles, which take seconds.

    Raises:
        DataError: there is no such file, it is no scenario, or has a value that no page of these names gives.
    """
    with parsing(ScenarioError, path, "path", "a readable file"):
        content = read_bytes(path, MAX_SCENARIO)
    saved = decode(content, known, str(path))
    check_shapes(saved.scenario, str(path))
    return saved


def read_scenarios(folder: Path, known: Known) -> tuple[Mapping[str, Saved], tuple[DataError, ...]]:
    """Read the scenarios of a folder, by the names of their files without the suffix; return also what is refused.

    Raises:
        ScenarioError: it is no folder, or holds no .json file, or too many.
    """
    with parsing(ScenarioError, folder, "folder", "a readable folder"):
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".json")
        if not 1 <= len(paths) <= MAX_SCENARIOS:
            raise FormatError("folder", f"{len(paths)} .json files", f"1 to {MAX_SCENARIOS} saved scenarios")
    read, refused = dict[str, Saved](), list[DataError]()
    for path in paths:
        try:
            if not re.fullmatch(r"[\w-]{1,60}", path.stem, re.ASCII):
                accepted = "letters, digits, - and _, up to 60, as a link has them"
                raise ScenarioError(path, "name", repr(path.stem)[:80], accepted)
            read[path.stem] = read_scenario(path, known)
        except DataError as error:
            refused.append(error)
    return read, tuple(refused)


def is_motion(file: bytes | Path) -> bool:
    """Return whether a file, its content or its path, says that it is a saved motion, whether or not it can be read."""
    if isinstance(file, Path):
        if not file.is_file():
            return False
        with file.open("rb") as opened:
            file = opened.read(30 + len(FIRST))
    return re.match(rb"PK\x03\x04.{26}" + FIRST, file, re.DOTALL) is not None


def motion_task(path: Path) -> Task:
    """Return a saved motion as a task of the page, with what was learned and its transforms.

    Raises:
        DataError: it cannot be read, or has what the page has not, such as two avoidances.
    """
    with parsing(MotionError, path, "path", "a readable file"):
        content = read_bytes(path, MAX_BYTES)
    return _task_of(*read_motion(content, path), path)


def sent_motion_task(name: str, content: bytes, cancelled: Cancelled) -> Task:
    """Return a motion that a visitor has sent, the name and the content of its file, as a task of the page.

    The archive is unpacked, and its shapes are measured, in another process. A motion in the augmented state is learned
    again in the time that demonstrations take, as it has the settings that these are learned with.

    Raises:
        DataError: as `motion_task`, or it was learned with other settings.
        UnwantedError: nobody wants it any more.
    """
    with parsing(MotionError, name, "file", "a file that Motion.save wrote"):
        sent = read_upload(Archive, [(name, content)], cancelled, max_bytes=MAX_BYTES, max_text=MAX_PLAIN)
        texts = {key: np.array(text) for key, text in sent.texts.items() if key == TEXT}
        read = _read({**texts, **sent.numbers, **sent.integers}, name, as_usual=True)
    with measured_apart(cancelled):
        return _task_of(*read, Path(name))


def _task_of(saved: SavedMotion, imitation: AnyImitation, path: Path) -> Task:
    """Return a motion as a task of the page. Raises DataError where it has what the page has not."""
    given = own_task(saved.demonstrations)
    task = replace(given, title=path.stem[:40], state=imitation.state, imitation=imitation, layers=saved.layers)
    with naming(MotionError, path):
        scenario = Scenario(OWN, in_world(task))
    decode(encode(Saved(scenario, own=Own.of(task))), KNOWN, str(path))  # what the page could not have is refused now
    check_shapes(scenario, str(path))
    return task


def load_motion(path: str | os.PathLike[str]) -> tuple[SavedMotion, AnyImitation] | Saved:
    """Read a motion from a file, or a scenario that the page has saved.

    Raises:
        DataError: there is no such file, it cannot be read, or is neither. Nothing else is raised, whatever the file
            holds.
    """
    path = Path(path)
    with parsing(MotionError, path, "path", "a readable file"):
        content = read_bytes(path, MAX_BYTES)
    return decode(content, KNOWN, str(path)) if is_saved(content) else read_motion(content, path)


def read_motion(content: bytes, source: str | Path) -> tuple[SavedMotion, AnyImitation]:
    """Read a motion from the bytes of a file; `source` is its name, for messages.

    Raises:
        DataError: as :func:`load_motion`.
    """
    with parsing(MotionError, source, "file", "a file that Motion.save wrote"):
        return _read(arrays_of(content, max_bytes=MAX_BYTES, max_arrays=MAX_ARRAYS), source)


def _read(
    arrays: Mapping[str, np.ndarray], source: str | Path, *, as_usual: bool = False
) -> tuple[SavedMotion, AnyImitation]:
    """Read a motion from the arrays of its file, `as_usual` one with the default settings of the augmented state.

    Raises:
        DataError, FormatError: it is none, or not so.
        Exception: of almost any kind, on hostile texts.
    """
    arrays = dict(arrays)
    text = arrays.pop(TEXT, np.zeros(0))
    if text.dtype.kind != "U" or text.ndim:
        raise FormatError("arrays", "no text that describes a motion", "a file that Motion.save wrote")
    check_at_most("text", text.itemsize // 4, MAX_TEXT, "characters")
    plain = json.loads(str(text), object_hook=_from_before)
    json.dumps(plain, ensure_ascii=False).encode()  # fails at half a character, which nothing could show
    version = plain.pop("version", None) if isinstance(plain, dict) else None
    if version != FORMAT:
        raise FormatError("version", repr(version)[:40], f"{FORMAT}; another version of DT-Viz may have saved it")
    check_types(arrays)
    check_at_most("layers", len(plain.get("layers", ())), MAX_LAYERS)
    classes = {Transform: registry.KINDS, Obstacle: SHAPES}
    motion: SavedMotion = unpacked(plain, SavedMotion, "motion", arrays, classes)
    learned = {name.removeprefix(LEARNED): array for name, array in arrays.items() if name.startswith(LEARNED)}
    demonstrations = check_demonstrations(motion.demonstrations, source)
    usual = AugmentedSettings(preparation=PreparationSettings(goal=motion.settings.preparation.goal))
    if as_usual and motion.augmented and motion.settings != usual:
        accepted = "the defaults on the page; the command line takes others"
        raise FormatError("settings of the augmented state", "others", accepted)
    imitation = _again(motion) if motion.augmented else Imitation.from_arrays(learned)
    if len(imitation.goal) != demonstrations[0].dimension:
        found = f"{len(imitation.goal)}, and demonstrations in {demonstrations[0].dimension}"
        raise FormatError("dimension of the imitation", found, "the same dimension")
    for layer in motion.layers:
        for obstacle in layer.transform.avoided.parts:
            check_between("distance of an obstacle", float(np.linalg.norm(obstacle.position)), 0.0, MAX_COORDINATE)
            check_between("length of its quaternion", float(np.linalg.norm(obstacle.wxyz)), 1e-3, 1e3)
    return replace(motion, demonstrations=demonstrations), imitation


def _again(motion: SavedMotion) -> AugmentedImitation:
    """Learn a motion again. Raises FormatError where that fails."""
    try:
        return fit_augmented(motion.demonstrations, motion.labels, motion.settings, motion.reason)
    except ImitationError as error:
        raise FormatError("demonstrations", str(error), "some that a motion is learned from") from error


def _from_before(plain: dict[str, Any]) -> dict[str, Any]:
    """Name the kind of an avoidance; versions before 0.1 had one, with a field."""
    if plain.get(CLASS) != Avoidance.__name__:
        return plain
    space = plain.pop("space", "task")
    if space not in SPACES:
        raise FormatError("space", repr(space)[:40], " or ".join(SPACES))
    held = {name: plain[name] for name in plain if space == "task" or name != "plane"}
    return held | {CLASS: Avoidance.kinds[space].__name__}
