"""Codec of frozen dataclasses: text for their structure, arrays beside it, read back by their fields' annotations.

A field is a number, a string, one of a few literals, an array, a tuple of these, another dataclass, or None instead.
Where it may hold objects of several classes, the text names the class, and only listed classes are made.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from dt_viz.errors import FormatError

CLASS = "class"
"""Key of the name of an object's class: no field can be called so."""
SCALARS: Mapping[type, tuple[Any, str]] = {
    bool: ((bool, np.bool_), "true or false"),
    int: (Integral, "an integer"),
    float: (Real, "a finite number"),
    str: (str, "text"),
}
"""What is taken for each kind of scalar, and how messages call it."""


@dataclass(frozen=True)
class Codec:
    """Writes and reads values; `where` is the place of a value in the whole one, for messages."""

    classes: Mapping[Any, tuple[type, ...]]
    """Dataclasses whose objects may stand where a field is annotated with a base class or a protocol."""

    def encode(self, value: Any, annotation: Any, where: str, arrays: dict[str, np.ndarray]) -> Any:  # noqa: ANN401 - JSON
        """Return a value as what JSON can hold, and put its arrays into `arrays`.

        Raises:
            FormatError: it is not what its annotation says, or of a class that is not listed.
        """
        annotation = _of_optional(annotation)
        if value is None or get_origin(annotation) is Literal:
            return value
        if get_origin(annotation) is tuple:
            items = list(value)
            return [
                self.encode(item, kind, f"{where}[{k}]", arrays)
                for k, (item, kind) in enumerate(zip(items, _kinds(annotation, len(items), where), strict=True))
            ]
        if _is_array(annotation):
            arrays[where] = np.asarray(value, _numbers(annotation))
            return where
        if annotation in SCALARS:
            return _scalar(value, annotation, where)
        listed = self._listed(annotation, where)
        if type(value) not in listed:
            names = ", ".join(kind.__name__ for kind in listed)
            raise FormatError(where, f"a {type(value).__name__}, which is not registered", names)
        hints = get_type_hints(type(value))
        held = {
            field.name: self.encode(getattr(value, field.name), hints[field.name], f"{where}.{field.name}", arrays)
            for field in fields(value)
        }
        return {CLASS: type(value).__name__, **held} if annotation in self.classes else held

    def decode(self, plain: Any, annotation: Any, where: str, arrays: Mapping[str, np.ndarray]) -> Any:  # noqa: ANN401 - JSON
        """Return the value that `encode` wrote. Fields that the text lacks have their defaults.

        Raises:
            FormatError: it is not what the annotation says, or its class refuses it.
        """
        if plain is None and _of_optional(annotation) is not annotation:
            return None
        annotation = _of_optional(annotation)
        if get_origin(annotation) is Literal:
            if plain not in get_args(annotation):
                raise FormatError(where, _shown(plain), " or ".join(map(repr, get_args(annotation))))
            return plain
        if get_origin(annotation) is tuple:
            items = _of_type(plain, list, where, "a list")
            kinds = _kinds(annotation, len(items), where)
            return tuple(
                self.decode(item, kind, f"{where}[{k}]", arrays)
                for k, (item, kind) in enumerate(zip(items, kinds, strict=True))
            )
        if _is_array(annotation):
            array, kind = arrays.get(_of_type(plain, str, where, "the name of an array")), _numbers(annotation)
            if array is None or array.dtype != kind or not np.isfinite(array).all():
                raise FormatError(where, "no such array of finite numbers", f"an array of {kind.__name__}")
            return array
        if annotation in SCALARS:
            return _scalar(plain, annotation, where)
        return self._made(dict(_of_type(plain, dict, where, "an object")), annotation, where, arrays)

    def _made(self, held: dict[str, Any], annotation: Any, where: str, arrays: Mapping[str, np.ndarray]) -> Any:  # noqa: ANN401
        """Return an object made by its constructor, whose checks thus apply."""
        listed = self._listed(annotation, where)
        name = held.pop(CLASS, None) if annotation in self.classes else annotation.__name__
        kind = next((kind for kind in listed if kind.__name__ == name), None)
        if kind is None:
            raise FormatError(where, f"the class {_shown(name)}", " or ".join(kind.__name__ for kind in listed))
        names, hints = {field.name for field in fields(kind)}, get_type_hints(kind)
        if unknown := held.keys() - names:
            raise FormatError(where, f"the field {_shown(min(unknown))}", ", ".join(sorted(names)))
        values = {name: self.decode(plain, hints[name], f"{where}.{name}", arrays) for name, plain in held.items()}
        try:
            return kind(**values)
        except FormatError as error:
            raise FormatError(f"{where}.{error.field}", error.found, error.accepted) from error
        except TypeError as error:
            raise FormatError(where, f"too few fields ({error})", ", ".join(sorted(names))) from error

    def _listed(self, annotation: Any, where: str) -> tuple[type, ...]:  # noqa: ANN401 - an annotation
        if annotation in self.classes:
            return self.classes[annotation]
        if not is_dataclass(annotation):
            raise FormatError(where, f"a field annotated as {annotation}", "numbers, text, arrays, tuples, dataclasses")
        return (typing.cast(type, annotation),)


def _of_optional(annotation: Any) -> Any:  # noqa: ANN401 - an annotation
    """Return X of the annotation X | None; others as they are."""
    if get_origin(annotation) not in (typing.Union, types.UnionType):
        return annotation
    inner = [kind for kind in get_args(annotation) if kind is not types.NoneType]
    return inner[0] if len(inner) == 1 else annotation


def _kinds(annotation: Any, num: int, where: str) -> tuple[Any, ...]:  # noqa: ANN401 - an annotation
    """Return the annotation of each item of a tuple."""
    kinds = get_args(annotation)
    if kinds[-1] is Ellipsis:
        return kinds[:1] * num
    if num != len(kinds):
        raise FormatError(where, f"{num} values", f"{len(kinds)} values")
    return kinds


def _is_array(annotation: Any) -> bool:  # noqa: ANN401 - an annotation
    return (get_origin(annotation) or annotation) is np.ndarray


def _numbers(annotation: Any) -> type[np.generic]:  # noqa: ANN401 - an annotation
    """Return the numbers that an array of this annotation is written in, which hold all others of their kind."""
    *_, dtype = get_args(annotation) or (np.dtype[np.float64],)
    (kind,) = get_args(dtype)
    return np.int64 if issubclass(get_origin(kind) or kind, np.integer) else np.float64


def _scalar(value: Any, kind: type, where: str) -> Any:  # noqa: ANN401 - bool, int, float or str
    taken, accepted = SCALARS[kind]
    if isinstance(_of_type(value, taken, where, accepted), bool) and kind is not bool:
        raise FormatError(where, _shown(value), accepted)
    if kind is float and not (abs(value) < math.inf):
        raise FormatError(where, _shown(value), accepted)
    if kind is str:
        value.encode()  # half a character can be neither shown nor printed
    return kind(value)


def _of_type(value: Any, kind: Any, where: str, accepted: str) -> Any:  # noqa: ANN401
    if not isinstance(value, kind):
        raise FormatError(where, _shown(value), accepted)
    return value


def _shown(value: Any) -> str:  # noqa: ANN401
    return repr(value)[:40]
