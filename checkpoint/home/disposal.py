"""Ends inputs that nobody will handle, and homes that are given up; erases what was recorded, step by step.

The store has a note of each erasure from before its first step to behind its last one: one that was cut off is gone on
with by the next root. Nobody begins a life at an address meanwhile that is being erased; whoever is to waits.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from itertools import islice
from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import ActorStopped, AskFailed, HoldfastError, Quarantined
from ...actors.events import MessageQuarantined, StoreRefused
from ...actors.kernel.codec import Parcel
from ...actors.persistence import CHILDREN
from ..addresses import is_at
from ..group_commit import Unkept
from ..inputs import Batch, Input
from ..protocol import DROPPED, MESSAGE, START, TICK, Answer
from .pending_asks import SwitchAsk

if TYPE_CHECKING:
    from .homes import Homes
    from .switch import Switch

ERASING = "erasing"
"""How the facts begin that name an address whose tree is being erased; before that name stands a space."""
EVERYTHING = b"everything"
"""The value of such a fact if also that is forgotten which others have noted of these addresses."""
AT_ONCE = 8
"""Addresses that are erased in one step: about 2 ms of the loop's time."""


def end_begun(home: Switch, source: Input, error: HoldfastError, batch: Batch) -> None:
    """End the turn that was in hand when the life ended: it is not gone on with.

    It uses up its number: what that turn has sent, and asks it has out, are not another's. What was looked at beside
    another turn has none, and that turn goes on.
    """
    if home.ledger.released and source.id != home.ledger.begun:
        home.end_without_turn(source, _failure(home, error), batch)
        return
    home.end_turn(source, home.ledger.turn + 1, DROPPED, batch)
    home.give(source, _failure(home, error), batch)


def put_into_quarantine(home: Switch, source: Input) -> None:
    """Put an input aside that has ended its actor's process again and again."""
    home.node.emit(MessageQuarantined(home.path, source.name, source.deliveries))
    batch, error = Batch(), Quarantined(home.path, source.deliveries)
    home.homes.quarantine.hold(home, source, batch)
    end_begun(home, source, error, batch)
    batch.commit(home.journal)


def undo_begun(home: Switch, why: str) -> None:
    """Undo the turn in hand, whose first state is gone: if it has let something out, it ends with that."""
    source = home.ledger.undo_begun()
    if source is None:
        return
    if source.kind == MESSAGE and source.ask is None:
        lose(home, source, why)
    batch = Batch()
    end_begun(home, source, AskFailed(home.path, why), batch)
    batch.commit(home.journal)


def drop_all(
    home: Switch, why: str, *, keep_tells: bool = False, keep_asks: bool = False, keep_ticks: bool = True
) -> None:
    """End what waits where nobody lives any more: whoever waits for it is told, the rest goes to dead letters.

    What has begun, and what is to be answered later, fails otherwise than what has surely not.

    `keep_tells`: it is the actor's supervisor that has ended. Both may be started again, so what nobody waits for
    stays for the next life.
    `keep_asks`: that will be. What turns of recorded actors ask stays as well: they wait for it, or their next lives
    do. A turn in hand that waits for such an answer stays too; whoever asked for it from outside is told now.
    `keep_ticks`: what timers have brought stays as well, as the timers do that run: the address is not erased.
    """
    batch, stopped, ledger = Batch(), ActorStopped(home.path, why), home.ledger
    reason = None if home.cell is None else home.cell.extra().reason
    ended = AskFailed(home.path, why if reason is None else str(reason))
    home.life.abandon()
    home.timers.pause()
    if home.intake.bound is not None:
        home.intake.bound.release(stopped, keep_asks=keep_asks)
    lasts = ledger.waits.lasts or (keep_asks and home.calls.waits_for_answer)
    for source in list(ledger.open.values()):
        if source.kind == START or (keep_tells and source.ask is None) or (keep_ticks and source.kind == TICK):
            continue
        if home.homes.far.goes_on(source.ask):
            continue
        if keep_asks and isinstance(source.ask, SwitchAsk):
            source.ask.strand()  # Also if it is the turn in hand: the next life goes on with that.
            continue
        if source.ask is None and source.kind == MESSAGE:
            lose(home, source, why)
        if source.id == ledger.begun and ledger.released and lasts and keep_tells:
            ask, source.ask = source.ask, None  # It goes on in the next life: what it has done is not left half done.
            if ask is not None:
                ask.fail(ended)
        elif source.id == ledger.begun and ledger.released:
            end_begun(home, source, ended, batch)
        else:
            home.end_without_turn(source, _failure(home, ended if source.was_cut else stopped), batch)
    batch.commit(home.journal)
    home.calls.renounce(ended, keep_asks=keep_asks)
    home.limit.wake()
    home.due.abandon(why)


