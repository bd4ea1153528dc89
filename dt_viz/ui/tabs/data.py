"""What plots and tables of the panel show, as CSV files to take along."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.motion.following import ArmMotion
from dt_viz.motion.profiles import NUM_SAMPLES, Profiles
from dt_viz.robot.robot import Robot
from dt_viz.session.frame import Compared

SAVE = "Save data"
"""Label of the buttons that save them."""


def table_csv(table: Mapping[str, Sequence[object] | Array]) -> bytes:
    """Return a table as CSV: columns (N,) of numbers or texts by their heads, numbers with nine digits."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table)
    for row in zip(*table.values(), strict=True):
        writer.writerow([f"{value:.9g}" if isinstance(value, float) else value for value in row])
    return file.getvalue().encode()


def joints_table(motion: ArmMotion, robot: Robot) -> dict[str, Array]:
    """Return the angles and the speeds of a motion's joints, at its own samples; speeds are those until the next."""
    speeds = np.diff(motion.q, axis=0) / np.maximum(np.diff(motion.times), 1e-9)[:, None]
    columns: dict[str, Array] = {"time_s": motion.times}
    columns |= {f"{name}_deg": angles for name, angles in zip(robot.joint_names, np.degrees(motion.q).T, strict=True)}
    used = 100 * np.vstack([np.abs(speeds) / robot.velocity_limits, np.zeros((1, robot.num_joints))])
    return columns | {f"{name}_speed_percent": speed for name, speed in zip(robot.joint_names, used.T, strict=True)}


def path_table(profiles: Profiles) -> dict[str, Array]:
    """Return how the shown motion, and the one without behaviours, fare along the path, from 0 to 1."""
    columns: dict[str, Array] = {"path": profiles.along}
    for suffix, profile in (("", profiles.shown), ("_without", profiles.undisturbed)):
        columns[f"lyapunov{suffix}"] = profile.lyapunov
        columns[f"distance_mm{suffix}"] = 1e3 * profile.distance
        columns[f"clearance_mm{suffix}"] = 1e3 * profile.clearance
    return columns


def scores_table(comparison: Sequence[Compared]) -> dict[str, list[object]]:
    """Return the scores of compared methods, each a row; no score is an empty text."""
    scores = [compared.scores for compared in comparison]
    names = {
        "to_demo_mm": "frechet",
        "hand_in_mm": "hand_depth",
        "arm_in_mm": "arm_depth",
        "off_goal_mm": "goal_error",
    }
    table: dict[str, list[object]] = {"method": [compared.method.title for compared in comparison]}
    for head, name in names.items():
        values = [None if score is None else getattr(score, name) for score in scores]
        table[head] = ["" if value is None else 1e3 * float(value) for value in values]
    table["note"] = [compared.note for compared in comparison]
    return table


def curves_table(comparison: Sequence[Compared]) -> dict[str, Array]:
    """Return the curves of compared methods along the path, from 0 to 1; of those that have some."""
    columns: dict[str, Array] = {"path": np.linspace(0, 1, NUM_SAMPLES)}
    for compared in comparison:
        if compared.curves is not None:
            columns[f"{compared.method.name}_distance_mm"] = 1e3 * compared.curves[:, 0]
            columns[f"{compared.method.name}_depth_mm"] = 1e3 * compared.curves[:, 1]
    return columns
