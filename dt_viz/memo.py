"""Results that are kept, by what they were computed from."""

from __future__ import annotations

import functools
import threading
from collections import defaultdict
from collections.abc import Callable, Hashable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

_Result = TypeVar("_Result")
_Method = TypeVar("_Method", bound=Callable[..., Any])


class cached_property(functools.cached_property[_Result]):
    """`functools.cached_property` without its lock, which Python 3.10 and 3.11 hold for all instances.

    Several threads may ask. Where two compute the same value at once, both get the one that was there first.
    """

    if not TYPE_CHECKING:  # its types are those of the base class

        def __get__(self, instance: object, owner: type | None = None) -> object:
            if instance is None:
                return self
            return vars(instance).setdefault(self.attrname, self.func(instance))


class Memo:
    """The newest results of pure functions.

    Several threads may share it. Where two compute the same result at once, both get the one that was there first.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: defaultdict[str, dict[Hashable, Any]] = defaultdict(dict)

    def __call__(self, kind: str, key: Hashable, make: Callable[[], _Result], *, newest: int | None = None) -> _Result:
        """The result of a kind for a key, all that `make` computes from: what is kept, or else what it returns now.

        What it raises is not kept. Each kind keeps the `newest` results, those used last; None keeps all.
        """
        with self._lock:
            results = self._results[kind]
            if key in results:
                results[key] = result = results.pop(key)  # the newest now
                return result
        made = make()
        with self._lock:
            result = results.setdefault(key, made)
            while newest is not None and len(results) > newest:
                del results[next(iter(results))]
        return result

    def count(self, kind: str) -> int:
        """Number of results of a kind that are kept."""
        return len(self._results[kind])


def kept(
    newest: int | None = None, by: Callable[..., Hashable] = lambda *given: given, of: str = "memo"
) -> Callable[[_Method], _Method]:
    """Decorate a method whose newest results its object keeps in its `Memo`, the attribute `of`; None keeps all.

    `by` gives what a result depends on, of the method's arguments.
    """

    def decorate(method: _Method) -> _Method:
        @wraps(method)
        def asked(self: Any, *given: Any) -> Any:  # noqa: ANN401 - whatever the method takes and returns
            return getattr(self, of)(method.__qualname__, by(*given), lambda: method(self, *given), newest=newest)

        return cast(_Method, asked)

    return decorate
