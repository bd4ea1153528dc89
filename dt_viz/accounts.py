"""Accounts of the processor time that visitors use: who has overdrawn his own, or that of his address, gives way."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from weakref import WeakValueDictionary


@dataclass(frozen=True)
class QuotaSettings:
    """Quotas of processor time, of one process; a visitor who drags alone uses up to 0.8 s a second."""

    rate: float = 0.4
    """Processor time that a visitor is given, seconds a second."""
    saved: float = 2.0
    """Largest credit of a visitor, seconds."""
    owed: float = 10.0
    """Largest debt of a visitor, seconds: what was long ago is forgiven."""
    of_address: float = 3.0
    """Quota of an address, in those of a visitor."""


class Account:
    """A token bucket: filled at a constant rate, emptied by what is used, and below empty while overdrawn."""

    def __init__(self, address: Account | None = None, settings: QuotaSettings = QuotaSettings()) -> None:
        """Open an account, of a visitor of an address, whose account is charged, too; None if that has no quota."""
        self._settings, self._address = settings, address
        self._lock = threading.Lock()
        self._level, self._filled = settings.saved, time.monotonic()

    @classmethod
    def of_address(cls, settings: QuotaSettings = QuotaSettings()) -> Account:
        """Open the account of an address."""
        times = settings.of_address
        return cls(None, QuotaSettings(times * settings.rate, times * settings.saved, times * settings.owed))

    def charge(self, seconds: float) -> None:
        """Take processor time, seconds, from this account and from that of its address."""
        with self._lock:
            settings, now = self._settings, time.monotonic()
            level = min(self._level + settings.rate * (now - self._filled), settings.saved) - seconds
            self._level, self._filled = max(level, -settings.owed), now
        if self._address is not None:
            self._address.charge(seconds)

    @property
    def debt(self) -> float:
        """Time by which it is overdrawn, with the debt of its address, seconds; 0 if neither is."""
        self.charge(0.0)
        return max(0.0, -self._level) + (0.0 if self._address is None else self._address.debt)


class Accounts:
    """The accounts of the addresses that visitors of this process have now."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._addresses: WeakValueDictionary[str, Account] = WeakValueDictionary()

    def opened(self, address: str) -> Account:
        """Open the account of a visitor of an address; an empty one has no quota."""
        with self._lock:
            return Account(self._addresses.setdefault(address, Account.of_address()) if address else None)


class _Thread(threading.local):
    account: Account | None = None
    settled: float = 0.0
    """Processor time of the thread that is charged, seconds of `time.thread_time`."""


_thread = _Thread()


@contextmanager
def charged(account: Account | None) -> Iterator[None]:
    """Charge an account, if any, for the processor time of this thread within the block."""
    _thread.account, _thread.settled = account, time.thread_time()
    try:
        yield
    finally:
        settle()
        _thread.account = None


def settle(others: float = 0.0) -> float:
    """Charge this thread's account for what is not charged yet, and for processor time of others that work for it.

    Returns:
        Debt of the account, seconds; 0 if it is not overdrawn, or there is none.
    """
    account, now = _thread.account, time.thread_time()
    if account is None:
        return 0.0
    account.charge(now - _thread.settled + others)
    _thread.settled = now
    return account.debt