def forget_home(home: Switch, why: str) -> None:
    """Forget all that was recorded, which is gone from the store: nothing is written for it any more."""
    home.journal = Unkept(home.journal.commits)
    home.calls.abandon()
    drop_all(home, why, keep_ticks=False)
    home.timers.replace({})
    home.ties.replace([])
    home.images.close()
    if home.intake.between is not None:
        home.intake.between.over()
    home.cell = home.intake.between = None


def lose(home: Switch, message: Input | Parcel, why: str) -> None:
    """Make a dead letter of a message that will not be handled, and that nobody waits for."""
    cell = home.cell
    if cell is None:
        return
    try:
        decoded = cell.node.codec.decode(cell.table.kind_named(message.name), message.body)
    except (HoldfastError, msgspec.DecodeError):
        cell.node.dead_letter(cell, Parcel(message.name, message.body), why)
    else:
        cell.undelivered(decoded, why)


def _failure(home: Switch, error: HoldfastError) -> Answer:
    return Answer(*home.node.codec.encode_error(error))


@dataclasses.dataclass(frozen=True, slots=True)
class Erased:
    """What `erase` has forgotten, or would forget.

    Attributes:
        address: at and below which it was.
        addresses: how many addresses had something recorded: states, inputs, timers, asks that were not answered.
        children: how many notes of children that a supervisor would bring back.
        put_aside: how many messages in quarantine.
        events: how many past events of the history.
        others: how many other notes: of mechanisms, specifications, moves, and group snapshots with one of them.
    """

    address: str
    addresses: int = 0
    children: int = 0
    put_aside: int = 0
    events: int = 0
    others: int = 0


class Erasure:
    """One of them.

    Attributes:
        top: at and below which all is forgotten.
        everything: whether that is also what others have noted of these addresses.
        done: ends with what was forgotten, or with why the store has refused.
    """

    def __init__(self, top: str, *, everything: bool, done: asyncio.Future[Erased]) -> None:
        self.top, self.everything, self.done = top, everything, done
        self.addresses = self.children = self.put_aside = 0

    def concerns(self, path: str) -> bool:
        """Whether a life at this address would have to do with what is erased."""
        return is_at(path, self.top) or is_at(self.top, path)


