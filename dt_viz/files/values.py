"""Values of dataclasses as JSON and named arrays: of saved motions, and of what the process with limits answers."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from types import MappingProxyType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from dt_viz.errors import FormatError

CLASS = "class"  # key of the name of an object's class
SCALARS = {bool: "true or false", int: "an integer", float: "a finite number", str: "text"}
"""Types of scalars, and their names in messages."""


def packed(value: Any, where: str, arrays: dict[str, np.ndarray]) -> Any:  # noqa: ANN401 - what JSON can hold
    """Return a value as JSON holds it, and put its arrays into `arrays`, by their place in the whole.

    Fields that hold functions are left out; they will have their defaults.
    """
    if isinstance(value, np.ndarray):
        arrays[where] = value.astype(np.int64 if value.dtype.kind in "iu" else np.float64, copy=False)
        return where
    if isinstance(value, tuple | list):
        return [packed(item, f"{where}[{k}]", arrays) for k, item in enumerate(value)]
    if isinstance(value, Mapping):
        return {key: packed(item, f"{where}.{key}", arrays) for key, item in value.items()}
    if is_dataclass(value):
        held = {field.name: getattr(value, field.name) for field in fields(value)}
        plain = {name: packed(item, f"{where}.{name}", arrays) for name, item in held.items() if not callable(item)}
        return {CLASS: type(value).__name__, **plain}
    return value


def unpacked(
    plain: Any,  # noqa: ANN401 - what JSON holds
    kind: Any,  # noqa: ANN401 - an annotation
    where: str,
    arrays: dict[str, np.ndarray],
    classes: Mapping[type, Collection[type]] = MappingProxyType({}),
) -> Any:  # noqa: ANN401 - of that type
    """Return the value that `packed` wrote, made by constructors, and take its arrays out of `arrays`.

    Args:
        plain: what JSON holds.
        kind: annotation of the value; fields that are not there have their defaults.
        where: place of the value in the whole, for messages.
        arrays: arrays by their names.
        classes: classes whose objects may stand where a base class is annotated.

    Raises:
        FormatError: it is not what the annotation says, or its class refuses it.
    """
    inner, origin = get_args(kind), get_origin(kind)
    if origin in (Union, UnionType):  # X | None
        return None if plain is None else unpacked(plain, inner[0], where, arrays, classes)
    if origin is tuple:
        items = _checked(plain, isinstance(plain, list), where, "a list")
        inner = inner[:1] * len(items) if inner[-1] is Ellipsis else inner
        _checked(items, len(items) == len(inner), where, f"{len(inner)} values")
        return tuple(unpacked(items[k], inner[k], f"{where}[{k}]", arrays, classes) for k in range(len(inner)))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        held = _checked(plain, isinstance(plain, dict), where, "an object")
        return {key: unpacked(item, inner[1], f"{where}.{key}", arrays, classes) for key, item in held.items()}
    if np.ndarray in (kind, origin, get_origin(getattr(origin, "__value__", None))):  # an alias since numpy 2.5
        array = arrays.pop(plain, None) if isinstance(plain, str) else None  # each once, or a few bytes fill the memory
        wanted = np.int64 if "integer" in repr(inner) else np.float64
        fits = array is not None and array.dtype == wanted and bool(np.isfinite(array).all())
        _checked(plain, fits, where, f"the name of an array of finite {wanted.__name__}")
        return array
    if kind in classes or is_dataclass(kind):
        return _object(plain, kind, where, arrays, classes)
    try:
        value = msgspec.convert(plain, kind)
        fits = not isinstance(value, float) or math.isfinite(value)
    except msgspec.ValidationError:
        value, fits = plain, False
    return _checked(value, fits, where, " or ".join(map(repr, inner)) or SCALARS.get(kind, f"{kind}"))


def _object(
    plain: Any,  # noqa: ANN401
    kind: Any,  # noqa: ANN401
    where: str,
    arrays: dict[str, np.ndarray],
    classes: Mapping[type, Collection[type]],
) -> object:
    """Return an object of a class, or of one of the classes that may be named. Raises as `unpacked`."""
    held = dict(_checked(plain, isinstance(plain, dict), where, "an object"))
    name = held.pop(CLASS, None)
    if kind in classes:
        known = {each.__name__: each for each in classes[kind]}
        kind = known[_checked(name, name in list(known), f"{where}.{CLASS}", " or ".join(known))]
    types = get_type_hints(kind)
    hints = {field.name: types[field.name] for field in fields(kind)}
    for name in held:
        _checked(name, name in hints, f"fields of {where}", ", ".join(hints))
    values = {name: unpacked(held[name], hints[name], f"{where}.{name}", arrays, classes) for name in held}
    try:
        return kind(**values)
    except FormatError as error:
        raise FormatError(f"{where}.{error.field}", error.found, error.accepted) from error
    except TypeError as error:
        raise FormatError(where, f"too few fields ({error})", ", ".join(hints)) from error


def _checked(plain: Any, fits: bool, where: str, accepted: str) -> Any:  # noqa: ANN401 - the same
    if not fits:
        raise FormatError(where, repr(plain)[:40], accepted)
    return plain
