"""Slots: no more at once than there are, who follows a hand first, and nobody is left out."""

import sys
import threading
from contextlib import nullcontext, suppress
from time import monotonic, thread_time

import pytest

from dt_viz.accounts import Account, QuotaSettings, charged
from dt_viz.checkpoints import checked, checkpoint
from dt_viz.errors import UnwantedError, never
from dt_viz.session import cores as cores_module
from dt_viz.session.cores import Cores, CoresSettings, Rank

PATIENCE = 30
"""Seconds after which a test gives up; nothing takes that long."""


class Crowd:
    """Threads that want slots, and the order in which they get them; each keeps its own until it is let go."""

    def __init__(self, num, num_hands=None, patience=10.0 * PATIENCE):
        settings = CoresSettings(num_hands=num_hands or num, patience=patience)
        self.cores, self.order, self.threads, self.let_go = Cores(num, settings), [], {}, {}
        self._got = threading.Condition()

    def come(self, name, cancelled=never, account=None):
        """Returns when this one waits or has a slot. Upper case refines, and numbers are pages."""
        rank = Rank.REFINEMENT if name.isupper() else Rank.PAGE if name.isdigit() else Rank.HAND
        self.let_go[name] = threading.Event()

        def want():
            with charged(account), self.cores.slot(rank, cancelled):
                with self._got:
                    self.order.append(name)
                    self._got.notify_all()
                self.let_go[name].wait(PATIENCE)

        def try_it():
            try:
                want()
            except UnwantedError:
                self.order.append(f"{name} left")

        self.threads[name] = threading.Thread(target=try_it, daemon=True)
        self.threads[name].start()
        self._settle()

    def go(self, *names):
        """Returns when they are gone and who comes next has come."""
        for name in names:
            self.let_go[name].set()
            self.threads[name].join(PATIENCE)
            assert not self.threads[name].is_alive()
            self._settle()

    def _settle(self):
        """Wait until all who are there wait for a slot or have noted that they have one."""

        def settled():
            with self.cores._lock:
                waiting, held = len(self.cores.queue), {place.thread for place in self.cores._held}
            alive = {thread.ident: name for name, thread in self.threads.items() if thread.is_alive()}
            return len(alive) == waiting + len(held) and all(alive[thread] in self.order for thread in held)

        while not settled():
            threading.Event().wait(0.001)

    def close(self):
        for event in self.let_go.values():
            event.set()
        for thread in self.threads.values():
            thread.join(PATIENCE)
        assert not any(thread.is_alive() for thread in self.threads.values())


@pytest.fixture(name="crowd")
def _crowd(request):
    crowd = Crowd(*getattr(request, "param", [2]))
    yield crowd
    crowd.close()


@pytest.mark.parametrize("crowd", [[1]], indirect=True)
def test_who_follows_a_hand_goes_first_and_else_who_came_first(crowd):
    for name in "xAbCd":
        crowd.come(name)
    crowd.go("x", "b", "d", "A")
    assert crowd.order == ["x", "b", "d", "A", "C"]


@pytest.mark.parametrize("crowd", [[1, 1]], indirect=True)
def test_pages_are_built_after_hands_and_before_anybody_refines(crowd):
    for name in "xA1b2":
        crowd.come(name)
    crowd.go("x", "b", "1", "2")
    assert crowd.order == ["x", "b", "1", "2", "A"]


@pytest.mark.parametrize("crowd", [[1, 1, 0.2]], indirect=True)
def test_who_has_waited_longest_comes_first_once_in_a_while(crowd):
    """Else nobody would refine, nor have a page, while two drag without a pause on a single core."""
    came = monotonic()
    for name in "aB1c":
        crowd.come(name)
    threading.Event().wait(0.2)
    crowd.go("a")
    assert crowd.order == ["a", "B"] and monotonic() - came >= 0.2
    crowd.come("d")
    crowd.let_go["B"].set()
    crowd.threads["B"].join(PATIENCE)
    crowd._settle()
    is_late = monotonic() - came >= 0.4  # on a machine that is slow it is the turn of the page already
    assert crowd.order[2:] == ["1"] if is_late else ["c"]
    if not is_late:
        threading.Event().wait(0.2)
        crowd.go("c")
        assert crowd.order == ["a", "B", "c", "1"]


