"""The actor behind a registry: it knows the holders of keys and the waiters for locks.

It runs no code of its users: what they decide with functions is decided in the caller (`registry.py`). A key comes as
its bytes, so that 1, 1.0 and True are three keys, the same from every process.

The book belongs to the address, not to a life there: a registry that is restarted goes on with it, without those who
have ended meanwhile.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import deque
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from ...actors.errors import ActorStopped, BadMessage, HoldfastError
from ...actors.events import StoreRefused
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.envelope import Ask, ReplyHandle, refuse
from ...actors.kernel.links import Monitor
from ...actors.kernel.message import Message, Refusal, RuntimeCall
from ...actors.kernel.ref import ActorRef
from ...actors.persistence import ENTRIES, entries_key
from ...actors.process.wire.peer import OutsideHost

Keys = Literal["unique", "duplicate"]


class KeyTaken(Refusal, text="{holder.path} holds this key: take another one, or wait for its end"):
    """A living actor holds this unique key. `Registry` says it as `AlreadyRegistered`, which names the key."""

    holder: ActorRef[Any]


class NotAnActor(Refusal, text="only an actor can hold a key, for its end frees it: call this from a handler"):
    """Only an actor can hold a key, for it is freed with its holder's end: call this from a handler."""


class NotUnique(
    Refusal,
    text="{order} is for unique keys, and this registry may have many entries for one: nobody knows which is meant",
):
    """The registry allows many entries for one key: `order` would not know which is meant."""

    order: str


class RegistryRow(msgspec.Struct, frozen=True, array_like=True):
    """An entry as it travels."""

    number: int
    key: bytes
    holder: ActorRef[Any]
    value: Any


class Register(RuntimeCall[None]):
    """Hold a key. `life` is the sender's, 0 if it is recorded (its replay must send the same)."""

    key: bytes
    value: Any
    life: int


class Find(RuntimeCall[list[RegistryRow]]):
    """The entries of a key, of a holder, of both, or all."""

    key: bytes | None = None
    holder: ActorRef[Any] | None = None


class Count(Message[int]):
    """How many entries there are."""


class DropEntries(RuntimeCall[int]):
    """Give up the sender's entries for a key: those numbered, or all. The reply is how many these were."""

    key: bytes
    numbers: list[int] | None = None


class ReplaceValue(RuntimeCall[bool]):
    """Put another value into an entry of the sender's; False if it is gone."""

    key: bytes
    number: int
    value: Any


class Lock(RuntimeCall[None]):
    """Have a key's lock; the reply is that it is had."""

    key: bytes
    ticket: str
    life: int


class Unlock(RuntimeCall[None]):
    """Give a lock back, or up."""

    key: bytes
    ticket: str


class PutMeta(RuntimeCall[None]):
    """Keep a value that belongs to the registry itself."""

    name: str
    value: Any


class GetMeta(RuntimeCall[list[Any]]):
    """Such a value: a list of one, or an empty one."""

    name: str


class DeleteMeta(RuntimeCall[None]):
    """Forgets a value that belongs to the registry as a whole."""

    name: str


class Returned(Message[None]):
    """Somebody lives again at the address of a recorded holder that had ended."""

    holder: str


class KeyRegistered(Message[None]):
    """To listeners: `holder` holds `key` from now on."""

    registry: ActorRef[Any]
    key: Any
    holder: ActorRef[Any]
    value: Any


class KeyFreed(Message[None]):
    """To listeners: `holder` holds `key` no more; `ended`: because its life is over."""

    registry: ActorRef[Any]
    key: Any
    holder: ActorRef[Any]
    ended: bool


class KeptKey(msgspec.Struct, frozen=True, array_like=True):
    """An entry of a recorded actor as it is kept."""

    key: bytes
    value: Any


@dataclasses.dataclass(slots=True, eq=False)
class HeldKey:
    """One key, held by one life of an actor."""

    number: int
    key: bytes
    holder: Cell
    life: int
    value: Any

    def row(self) -> RegistryRow:
        """Make the row in which the entry travels."""
        return RegistryRow(self.number, self.key, self.holder.ref, self.value)


@dataclasses.dataclass(slots=True, eq=False)
class Claim:
    """Somebody who has a lock, or waits for it."""

    key: bytes
    ticket: str
    holder: Cell | None  # None: not an actor, so only it can give the lock back
    life: int
    turn: int  # the input in whose turn a recorded actor has asked for it; -1: in none, as a hook does
    handle: ReplyHandle[Any]


