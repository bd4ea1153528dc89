"""Joint trajectories, and their files: CSV, npz, and the YAML of ROS 2's trajectory_msgs/JointTrajectory."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly

from dt_viz.errors import DataError
from dt_viz.files.npz import npz_bytes, write_whole
from dt_viz.flows.fields import Array

DECIMALS = 9
"""Number of decimals of texts: 1 nrad, and 1 ns, which is the step of times in ROS."""
TOPIC = "/joint_trajectory_controller/joint_trajectory trajectory_msgs/msg/JointTrajectory"
"""Topic of the controller, under its usual name, and type of the message."""
PUBLISH = f"""\
# ros2 topic pub --once {TOPIC} --yaml-file FILE
# (where ros2 has no --yaml-file: "$(cat FILE)"); first bring the arm to the first positions
"""
"""Head of the YAML file: the command that has a controller follow it."""


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """A motion of the joints from rest to rest: points, with a quintic between each two."""

    joint_names: tuple[str, ...]
    """Names of the n joints."""
    times: Array
    """(K,) seconds from the start, strictly increasing from 0."""
    positions: Array
    """(K, n) rad; continuous joints unwrapped."""
    velocities: Array
    """(K, n) rad/s; 0 at both ends."""
    accelerations: Array
    """(K, n) rad/s²; 0 at both ends."""

    @property
    def quintics(self) -> BPoly:
        """The function of time (T,) that interpolates the points: (T, n) rad."""
        states = np.stack([self.positions, self.velocities, self.accelerations], axis=1)
        return BPoly.from_derivatives(self.times, states)

    def slower(self, factor: float) -> JointTrajectory:
        """Return it on the same path, with times longer by a factor."""
        times, velocities = self.times * factor, self.velocities / factor
        return replace(self, times=times, velocities=velocities, accelerations=self.accelerations / factor**2)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file in the format of its suffix: .csv, .npz, or .yaml for ROS 2.

        Raises:
            DataError: there is no such format, or the file cannot be written.
        """
        file = Path(path)
        if file.suffix not in FORMATS:
            raise DataError(file, "suffix", repr(file.suffix), ", ".join(FORMATS))
        try:
            write_whole(file, FORMATS[file.suffix](self))
        except OSError as error:
            raise DataError(
                file, "place", error.strerror or str(error), "a file in a folder that can be written"
            ) from None


def _csv(trajectory: JointTrajectory) -> bytes:
    names, states = trajectory.joint_names, ("position_rad", "velocity_rad_s", "acceleration_rad_s2")
    heads = ["time_s", *(f"{name}_{state}" for state in states for name in names)]
    values = (trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations)
    rows = [",".join(map(_decimal, row)) for row in np.column_stack(values)]
    return "\n".join([",".join(heads), *rows, ""]).encode()


def _npz(trajectory: JointTrajectory) -> bytes:
    arrays = {name: getattr(trajectory, name) for name in ("times", "positions", "velocities", "accelerations")}
    return npz_bytes({"joint_names": np.array(trajectory.joint_names), **arrays})


def _yaml(trajectory: JointTrajectory) -> bytes:
    states = ("positions", "velocities", "accelerations")
    lines = ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"]
    lines += [f"joint_names: {json.dumps(trajectory.joint_names)}", "points:"]
    for k, time in enumerate(trajectory.times):
        rows = [f"{state}: [{', '.join(map(_decimal, getattr(trajectory, state)[k]))}]" for state in states]
        sec, nanosec = divmod(round(time * 10**9), 10**9)
        since = f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}"
        lines += [f"- {rows[0]}", *(f"  {row}" for row in (*rows[1:], since))]
    return (PUBLISH + "\n".join([*lines, ""])).encode()


def _decimal(value: float) -> str:
    """A number with at most so many decimals, and at least one, which makes it no integer in YAML."""
    text = f"{value:.{DECIMALS}f}".rstrip("0")
    text = f"{text}0" if text.endswith(".") else text
    return "0.0" if text == "-0.0" else text


FORMATS: Mapping[str, Callable[[JointTrajectory], bytes]] = {".csv": _csv, ".npz": _npz, ".yaml": _yaml}
"""Function that encodes a trajectory, by the suffix of the file."""