def test_a_hand_has_its_slot_also_where_a_refinement_has_waited_longest():
    crowd = Crowd(2, 1, patience=0.0)
    for name in "aBcD":
        crowd.come(name)
    crowd.go("a")
    assert crowd.order == ["a", "B", "c"]
    crowd.close()


@pytest.mark.parametrize("crowd", [[2], [3]], indirect=True)
def test_refinements_leave_a_slot_to_who_follows_a_hand(crowd):
    num = crowd.cores._num
    for name in "ABC":
        crowd.come(name)
    assert crowd.order == list("ABC")[: num - 1]
    crowd.come("d")
    assert crowd.order[-1] == "d"  # it waits for no refinement
    crowd.come("e")
    assert crowd.order[-1] == "d"
    crowd.go("A")
    assert crowd.order[-1] == "e"  # though a refinement came before it


@pytest.mark.parametrize("crowd", [[2, 1]], indirect=True)
def test_a_refinement_begins_beside_a_hand_but_not_while_another_one_waits(crowd):
    for name in "abC":
        crowd.come(name)
    assert crowd.order == ["a"]
    crowd.go("a")
    assert crowd.order[0] == "a" and set(crowd.order[1:]) == {"b", "C"}  # both at once
    crowd.go("b")
    crowd.come("d")
    assert crowd.order[-1] == "d"  # beside the refinement


@pytest.mark.parametrize("crowd", [[1], [2]], indirect=True)
def test_a_refinement_that_is_cancelled_leaves_the_queue_and_takes_nobodys_slot(crowd):
    unwanted = threading.Event()
    crowd.come("A")
    crowd.come("B", unwanted.is_set)
    crowd.come("C")
    unwanted.set()
    crowd.threads["B"].join(PATIENCE)
    assert crowd.order == ["A", "B left"] and len(crowd.cores.queue) == 1
    crowd.go("A")
    assert crowd.order == ["A", "B left", "C"]
    crowd.come("D", unwanted.is_set)
    assert crowd.order[-1] == "D left"  # nor does it begin


def test_what_waits_and_is_not_wanted_any_more_leaves_at_once_when_it_is_woken():
    cores, unwanted, left = Cores(1, CoresSettings(look=100 * PATIENCE)), threading.Event(), threading.Event()

    def want():
        try:
            with cores.slot(Rank.REFINEMENT, unwanted.is_set):
                pass
        except UnwantedError:
            left.set()

    thread = threading.Thread(target=want, daemon=True)
    with cores.slot():
        thread.start()
        while not cores.queue:
            threading.Event().wait(0.001)
        unwanted.set()
        cores.wake(threading.get_ident())
        assert not left.wait(0.2)  # another one was woken
        assert thread.ident is not None
        cores.wake(thread.ident)
        assert left.wait(PATIENCE)
    assert not cores.queue


def owing(debt):
    """An account that is overdrawn by so many seconds, for the time of a test."""
    account = Account(None, QuotaSettings(rate=1e-9, saved=0.0))
    account.charge(debt)
    return account


@pytest.mark.parametrize("crowd", [[1]], indirect=True)
def test_of_hands_and_then_of_refinements_who_owes_least_comes_first(crowd):
    crowd.come("x")
    for name, debt in zip("bCdEf", (2.0, 1.0, 3.0, 0.0, 0.0), strict=True):
        crowd.come(name, account=owing(debt))
    crowd.go("x", "f", "b", "d", "E")
    assert crowd.order == ["x", "f", "b", "d", "E", "C"]


@pytest.mark.parametrize("crowd", [[2, 1]], indirect=True)
def test_a_hand_waits_for_no_refinement_also_of_who_has_overdrawn(crowd):
    crowd.come("A")
    crowd.come("b", account=owing(5.0))
    assert crowd.order == ["A", "b"]
    crowd.come("c", account=owing(1.0))
    crowd.come("d")
    crowd.go("b", "d")
    assert crowd.order == ["A", "b", "d", "c"]


def test_what_is_computed_in_a_slot_is_charged(crowd):
    account = owing(0.0)
    with charged(account):
        with crowd.cores.slot():
            end = thread_time() + 0.1
            while thread_time() < end:
                pass
        assert 0.1 <= account.debt < 0.2


