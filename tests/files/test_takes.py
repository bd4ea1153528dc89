"""Recorded motions in every kind of file: written by the library that usually writes it, and read back equal."""

import json
import sys

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from recorded import (
    ANGLES,
    POSE,
    STATES,
    TEXTS,
    TF,
    TIMES,
    Planar,
    bag,
    lerobot,
    path_of,
    pose,
    read_demonstrations,
    robomimic,
    table,
    turns_of,
    wxyz,
    zipped,
)

from dt_viz.files.columns import role_of
from dt_viz.files.takes import READERS
from dt_viz.learning.demonstrations import Demonstration, DemonstrationError, load_demonstrations, save_demonstrations

RNG = np.random.default_rng(1)


def refusal(content, name, **options):
    with pytest.raises(DemonstrationError) as caught:
        read_demonstrations(content, name, **options)
    message = str(caught.value)
    assert "\n" not in message and ": found " in message and "; accepted: " in message
    return message


def assert_turns(demonstration, turns, atol=1e-12):
    assert demonstration.orientations is not None
    np.testing.assert_allclose(demonstration.orientations, turns, atol=atol)


def assert_same(demonstration, positions, times=TIMES):
    np.testing.assert_allclose(demonstration.positions, positions, rtol=1e-12)
    np.testing.assert_allclose(demonstration.times, times - times[0], rtol=1e-9, atol=1e-9)


