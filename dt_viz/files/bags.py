"""Reader of ROS bags (mcap, db3, bag, and folders with metadata.yaml), by rosbags, without ROS."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dt_viz.errors import FormatError, UnclearError
from dt_viz.files.checks import check_at_most
from dt_viz.files.tables import LIMITS, ReadOptions, Table, imported

POSES = ("PoseStamped", "Pose", "PoseWithCovarianceStamped", "Odometry", "TransformStamped", "PointStamped", "Point")
TRANSFORMS, JOINTS = ("TFMessage", "tfMessage"), "JointState"
MARKS = {*"%?#"}
"""Characters that SQLite, to which rosbags gives paths as addresses, does not take as they are: "%2F" is "/"."""
RANKS = {**dict.fromkeys(POSES, 0), **dict.fromkeys(TRANSFORMS, 1), JOINTS: 2}
"""Types of messages that are read; of those in a bag, the ones of the lowest rank."""

Samples = list[tuple[int, tuple[float, ...]]]
"""Times, nanoseconds, and places, perhaps with orientations x, y, z, w."""


def read_bag(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read the poses or joint angles of one topic of a bag, a file or a folder.

    Raises:
        FormatError: no topic has any, or several have and none is chosen; the message lists the topics.
    """
    reader = imported("rosbags.highlevel", "ros").AnyReader
    typesys = imported("rosbags.typesys", "ros")
    latest = typesys.get_typestore(typesys.Stores.LATEST)
    with _plain(path) as plain, reader([plain], default_typestore=latest) as bag:
        chosen, frame = _chosen(bag, options.topic)
        messages = (
            (time, bag.deserialize(content, connection.msgtype)) for connection, time, content in bag.messages(chosen)
        )
        check_at_most("bag", sum(connection.msgcount for connection in chosen), LIMITS.numbers // 8, "messages")
        kind = _kind(chosen[0])
        if kind == JOINTS:
            yield Table(path.stem, _joint_columns(messages))
            return
        if kind in TRANSFORMS:
            samples = _samples(messages, frame, chosen[0].topic)
        else:
            samples = [(_stamp(message, time), _place(message)) for time, message in messages]
    times = np.array([time for time, _ in samples], dtype=np.int64)
    values = np.array([place for _, place in samples]).reshape(len(samples), -1)
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")[: values.shape[1]]
    yield Table(path.stem, {"t": _seconds(times)} | {name: values[:, k] for k, name in enumerate(names)})


@contextmanager
def _plain(path: Path) -> Iterator[Path]:
    """Give a path of the bag without `MARKS`, and with a suffix in lower case, as rosbags knows them."""
    if path.is_dir() and (names := [file.name for file in path.iterdir() if MARKS & {*file.name}]):
        raise FormatError("name", repr(min(names)[:40]), "names of a bag's files without %, ? and #")
    if not MARKS & {*str(path)} and (path.is_dir() or path.suffix.islower()):
        yield path
        return
    with TemporaryDirectory() as folder:
        link = Path(folder, f"bag{path.suffix.lower()}")
        link.symlink_to(path.resolve())
        yield link


def _kind(connection: Any) -> str:  # noqa: ANN401 - of rosbags
    return connection.msgtype.rpartition("/")[2]


def _chosen(bag: Any, topic: str | None) -> tuple[list[Any], str | None]:  # noqa: ANN401 - of rosbags
    """Connections of the one topic that is read, and the frame of transforms if one is given."""
    listed = ", ".join(f"{c.topic} ({_kind(c)})" for c in {c.topic: c for c in bag.connections}.values())[:200]
    usable = [connection for connection in bag.connections if _kind(connection) in RANKS and connection.msgcount]
    if not usable:
        found = f"no poses among the topics {listed}" if listed else "no topics"
        raise FormatError("bag", found, f"messages of the types {', '.join(RANKS)}")
    named = [connection for connection in usable if connection.topic == topic]
    if topic is not None and not named:
        transforms = [connection for connection in usable if _kind(connection) in TRANSFORMS]
        if not transforms:
            raise FormatError("topic", f"{topic!r}, but the topics {listed}", "one of them with poses or joint angles")
        return transforms, topic
    best = min(RANKS[_kind(connection)] for connection in usable)
    ranked = named or [connection for connection in usable if RANKS[_kind(connection)] == best]
    topics = list(dict.fromkeys(connection.topic for connection in ranked))
    if len(topics) > 1 and _kind(ranked[0]) not in TRANSFORMS:
        found = f"poses or joint angles on the topics {listed}"
        raise UnclearError("bag", found, "topic='…', one of them", "topic", topics)
    return ranked, None


def _stamp(message: Any, time: int) -> int:  # noqa: ANN401 - a message
    """Time of a message in nanoseconds: that of its header, else when it was recorded."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return (stamp.sec * 10**9 + stamp.nanosec or time) if stamp is not None else time


def _seconds(times: np.ndarray) -> np.ndarray:
    return 1e-9 * (times - times[0]) if len(times) else times.astype(float)


def _place(message: Any) -> tuple[float, ...]:  # noqa: ANN401 - a message, or a part of one
    """Position and orientation in a message that may hold them in parts of parts."""
    for part in ("pose", "transform", "point"):
        if hasattr(message, part):
            return _place(getattr(message, part))
    position = getattr(message, "position", getattr(message, "translation", message))
    orientation = getattr(message, "orientation", getattr(message, "rotation", None))
    turn = () if orientation is None else (orientation.x, orientation.y, orientation.z, orientation.w)
    return (position.x, position.y, position.z, *turn)


def _samples(messages: Iterator[tuple[int, Any]], frame: str | None, topic: str) -> Samples:
    """Transforms of a frame in its parent; of the only one that moves, if none is given."""
    frames: dict[str, Samples] = defaultdict(list)
    for time, message in messages:
        for transform in message.transforms:
            frames[transform.child_frame_id].append((_stamp(transform, time), _place(transform)))
    if frame is not None and frame not in frames:
        raise FormatError(
            "topic", f"{frame!r}, but the frames {', '.join(frames)[:200]}", "a topic or one of the frames"
        )
    moving = [name for name, samples in frames.items() if any(place != samples[0][1] for _, place in samples)]
    if frame is None and len(moving) != 1:
        found = f"{len(moving)} moving frames on {topic} ({', '.join(moving or frames)[:160]})"
        raise UnclearError("bag", found, "topic='…', the frame of the hand", "topic", moving or list(frames))
    return frames[frame or moving[0]]


def _joint_columns(messages: Iterator[tuple[int, Any]]) -> dict[str, np.ndarray]:
    """Joint angles of the messages that name most often named joints."""
    samples = [(_stamp(message, time), tuple(message.name), message.position) for time, message in messages]
    (names, _), *_ = Counter(names for _, names, _ in samples).most_common(1)
    kept = [(time, angles) for time, named, angles in samples if named == names and len(angles) == len(names)]
    angles = np.array([angles for _, angles in kept]).reshape(len(kept), len(names))
    times = np.array([time for time, _ in kept], dtype=np.int64)
    return {"t": _seconds(times)} | {f"joint.{name}": angles[:, k] for k, name in enumerate(names)}