@pytest.mark.parametrize("begins", [True, False], ids=["within a slot", "without"])
@pytest.mark.parametrize("account", [None, owing(5.0)], ids=["in credit", "overdrawn"])
@pytest.mark.parametrize("followed", [True, False])
def test_at_a_checkpoint_who_has_overdrawn_gives_way_while_a_hand_is_followed(account, followed, begins):
    gives_way = followed and account is not None
    cores, went_on = Cores(2, CoresSettings(longest=0.5 if gives_way else 10 * PATIENCE)), threading.Event()

    def compute():
        with charged(account), cores.slot(Rank.BEGINNING) if begins else checked(cores.give_way):
            checkpoint()
            went_on.set()

    thread, began = threading.Thread(target=compute), monotonic()
    with cores.slot() if followed else nullcontext():
        thread.start()
        assert went_on.wait(PATIENCE)  # not for ever
        assert not gives_way or monotonic() - began >= 0.5
    thread.join(PATIENCE)


@pytest.mark.parametrize("gap", [0.0, 0.4])
def test_who_has_overdrawn_goes_on_once_a_drag_has_ended(gap):
    cores, went_on = Cores(2, CoresSettings(longest=10 * PATIENCE, gap=gap)), threading.Event()

    def compute():
        with charged(owing(5.0)):
            cores.give_way()
            went_on.set()

    thread = threading.Thread(target=compute)
    with cores.slot():
        thread.start()
        assert not went_on.wait(0.2)
    ended = monotonic()
    assert went_on.wait(PATIENCE / 3)
    assert monotonic() - ended >= gap - 0.05
    thread.join(PATIENCE)


@pytest.mark.parametrize("owed", [1.0, 9.0])
def test_who_has_overdrawn_gives_way_to_who_owes_less_and_computes(owed):
    cores, went_on, has_slot, end = Cores(2, CoresSettings(longest=10 * PATIENCE)), *(threading.Event() for _ in "abc")

    def refine():
        with charged(owing(owed)), cores.slot(Rank.REFINEMENT):
            has_slot.set()
            end.wait(PATIENCE)

    def compute():
        with charged(owing(5.0)):
            cores.give_way()
            went_on.set()

    threads = [threading.Thread(target=work) for work in (refine, compute)]
    threads[0].start()
    assert has_slot.wait(PATIENCE)
    threads[1].start()
    assert went_on.wait(0.3 if owed < 5 else PATIENCE) == (owed > 5)
    end.set()
    assert went_on.wait(PATIENCE)
    for thread in threads:
        thread.join(PATIENCE)


@pytest.mark.parametrize(("least", "pauses"), [(PATIENCE, False), (0.0, True)])
def test_who_has_overdrawn_computes_for_a_while_between_two_pauses(least, pauses):
    cores, ended = Cores(2, CoresSettings(longest=0.5, least=least)), threading.Event()

    def compute():
        with charged(owing(5.0)), checked(cores.give_way):
            for _ in range(5):
                checkpoint()
        ended.set()

    thread, began = threading.Thread(target=compute), monotonic()
    with cores.slot():
        thread.start()
        assert ended.wait(PATIENCE)
    assert monotonic() - began >= 0.5 and (monotonic() - began >= 2.5) == pauses
    thread.join(PATIENCE)


def test_an_arm_that_moves_gives_no_way_at_checkpoints():
    cores = Cores(2)
    with checked(lambda: pytest.fail("an arm paused")), cores.between_hands():
        checkpoint()


def test_a_slot_ends_with_an_exception(crowd):
    with pytest.raises(ZeroDivisionError), crowd.cores.slot(), crowd.cores.slot(Rank.REFINEMENT):
        raise ZeroDivisionError
    crowd.come("A")
    crowd.come("b")
    assert crowd.order == ["A", "b"]


