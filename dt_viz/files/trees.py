"""Nested data, as archives hold them, turned into tables: mappings, lists of records, arrays of takes."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.columns import expanded, is_kind, is_place, layout
from dt_viz.files.tables import Table

ACCEPTED = "times (T,) and positions (T, d), d 2 or 3, of one take or of each; or arrays (T, d) or (N, T, d)"


def tables_of(
    tree: Any,  # noqa: ANN401 - whatever a file holds
    name: str,
    joint_names: tuple[str, ...] = (),
) -> Iterator[Table]:
    """Find the takes of nested mappings, lists and arrays.

    An array (T, d) is a take, (N, T, d) are several. A mapping whose names tell times, positions or joint angles is a
    take (or several, if its positions are (N, T, d)); any other holds a take, or several, in each of its parts.

    Args:
        tree: mappings, lists, arrays and numbers.
        name: name of the takes.
        joint_names: names of an arm's joints, which are names of joint angles.

    Raises:
        FormatError: there is none.
    """
    found = False
    for table in _tables(condensed(tree), name, joint_names):
        found = True
        yield table
    if not found:
        what = f"an array {tree.shape} of {tree.dtype}" if isinstance(tree, np.ndarray) else f"a {type(tree).__name__}"
        names = ", ".join(map(repr, tree)) or "an empty file" if isinstance(tree, Mapping) else what
        raise FormatError("arrays", f"no takes in {names[:160]}", ACCEPTED)


def condensed(tree: Any) -> Any:  # noqa: ANN401 - whatever a file holds
    """Make arrays of lists of numbers, and mappings of arrays of lists of records."""
    if isinstance(tree, Mapping):
        return {str(key): condensed(value) for key, value in tree.items()}
    if isinstance(tree, np.ndarray) and tree.dtype.names:
        return {name: condensed(tree[name]) for name in tree.dtype.names}
    if isinstance(tree, list | tuple) or (isinstance(tree, np.ndarray) and tree.dtype == object):
        return _condensed_list(list(tree))
    return np.asarray(tree)


def _condensed_list(items: list[Any]) -> Any:  # noqa: ANN401 - whatever a file holds
    try:
        return np.array(items, dtype=float)
    except (TypeError, ValueError):
        items = [condensed(item) for item in items]
    if items and all(isinstance(item, Mapping) for item in items):
        records = [flat(item) for item in items]
        return _columns(records) if all(map(_is_sample, records)) else items
    return (
        np.asarray(items) if items and all(isinstance(item, np.ndarray) and not item.ndim for item in items) else items
    )


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return the arrays in nested mappings, their names joined by dots."""
    arrays = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            arrays |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, np.ndarray):
            arrays[prefix + key] = value
    return arrays


def _is_sample(record: Mapping[str, np.ndarray]) -> bool:
    """Tell whether this is a sample, whose parts are numbers and short vectors, rather than a take."""
    numbers = [key for key, value in record.items() if value.ndim == 0 and value.dtype.kind in "iuf"]
    others = [key for key in numbers if not is_kind(key, "rate")]
    return bool(others) and all(value.ndim < 2 and value.size < 17 for value in record.values())


