"""Messages put aside because they have ended their actor's process again and again (T16).

They are kept here, outside the actor, until somebody has them tried again or dropped; in a store they survive the root.
What is put aside, and the end of its turn, are one append; so are a second try, and the end of the quarantine.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError, NoSuchActor
from ...actors.kernel.cell import ANY
from ...actors.kernel.codec import Parcel
from ..inputs import Batch, Input
from ..protocol import MESSAGE, PIPE, TICK
from ..schema import as_shape, class_of
from ..upgrade.field_tables import as_data
from ..upgrade.old_records import mapper_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ..group_commit import Commits
    from ..journal import Entry
    from .switch import Switch

PLACE = "quarantine"
"""Its address in the store; no actor's, for those begin with a slash."""
MOST_ENTRIES = 200
"""Entries after which what is left is written anew."""


class NotQuarantined(HoldfastError, text="message {id} of {actor} is not in quarantine (any more)"):
    """The message was tried again, dropped or erased meanwhile: ask for the list again."""

    actor: str
    id: int


@dataclasses.dataclass(frozen=True, slots=True)
class QuarantinedMessage:
    """A message that was put aside because handling it has ended its actor's process too often.

    Attributes:
        address: whose message it is.
        message: the message; as it came (type name and encoded body) if its class is not known here; None if it is a
            hook's input (`kind`).
        attempts: how often it has ended the process.
        since: Unix time at which it was put aside.
        sender: the address of who sent it, if an actor has.
        kind: "message", or "tick", "exit", "down", "pipe" for what the runtime itself brought.
        id: its number at the address.
    """

    address: str
    message: Any
    attempts: int
    since: float
    sender: str | None
    kind: str
    id: int


class QuarantineEntry(msgspec.Struct, array_like=True, frozen=True):
    """One of them, as it is kept."""

    address: str
    id: int
    kind: str
    name: str
    body: bytes
    sender: str | None
    origin: str
    attempts: int
    since: float
    shape: tuple[Any, ...] = ()  # the table with which it was written; stores of before do not say