@pytest.mark.parametrize("num", [1, 2, 3])
def test_in_a_storm_no_more_than_the_slots_are_taken_and_all_get_one(num):
    free, free_to_refine = threading.Semaphore(num), threading.Semaphore(max(1, num - 1))
    cores, crowded = Cores(num, CoresSettings(num_hands=num)), []

    def want(refines):
        for _ in range(100):
            with cores.slot(Rank.REFINEMENT if refines else Rank.HAND):
                for semaphore in (free, *([free_to_refine] if refines else [])):
                    if not semaphore.acquire(blocking=False):
                        crowded.append(threading.current_thread().name)
                        return
                threading.Event().wait(0)
                free.release()
                if refines:
                    free_to_refine.release()

    threads = [threading.Thread(target=want, args=(k % 2 == 0,), daemon=True) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()
    assert crowded == []


@pytest.mark.parametrize("rank", [Rank.REFINEMENT, Rank.BEGINNING])
def test_at_a_checkpoint_a_refinement_pauses_while_a_hand_is_followed_and_a_beginning_does_not(rank):
    cores, went_on = Cores(2, CoresSettings(longest=10 * PATIENCE)), threading.Event()

    def compute():
        with cores.slot(rank):
            checkpoint()
            went_on.set()

    thread = threading.Thread(target=compute)
    with cores.slot():
        thread.start()
        assert went_on.wait(0.3 if rank is Rank.REFINEMENT else PATIENCE) == (rank is Rank.BEGINNING)
    assert went_on.wait(PATIENCE)
    thread.join(PATIENCE)
    checkpoint()  # without a slot it asks nobody


def test_a_beginning_waits_for_one_slot_only_while_hands_wait_for_theirs():
    cores = Cores(2)
    began = threading.Event()

    def begin():
        with cores.slot(Rank.BEGINNING):
            began.set()

    def follow():
        with cores.slot():
            pass

    with cores.slot():
        others = [threading.Thread(target=follow), threading.Thread(target=begin)]
        others[0].start()
        while not cores.queue:
            threading.Event().wait(0.001)
        others[1].start()
        assert began.wait(PATIENCE)
    for thread in others:
        thread.join(PATIENCE)


@pytest.fixture
def usual_turn():
    """Threads switch as before, after a test."""
    before = sys.getswitchinterval()
    yield before
    sys.setswitchinterval(before)


class Pausing:
    """A thread within a slot that calls checkpoints when it is told to; it notes that it has gone on after each."""

    def __init__(self, cores, rank=Rank.REFINEMENT, account=None):
        self._come, self.went_on, self._ends, has_slot = (threading.Event() for _ in range(4))

        def compute():
            with charged(account), cores.slot(rank):
                has_slot.set()
                while self._come.wait(PATIENCE) and not self._ends.is_set():
                    self._come.clear()
                    checkpoint()
                    self.went_on.set()

        self._thread = threading.Thread(target=compute, daemon=True)
        self._thread.start()
        assert has_slot.wait(PATIENCE)

    def checkpoint(self):
        self.went_on.clear()
        self._come.set()

    def end(self):
        self._ends.set()
        self._come.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


@pytest.mark.parametrize("rank", [Rank.HAND, Rank.BEGINNING, Rank.PAGE, Rank.REFINEMENT])
@pytest.mark.parametrize("num", [1, 2])
def test_at_a_checkpoint_a_refinement_lends_its_slot_to_all_but_another_refinement(num, rank):
    cores, has_slot, may_end = Cores(num, CoresSettings(longest=10 * PATIENCE)), threading.Event(), threading.Event()

    def come():
        with cores.slot(rank):
            has_slot.set()
            may_end.wait(PATIENCE)

    refines, other = Pausing(cores), threading.Thread(target=come)
    other.start()
    while not cores.queue and not has_slot.is_set():
        threading.Event().wait(0.001)
    assert has_slot.is_set() == (rank is Rank.HAND and num == 2)
    refines.checkpoint()
    lends = rank is not Rank.REFINEMENT
    assert has_slot.wait(PATIENCE if lends else 0.2) == lends
    assert refines.went_on.wait(0.2 if lends else PATIENCE) != lends
    may_end.set()
    assert refines.went_on.wait(PATIENCE)
    refines.end()
    other.join(PATIENCE)
    assert not cores._held and not cores.queue


def test_a_slot_is_lent_to_one_only_and_is_taken_again():
    settings = CoresSettings(longest=10 * PATIENCE, patience=10 * PATIENCE)
    cores, refines, others = Cores(2, settings), None, {}
    refines = Pausing(cores)
    for name, rank in (("a page", Rank.PAGE), ("another page", Rank.PAGE), ("a refinement", Rank.REFINEMENT)):
        others[name] = threading.Event(), threading.Event()

        def come(rank=rank, has_slot=others[name][0], may_end=others[name][1]):
            with cores.slot(rank):
                has_slot.set()
                may_end.wait(PATIENCE)

        threading.Thread(target=come, daemon=True).start()
        while len(cores.queue) < len(others):
            threading.Event().wait(0.001)
    refines.checkpoint()
    for name in ("a page", "another page"):
        assert others[name][0].wait(PATIENCE)
        assert not refines.went_on.is_set() and len(cores._held) == 2
        others[name][1].set()
    assert refines.went_on.wait(PATIENCE)
    assert not others["a refinement"][0].wait(0.2)
    refines.end()
    assert others["a refinement"][0].wait(PATIENCE)
    others["a refinement"][1].set()


@pytest.mark.parametrize("rank", [Rank.REFINEMENT, Rank.BEGINNING])
def test_nobody_pauses_for_who_cannot_have_his_slot(rank):
    """Such as one who overdraws while he refines, and another one who waits to refine, too."""
    cores = Cores(2, CoresSettings(longest=10 * PATIENCE, least=0.0))
    account, may_end = owing(0.0), threading.Event()
    pausing = Pausing(cores, rank, account)
    account.charge(5.0)
    other = threading.Thread(target=lambda: refine_once(cores, may_end), daemon=True)
    other.start()
    while not cores.queue:
        threading.Event().wait(0.001)
    pausing.checkpoint()
    assert pausing.went_on.wait(PATIENCE / 3)
    pausing.end()
    may_end.set()
    other.join(PATIENCE)


def test_a_refinement_lends_its_slot_to_no_refinement_that_owes_less():
    cores, may_end = Cores(2, CoresSettings(longest=10 * PATIENCE)), threading.Event()
    may_end.set()
    pausing = Pausing(cores, Rank.REFINEMENT, owing(5.0))
    with cores.slot():
        pausing.checkpoint()
        other = threading.Thread(target=lambda: refine_once(cores, may_end), daemon=True)
        other.start()
        other.join(0.3)
        assert other.is_alive()
    pausing.end()
    other.join(PATIENCE)
    assert not other.is_alive()


def test_whoever_has_a_slot_knows_it_without_looking_through_a_list_that_others_change(monkeypatch):
    """Else one who moves up in it while he looks may overlook himself, and wait for ever with the slot."""
    cores, compared = Cores(2), []

    def equal(place, other):
        compared.append(cores._lock.locked())
        return place is other

    monkeypatch.setattr(cores_module._Place, "__eq__", equal)
    with cores.slot(Rank.REFINEMENT), cores.slot():
        pass
    assert compared and all(compared)


def refine_once(cores, may_end):
    with cores.slot(Rank.REFINEMENT):
        may_end.wait(PATIENCE)


def test_a_hand_waits_for_hands_alone_also_where_a_slot_is_lent_and_the_lender_has_gone_on():
    cores, may_end, has_slot = Cores(2, CoresSettings(longest=0.1)), threading.Event(), threading.Event()
    refines = Pausing(cores)

    def build():
        with cores.slot(Rank.PAGE):
            has_slot.set()
            may_end.wait(PATIENCE)

    page = threading.Thread(target=build, daemon=True)
    page.start()
    while not cores.queue:
        threading.Event().wait(0.001)
    refines.checkpoint()
    assert has_slot.wait(PATIENCE) and refines.went_on.wait(PATIENCE)
    followed = threading.Event()

    def follow():
        with cores.slot():
            followed.set()

    hand = threading.Thread(target=follow, daemon=True)
    hand.start()
    assert followed.wait(PATIENCE / 3)
    may_end.set()
    hand.join(PATIENCE)
    page.join(PATIENCE)
    refines.end()


def test_who_pauses_and_is_not_wanted_any_more_ends_at_once_when_it_is_woken():
    cores, unwanted, left = Cores(2, CoresSettings(longest=10 * PATIENCE)), threading.Event(), threading.Event()

    def refine():
        with suppress(UnwantedError), cores.slot(Rank.REFINEMENT, unwanted.is_set):
            checkpoint()
        left.set()

    thread = threading.Thread(target=refine, daemon=True)
    with cores.slot():
        thread.start()
        assert not left.wait(0.2)
        unwanted.set()
        assert thread.ident is not None
        cores.wake(thread.ident)
        assert left.wait(PATIENCE)


def test_in_a_storm_of_all_ranks_and_checkpoints_nobody_waits_for_ever(usual_turn):
    """Threads switch as often as they can, also while they look whether they have a slot."""
    sys.setswitchinterval(1e-6)
    cores, done = Cores(2, CoresSettings(longest=0.002)), []

    def come(number):
        for k in range(150):
            with cores.slot(Rank((number + k) % 4)):
                checkpoint()
        done.append(number)

    threads = [threading.Thread(target=come, args=(number,), daemon=True) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(done) == list(range(8)) and not cores._held and not cores.queue


def test_who_lends_his_slot_goes_on_after_a_while_also_beside_the_other():
    cores = Cores(2, CoresSettings(longest=0.3))
    refines = Pausing(cores)
    with cores.slot(Rank.HAND):
        began = monotonic()
        refines.checkpoint()
        assert refines.went_on.wait(PATIENCE) and monotonic() - began >= 0.3
        assert len(cores._held) == 2 and not any(place.pauses for place in cores._held)
    refines.end()


def test_a_refinement_that_is_cancelled_ends_at_its_next_checkpoint():
    cores, unwanted = Cores(2), threading.Event()
    with pytest.raises(UnwantedError), cores.slot(Rank.REFINEMENT, unwanted.is_set):
        checkpoint()
        unwanted.set()
        checkpoint()
        pytest.fail("it went on")


def test_threads_take_short_turns_beside_what_computes_for_long_and_usual_ones_after_it():
    cores, usual = Cores(), sys.getswitchinterval()
    with cores.short_turns():
        with suppress(UnwantedError), cores.short_turns():
            raise UnwantedError
        assert sys.getswitchinterval() <= 0.001
    assert sys.getswitchinterval() == usual


def moving_an_arm(cores, going_on):
    """A thread that notes, within `between_hands`, that it goes on, and then waits until it may end."""
    may_end = threading.Event()

    def move():
        with cores.between_hands():
            going_on.set()
            may_end.wait(PATIENCE)

    thread = threading.Thread(target=move, daemon=True)
    thread.start()
    return thread, may_end


def test_an_arm_moves_once_no_hand_is_followed_whatever_else_is_computed():
    cores, moves = Cores(2, CoresSettings(pause=PATIENCE)), threading.Event()
    with cores.slot(Rank.REFINEMENT):
        with cores.slot():
            thread, may_end = moving_an_arm(cores, moves)
            assert not moves.wait(0.2)
        assert moves.wait(PATIENCE / 3)
    may_end.set()
    thread.join(PATIENCE)


def test_arms_move_one_after_the_other():
    cores, first, second = Cores(2, CoresSettings(longest=PATIENCE)), threading.Event(), threading.Event()
    one, one_may_end = moving_an_arm(cores, first)
    assert first.wait(PATIENCE)
    other, other_may_end = moving_an_arm(cores, second)
    assert not second.wait(0.2)
    one_may_end.set()
    assert second.wait(PATIENCE / 3)
    other_may_end.set()
    for thread in (one, other):
        thread.join(PATIENCE)


def test_an_arm_moves_after_a_while_though_a_hand_is_followed_and_another_arm_is_held_up():
    cores, first, second = Cores(2, CoresSettings(longest=0.6, pause=0.1)), threading.Event(), threading.Event()
    with cores.slot():
        one, one_may_end = moving_an_arm(cores, first)
        assert first.wait(PATIENCE)
        other, other_may_end = moving_an_arm(cores, second)
        assert second.wait(PATIENCE)
        other_may_end.set()
        other.join(PATIENCE)
    third = threading.Event()
    last, last_may_end = moving_an_arm(cores, third)
    assert not third.wait(0.3)  # the one that did not wait has let go of nothing that the first one holds
    assert third.wait(PATIENCE)
    for thread, may_end in ((one, one_may_end), (last, last_may_end)):
        may_end.set()
        thread.join(PATIENCE)
    with cores.between_hands(), pytest.raises(ZeroDivisionError), cores.between_hands():
        raise ZeroDivisionError