class TestText:
    @pytest.mark.parametrize(
        "header",
        [
            "timestamp,pos_x,pos_y,pos_z,qx,qy,qz,qw",
            "# t x y z",
            "elapsed,ee_x,ee_y,ee_z,ee_vx,ee_vy,ee_vz",
            "header.stamp.sec,header.stamp.nsec,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,"
            "pose.orientation.y,pose.orientation.z,pose.orientation.w",
            "posX,posY,posZ,time_us",
            "t,target_x,target_y,target_z,x,y,z",
            "t,q1,q2,q3,q4,q5,q6,px,py,pz",
        ],
    )
    def test_headers(self, header):
        delimiter, stamps, columns = "," if "," in header else " ", 1.7e9 + TIMES, []
        names = header.removeprefix("# ").split(delimiter)
        for name in names:
            role = role_of(name)
            if name.endswith("nsec"):
                columns.append(np.round(1e9 * (stamps % 1)))
            elif name.endswith(".sec"):
                columns.append(np.floor(stamps))
            elif role and role.kind == "time":
                columns.append(TIMES * (1e6 if "us" in name else 1.0))
            elif role and role.kind in ("position", "orientation") and role.rank < 4:
                columns.append((path_of() if role.kind == "position" else turns_of())[:, "xyzw".index(role.part)])
            else:
                columns.append(RNG.normal(size=60))
        names[0] = "# t" if header[0] == "#" else names[0]
        (read,) = read_demonstrations(table(names, columns, delimiter), "take.csv")
        np.testing.assert_allclose(read.positions, path_of(), rtol=1e-12)
        np.testing.assert_allclose(read.times, TIMES, atol=1e-6)
        assert (read.orientations is not None) == ("w" in header)
        if read.orientations is not None:
            assert_turns(read, wxyz(turns_of()))

    @given(
        st.sampled_from(["t", "time", "timestamp", "Stamp", "elapsed"]),
        st.sampled_from(["", "_s", "_ms", " [us]", "_ns"]),
        st.sampled_from(["{}", "pos_{}", "position.{}", "tool0 {}", "field.pose.position.{}", "P{}", "{}_tcp"]),
        st.sampled_from(["", "_mm", " (m)", " [cm]"]),
        st.permutations(range(6)),
        st.sampled_from([",", ";", "\t"]),
    )
    def test_names_order_units_and_delimiters_do_not_matter(self, clock, time_unit, places, unit, order, delimiter):
        seconds = {"_ms": 1e-3, " [us]": 1e-6, "_ns": 1e-9}.get(time_unit, 1.0)
        metres = {"_mm": 1e-3, " [cm]": 1e-2}.get(unit, 1.0)
        path = path_of()
        names = [clock + time_unit, *(places.format(axis) + unit for axis in "xyz"), "force_x", "note"]
        columns = [TIMES / seconds, *(path / metres).T, RNG.normal(size=60), RNG.normal(size=60)]
        content = table([names[k] for k in order], [columns[k] for k in order], delimiter)
        (read,) = read_demonstrations(content, "take.csv")
        assert_same(read, path)

    def test_units_are_recognised_said_and_given(self, caplog):
        path = path_of()
        content = table(["t", "x", "y", "z"], [1e3 * (5 + TIMES), *(1e3 * path).T])
        assert_same(read_demonstrations(content, "a.csv", unit="mm,ms")[0], path)
        assert not caplog.messages
        with caplog.at_level("WARNING"):
            (read,) = read_demonstrations(content, "a.csv")
        assert_same(read, path)
        assert caplog.messages == ["a.csv: taken as in mm and ms by its size; unit=… says otherwise"]
        assert "unit: found 'miles'; accepted: m, cm, mm" in refusal(content, "a.csv", unit="miles")

    @pytest.mark.parametrize(("rate", "unit"), [(5, "ms"), (100, "ms"), (1000, "us"), (30, "ns"), (1000, "ns")])
    def test_units_of_times_are_those_that_make_a_rate(self, rate, unit):
        times, size = np.arange(600) / rate, {"ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
        content = table(["t", "x", "y", "z"], [times * size, *path_of(num=600).T])
        np.testing.assert_allclose(read_demonstrations(content, "a.csv")[0].times, times, rtol=1e-9)

    def test_takes_are_told_apart_by_label_and_by_times_that_begin_again(self):
        paths = [path_of(k) for k in range(3)]
        clock, places = np.tile(TIMES, 3), np.concatenate(paths)
        for names, columns in (
            (["t", "x", "y", "z"], [clock, *places.T]),
            (["t", "x", "y", "z", "trial"], [clock, *places.T, np.repeat(np.arange(3), 60)]),
            (["t", "x", "y", "z", "episode_index"], [np.arange(180) / 50, *places.T, np.repeat(np.arange(3), 60)]),
        ):
            read = read_demonstrations(table(names, columns), "takes.csv")
            assert len(read) == 3
            for demonstration, path in zip(read, paths, strict=True):
                assert_same(demonstration, path)

    def test_tables_without_header(self):
        path, turns = path_of(), turns_of()
        for columns, rate in (([TIMES, path], None), ([path], 50), ([TIMES, path, turns], None), ([path, turns], 50)):
            rows = np.column_stack(columns)
            for delimiter in (" ", ",", "\t", ";"):
                text = "\n".join(delimiter.join(map(repr, row)) for row in rows.tolist()).encode()
                (read,) = read_demonstrations(text, "take.txt", rate=rate)
                assert_same(read, path)
                assert (read.orientations is None) == (rows.shape[1] < 7)
        (flat,) = read_demonstrations(
            "\n".join(f"{t} {x} {y}" for t, (x, y, _) in zip(TIMES, path, strict=True)).encode(), "a.txt"
        )
        assert_same(flat, path[:, :2])

    def test_decimal_commas(self):
        text = table(["t", "x", "y", "z"], [TIMES, *path_of().T], ";").replace(b".", b",")
        assert_same(read_demonstrations(text, "a.csv")[0], path_of())

    def test_what_is_not_clear_is_asked_for(self):
        path = path_of()
        content = table(["left_x", "left_y", "right_x", "right_y"], [*path[:, :2].T, *path[:, :2].T])
        assert "2 places (left, right)" in refusal(content, "a.csv")
        columns = {"x": "right_x", "y": "right_y"}
        assert_same(read_demonstrations(content, "a.csv", columns=columns, rate=50)[0], path[:, :2])
        content = table(["a", "b", "c"], path.T)
        assert "'a,b,c'" in refusal(content, "a.csv")
        assert_same(read_demonstrations(content, "a.csv", columns="x,y,z", rate=50)[0], path)
        assert "no 'd' in" in refusal(content, "a.csv", columns={"x": "d", "y": "b"})
        assert "2 names for 3 columns" in refusal(content, "a.csv", columns="x,y")
        content = table(["1", "2", "3", "4", "5"], RNG.normal(size=(5, 9)))
        assert "5 columns without names" in refusal(content, "a.csv")


class TestArrays:
    def test_npy(self, tmp_path):
        np.save(tmp_path / "one.npy", path_of())
        np.save(tmp_path / "timed.npy", np.column_stack([TIMES, path_of()]))
        np.save(tmp_path / "poses.npy", np.column_stack([path_of(), turns_of()]))
        fields = np.array([(t, *p) for t, p in zip(TIMES, path_of(), strict=True)], [(n, "f8") for n in ("t", *"xyz")])
        np.save(tmp_path / "named.npy", fields)
        for path in tmp_path.iterdir():
            timed = path.stem in ("timed", "named")
            (read,) = load_demonstrations(path, rate=None if timed else 50)
            assert_same(read, path_of())
            assert read.name == path.stem
        np.save(tmp_path / "many.npy", np.stack([path_of(k) for k in range(4)]))
        read = load_demonstrations(tmp_path / "many.npy", rate=50)
        assert [d.name for d in read] == [f"many {k}" for k in range(4)]
        assert_same(read[3], path_of(3))

    def test_objects_are_never_unpickled_and_the_message_says_what_to_do(self, tmp_path):
        ragged = np.empty(2, dtype=object)
        ragged[:] = [path_of(num=20), path_of(num=30)]
        np.save(tmp_path / "a.npy", ragged, allow_pickle=True)
        message = refusal((tmp_path / "a.npy").read_bytes(), "a.npy")
        assert "never unpickled" in message and "np.savez(path, *takes)" in message
        np.savez(tmp_path / "a.npz", ragged=ragged)
        assert "never opened" in refusal((tmp_path / "a.npz").read_bytes(), "a.npz")
        np.savez(tmp_path / "b.npz", *ragged)
        assert [len(d.times) for d in load_demonstrations(tmp_path / "b.npz")] == [20, 30]

    @pytest.mark.parametrize(
        "arrays",
        [
            {"time": TIMES, "pos": path_of()},
            {"t": TIMES, "x": path_of()},
            {"t": TIMES[:, None], "positions": path_of().T},
            {"timestamps": 1e3 * TIMES, "ee_pos": 1e3 * path_of(), "ee_quat": turns_of(), "velocities": path_of(1)},
            {
                "stamp_ns": (1e9 * TIMES).astype(np.int64),
                "x": path_of()[:, 0],
                "y": path_of()[:, 1],
                "z": path_of()[:, 2],
            },
            {"positions": path_of(), "rate": 50.0},
            {"positions": path_of()[None], "times": TIMES},
            {"trajectory": path_of(), "dt": 0.02},
        ],
    )
    @pytest.mark.parametrize("suffix", ["npz", "mat", "json"])
    def test_named_arrays(self, tmp_path, arrays, suffix):
        path = tmp_path / f"take.{suffix}"
        if suffix == "npz":
            np.savez(path, **arrays)
        elif suffix == "mat":
            scipy.io.savemat(path, {"run": arrays} if "pos" in arrays else arrays)
        else:
            path.write_text(json.dumps({key: np.asarray(value).tolist() for key, value in arrays.items()}))
        (read,) = load_demonstrations(path, unit="ms,mm" if "timestamps" in arrays else None)
        assert_same(read, path_of())
        if "ee_quat" in arrays:
            assert_turns(read, wxyz(turns_of()))

    def test_several_takes_of_named_arrays(self, tmp_path):
        takes = {f"take_{k}": path_of(k, 40 + k) for k in range(3)}
        np.savez(tmp_path / "a.npz", **takes)  # pyright: ignore[reportArgumentType]
        scipy.io.savemat(tmp_path / "b.mat", takes)
        records = [
            {"name": f"take_{k}", "times": np.arange(40 + k) / 50, "positions": takes[f"take_{k}"]} for k in range(3)
        ]
        plain = [{key: np.asarray(value).tolist() for key, value in record.items()} for record in records]
        (tmp_path / "c.json").write_text(json.dumps({"demonstrations": plain}))
        (tmp_path / "d.json").write_text(json.dumps({take["name"]: take for take in plain}))
        cells = np.empty(3, dtype=object)
        cells[:] = [{"time": record["times"], "pos": record["positions"].T} for record in records]
        scipy.io.savemat(tmp_path / "e.mat", {"takes": cells})
        for path in sorted(tmp_path.iterdir()):
            read = load_demonstrations(path, rate=50 if path.stem in "ab" else None)
            assert len(read) == 3
            for k, demonstration in enumerate(read):
                assert_same(demonstration, takes[f"take_{k}"], np.arange(40 + k) / 50)

    @pytest.mark.parametrize("nested", [False, True])
    def test_json_records(self, nested):
        def record(t, x, y, z):
            if not nested:
                return {"t": t, "position": [x, y, z]}
            stamp = {"sec": 1700000000 + int(t), "nanosec": round(t % 1 * 1e9)}
            return {"stamp": stamp, "pose": {"position": {"x": x, "y": y, "z": z}}}

        records = [record(*row) for row in np.column_stack([TIMES, path_of()]).tolist()]
        (read,) = read_demonstrations(json.dumps(records).encode(), "a.json")
        np.testing.assert_allclose(read.positions, path_of())
        np.testing.assert_allclose(read.times, TIMES, atol=1e-6)

    def test_json_lists(self):
        (read,) = read_demonstrations(json.dumps(path_of().tolist()).encode(), "a.json", rate=50)
        assert_same(read, path_of())
        ragged = [path_of(k, 30 + k).tolist() for k in range(3)]
        assert [len(d.times) for d in read_demonstrations(json.dumps(ragged).encode(), "a.json")] == [30, 31, 32]
        assert "the same fields in all samples" in refusal(b'[{"t":0,"x":1,"y":2},{"t":1,"x":1}]', "a.json")

    def test_the_files_own_npz_keeps_metres_and_orientations(self, tmp_path):
        saved = Demonstration(TIMES, 200 * path_of() % 90, "a", wxyz(turns_of()))
        save_demonstrations(tmp_path / "a.npz", [saved])
        (read,) = load_demonstrations(tmp_path / "a.npz")
        assert_same(read, saved.positions)
        assert_turns(read, saved.orientations)


class TestOrientations:
    @pytest.mark.parametrize("name", ["ori_wxyz", "quat", "orientation_xyzw"])
    def test_order_is_by_name_and_signs_do_not_jump(self, tmp_path, name):
        turns = wxyz(turns_of()) if name == "ori_wxyz" else turns_of()
        np.savez(
            tmp_path / "a.npz", t=TIMES, pos=path_of(), **{name: turns * np.where(np.arange(60) % 2, -1, 1)[:, None]}
        )
        (read,) = load_demonstrations(tmp_path / "a.npz")
        assert_turns(read, wxyz(turns_of()))
        assert read.orientations is not None and not read.orientations.flags.writeable


class TestJoints:
    @pytest.mark.parametrize(
        ("names", "order", "size"),
        [
            (["q1", "q2"], [0, 1], 1.0),
            (["joint_elbow", "joint_shoulder"], [1, 0], 1.0),
            (["joint.elbow", "joint.shoulder"], [1, 0], 1.0),
            (["J1_deg", "J2_deg"], [0, 1], 180 / np.pi),
            (["position0", "position1"], [0, 1], 1.0),
            (["joint_positions[0]", "joint_positions[1]"], [0, 1], 1.0),
        ],
    )
    def test_angles_become_places_of_the_hand_by_the_arm(self, names, order, size):
        content = table(["t", *names], [TIMES, *(size * ANGLES[:, order]).T])
        (read,) = read_demonstrations(content, "a.csv", arm=Planar())
        assert_same(read, Planar().end_effector(ANGLES))
        assert read.orientations is not None
        np.testing.assert_allclose(read.orientations, Planar().hand_orientation(ANGLES), atol=1e-12)
        message = refusal(content, "a.csv")
        assert "angles of 2 joints" in message and "arm=…" in message

    @pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
    @pytest.mark.parametrize(
        ("names", "size"),
        [
            (["elbow", "shoulder"], 1.0),
            (["Elbow", "Shoulder"], 1.0),
            (["elbow.pos", "shoulder.pos"], 1.0),
            (["observation.state.elbow", "observation.state.shoulder"], 1.0),
            (["elbow_deg", "shoulder_deg"], 180 / np.pi),
        ],
    )
    def test_columns_named_as_the_arms_joints_are_its_angles(self, tmp_path, suffix, names, size):
        columns = dict(
            zip(
                [*names, "elbow_vel", "action.elbow", "gripper_elbow"], size * ANGLES[:, [1, 0, 0, 0, 0]].T, strict=True
            )
        )
        path = tmp_path / f"a{suffix}"
        if suffix == ".csv":
            path.write_bytes(table(["t", *columns], [TIMES, *columns.values()]))
        elif suffix == ".npz":
            np.savez(path, t=TIMES, **columns)
        else:
            pq, pa = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
            pq.write_table(pa.table({"t": TIMES, **columns}), path)
        assert_same(load_demonstrations(path, arm=Planar())[0], Planar().end_effector(ANGLES))
        with pytest.raises(DemonstrationError, match=r"no places|no takes"):
            load_demonstrations(path)

    def test_degrees_are_recognised_and_a_gripper_is_left_out(self, tmp_path):
        np.savez(tmp_path / "a.npz", t=TIMES, qpos=np.column_stack([180 / np.pi * ANGLES, np.full(60, 30)]))
        assert_same(load_demonstrations(tmp_path / "a.npz", arm=Planar())[0], Planar().end_effector(ANGLES))

    def test_arrays_as_wide_as_the_arm_are_its_angles(self, tmp_path):
        class Long(Planar):
            joint_names = tuple("abcdefg")

        q = RNG.uniform(-1, 1, (60, 7))
        np.save(tmp_path / "a.npy", q)
        assert_same(load_demonstrations(tmp_path / "a.npy", rate=50, arm=Long())[0], Long().end_effector(q))
        with pytest.raises(DemonstrationError, match="7 columns without names"):
            load_demonstrations(tmp_path / "a.npy")

    def test_other_numbers_of_joints_and_two_kinds_in_one_folder_are_refused(self, tmp_path):
        (tmp_path / "a.csv").write_bytes(table(["t", "x", "y", "z"], [TIMES, *path_of().T]))
        (tmp_path / "b.csv").write_bytes(table(["t", *(f"q{k}" for k in range(5))], [TIMES, *RNG.normal(size=(5, 60))]))
        with pytest.raises(DemonstrationError, match=r"joint angles in 'b' but places of the hand in 'a'"):
            load_demonstrations(tmp_path)
        with pytest.raises(DemonstrationError, match=r"b\.csv.*angles of 5 joints.*the arm's 2 \(shoulder, elbow\)"):
            load_demonstrations(tmp_path / "b.csv", arm=Planar())


class TestParquet:
    def test_a_lerobot_data_set(self, tmp_path):
        lerobot(tmp_path / "places", ["x", "y", "z"])
        read = load_demonstrations(tmp_path / "places")
        assert [d.name for d in read] == ["0", "1"]
        np.testing.assert_allclose(read[1].positions, path_of(1), rtol=1e-6)
        np.testing.assert_allclose(read[1].times, TIMES, atol=1e-6)
        lerobot(tmp_path / "angles", {"motors": ["shoulder.pos", "elbow.pos", "gripper.pos"]})
        read = load_demonstrations(tmp_path / "angles", arm=Planar())
        np.testing.assert_allclose(read[0].positions, Planar().end_effector(path_of()[:, :2]), atol=1e-6)
        with pytest.raises(DemonstrationError, match=r"angles of 2 joints \(observation"):
            load_demonstrations(tmp_path / "angles")
        file = next((tmp_path / "angles").rglob("*.parquet"))
        np.testing.assert_allclose(load_demonstrations(file, arm=Planar())[0].duration, TIMES[-1], rtol=1e-6)


class TestHdf5:
    def test_robomimic(self, tmp_path):
        robomimic(tmp_path / "low_dim.hdf5")
        read = load_demonstrations(tmp_path / "low_dim.hdf5")
        assert [d.name for d in read] == ["demo_0", "demo_1", "demo_10"]
        assert_same(read[2], path_of(10))
        assert_turns(read[2], wxyz(turns_of()))

    def test_plain_arrays(self, tmp_path):
        h5py = pytest.importorskip("h5py")
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["time"], file["positions"] = TIMES, path_of()
        assert_same(load_demonstrations(tmp_path / "a.h5")[0], path_of())


class TestBags:
    @pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
    @pytest.mark.parametrize(
        "topics",
        [POSE | TF | STATES | TEXTS, {"/p": ("geometry_msgs/msg/Pose", pose)}, TF],
        ids=["PoseStamped", "Pose", "TFMessage"],
    )
    def test_poses(self, tmp_path, suffix, topics):
        path = bag(tmp_path / f"take{suffix}", topics)
        loud = tmp_path / f"loud{suffix.upper()}"
        loud.write_bytes(path.read_bytes())
        for read in (*map(load_demonstrations, (path, loud)), read_demonstrations(path.read_bytes(), f"take{suffix}")):
            assert len(read) == 1
            assert_same(read[0], path_of())
            assert_turns(read[0], wxyz(turns_of()))
        if suffix != ".bag":
            assert_same(load_demonstrations(path.parent)[0], path_of())

    @pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
    def test_joint_states_become_places_by_the_arm(self, tmp_path, suffix):
        path = bag(tmp_path / f"take{suffix}", STATES | TEXTS)
        assert_same(load_demonstrations(path, arm=Planar())[0], Planar().end_effector(ANGLES))
        with pytest.raises(DemonstrationError, match=r"angles of 2 joints \(elbow, shoulder\)"):
            load_demonstrations(path)

    def test_topics_are_listed_where_none_or_several_have_poses(self, tmp_path):
        path = bag(tmp_path / "none.mcap", TEXTS)
        with pytest.raises(DemonstrationError, match=r"no poses among the topics /log \(String\)"):
            load_demonstrations(path)
        path = bag(tmp_path / "two.mcap", POSE | {"/wanted": POSE["/ee"]} | TF)
        with pytest.raises(DemonstrationError, match=r"/ee \(PoseStamped\), /wanted \(PoseStamped\).*topic="):
            load_demonstrations(path)
        assert_same(load_demonstrations(path, topic="/wanted")[0], path_of())
        assert_same(load_demonstrations(path, topic="tool0")[0], path_of())
        with pytest.raises(DemonstrationError, match="frames camera, tool0"):
            load_demonstrations(path, topic="nowhere")


class TestFolders:
    def test_files_of_all_kinds_are_read_together(self, tmp_path):
        (tmp_path / "a.csv").write_bytes(table(["t", "x", "y", "z"], [TIMES, *path_of().T]))
        np.savez(tmp_path / "b.npz", t=TIMES, pos=path_of(1))
        (tmp_path / "c.json").write_text("{}")
        (tmp_path / "notes.txt").write_text("ours")
        scipy.io.savemat(tmp_path / "d.mat", {"t": TIMES, "pos": path_of(2).T})
        read = load_demonstrations(tmp_path)
        assert [d.name for d in read] == ["a", "b", "d"]
        assert_same(read[2], path_of(2))
        assert len(load_demonstrations([tmp_path / "a.csv", str(tmp_path)])) == 4
        with pytest.raises(DemonstrationError, match="found none"):
            load_demonstrations([])

    def test_units_are_recognised_over_all_files_and_said_once(self, tmp_path, caplog):
        for k, size in enumerate((1, 10, 20)):  # the first alone might be metres
            (tmp_path / f"{k}.csv").write_bytes(
                table(["t", "x", "y", "z", "n"], [TIMES, *(10 * size * path_of()).T, TIMES])
            )
        read = load_demonstrations(tmp_path)
        assert_same(read[0], 0.01 * path_of())
        assert caplog.messages == [
            f"{tmp_path / '0.csv'} and 2 more: columns n are not used",
            f"{tmp_path}: taken as in mm by its size; unit=… says otherwise",
        ]


@pytest.mark.parametrize(
    ("suffix", "module", "extra"),
    [(".parquet", "pyarrow.parquet", "parquet"), (".h5", "h5py", "hdf5"), (".mcap", "rosbags.highlevel", "ros")],
)
def test_a_missing_reader_is_one_line_that_names_the_extra(monkeypatch, suffix, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    assert f"pip install 'dt-viz[{extra}]'" in refusal(b"PAR1", f"a{suffix}")


def test_a_gigabyte_is_refused_by_its_size(tmp_path):
    for suffix in READERS:
        path = tmp_path / f"a{suffix}"
        with path.open("wb") as file:
            file.truncate(10**9)
        with pytest.raises(DemonstrationError, match=r"found 1000\.0 MB; accepted: at most"):
            load_demonstrations(path)
        path.unlink()


class Panda:
    """Seven joints, whose hand is where the first three angles say, and whose orientations are not known."""

    joint_names = tuple(f"joint{k}" for k in range(1, 8))

    def end_effector(self, q):
        return np.asarray(q)[..., :3]


@pytest.mark.parametrize("name", ["positions", "joints"])
def test_an_empty_array_that_claims_very_many_columns_is_refused_at_once(tmp_path, name):
    np.savez(tmp_path / "a.npz", **{name: np.empty((3, 0, 10**9)), "times": TIMES})  # pyright: ignore[reportArgumentType]
    with pytest.raises(DemonstrationError, match=r"columns.*1000000000.*at most 1000"):
        load_demonstrations(tmp_path / "a.npz", arm=Panda())


def test_a_gripper_beside_joint_angles_says_nothing_of_their_unit(tmp_path):
    q = np.column_stack([np.resize(path_of(), (60, 3)), np.zeros((60, 4)), np.linspace(0, 255, 60)])
    np.savez(tmp_path / "arm.npz", qpos=q, time=TIMES)
    (take,) = load_demonstrations(tmp_path / "arm.npz", arm=Panda())
    np.testing.assert_allclose(take.positions, q[:, :3])
    assert take.orientations is None


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (
            json.dumps([path_of().tolist(), [*path_of().tolist()[:-1], [1.0]]]).encode(),
            "a.json",
            "take 2: found no places",
        ),
        (table(("t", "x_mm", "y_mm", "z_cm"), [TIMES, path_of()]), "a.csv", "several units of one length"),
        (b"t,x,y,z\n0,0.1,0.2,\n1,0.2,0.3,0.4\n2,0.3,0.4,0.5\n", "a.csv", "line 2"),
        (zipped({"x.npy": b"no array"}), "a.npz", "another member"),
    ],
    ids=["a short row", "two units", "an empty cell", "another member"],
)
def test_nothing_is_left_out_without_a_word(content, name, words):
    assert words in refusal(content, name)


