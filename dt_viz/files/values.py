"""Codec of frozen dataclasses: text for their structure, arrays beside it, read back by their fields' annotations.

A field is a number, a string, one of a few literals, an array, a tuple of these, another dataclass, or None instead.
Where it may hold objects of several classes, the text names the class, and only listed classes are made.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from dt_viz.errors import FormatError

CLASS = "class"
"""Key of the name of an object's class: no field can be called so."""
Plain = Any
"""What JSON can hold."""
Annotation = Any
Arrays = dict[str, np.ndarray]
SCALARS = {bool: "true or false", int: "an integer", float: "a finite number", str: "text"}
"""Types of scalars, and their names in messages."""


@dataclass(frozen=True)
class Codec:
    """Writes and reads values; `where` is the place of a value in the whole, for messages and names of arrays."""

    classes: Mapping[Annotation, tuple[type, ...]]
    """Dataclasses whose objects may stand where a field is annotated with a base class or a protocol."""

    def encode(self, value: Any, annotation: Annotation, where: str, arrays: Arrays) -> Plain:  # noqa: ANN401 - any value
        """Return a value as JSON holds it, and put its arrays into `arrays`. What it holds is checked by `decode` only.

        Raises:
            FormatError: it is of a class that is not listed, or of another length.
        """
        annotation = _of_optional(annotation)
        if value is not None and get_origin(annotation) is tuple:
            return [self.encode(*item, arrays) for item in _items(list(value), annotation, where)]
        if value is not None and _is_array(annotation):
            arrays[where] = np.asarray(value, _numbers(annotation))
            return where
        if annotation not in self.classes and not is_dataclass(annotation):
            return value
        listed: tuple[type, ...] = self.classes.get(annotation, (typing.cast(type, annotation),))
        kind = type(value)
        if kind not in listed:
            found = f"a {kind.__name__}, which is not registered"
            raise FormatError(where, found, ", ".join(kind.__name__ for kind in listed))
        held = {
            name: self.encode(getattr(value, name), hint, f"{where}.{name}", arrays)
            for name, hint in _hints(kind).items()
        }
        return {CLASS: kind.__name__, **held} if annotation in self.classes else held

    def decode(self, plain: Plain, annotation: Annotation, where: str, arrays: Arrays) -> Any:  # noqa: ANN401 - any value
        """Return the value that `encode` wrote, and take its arrays out of `arrays`. Fields not there have defaults.

        Raises:
            FormatError: it is not what the annotation says, or its class refuses it.
        """
        if plain is None and _of_optional(annotation) is not annotation:
            return None
        annotation = _of_optional(annotation)
        if get_origin(annotation) is Literal or annotation in SCALARS:
            return _scalar(plain, annotation, where)
        if get_origin(annotation) is tuple:
            items = _checked(plain, isinstance(plain, list), where, "a list")
            return tuple(self.decode(*item, arrays) for item in _items(items, annotation, where))
        if _is_array(annotation):
            name, kind = _checked(plain, isinstance(plain, str), where, "the name of an array"), _numbers(annotation)
            array = arrays.pop(name, None)  # each is used once, or few bytes could fill the memory
            if array is None or array.dtype != kind or not np.isfinite(array).all():
                raise FormatError(where, "no such array of finite numbers", f"an array of {kind.__name__}")
            return array
        if annotation not in self.classes and not is_dataclass(annotation):
            raise FormatError(where, f"a field of type {annotation}", "numbers, text, arrays, tuples and dataclasses")
        return self._made(dict(_checked(plain, isinstance(plain, dict), where, "an object")), annotation, where, arrays)

    def _made(self, held: dict[str, Plain], annotation: Annotation, where: str, arrays: Arrays) -> object:
        """Return an object made by its constructor, whose checks thus apply."""
        kind = annotation
        if annotation in self.classes:
            by_name, name = {kind.__name__: kind for kind in self.classes[annotation]}, held.pop(CLASS, None)
            kind = by_name[_checked(name, name in list(by_name), f"{where}.{CLASS}", " or ".join(by_name))]
        hints = _hints(kind)
        for name in held:
            _checked(name, name in hints, f"fields of {where}", ", ".join(hints))
        values = {name: self.decode(plain, hints[name], f"{where}.{name}", arrays) for name, plain in held.items()}
        try:
            return kind(**values)
        except FormatError as error:
            raise FormatError(f"{where}.{error.field}", error.found, error.accepted) from error
        except TypeError as error:
            raise FormatError(where, f"too few fields ({error})", ", ".join(hints)) from error


def _scalar(plain: Plain, annotation: Annotation, where: str) -> Plain:
    """Return a literal, or a scalar of just this type; integers are numbers, too."""
    if annotation not in SCALARS:
        return _checked(plain, plain in get_args(annotation), where, " or ".join(map(repr, get_args(annotation))))
    value = float(plain) if annotation is float and type(plain) is int else plain
    fits = type(value) is annotation and (annotation is not float or math.isfinite(value))
    return _checked(value, fits, where, SCALARS[annotation])


def _hints(kind: type) -> dict[str, Annotation]:
    """Return the annotations of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}  # pyright: ignore[reportArgumentType]


def _of_optional(annotation: Annotation) -> Annotation:
    """Return X of the annotation X | None; others as they are."""
    inner = [kind for kind in get_args(annotation) if kind is not types.NoneType]
    is_union = get_origin(annotation) in (typing.Union, types.UnionType)
    return inner[0] if is_union and len(inner) == 1 else annotation


def _items(values: Sequence[Any], annotation: Annotation, where: str) -> list[tuple[Any, Annotation, str]]:
    """Return the items of a tuple, each with its annotation and place."""
    kinds = get_args(annotation)
    kinds = kinds[:1] * len(values) if kinds[-1] is Ellipsis else kinds
    if len(values) != len(kinds):
        raise FormatError(where, f"{len(values)} values", f"{len(kinds)} values")
    return [(value, kind, f"{where}[{k}]") for k, (value, kind) in enumerate(zip(values, kinds, strict=True))]


def _is_array(annotation: Annotation) -> bool:
    origin = get_origin(annotation) or annotation
    return (get_origin(getattr(origin, "__value__", None)) or origin) is np.ndarray  # NDArray is an alias since 2.5


def _numbers(annotation: Annotation) -> type[np.generic]:
    """Return the numbers that an array of this annotation is written in, which hold all others of their kind."""
    *_, kind = get_args(annotation) or (np.float64,)
    kind = get_args(kind)[0] if get_origin(kind) is np.dtype else kind
    return np.int64 if issubclass(get_origin(kind) or kind, np.integer) else np.float64


def _checked(value: Plain, fits: bool, where: str, accepted: str) -> Plain:
    if not fits:
        raise FormatError(where, repr(value)[:40], accepted)
    return value
