"""Accounts of processor time: credit grows with time up to a limit, debts are forgiven, addresses count as well."""

import time
from types import SimpleNamespace

import pytest

from dt_viz import accounts
from dt_viz.accounts import Account, Accounts, QuotaSettings, charged, settle

SETTINGS = QuotaSettings(rate=0.5, saved=2.0, owed=10.0, of_address=3.0)


@pytest.fixture
def clocks(monkeypatch):
    """Time that passes, and processor time, as they are set."""
    clocks = SimpleNamespace(now=0.0, used=0.0)
    told = SimpleNamespace(monotonic=lambda: clocks.now, thread_time=lambda: clocks.used)
    monkeypatch.setattr(accounts, "time", told)
    return clocks


def test_who_uses_no_more_than_the_rate_owes_nothing_and_who_uses_more_for_long_does(clocks):
    frugal, greedy = Account(None, SETTINGS), Account(None, SETTINGS)
    for _ in range(20):
        clocks.now += 1
        frugal.charge(0.5)
        greedy.charge(0.8)
    assert frugal.debt == 0
    assert greedy.debt == pytest.approx(0.8 + 19 * 0.3 - 2.0)


def test_a_debt_is_paid_by_waiting_and_what_was_long_ago_is_forgiven(clocks):
    account = Account(None, SETTINGS)
    account.charge(100.0)
    assert account.debt == 10
    clocks.now += 6
    assert account.debt == pytest.approx(7)
    clocks.now += 1000
    assert account.debt == 0
    account.charge(2.5)
    assert account.debt == pytest.approx(0.5)  # credit has a limit


def test_all_visitors_of_an_address_owe_what_it_owes_and_others_do_not(clocks):
    known = Accounts()
    visitors, other, here = [known.opened("a") for _ in range(8)], known.opened("b"), known.opened("")
    for visitor in visitors:
        visitor.charge(QuotaSettings().saved)
    owed = (8 - QuotaSettings().of_address) * QuotaSettings().saved
    assert [visitor.debt for visitor in visitors] == [pytest.approx(owed)] * 8
    visitors[0].charge(1.0)
    assert visitors[0].debt == pytest.approx(visitors[1].debt + 1)
    assert other.debt == here.debt == 0


def test_a_thread_is_charged_for_what_it_uses_within_the_block_and_not_before_or_twice(clocks):
    account = Account(None, SETTINGS)
    clocks.used = 50.0
    with charged(account):
        clocks.used += 2.5
        assert settle() == pytest.approx(0.5)
        assert settle() == pytest.approx(0.5)
        assert settle(1.0) == pytest.approx(1.5)  # of a process that works for it
        clocks.used += 1
    clocks.used += 5
    assert settle(7.0) == 0
    assert account.debt == pytest.approx(2.5)


def test_computing_is_charged_and_waiting_is_not():
    account = Account(None, QuotaSettings(rate=1e-9, saved=1e-9))
    with charged(account):
        time.sleep(0.3)
        waited = settle()
        end = time.thread_time() + 0.1
        while time.thread_time() < end:
            pass
    assert waited < 0.1
    assert 0.1 <= account.debt < 0.2