@pytest.mark.parametrize(("unit", "value", "seconds"), [("", 0.01, 0.01), ("_ms", 10.0, 0.01), (" [ms]", 20.0, 0.02)])
def test_a_column_of_intervals_has_a_unit(unit, value, seconds):
    content = table((f"dt{unit}", "x", "y", "z"), [np.full(60, value), path_of()])
    (take,) = read_demonstrations(content, "a.csv")
    assert take.duration == pytest.approx(59 * seconds)


def test_lists_of_different_lengths_are_refused(tmp_path):
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    places = [*path_of()[:, :2].tolist(), [0.1, 0.2], [0.1, 0.2, 0.3, 0.4]]
    parquet.write_table(pa.table({"observation.state": places}), tmp_path / "a.parquet")
    with pytest.raises(DemonstrationError, match="lists of different lengths"):
        load_demonstrations(tmp_path / "a.parquet", rate=20)


def test_takes_may_have_letters_for_names(tmp_path):
    np.savez(tmp_path / "k.npz", a=path_of(0), b=path_of(1))
    takes = load_demonstrations(tmp_path / "k.npz", rate=20)
    for take, path in zip(takes, (path_of(0), path_of(1)), strict=True):
        np.testing.assert_allclose(take.positions, path)


def test_half_a_take_of_our_own_is_refused(tmp_path):
    np.savez(tmp_path / "k.npz", times_0=TIMES, positions_0=path_of(), times_1=TIMES)
    with pytest.raises(DemonstrationError, match="only one of times_1 and positions_1"):
        load_demonstrations(tmp_path / "k.npz")