@dataclasses.dataclass(slots=True, eq=False)
class Holdings:
    """What one actor holds, in the order in which it came to it."""

    monitor: Monitor
    entries: dict[HeldKey, None] = dataclasses.field(default_factory=dict[HeldKey, None])
    claims: dict[Claim, None] = dataclasses.field(default_factory=dict[Claim, None])


@dataclasses.dataclass(slots=True, eq=False)
class Book:
    """All that a registry knows."""

    meta: dict[str, Any]
    number: int = 0
    keys: dict[bytes, dict[HeldKey, None]] = dataclasses.field(default_factory=dict[bytes, dict[HeldKey, None]])
    locks: dict[bytes, deque[Claim]] = dataclasses.field(default_factory=dict[bytes, deque[Claim]])
    holders: dict[Cell, Holdings] = dataclasses.field(default_factory=dict[Cell, Holdings])

    def given_up(self, error: ActorStopped) -> None:
        """Nobody gets a lock here any more."""
        for waiting in self.locks.values():
            for claim in waiting:
                claim.handle.fail(error)


class RegistryActor(Actor):
    """Keeps the book of one registry. Started by `registry(...)`, used through `Registry(ref)`."""

    deterministic = False
    _is_asked_again = True
    _keeps_promises = True

    def __init__(self, keys: Keys, listeners: tuple[str, ...], meta: dict[str, Any]) -> None:
        self._is_unique = keys == "unique"
        self._listeners = listeners
        self._first_meta = meta

    def on_start(self, restored: bool) -> None:
        """Go on with the book that earlier lives at this address have kept, without those who are dead by now."""
        cell = self.ctx._cell
        book = cell.node.kept.get(cell)
        if not isinstance(book, Book):
            book = cell.node.kept[cell] = Book(dict(self._first_meta))
        self._book = book
        self._awaited: set[str] = set()
        for holder, holdings in list(book.holders.items()):
            holdings.monitor.cancel()
            holdings.monitor = self.ctx.monitor(holder.ref)
            self._drop_dead(holder)
        for key in cell.node.ports.keeper.notes(ENTRIES):
            path, _, registry = key.removeprefix(ENTRIES).partition("\n")
            if registry == cell.path:
                self._take_back(path)

    # -- who holds what ---------------------------------------------------------------------------------------------

    @on(Register)
    def _register(self, message: Register) -> ReplyHandle[Any] | None:
        """A unique key has one living holder; a recorded one has one entry for a key, and may say it again."""
        holder = self._sender()
        if not is_living(holder, message.life):
            return None  # Its ask has outlived it.
        try:
            key_of(message.key)
        except msgspec.DecodeError as error:
            return refuse(self.ctx, BadMessage(self.ctx.path, "Register", f"Expected a packed key - at `key`: {error}"))
        holdings = self._book.holders.get(holder)
        for entry in () if holdings is None else holdings.entries:
            if entry.key == message.key and 0 in (entry.life, message.life):
                entry.life, entry.value = message.life, message.value
                self._note(holder)
                return None
        if (other := self._in_the_way(message.key)) is not None:
            raise KeyTaken(other.holder.ref)
        self._enter(message.key, holder, message.life, message.value)
        if message.life == 0:
            self._note(holder)
        return None

    def _in_the_way(self, key: bytes) -> HeldKey | None:
        """The entry of a living actor that has this key, if only one may have it."""
        for entry in list(self._book.keys.get(key, ())) if self._is_unique else ():
            if is_living(entry.holder, entry.life):
                return entry
            self._remove(entry, ended=True)  # Its DOWN is still on the way.
        return None

    def _enter(self, key: bytes, holder: Cell, life: int, value: Any) -> None:
        self._book.number += 1
        entry = HeldKey(self._book.number, key, holder, life, value)
        self._book.keys.setdefault(key, {})[entry] = None
        self._holdings(holder).entries[entry] = None
        self._tell_listeners(KeyRegistered(self.ctx.ref, key_of(key), holder.ref, value))

    # -- recorded holders -------------------------------------------------------------------------------------------

    def _note(self, holder: Cell) -> None:
        """Keep what a recorded actor holds: it is its own, as its state is, until it gives it up or is erased."""
        node, holdings = self.ctx._cell.node, self._book.holders.get(holder)
        if not node.ports.keeper.has_recorded(holder.path):
            return  # It is of another system, or a replica.
        entries = () if holdings is None else holdings.entries
        kept = [KeptKey(entry.key, entry.value) for entry in entries if entry.life == 0]
        try:
            body = node.codec.encode(kept, self.ctx.path) if kept else None
            node.ports.keeper.note(entries_key(holder.path, self.ctx.path), body)
        except HoldfastError as error:
            node.emit(StoreRefused(self.ctx.path, f"what {holder.path} holds is not kept: {error}"))

    def _await(self, path: str) -> None:
        """Have the entries of a recorded actor again as soon as somebody lives at its address."""
        if path not in self._awaited:
            self._awaited.add(path)
            own = self.ctx._cell
            own.node.awaited.setdefault(path, []).append(functools.partial(_tell_soon, own, Returned(path)))

    @on(Returned)
    def _returned(self, message: Returned) -> None:
        """Whoever is there has what was kept for the address, unless that was erased."""
        self._awaited.discard(message.holder)
        self._take_back(message.holder)

    def _take_back(self, path: str) -> None:
        node = self.ctx._cell.node
        body = node.ports.keeper.noted(entries_key(path, self.ctx.path))
        if body is None:
            return
        holder = node.find(path)
        if holder is None or holder.has_nobody:
            self._await(path)
            return
        holdings = self._book.holders.get(holder)
        held = set() if holdings is None else {entry.key for entry in holdings.entries}
        for kept in node.codec.decode(list[KeptKey], body):
            if kept.key not in held and self._in_the_way(kept.key) is None:
                self._enter(kept.key, holder, 0, kept.value)

    # -- reading ----------------------------------------------------------------------------------------------------

    @on(Find, readonly=True)
    def _find(self, message: Find) -> list[RegistryRow]:
        """Entries in the order in which they came, without those of the dead."""
        book = self._book
        if message.holder is not None:
            holdings = book.holders.get(message.holder._cell)
            found = [] if holdings is None else list(holdings.entries)
            if message.key is not None:
                found = [entry for entry in found if entry.key == message.key]
        elif message.key is not None:
            found = list(book.keys.get(message.key, ()))
        else:
            found = [entry for entries in book.keys.values() for entry in entries]
        return [entry.row() for entry in found if is_living(entry.holder, entry.life)]

    @on(Count, readonly=True)
    def _count(self, message: Count) -> int:
        """All entries of the living."""
        return sum(is_living(entry.holder, entry.life) for entries in self._book.keys.values() for entry in entries)

    @on(DropEntries)
    def _drop(self, message: DropEntries) -> int:
        """Only one's own; what is not there is no error."""
        holdings = self._book.holders.get(self._sender())
        mine = [entry for entry in (holdings.entries if holdings is not None else ()) if entry.key == message.key]
        if message.numbers is not None:
            mine = [entry for entry in mine if entry.number in message.numbers]
        for entry in mine:
            self._remove(entry, ended=False)
        return len(mine)

    @on(ReplaceValue)
    def _replace(self, message: ReplaceValue) -> bool:
        """Put another value into an entry, if it is the sender's own."""
        if not self._is_unique:
            raise NotUnique("update_value")
        holder = self._sender()
        for entry in self._book.keys.get(message.key, ()):
            if entry.number == message.number and entry.holder is holder:
                entry.value = message.value
                if entry.life == 0:
                    self._note(holder)
                return True
        return False

    def _remove(self, entry: HeldKey, *, ended: bool) -> None:
        entries = self._book.keys[entry.key]
        del entries[entry]
        if not entries:
            del self._book.keys[entry.key]
        del self._book.holders[entry.holder].entries[entry]
        if entry.life == 0 and not ended:
            self._note(entry.holder)
        self._let_go(entry.holder)
        self._tell_listeners(KeyFreed(self.ctx.ref, key_of(entry.key), entry.holder.ref, ended))

    # -- locks ------------------------------------------------------------------------------------------------------

    @on(Lock)
    def _lock(self, message: Lock) -> ReplyHandle[Any] | None:
        """Queue for the lock of a key; whoever has asked first gets it."""
        item = self.ctx._item
        handle = self.ctx.reply_handle()
        sender, chain = (item.sender, item.chain) if isinstance(item, Ask) else (None, ())
        if sender is not None and not is_living(sender, message.life):
            return None
        turn = chain[0][1] if chain else -1
        claim = Claim(message.key, message.ticket, sender, message.life, turn, handle)
        waiting = self._book.locks.setdefault(message.key, deque())
        waiting.append(claim)
        if sender is not None:
            self._holdings(sender).claims[claim] = None
        if waiting[0] is claim:
            handle.reply(None)
        return handle

    @on(Unlock)
    def _unlock(self, message: Unlock) -> None:
        """The ticket says whose: a claim that is no longer wanted is given up in the same way."""
        for claim in self._book.locks.get(message.key, ()):
            if claim.ticket == message.ticket:
                self._give_up(claim)
                return

    def _give_up(self, claim: Claim) -> None:
        waiting = self._book.locks[claim.key]
        had_it = waiting[0] is claim
        waiting.remove(claim)
        if claim.holder is not None:
            del self._book.holders[claim.holder].claims[claim]
            self._let_go(claim.holder)
        if not waiting:
            del self._book.locks[claim.key]
        elif had_it:
            waiting[0].handle.reply(None)  # If it does not wait any more, its `Unlock` or DOWN is on the way.

    # -- metadata ---------------------------------------------------------------------------------------------------

    @on(PutMeta)
    def _put_meta(self, message: PutMeta) -> None:
        """Any value under a name."""
        self._book.meta[message.name] = message.value

    @on(GetMeta, readonly=True)
    def _get_meta(self, message: GetMeta) -> list[Any]:
        """None is a value too."""
        meta = self._book.meta
        return [meta[message.name]] if message.name in meta else []

    @on(DeleteMeta)
    def _delete_meta(self, message: DeleteMeta) -> None:
        """What is not there is no error."""
        self._book.meta.pop(message.name, None)

    # -- ends -------------------------------------------------------------------------------------------------------

    def on_down(self, source: ActorRef[Any], reason: ExitReason, recovering: bool) -> None:
        """Let go what a holder held whose life is over, unless it is brought back with its state.

        A lock belongs to a turn: if the next life does not go on with that, nobody would give it back.
        """
        holder: Cell = source._cell
        if not recovering:
            self._drop_dead(holder, told=True)
            self._take_back(source.path)
        elif not isinstance(holder.host, OutsideHost):
            self._drop_claims(holder, lambda claim: not holder.host.home.goes_on_with(claim.turn))

    def _drop_dead(self, holder: Cell, *, told: bool = False) -> None:
        """Free what the ended lives of an actor held; if it was `told`, a stand-in has ended whatever it looks like."""
        sure = told and isinstance(holder.host, OutsideHost)
        holdings = self._book.holders.get(holder)
        if holdings is None:
            return
        for entry in list(holdings.entries):
            if sure or not is_living(holder, entry.life):
                self._remove(entry, ended=True)
        self._drop_claims(holder, lambda claim: sure or not is_living(holder, claim.life))

    def _drop_claims(self, holder: Cell, is_over: Callable[[Claim], bool]) -> None:
        """Have an actor give up locks that it has, and no more wait for others."""
        holdings = self._book.holders.get(holder)
        if holdings is None:
            return
        for claim in list(holdings.claims):
            if claim in holdings.claims and is_over(claim):
                self._give_up(claim)

    def _sender(self) -> Cell:
        """Whoever asks, if it is an actor."""
        sender = self.ctx.sender
        if sender is None:
            raise NotAnActor
        cell: Cell = sender._cell
        return cell

    def _holdings(self, holder: Cell) -> Holdings:
        holdings = self._book.holders.get(holder)
        if holdings is None:
            holdings = self._book.holders[holder] = Holdings(self.ctx.monitor(holder.ref))
        return holdings

    def _let_go(self, holder: Cell) -> None:
        """Who holds nothing need not be monitored."""
        holdings = self._book.holders[holder]
        if not holdings.entries and not holdings.claims:
            del self._book.holders[holder]
            holdings.monitor.cancel()

    def _tell_listeners(self, message: Message[Any]) -> None:
        node = self.ctx._cell.node
        for name in self._listeners:
            cell = node.find(name) if name.startswith("/") else node.names.get(name)
            if cell is None:
                continue  # Nobody listens at the moment.
            try:
                cell.ref.tell(message)
            except HoldfastError as error:  # One's trouble is not the registry's.
                node.dead_letter(cell, message, str(error))


def _tell_soon(registry: Cell, message: Returned) -> None:
    node = registry.node  # In nobody's turn; and whoever comes there is not started yet.
    node.loop.call_soon(_tell, registry, message, context=node.base_context.copy())


def _tell(registry: Cell, message: Returned) -> None:
    if not registry.is_dead:  # Else the next one at its address looks for itself.
        registry.ref.tell(message)


def is_living(holder: Cell, life: int) -> bool:
    """Whether that life of an actor goes on; a recorded one (life 0) also while it is brought back."""
    if life == 0:
        return not holder.has_nobody
    # A stand-in in another process counts no lives: there it takes the DOWN to know.
    return holder.state not in (DOWN, GONE) and holder.life in (0, life)


def key_of(packed: bytes) -> Any:
    """The key again: lists can only have been tuples."""
    return _hashable(msgspec.msgpack.decode(packed))


def _hashable(value: Any) -> Any:
    return tuple(map(_hashable, value)) if isinstance(value, list) else value
