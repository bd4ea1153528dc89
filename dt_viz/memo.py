"""Results that are kept, by what they were computed from."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

_Result = TypeVar("_Result")


class Memo:
    """The newest results of pure functions. For one thread."""

    def __init__(self) -> None:
        self._results: defaultdict[str, dict[Hashable, Any]] = defaultdict(dict)

    def __call__(self, kind: str, key: Hashable, make: Callable[[], _Result], *, newest: int | None = None) -> _Result:
        """The result for a key: what is kept, or else what `make` returns now. What it raises is not kept.

        Args:
            kind: of the results, which have keys and a size of their own.
            key: all that `make` computes from.
            make: computes the result.
            newest: number of results of this kind that are kept, those used last; None keeps all.
        """
        results = self._results[kind]
        result = results.pop(key) if key in results else make()
        results[key] = result
        while newest is not None and len(results) > newest:
            del results[next(iter(results))]
        return result

    def has(self, kind: str, key: Hashable) -> bool:
        """Whether the result for a key is kept."""
        return key in self._results[kind]

    def count(self, kind: str) -> int:
        """Number of results of a kind that are kept."""
        return len(self._results[kind])
