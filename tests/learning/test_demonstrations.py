"""Loaders: what they accept, that what they give is the same motion, and what they say about everything else."""

import io
import pickle
from contextlib import suppress

import numpy as np
import pytest
import scipy.io
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from recorded import read_demonstrations

from dt_viz.files.npz import npz_bytes
from dt_viz.files.takes import UNTIMED
from dt_viz.learning.demonstrations import (
    Demonstration,
    DemonstrationError,
    check_demonstrations,
    lasa_files,
    load_demonstrations,
    save_demonstrations,
)

SUFFIXES = [".csv", ".npz", ".npy", ".mat", ".json"]


def motion(name="one", n=5, dimension=2):
    positions = np.stack([np.linspace(0.1 * k, 1, n) for k in range(dimension)], axis=1)
    return Demonstration(np.linspace(0, 2, n), positions, name)


def lasa_bytes(demos=None, **variables):
    """Return a MATLAB file laid out as the LASA handwriting files are: pos 2×T in millimetres."""
    if demos is None:
        demos = [
            {"pos": 10 * motion(n=4 + i).positions.T, "t": motion(n=4 + i).times[None], "vel": np.zeros((2, 4 + i))}
            for i in range(7)
        ]
    cells = np.empty((1, len(demos)), dtype=object)
    for i, fields in enumerate(demos):
        cells[0, i] = fields
    file = io.BytesIO()
    scipy.io.savemat(file, {"demos": cells, "dt": 0.1, **variables})
    return file.getvalue()


def refusal(content, source):
    with pytest.raises(DemonstrationError) as caught:
        read_demonstrations(content, source)
    message = str(caught.value)
    assert message.startswith(f"{source}: ") and "found " in message and "accepted: " in message
    return message


class TestChecks:
    def test_times_are_shifted_to_zero_and_arrays_are_read_only_floats_but_those_of_the_caller(self):
        given = Demonstration(np.array([5, 6, 8]), np.eye(3, dtype=int), "a")
        (checked,) = check_demonstrations([given], "memory")
        np.testing.assert_array_equal(checked.times, [0, 1, 3])
        assert checked.times.dtype == checked.positions.dtype == np.float64
        assert not checked.times.flags.writeable and not checked.positions.flags.writeable
        assert (checked.dimension, checked.duration) == (3, 3.0)
        assert given.times.flags.writeable and given.positions.flags.writeable and given.times[0] == 5
        (again,) = check_demonstrations([checked], "memory")
        np.testing.assert_array_equal(again.positions, checked.positions)
        np.testing.assert_array_equal(again.times, checked.times)

    @pytest.mark.parametrize(
        ("times", "positions", "words"),
        [
            ([0, 1, 2], np.eye(2), ["2 positions for 3 times"]),
            ([], np.ones((0, 2)), ["0 sample"]),
            ([0, np.inf], np.eye(2), ["times of 'a'", "inf at sample 2"]),
            ([0, 2, 1], np.eye(3), ["1 s at sample 3, after 2 s"]),
            ([-1e3, 1e-300, 2e-300], np.eye(3), ["sample 3"]),
            ([-1.7e308, 1.7e308], np.eye(2), ["milliseconds"]),
            ([0, 1], np.array([[1.0], [2.0]]), ["(2, 1)", "(T, 2) or (T, 3)"]),
            ([[0, 1]], np.eye(2), ["times of 'a'", "(1, 2)"]),
            ([0, 1], np.array([["x", "y"], ["z", "w"]]), ["type <U1"]),
            ([0, 1], np.eye(2) * 1j, ["type complex128"]),
            ([0, 5000], np.eye(2), ["5000 s", "milliseconds"]),
            ([0, 1], np.ones((2, 2)), ["stays at one point"]),
        ],
    )
    def test_refusals_say_what_is_wrong(self, times, positions, words):
        with pytest.raises(DemonstrationError) as caught:
            check_demonstrations([Demonstration(np.array(times), positions, "a")], "memory")
        assert all(word in str(caught.value) for word in ["memory: ", "accepted: ", *words]), str(caught.value)

    def test_the_error_survives_pickling(self):
        error = DemonstrationError("a.csv", "header line", "nothing", "a header")
        assert str(pickle.loads(pickle.dumps(error))) == str(error)


