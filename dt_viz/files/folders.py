"""Folders of recorded motions: files of any kind, LeRobot data sets, and ROS bags."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dt_viz.errors import FormatError
from dt_viz.files.archives import read_parquet
from dt_viz.files.bags import read_bag
from dt_viz.files.checks import check_size
from dt_viz.files.columns import role_of
from dt_viz.files.tables import LIMITS, ReadOptions, Table
from dt_viz.files.takes import READERS, Take, read_takes, takes_of

NOTES = (".txt", ".dat", ".json")
"""Suffixes of files that beside others are notes rather than motions."""


def files_of(folder: Path) -> list[Path]:
    """Return the visible files of a folder with a known suffix, by name.

    Raises:
        OSError: it cannot be read.
    """
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    known = [path for path in files if path.suffix.lower() in READERS]
    return [path for path in known if path.suffix.lower() not in NOTES] or known


def _is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file()


def _is_lerobot(folder: Path) -> bool:
    return (folder / "meta" / "info.json").is_file()


def parts_of(path: Path) -> list[Path]:
    """Return what is read at a path: the files of a folder, unless it is one bag or data set; or the path itself."""
    return files_of(path) if path.is_dir() and not _is_bag(path) and not _is_lerobot(path) else [path]


def accepted_as(path: Path) -> str:
    """Describe what a file with the suffix of this path must hold, for the message that refuses it."""
    return READERS.get(path.suffix.lower(), (None, "a file of recorded motions"))[1]


def read_part(path: Path, options: ReadOptions) -> tuple[list[Take], tuple[str, ...]]:
    """Read the takes of a file, of a ROS 2 bag's folder, or of a LeRobot data set; see `read_takes`."""
    if not path.is_dir():
        return read_takes(path, options)
    if _is_bag(path):
        check_size(sum(file.stat().st_size for file in path.iterdir()), LIMITS.bytes)
        return takes_of(read_bag(path, options), options)
    information = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
    files = sorted((path / "data").rglob("*.parquet"))
    check_size(sum(file.stat().st_size for file in files), LIMITS.bytes)
    if not files:
        raise FormatError("folder", "no .parquet file in data/", "a LeRobot data set")
    return takes_of(_tables(files, information.get("features", {}), options), options)


def _tables(files: list[Path], features: Mapping[str, Any], options: ReadOptions) -> Iterator[Table]:
    """Tables of a data set, the columns of states named as it says."""
    for table in (table for path in files for table in read_parquet(path, options)):
        columns: dict[str, Any] = {}
        for name, values in table.columns.items():
            parts = _part_names(features.get(name, {}))
            if values.ndim == 2 and len(parts) == values.shape[1]:
                columns |= {f"{name}.{part}": values[:, k] for k, part in enumerate(parts)}
            else:
                columns[name] = values
        yield Table(table.name, columns, unused=table.unused)


def _part_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of the parts of a state: of places as they are, of anything else as joints."""
    names = feature.get("names") or []
    names = next(iter(names.values()), []) if isinstance(names, Mapping) else names
    if not isinstance(names, list):
        return []
    axes = {role.part for name in names if (role := role_of(str(name))) and role.kind == "position"}
    return [str(name) if {"x", "y"} <= axes else f"joint.{name}" for name in names]
