"""Recorded motions in files of each kind, written by the libraries that usually write them."""

import io
import json
import zipfile
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from dt_viz.learning.demonstrations import load_demonstrations

TIMES = 0.02 * np.arange(60)
RNG = np.random.default_rng(1)
ANGLES = np.column_stack([np.linspace(0, 1, 60), np.linspace(1, -0.5, 60)])  # of two joints


class Planar:
    """Kinematics of two links of 0.4 m in a plane."""

    joint_names = ("shoulder", "elbow")

    def end_effector(self, q):
        angles = np.cumsum(q, axis=-1)
        return np.stack([0.4 * np.cos(angles).sum(-1), 0.4 * np.sin(angles).sum(-1), 0 * angles[..., 0]], axis=-1)

    def hand_orientation(self, q):
        half = q.sum(axis=-1) / 2
        return np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)


def path_of(seed=0, num=60):
    """A motion (num, 3) within an arm's reach."""
    return np.array([0.3, -0.4, 0.2]) + np.random.default_rng(seed).normal(scale=0.02, size=(num, 3)).cumsum(axis=0)


def turns_of(num=60):
    """Orientations (num, 4), xyzw, that turn steadily."""
    return Rotation.from_rotvec(np.linspace(0, 1, num)[:, None] * [0.3, 1.0, -0.2]).as_quat()


def wxyz(turns):
    return np.roll(turns, 1, axis=1)


def table(names, columns, delimiter=","):
    rows = [delimiter.join(f"{value!r}" for value in map(float, row)) for row in np.column_stack(columns)]
    return "\n".join([delimiter.join(names), *rows]).encode()


def zipped(files, compression=zipfile.ZIP_STORED):
    """An archive of files."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return file.getvalue()


def read_demonstrations(content, name, **options):
    """Load a file of this content from the folder that it lies in, so that messages begin with its name alone."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path(name).write_bytes(content)
        return load_demonstrations(name, **options)


def lerobot(folder, names):
    """A LeRobot data set of two episodes."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    state = {"dtype": "float32", "shape": [3], "names": names}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": {"observation.state": state}}))
    for k in range(2):
        values = path_of(k).astype(np.float32)
        columns = {
            "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 3),
            "action": pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 3),
            "timestamp": TIMES.astype(np.float32),
            "frame_index": np.arange(60),
            "episode_index": np.full(60, k),
            "task": ["pour"] * 60,
        }
        pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / f"episode_{k:06}.parquet")


def robomimic(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 50}})
        for k in (0, 1, 10):
            obs = data.create_group(f"demo_{k}/obs")
            obs["robot0_eef_pos"], obs["robot0_eef_quat"] = path_of(k), turns_of()
            obs["robot0_joint_pos"], obs["robot0_gripper_qpos"] = RNG.normal(size=(60, 7)), np.zeros((60, 2))
            obs["object"], obs["agentview_image"] = np.zeros((60, 10)), np.zeros((60, 8, 8, 3), np.uint8)
            data[f"demo_{k}/actions"], data[f"demo_{k}/dones"] = np.zeros((60, 7)), np.zeros(60, int)
        file["mask/train"] = np.array([b"demo_0", b"demo_1"])


NANOSECONDS = 1_700_000_000 * 10**9 + (TIMES * 1e9).round().astype(np.int64)


def bag(path, topics):
    """Write a bag: for each topic, its type and what makes a message of a sample's number and of the types."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    if first:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    with Writer1(path) if first else Writer2(folder, version=9, storage_plugin=plugin) as writer:
        for topic, (kind, make) in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in range(len(TIMES)):
                message = make(k, store.types)
                data = (store.serialize_ros1 if first else store.serialize_cdr)(message, kind)
                writer.write(connection, int(NANOSECONDS[k]) + 10**9, data)
    return path if first else next(folder.glob(f"*{path.suffix}"))


def header(k, types):
    stamp = types["builtin_interfaces/msg/Time"](int(NANOSECONDS[k] // 10**9), int(NANOSECONDS[k] % 10**9))
    fields = {"stamp": stamp, "frame_id": "base"}
    kind = types["std_msgs/msg/Header"]
    return kind(**fields, seq=k) if "seq" in kind.__dataclass_fields__ else kind(**fields)


def pose(k, types, part="Pose", places=("position", "orientation"), point="Point"):
    vector, turn = (
        types[f"geometry_msgs/msg/{point}"](*path_of()[k]),
        types["geometry_msgs/msg/Quaternion"](*turns_of()[k]),
    )
    return types[f"geometry_msgs/msg/{part}"](**dict(zip(places, (vector, turn), strict=True)))


def pose_stamped(k, types):
    return types["geometry_msgs/msg/PoseStamped"](header(k, types), pose(k, types))


def transforms(k, types):
    moving = pose(k, types, "Transform", ("translation", "rotation"), "Vector3")
    fixed = pose(0, types, "Transform", ("translation", "rotation"), "Vector3")
    stamped = types["geometry_msgs/msg/TransformStamped"]
    return types["tf2_msgs/msg/TFMessage"](
        [stamped(header(k, types), "camera", fixed), stamped(header(k, types), "tool0", moving)]
    )


def joint_state(k, types):
    q = ANGLES[k, ::-1].copy()
    return types["sensor_msgs/msg/JointState"](header(k, types), ["elbow", "shoulder"], q, np.zeros(2), np.zeros(2))


POSE = {"/ee": ("geometry_msgs/msg/PoseStamped", pose_stamped)}
TF = {"/tf": ("tf2_msgs/msg/TFMessage", transforms)}
STATES = {"/joint_states": ("sensor_msgs/msg/JointState", joint_state)}
TEXTS = {"/log": ("std_msgs/msg/String", lambda k, types: types["std_msgs/msg/String"]("hello"))}


def good_files(folder):
    """A file of each kind; of MATLAB's, two."""
    np.savez(folder / "a.npz", times=TIMES, positions=path_of())
    np.save(folder / "a.npy", path_of())
    for name in "ab":
        scipy.io.savemat(folder / f"{name}.mat", {"t": TIMES, "pos": path_of().T}, do_compression=name == "b")
    (folder / "a.json").write_text(
        json.dumps([{"t": t, "pos": p} for t, p in zip(TIMES.tolist(), path_of().tolist(), strict=True)])
    )
    for suffix in (".csv", ".tsv", ".txt", ".dat"):
        (folder / f"a{suffix}").write_bytes(table(["t", "x", "y", "z"], [TIMES, *path_of().T]))
    with suppress(pytest.skip.Exception):
        robomimic(folder / "a.hdf5")
        (folder / "a.h5").write_bytes((folder / "a.hdf5").read_bytes())
    with suppress(pytest.skip.Exception):
        lerobot(folder / "lerobot", ["x", "y", "z"])
        next((folder / "lerobot").rglob("*.parquet")).rename(folder / "a.parquet")
    with suppress(pytest.skip.Exception):
        for suffix in (".mcap", ".db3", ".bag"):
            bag(folder / f"bag{suffix[1:]}{suffix}", POSE).rename(folder / f"a{suffix}")
