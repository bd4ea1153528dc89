"""Properties that are computed once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

_Value = TypeVar("_Value")


class cached_property(Generic[_Value]):
    """A property that is computed on first use and kept in the instance, without a lock.

    `functools.cached_property` of Python 3.10 and 3.11 holds one lock for each class attribute while it computes. What
    is computed here may pause at a checkpoint and let another engine go first (see `dt_viz.engine.turns`), which would
    then wait for that lock for ever. Threads that ask for a value at the same time each compute it, and all get the one
    that was ready first.
    """

    def __init__(self, compute: Callable[[Any], _Value]) -> None:
        self._compute = compute
        self.__doc__ = compute.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type | None = None) -> cached_property[_Value]: ...

    @overload
    def __get__(self, instance: object, owner: type | None = None) -> _Value: ...

    def __get__(self, instance: object, owner: type | None = None) -> cached_property[_Value] | _Value:
        # not a data descriptor: from the second use on Python finds the value in the instance and does not come here
        return self if instance is None else vars(instance).setdefault(self._name, self._compute(instance))
