"""Visitors' recordings: several files at once, archives, what is asked, and what is refused, by the limited process."""

import io
import zipfile
from functools import partial

import numpy as np
import pytest
from recorded import TIMES, bag, path_of, table, zipped

from dt_viz.errors import FormatError
from dt_viz.files import recordings
from dt_viz.files.reading import read_upload
from dt_viz.files.recordings import NO_COLUMN, Recordings, read_recordings

HEADER = ("t", "x", "y", "z")
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "wrist_yaw")
TIMED = table(HEADER, [TIMES, *path_of().T])


def read(*files, answers=None, process=False):
    """What is read of files, each a name and its content."""
    reader = partial(read_upload, Recordings) if process else read_recordings
    return reader([*files], answers=answers or {}, joint_names=[*JOINT_NAMES])


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_several_files_and_an_archive_of_their_folder_give_the_same_takes():
    files = {f"take_{k}.csv": table(HEADER, [TIMES, *path_of(k).T]) for k in range(3)}
    archive = zipped({f"takes/day/{name}": content for name, content in files.items()} | {"__MACOSX/._a.csv": b"?"})
    one, other = read(*files.items()), read(("all.zip", archive), process=True)
    assert [take.name for take in one.takes] == [take.name for take in other.takes] == ["take_0", "take_1", "take_2"]
    for k, (take, same) in enumerate(zip(one.takes, other.takes, strict=True)):
        np.testing.assert_array_equal(take.positions, path_of(k))
        np.testing.assert_array_equal(take.positions, same.positions)
    assert one.refused == other.refused == one.notes == other.notes == ()


def test_joint_angles_orientations_and_missing_times_come_through():
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (60, 1))
    poses = table(("x", "y", "z", "qx", "qy", "qz", "qw"), [*path_of().T, *turns.T])
    angles = table(["t", *(f"{name}.pos" for name in JOINT_NAMES), "gripper.pos"], np.eye(8))
    found = read(("a.csv", poses), ("b.npy", npy(np.zeros((50, 6)))), ("c.csv", angles), process=True)
    assert not found.takes[0].is_timed and found.takes[0].orientations is not None
    np.testing.assert_array_equal(found.takes[0].orientations, np.roll(turns, 1, axis=1))
    assert found.takes[1].positions is None and found.takes[1].joint_names[:2] == ("joint1", "joint2")
    assert found.takes[2].joint_names == JOINT_NAMES and not found.questions
    np.testing.assert_array_equal(found.takes[2].joints, np.eye(8)[:, 1:7])


def test_a_file_that_cannot_be_read_is_named_and_the_others_are_read():
    bad = b"t,x,y,z\n0,0,0,0\n1,0,nan,0\n"
    found = read(("a.csv", TIMED), ("b.csv", bad), ("c.txt.exe", b"?"), ("d.zip", b"no archive"), ("e.npz", TIMED))
    assert [take.name for take in found.takes] == ["a"]
    names = [line.partition(":")[0] for line in found.refused]
    assert names == ["b.csv", "c.txt.exe", "d.zip", "e.npz"] and "nan at line 3" in found.refused[0]
    assert all("found " in line and "accepted: " in line and "\n" not in line for line in found.refused)


def test_what_is_not_used_of_several_files_is_said_once():
    content = table((*HEADER, "current"), [TIMES, *path_of().T, TIMES])
    found = read(*((f"{k}.csv", content) for k in range(3)))
    assert found.notes == ("0.csv and 2 more: columns current are not used",)


def test_what_of_an_archive_is_no_recording_is_said():
    found = read(("all.zip", zipped({"a/notes.md": b"# day 1", "a/one.csv": TIMED, "a/.hidden.csv": b"?"})))
    assert len(found.takes) == 1 and found.notes == ("all.zip: not read are a/notes.md",)


def test_columns_that_are_not_clear_are_guessed_and_asked_and_answers_are_for_files_that_ask():
    unclear = table(("when", "a", "b", "c", "note"), [TIMES, *path_of().T, TIMES])
    found = read(("clear.csv", TIMED), ("unclear.csv", unclear))
    question = found.questions["columns"]
    assert question.choices == ("when", "a", "b", "c", "note")
    assert question.answer == {"t": NO_COLUMN, "x": "when", "y": "a", "z": "b"}
    answers = {"columns": {"t": "when", "x": "a", "y": "b", "z": "c"}}
    found = read(("clear.csv", TIMED), ("unclear.csv", unclear), answers=answers)
    assert found.questions["columns"].answer == answers["columns"] and found.refused == ()
    for take in found.takes:
        np.testing.assert_array_equal(take.positions, path_of())
        np.testing.assert_array_equal(take.times, TIMES)
    forged = {"columns": {"t": "when", "x": "__class__", "y": "b", "z": "c"}, "topic": 7}
    assert read(("unclear.csv", unclear), answers=forged).questions["columns"].answer["x"] == "when"


@pytest.mark.parametrize("suffix", [".csv", ".npy"])
def test_columns_without_names_can_be_told_by_their_numbers(suffix):
    values = np.column_stack([path_of(), *(TIMES,) * 2])
    content = npy(values) if suffix == ".npy" else "\n".join(",".join(map(repr, r)) for r in values.tolist()).encode()
    answer = {"t": "column 4", "x": "column 1", "y": "column 2", "z": "column 3"}
    found = read((f"a{suffix}", content), answers={"columns": answer})
    np.testing.assert_array_equal(found.takes[0].positions, path_of())
    np.testing.assert_array_equal(found.takes[0].times, TIMES)
    assert found.questions["columns"].choices == tuple(f"column {k}" for k in range(1, 6))