def _columns(records: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the columns (T,) or (T, k) of samples."""
    for k, record in enumerate(records):
        if missing := set(records[0]) - set(record):
            raise FormatError(f"sample {k + 1}", f"no {min(missing)[:40]!r}", "the same fields in all samples")
    return {key: np.stack([record[key] for record in records]) for key in records[0]}


def _tables(tree: Any, name: str, joints: tuple[str, ...]) -> Iterator[Table]:  # noqa: ANN401 - condensed data
    if isinstance(tree, Mapping):
        yield from _of_mapping(tree, name, joints)
    elif isinstance(tree, list):
        takes = [list(_tables(item, f"{name} {k}" if len(tree) > 1 else name, joints)) for k, item in enumerate(tree)]
        if any(takes) and not all(takes):
            raise FormatError(f"take {takes.index([]) + 1}", "no places", ACCEPTED)
        yield from itertools.chain.from_iterable(takes)
    elif tree.dtype.kind in "iuf" and tree.ndim in (2, 3):
        yield from _several({"": _upright(tree, None)}, name)
    elif tree.dtype.kind == "c" and tree.ndim in (2, 3):
        raise complex_numbers(name)


def complex_numbers(name: str) -> FormatError:
    """Return the error about an array of this name that would be a take if its numbers were real."""
    return FormatError(f"array {name[:40]!r}", "complex numbers", "real numbers")


def _of_mapping(tree: Mapping[str, Any], name: str, joints: tuple[str, ...]) -> Iterator[Table]:
    own = {key: value for key, value in tree.items() if isinstance(value, np.ndarray)}
    if numbered := _numbered(own, joints):
        for k, arrays in numbered.items():
            yield from _several(arrays, f"{name} {k}")
    elif (
        not (len(own) > 1 and set(own) <= set("abcdefg"))
        and any(value.ndim for value in own.values())
        and _tells(arrays := _all_upright(flat(tree)), joints)
    ):
        yield from _several(arrays, name)
    else:
        parts = {key: value for key, value in tree.items() if key not in own or (own[key].ndim > 1 and is_place(key))}
        rates = {key: value for key, value in own.items() if not value.ndim and is_kind(key, "rate")}
        for key, value in parts.items():
            for table in _tables(value, name if len(parts) == 1 else key, joints):
                yield replace(table, columns={**rates, **table.columns})


def _numbered(arrays: Mapping[str, np.ndarray], joints: tuple[str, ...]) -> dict[int, dict[str, np.ndarray]]:
    """Arrays of each take by its number, if all their names end in such: ``times_0``, ``positions_0``, …."""
    takes: dict[int, dict[str, np.ndarray]] = {}
    for key, value in arrays.items():
        if match := re.fullmatch(r"(.*?)_?(\d{1,9})", key):
            takes.setdefault(int(match[2]), {})[match[1]] = value
        elif value.ndim:
            return {}
    takes = {k: _all_upright(takes[k]) for k in sorted(takes)}
    whole = all(_tells(take, joints) and max(value.ndim for value in take.values()) > 1 for take in takes.values())
    return takes if whole else {}


def _all_upright(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    times = {key: value for key, value in arrays.items() if is_kind(key, "time")}
    length = next((max(value.shape, default=0) for value in times.values()), None)
    return {key: value if key in times else _upright(value, length) for key, value in arrays.items()}


def _upright(array: np.ndarray, length: int | None) -> np.ndarray:
    """Turn an array (…, d, T) into (…, T, d); T may be known."""
    if array.ndim not in (2, 3):
        return array
    d, num = array.shape[-2:]
    lies = num == length != d if length and length in (d, num) else d in (2, 3, 7) and num > 16
    return np.swapaxes(array, -1, -2) if lies else array


def _tells(arrays: Mapping[str, np.ndarray], joints: tuple[str, ...]) -> bool:
    """Tell whether the names of these arrays say what is a place or a joint angle."""
    columns = {key: value[0] if value.ndim == 3 and len(value) else value for key, value in arrays.items()}
    try:
        names = [name for key, value in columns.items() if value.ndim for name in expanded(key, value)]
        return bool(layout(names, joint_names=joints))
    except FormatError:
        return False


def _several(arrays: Mapping[str, np.ndarray], name: str) -> Iterator[Table]:
    """Return a table, or one for each index of the first axis of arrays (N, T, k)."""
    given = arrays.get("name")
    name = str(given) if given is not None and given.ndim == 0 and given.dtype.kind == "U" else name
    deep = next((value.shape for key, value in arrays.items() if value.ndim == 3 and is_place(key)), None)
    if deep is None:
        yield Table(name, arrays)
        return
    for i in range(deep[0]):
        columns = {key: value[i] if value.shape[:2] == deep[:2] else value for key, value in arrays.items()}
        yield Table(f"{name} {i}" if deep[0] > 1 else name, columns)
