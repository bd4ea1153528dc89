"""Lengths that belong to an arm's size: settings give them for an arm as large as the JACO."""

from __future__ import annotations

from dataclasses import field, fields, replace
from functools import lru_cache
from typing import Any, TypeVar

_Settings = TypeVar("_Settings")


def scales(default: float, power: float = 1) -> Any:  # noqa: ANN401 - as `dataclasses.field`
    """Default of a field, in metres to a power, that scales with the reach of an arm; see `sized`."""
    return field(default=default, metadata={"metres": power})


def sized(settings: _Settings, size: float) -> _Settings:
    """Settings, a frozen dataclass, for an arm whose reach is `size` times the JACO's."""
    return _sized(settings, size)


@lru_cache(maxsize=64)
def _sized(settings: Any, size: float) -> Any:  # noqa: ANN401 - as `sized`
    powers: dict[str, float] = {own.name: own.metadata.get("metres", 0) for own in fields(settings)}
    scaled = {name: getattr(settings, name) * size**power for name, power in powers.items() if power}
    return replace(settings, **scaled)