class Erasures:
    """The erasures of a root that are under way, or that its store has refused.

    Attributes:
        history: forgets, or only counts, the past events of an address and those below it; None: there are none.
        notes: forget what others have noted of an address and those below it, each; how many notes that were.
    """

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        self._under_way: dict[str, Erasure] = {}
        self._refused: dict[str, bool] = {}
        self._next: asyncio.Handle | None = None
        self.history: Callable[[str, bool], int] | None = None
        self.notes: list[Callable[[str, bool], int]] = [homes.groups.forget_below, homes.addresses.forget]
        for key, value in homes.journal.notes(ERASING).items():  # This process's predecessor died in the middle of it.
            top = value.decode() if key == ERASING else key.removeprefix(f"{ERASING} ")
            self._begin(top, everything=key != ERASING and value == EVERYTHING)

    def erase(self, top: str, *, everything: bool = False) -> asyncio.Future[Erased]:
        """Begin to forget what was recorded at and below an address, where nobody lives, and do the first step.

        Raises:
            HoldfastError: the store refused, and all is as it was.
        """
        found = self._under_way.get(top)
        if found is None or (everything and not found.everything):
            everything = everything or self._refused.get(top, False)
            self._homes.journal.note(f"{ERASING} {top}", EVERYTHING if everything else b"")
            if found is not None:
                found.everything = True
        if found is None:
            found = self._begin(top, everything=everything)
            self._step(found)
        return found.done

    def at(self, path: str) -> asyncio.Future[Erased] | None:
        """The erasure that has to be over before a life may begin at this address; None: there is none.

        One that the store has refused is tried again.

        Raises:
            HoldfastError: the store refuses it once more.
        """
        for one in self._under_way.values():
            if one.concerns(path):
                return one.done
        for top in self._refused:
            if is_at(path, top) or is_at(top, path):
                return self.erase(top)
        return None

    def covers(self, path: str) -> bool:
        """Whether a life at this address would have to wait."""
        return any(is_at(path, top) for top in (*self._under_way, *self._refused))

    def counted(self, top: str) -> Erased:
        """What an erasure would forget."""
        homes = self._homes
        return Erased(
            top,
            sum(homes.knows(path) for path in homes.tree_of(top)),
            sum(map(_is_child, homes.child_notes(top))),
            homes.quarantine.forget_below(top, dry_run=True),
            self.history(top, True) if self.history is not None else 0,
            sum(forget(top, True) for forget in self.notes),
        )

    def close(self) -> None:
        """The root ends: what is left is erased by the next one."""
        if self._next is not None:
            self._next.cancel()
        for one in self._under_way.values():
            one.done.cancel()
        self._under_way.clear()

    # -- step by step -------------------------------------------------------------------------------------------------

    def _begin(self, top: str, *, everything: bool) -> Erasure:
        loop = self._homes.node.loop
        one = Erasure(top, everything=everything, done=loop.create_future())
        one.done.add_done_callback(_looked_at)
        self._refused.pop(top, None)
        self._under_way[top] = one
        self._go_on()
        return one

    def _go_on(self) -> None:
        """In nobody's name: whoever has called for it may be an actor in its turn."""
        if self._next is None and self._under_way:
            node = self._homes.node
            self._next = node.loop.call_soon(self._steps, context=node.base_context.copy())

    def _steps(self) -> None:
        self._next = None
        for one in list(self._under_way.values())[:1]:
            try:
                self._step(one)
            except HoldfastError as error:
                self._homes.node.emit(StoreRefused(one.top, f"what was recorded there is not erased: {error}"))
        self._go_on()

    def _step(self, one: Erasure) -> None:
        """Forget a few more addresses, or the rest."""
        if one.done.done():
            return
        homes = self._homes
        try:
            known = list(islice(homes.tree_of(one.top), AT_ONCE))
            for path in known:
                one.addresses += homes.forget(path)
            noted = list(islice(homes.child_notes(one.top), AT_ONCE - len(known)))
            for path in noted:
                homes.note(f"{CHILDREN}{path}", None)
                one.children += _is_child(path)
            if len(known) + len(noted) < AT_ONCE:
                self._finish(one)
        except HoldfastError as error:
            del self._under_way[one.top]
            self._refused[one.top] = one.everything
            one.done.set_exception(error)
            raise

    def _finish(self, one: Erasure) -> None:
        top, homes, events, others = one.top, self._homes, 0, 0
        homes.forget(top)  # Its store may have parts of a snapshot that was never finished.
        put_aside = homes.quarantine.forget_below(top)
        if one.everything:
            homes.far.forget_gone()
            others = sum(forget(top, False) for forget in self.notes)
            events = self.history(top, False) if self.history is not None else 0
        homes.journal.note(f"{ERASING} {top}", None)
        if homes.journal.noted(ERASING) is not None:
            homes.journal.note(ERASING, None)
        del self._under_way[top]
        one.done.set_result(Erased(top, one.addresses, one.children, put_aside, events, others))


def _is_child(noted: str) -> bool:
    """Whether it is a child that is noted so, and not what its supervisor was given."""
    return not noted.endswith("/")


def _looked_at(done: asyncio.Future[Erased]) -> None:
    """Nobody may be left who waits for it."""
    if not done.cancelled():
        done.exception()