class TestNpz:
    @given(
        st.integers(2, 3).flatmap(
            lambda d: st.lists(
                arrays(np.float64, st.tuples(st.integers(2, 9), st.just(d)), elements=st.floats(-99, 99)), min_size=1
            )
        ),
        st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])),
    )
    @settings(max_examples=50)
    def test_round_trip(self, tmp_path_factory, tables, name):
        for table in tables:
            table[0, 0] = -100  # so that none stays at one point
        saved = [Demonstration(np.arange(float(len(table))), table, f"{name}{i}") for i, table in enumerate(tables)]
        path = tmp_path_factory.mktemp("npz") / "demos.npz"
        save_demonstrations(path, saved)
        loaded = load_demonstrations(path)
        assert [d.name for d in loaded] == [d.name for d in saved]
        for ours, theirs in zip(saved, loaded, strict=True):
            np.testing.assert_array_equal(ours.times, theirs.times)
            np.testing.assert_array_equal(ours.positions, theirs.positions)

    def test_names_are_optional_and_order_is_by_number(self):
        members = {}
        for i in (10, 2):
            members |= {f"times_{i}": motion(n=i).times, f"positions_{i}": motion(n=i).positions}
        loaded = read_demonstrations(npz_bytes(members), "run.npz")
        assert [(d.name, len(d.times)) for d in loaded] == [("run 2", 2), ("run 10", 10)]

    def test_pickled_arrays_are_never_opened(self, tmp_path):
        trap = tmp_path / "opened"

        class Trap:
            def __reduce__(self):
                return (open, (str(trap), "w"))

        hostile = np.empty(2, dtype=object)
        hostile[:] = [Trap(), Trap()]
        content = npz_bytes({"times_0": hostile, "positions_0": np.eye(2)})
        assert "never opened" in refusal(content, "trap.npz")
        refusal(pickle.dumps(Trap()), "trap.npz")
        assert not trap.exists()

    def test_missing_unknown_and_wrong_arrays_are_named(self):
        assert "no takes in an empty file" in refusal(npz_bytes({}), "a.npz")
        assert "no takes in 'times_0'" in refusal(npz_bytes({"times_0": np.arange(2)}), "a.npz")
        assert "'velocity_0'" in refusal(npz_bytes({"velocity_0": np.eye(2)}), "a.npz")


class TestCsv:
    def test_samples_without_times_are_even(self, caplog):
        text = b"demo,x,y,z\na,0,0,0\na,1,0,0\na,2,0,0\nb,1,0,0\nb,2,0,0\n"
        a, b = read_demonstrations(text, "a.csv", rate=50)
        np.testing.assert_allclose(a.times, [0, 0.02, 0.04])
        np.testing.assert_allclose(b.times, [0, 0.02])
        assert not caplog.messages
        a, b = read_demonstrations(text, "a.csv")
        np.testing.assert_allclose(a.times, [0, UNTIMED / 2, UNTIMED])
        assert b.duration == UNTIMED
        assert "no times and no rate" in caplog.text

    @pytest.mark.parametrize(
        ("content", "name", "rate", "words"),
        [
            (b"t,x,y\n0,1,2\n1,2,2\n", "a.csv", 50, "rate: found 50 beside a column of times"),
            (b"x,y\n1,2\n2,2\n", "a.csv", 0, "rate: found 0"),
            (b"x,y\n1,2\n2,2\n", "a.csv", float("nan"), "rate: found nan"),
            (npz_bytes({"t": np.arange(3), "x": np.eye(3)}), "a.npz", 50, "rate: found 50 beside a column of times"),
        ],
    )
    def test_a_rate_is_for_tables_without_times(self, content, name, rate, words):
        with pytest.raises(DemonstrationError, match=words):
            read_demonstrations(content, name, rate=rate)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("a,b\n0,1\n", ["columns: found no places", "'a,b'", "'t,x,y,z'", "columns={"]),
            ("t,x,y\n0,1\n", ["line 2", "2 columns"]),
            ("t,x,y\n0,1,2\n1,1,2,3\n", ["line 3", "4 columns"]),
            ("\n", ["0 sample"]),
            ("t,x,y\n0,1,2\n", ["1 sample"]),
            ("t,x,y\n0,1,2\n1,two,2\n", ["line 3", "'1,two,2'"]),
            ("t,x,y\n0,1,2\n1,nan,2\n", ["nan at line 3"]),
            ("demo,t,x,y\na,0,1,2\na,1,2,2\nb,0,1,2\n\nb,0,2,2\n", ["times of 'b'", "0 s at line 6, after 0 s"]),
        ],
    )
    def test_refusals_name_the_line(self, text, words):
        message = refusal(text.encode(), "bad.csv")
        assert all(word in message for word in words), message

    def test_a_folder_of_mixed_dimensions_is_refused_rather_than_read_in_part(self, tmp_path):
        (tmp_path / "a.csv").write_text("t,x,y\n0,0,0\n1,1,0\n")
        (tmp_path / "b.csv").write_text("t,x,y,z\n0,0,0,0\n1,1,0,0\n")
        with pytest.raises(DemonstrationError, match="2 in 'a' but 3 in 'b'"):
            load_demonstrations(tmp_path)