def test_a_column_that_is_given_two_roles_is_used_for_both():
    answer = {"t": "column 4", "x": "column 1", "y": "column 1", "z": NO_COLUMN}
    found = read(("a.npy", npy(np.column_stack([path_of(), *(TIMES,) * 2]))), answers={"columns": answer})
    assert found.takes[0].positions is not None and found.takes[0].positions.shape == (60, 2)


def test_three_columns_without_names_whose_first_may_have_times_are_asked_about():
    values = np.column_stack([TIMES, path_of()[:, :2]])
    content = "\n".join(",".join(map(repr, row)) for row in values.tolist()).encode()
    found = read(("a.csv", content))
    assert found.questions["reading"].choices == ("t,x,y", "x,y,z") and found.questions["reading"].answer == "t,x,y"
    np.testing.assert_array_equal(found.takes[0].times, TIMES)
    found = read(("a.csv", content), answers={"reading": "x,y,z"})
    np.testing.assert_array_equal(found.takes[0].positions, values)
    assert read(("a.csv", content), answers={"reading": "t,q,r"}).questions["reading"].answer == "t,x,y"


def test_the_topic_of_a_bag_is_asked_for(tmp_path):
    kind = "geometry_msgs/msg/Point"
    both = {
        topic: (kind, lambda k, types, sign=sign: types[kind](*(sign * path_of()[k])))
        for sign, topic in ((1.0, "/hand"), (-1.0, "/other"))
    }
    bag(tmp_path / "bag.mcap", both)
    files = {f"bag/{path.name}": path.read_bytes() for path in (tmp_path / "bag").iterdir()}
    (name,) = [name for name in files if name.endswith(".mcap")]
    for sent in (("take.mcap", files[name]), ("folder.zip", zipped(files))):
        found = read(sent)
        assert found.questions["topic"].choices == ("/hand", "/other") and found.questions["topic"].answer == "/hand"
        np.testing.assert_array_equal(found.takes[0].positions, path_of())
        np.testing.assert_array_equal(read(sent, answers={"topic": "/other"}).takes[0].positions, -path_of())


@pytest.mark.parametrize(("suffix", "key"), [(".npz", "b"), (".npz", "data"), (".h5", "demo_1/pos")])
def test_complex_numbers_are_refused_not_left_out(tmp_path, suffix, key):
    """A take of them went without a word where others were in the file."""
    first = "a" if suffix == ".npz" else "demo_0/pos"
    path, arrays = tmp_path / f"c{suffix}", {first: path_of(), key: path_of() + 1j}
    if suffix == ".npz":
        np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    (refused,) = read(("a.csv", TIMED), (path.name, path.read_bytes())).refused
    assert refused.startswith(f"c{suffix}: ") and f"'{key.rpartition('/')[2]}" in refused and "complex" in refused


def test_archives_that_unpack_to_much_or_climb_out_do_no_harm(tmp_path):
    bomb = zipped({"a.csv": b"0" * (recordings.LIMITS.unpacked + 1)}, zipfile.ZIP_DEFLATED)
    assert len(bomb) < 10**6
    many = zipped({f"{k}.csv": b"" for k in range(recordings.LIMITS.files + 1)})
    out = zipped({"/a/one.csv": TIMED, "../../two.csv": TIMED})
    found = read(("a.csv", TIMED), ("bomb.zip", bomb), ("many.zip", many), ("out.zip", out))
    assert [line.partition(":")[0] for line in found.refused] == ["bomb.zip", "many.zip"]
    assert [take.name for take in found.takes] == ["a", "one"]  # within its folder, as zipfile has it
    lies = bytearray(zipped({"a.csv": TIMED}))
    lies[lies.index(b"PK\1\2") + 24 : lies.index(b"PK\1\2") + 28] = (2**31).to_bytes(4, "little")
    assert read(("a.csv", TIMED), ("lies.zip", bytes(lies))).refused


def test_more_numbers_than_a_visitor_may_keep_are_refused(monkeypatch):
    monkeypatch.setattr(recordings, "LIMITS", recordings.RecordingLimits(numbers=300))
    found = read(("a.csv", TIMED), ("b.csv", TIMED))
    assert len(found.takes) == 1 and "on the page; the command line takes more" in found.refused[0]


def test_where_nothing_can_be_read_the_reason_is_said_once():
    nested = zipped({"takes.zip": zipped({"a.csv": TIMED})})
    broken = TIMED.replace(TIMED.splitlines()[3], b"1,2")
    for files, said in (
        ([("a.csv", broken)], "line 4: found 2 columns; accepted: 4, as in the first line"),
        ([("a.csv", broken), ("b.csv", b"")], "a.csv: line 4: found 2 columns; accepted: 4, as in the first line"),
        ([("a.zip", zipped({"b.csv": broken}))], "b.csv: line 4: found 2 columns; accepted: 4, as in the first line"),
        ([("a.zip", nested)], "archive: found takes.zip; accepted: files of the kinds .csv, "),
    ):
        with pytest.raises(FormatError) as raised:
            read(*files)
        assert str(raised.value).startswith(said) and str(raised.value).count("accepted") == 1