class Quarantine:
    """All that a root has put aside."""

    def __init__(self, node: Node, journal: Commits) -> None:
        self._node, self._journal = node, journal
        self._held: dict[tuple[str, int], QuarantineEntry] = {}
        self._positions: list[int] = []
        saved = journal.load(PLACE)
        if saved.snapshot is not None:
            for one in msgspec.msgpack.decode(saved.snapshot, type=list[QuarantineEntry]):
                self._held[one.address, one.id] = one
        for position, entry in saved.entries:
            self._positions.append(position)
            values: tuple[Any, ...] = entry
            match values:
                case ("held", *fields):
                    one = QuarantineEntry(*fields)
                    self._held[one.address, one.id] = one
                case (_, address, key):
                    self._held.pop((address, key), None)
                case _:
                    raise HoldfastError(f"quarantine: entry {position} is of an unknown kind {entry[0]!r}")
        self._turn = saved.turn

    def hold(self, home: Switch, source: Input, batch: Batch) -> None:
        """Put an input aside; its turn ends in the same append."""
        one = QuarantineEntry(
            home.path, source.id, source.kind, source.name, source.body, source.sender, source.origin,
            source.deliveries, self._node.clock.wall(), as_data(home.shapes.now(source.name) or ()),
        )  # fmt: skip
        self._held[one.address, one.id] = one
        if home.journal.durable:
            batch.add(PLACE, ("held", *msgspec.structs.astuple(one)), self._positions)
            batch.after.append(self._tidy)

    @property
    def count(self) -> int:
        """How many messages it has."""
        return len(self._held)

    def messages(self, address: str | None) -> list[QuarantinedMessage]:
        """What is in quarantine, oldest first: all of it, or what belongs to one address."""
        return [self._shown(one) for one in self._held.values() if address in (None, one.address)]

    def _shown(self, one: QuarantineEntry) -> QuarantinedMessage:
        message: Any = None
        if one.name:
            message = Parcel(one.name, one.body)
            cell = self._node.find(one.address)
            if cell is not None and cell.table is not ANY:
                try:
                    name, body = self._as_now(one, cell)
                    message = self._node.codec.decode(cell.table.kind_named(name), body)
                except (HoldfastError, msgspec.DecodeError):  # The class has changed: it is shown as it came.
                    pass
        return QuarantinedMessage(one.address, message, one.attempts, one.since, one.sender, one.kind, one.id)

    def retry(self, asked: QuarantinedMessage, home: Switch | None) -> None:
        """Have it handled as if it had come now; nobody waits for a reply any more.

        Raises:
            NotQuarantined: it is not here any more. NoSuchActor: nobody was started at its address since the root was.
            NotMapped: an earlier version of the program has recorded it, and its class cannot read it.
        """
        one = self._one(asked)
        if home is None or home.cell is None:
            raise NoSuchActor(one.address)
        name, body = self._as_now(one, home.cell)
        batch = Batch()
        kind = MESSAGE if one.kind == TICK else one.kind  # Its timer goes its own way.
        again = home.record(kind, name, body, one.sender, batch, one.origin if one.kind == PIPE else "")
        self._free(one, home.journal.durable, batch)
        batch.after.append(lambda: home.admitted(again))
        batch.commit(home.journal)

    def drop(self, asked: QuarantinedMessage) -> None:
        """Forget it; it becomes a dead letter.

        Raises:
            NotQuarantined: it is not here any more.
        """
        one = self._one(asked)
        batch = Batch()
        self._free(one, self._journal.durable, batch)
        cell = self._node.cell_at(one.address)
        batch.after.append(lambda: self._node.dead_letter(cell, asked.message, "dropped from quarantine"))
        batch.commit(self._journal)

    def forget(self, address: str) -> None:
        """All that was recorded at an address has been erased."""
        if any(one.address == address for one in self._held.values()):
            self._forget(lambda at: at == address)

    def forget_below(self, top: str, *, dry_run: bool = False) -> int:
        """All that was recorded at an address and below it has been erased; how many messages are gone with that.

        What was put aside there before, and is not any more, leaves the store as well.
        """
        below = f"{top}/"
        count = sum(address == top or address.startswith(below) for address, _ in self._held)
        if not dry_run:
            self._forget(lambda at: at == top or at.startswith(below))
            if self._positions:
                self._tidy(most=0)
        return count

    def _forget(self, is_meant: Callable[[str], bool]) -> None:
        batch = Batch()
        for one in [one for one in self._held.values() if is_meant(one.address)]:
            self._free(one, self._journal.durable, batch)
        batch.commit(self._journal)

    def rename(self, paths: Mapping[str, str]) -> None:
        """What belongs to these addresses belongs to others now.

        Raises:
            HoldfastError: the store refused.
        """
        moved = [one for one in self._held.values() if one.address in paths]
        fresh = [msgspec.structs.replace(one, address=paths[one.address]) for one in moved]
        for one in moved:
            del self._held[one.address, one.id]
        self._held.update({(one.address, one.id): one for one in fresh})
        if moved and self._journal.durable:
            entries: list[Entry] = [("free", one.address, one.id) for one in moved]
            entries += [("held", *msgspec.structs.astuple(one)) for one in fresh]
            self._positions += self._journal.append([(PLACE, entry) for entry in entries])

    def _as_now(self, one: QuarantineEntry, cell: Cell) -> tuple[str, bytes]:
        """Its name and body as its class has them now. Raises NotMapped: it cannot read it."""
        table = as_shape(one.shape) or None
        mapper = mapper_of(one.name, table, class_of(cell), self._node.codec)
        return (one.name, one.body) if mapper is None else (mapper.name, mapper.mapped(one.body))

    def _one(self, asked: QuarantinedMessage) -> QuarantineEntry:
        one = self._held.get((asked.address, asked.id))
        if one is None:
            raise NotQuarantined(asked.address, asked.id)
        return one

    def _free(self, one: QuarantineEntry, durable: bool, batch: Batch) -> None:
        del self._held[one.address, one.id]
        if durable:
            batch.add(PLACE, ("free", one.address, one.id), self._positions)
            batch.after.append(self._tidy)

    def _tidy(self, most: int = MOST_ENTRIES) -> None:
        """Write what is left anew when much has come and gone."""
        if len(self._positions) < most:
            return
        left = msgspec.msgpack.encode(list(self._held.values()))
        try:
            self._journal.barrier()
            self._journal.cut(PLACE, left, self._positions, turn=self._turn + 1, keep=1)
        except HoldfastError:
            return  # It stays as long as it is, and is tried again.
        self._turn += 1
        self._positions.clear()