class TestLasa:
    def test_millimetres_become_metres(self):
        demonstrations = read_demonstrations(lasa_bytes(), "Zig.mat")
        assert len(demonstrations) == 7 and demonstrations[6].name == "Zig 6"
        np.testing.assert_allclose(demonstrations[2].positions, 0.01 * motion(n=6).positions)
        np.testing.assert_allclose(demonstrations[2].times, motion(n=6).times)

    @pytest.mark.parametrize(
        ("demos", "words"),
        [
            ([{"pos": np.eye(2)}], ["demos{1}", "no structure with t and pos"]),
            ([{"pos": "left", "t": np.array([[0.0, 1]])}], ["demos{1}.pos", "values of type <U4"]),
            ([{"pos": np.eye(2), "t": np.eye(2)}], ["demos{1}.t", "(2, 2)", "1×T"]),
            ([{"pos": np.eye(2), "t": np.array([[0.0, 1, 2]])}], ["2 positions for 3 times"]),
            ([{"pos": np.ones((9, 2)), "t": np.array([[0.0, 1]])}], ["demos{1}.pos", "(9, 2)"]),
            ([1.0], ["demos", "no structure with t and pos"]),
            ([], ["demonstrations: found none"]),
        ],
    )
    def test_other_layouts_are_refused(self, demos, words):
        message = refusal(lasa_bytes(demos), "odd.mat")
        assert all(word in message for word in words), message


class TestPaths:
    @pytest.mark.parametrize("load", [load_demonstrations, lasa_files])
    def test_what_is_missing_and_an_empty_folder_are_named(self, tmp_path, load):
        with pytest.raises(DemonstrationError, match="nowhere"):
            load(tmp_path / "nowhere")
        with pytest.raises(DemonstrationError, match=r"no (file of recorded motions|\.mat file)"):
            load(tmp_path)

    @pytest.mark.parametrize("name", ["a.pdf", "a", "a.csv.gz"])
    def test_other_suffixes_are_refused_with_the_list_of_ours(self, name):
        assert all(suffix in refusal(b"t,x,y\n", name) for suffix in SUFFIXES)

    @pytest.mark.parametrize("suffix", SUFFIXES)
    def test_an_empty_file_is_refused(self, suffix):
        assert "an empty file" in refusal(b"", f"a{suffix}")

    @pytest.mark.parametrize("path", ["\0.csv", "x" * 5000 + ".csv"])
    def test_impossible_paths_are_refused(self, path):
        with pytest.raises(DemonstrationError):
            load_demonstrations(path)


def read_or_refuse(content, source):
    """Read; the only exception let through is one that is not a DemonstrationError."""
    with suppress(DemonstrationError):
        for demonstration in read_demonstrations(content, source):
            assert np.isfinite(demonstration.positions).all()
            assert demonstration.times[0] == 0 and (np.diff(demonstration.times) > 0).all()


class TestHostileFiles:
    """Beside damaged files (tests/files/test_hostile_files.py)."""

    @pytest.mark.parametrize("suffix", SUFFIXES)
    @given(content=st.binary(max_size=2000))
    @example(content=b"\x80\x04")
    @example(content=b"PK\x05\x06" + bytes(18))
    def test_random_bytes(self, suffix, content):
        read_or_refuse(content, f"a{suffix}")

    @given(st.text(st.sampled_from("0123456789.,-eainfxyt\n\"' \0\r"), max_size=300))
    def test_random_tables(self, text):
        read_or_refuse(b"demo,t,x,y\n" + text.encode(), "a.csv")
