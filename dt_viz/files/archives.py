"""Readers of archives of arrays: npz, npy, MATLAB, JSON, Parquet and HDF5, none of which unpickles anything."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, check_size, real_numbers
from dt_viz.files.columns import is_place, role_of
from dt_viz.files.npz import arrays_of
from dt_viz.files.tables import LIMITS, ReadOptions, Table, imported
from dt_viz.files.trees import complex_numbers, tables_of

LASA_UNITS = {"length": 1e-3, "time": 1.0}
"""Units of the LASA handwriting data: millimetres and seconds."""
ALONE = "recordings; this file is opened alone"
"""What is accepted in place of a saved motion or a saved scenario."""
WITHIN = "hard links, and data within the file"
"""What is accepted of an HDF5 file, whose links and datasets may name any other file."""


def read_npz(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read named arrays; ``times_i``, ``positions_i`` and ``name_i``, as this program writes them, are metres."""
    arrays = arrays_of(path, max_bytes=LIMITS.bytes)
    if "motion" in arrays and arrays["motion"].dtype.kind == "U":
        raise FormatError("file", "a motion that the library has saved", ALONE)
    ours = all(re.fullmatch(r"(?:times|positions|orientations_wxyz|name)_\d+", key) for key in arrays)
    timed, placed = (
        {key.rpartition("_")[2] for key in arrays if key.startswith(f"{part}_")} for part in ("times", "positions")
    )
    if ours and timed and placed and timed != placed:
        number = min(timed ^ placed)
        raise FormatError("arrays", f"only one of times_{number} and positions_{number}", "both")
    for table in tables_of(arrays, path.stem, options.joint_names):
        yield Table(table.name, table.columns, units={"length": 1.0, "time": 1.0} if ours else {})


def read_npy(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read one array (T, d) or (N, T, d), perhaps with named fields."""
    try:
        with path.open("rb") as file:  # numpy leaves a path's file open where it refuses what is in it
            array = np.load(file, allow_pickle=False)
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        accepted = "numbers, as np.savez(path, *takes) writes arrays of different lengths"
        raise FormatError("array", "Python objects, which are never unpickled", accepted) from error
    if not isinstance(array, np.ndarray):
        raise FormatError("file", "an archive of several arrays", "one array, or the suffix .npz")
    yield from tables_of(array, path.stem, options.joint_names)


def read_mat(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read MATLAB variables; ``demos``, a cell array of structures with t and pos, is LASA's, in millimetres."""
    variables = scipy.io.loadmat(path, simplify_cells=True)
    if "demos" not in variables:
        yield from tables_of(
            {k: v for k, v in variables.items() if not k.startswith("__")}, path.stem, options.joint_names
        )
        return
    recordings = np.atleast_1d(np.asarray(variables["demos"], dtype=object)).ravel()
    for i, recording in enumerate(recordings):
        if not isinstance(recording, dict) or not {"t", "pos"} <= set(recording):
            accepted = "a cell array of structures with t (1×T) and pos (d×T)"
            raise FormatError(f"demos{{{i + 1}}}", "no structure with t and pos", accepted)
        times, positions = (real_numbers(recording[part], f"demos{{{i + 1}}}.{part}") for part in ("t", "pos"))
        if times.ndim != 1:
            raise FormatError(f"demos{{{i + 1}}}.t", f"an array of shape {times.shape}", "1×T")
        if positions.ndim != 2 or len(positions) not in (2, 3):
            raise FormatError(f"demos{{{i + 1}}}.pos", f"an array of shape {positions.shape}", "d×T, d is 2 or 3")
        yield Table(f"{path.stem} {i}", {"t": times, "pos": positions.T}, units=LASA_UNITS)


def read_json(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read lists of numbers, records with named fields, or mappings of them."""
    check_size(path.stat().st_size, LIMITS.text)
    tree = json.loads(path.read_bytes())
    if isinstance(tree, Mapping) and tree.get("class") == "Saved":
        raise FormatError("file", "a scenario that the page has saved", ALONE)
    yield from tables_of(tree, path.stem, options.joint_names)


def read_parquet(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read a table, such as LeRobot's: ``observation.state``, ``timestamp``, ``episode_index``."""
    file = imported("pyarrow.parquet", "parquet").ParquetFile(path, pre_buffer=False)
    given = {name.lower() for name in options.roles.values()}
    kinds = {field.name: str(field.type) for field in file.schema_arrow}
    names = [
        name for name in kinds if role_of(name, options.joint_names) or name.lower() in given or "list" in kinds[name]
    ]
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
    size = 0
    for batch in file.iter_batches(2**16, columns=names):
        for name, column in zip(names, batch.columns, strict=True):
            values = (column.flatten() if "list" in kinds[name] else column).to_numpy(zero_copy_only=False)
            size += values.size
            check_at_most("file", size, LIMITS.numbers, "numbers")
            whole = "list" in kinds[name] and values.dtype.kind in "iuf"
            if whole and len(imported("pyarrow.compute", "parquet").list_value_length(column).unique()) > 1:
                raise FormatError(f"column {name!r}", "lists of different lengths", "one length in all rows")
            parts[name].append(values.reshape(len(column), -1) if whole else values.copy())
    columns = {name: np.concatenate(parts.pop(name)) for name in names if parts[name]}
    imported("pyarrow", "parquet").default_memory_pool().release_unused()
    yield Table(path.stem, columns, unused=tuple(name for name in kinds if name not in columns))


def read_hdf5(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read groups of arrays, such as robomimic's: ``data/demo_0/obs/robot0_eef_pos``; pictures are left out."""
    h5py = imported("h5py", "hdf5")
    size = 0

    def tree_of(group: Any) -> dict[str, Any]:  # noqa: ANN401 - a group of h5py
        nonlocal size
        tree = {}
        for key in sorted(
            group, key=lambda key: [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", key)]
        ):
            if not isinstance(link := group.get(key, getlink=True), h5py.HardLink):
                raise FormatError(f"link {key[:40]!r}", f"a link of the kind {type(link).__name__}", WITHIN)
            item = group[key]
            if isinstance(item, h5py.Dataset) and (item.is_virtual or item.external):
                raise FormatError(f"dataset {key[:40]!r}", "data in other files", WITHIN)
            if isinstance(item, h5py.Group):
                tree[key] = tree_of(item)
            elif item.dtype.kind in "iuf" and (item.ndim < 3 or (item.ndim == 3 and item.dtype.kind == "f")):
                size += item.size
                check_at_most("file", size, LIMITS.numbers, "numbers")
                tree[key] = item[()]
            elif item.dtype.kind == "c" and item.ndim in (2, 3) and is_place(key):
                raise complex_numbers(key)
        return tree

    with h5py.File(path, "r") as archive:
        tree = tree_of(archive)
        data = archive.get("data")
        rate = _control_rate(data.attrs.get("env_args", "")) if isinstance(data, h5py.Group) else None
    for table in tables_of(tree, path.stem, options.joint_names):
        columns = table.columns if rate is None else {**table.columns, "rate": np.array(rate)}
        yield Table(table.name, columns)


def _control_rate(text: str) -> float | None:
    """Rate in Hz at which robomimic's environment was recorded, if it says so."""
    try:
        arguments = json.loads(text)
    except ValueError:
        return None
    settings = arguments.get("env_kwargs", {}) if isinstance(arguments, Mapping) else {}
    rate = settings.get("control_freq") if isinstance(settings, Mapping) else None
    return float(rate) if isinstance(rate, int | float) and rate > 0 else None
