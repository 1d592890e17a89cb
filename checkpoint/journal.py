"""The journal protocol: what a store promises the switch, its errors, and the engine that stores nothing."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, TypeAlias

from ..actors.errors import StoreError

if TYPE_CHECKING:
    from .snapshot.shared_blocks import Segment

__all__ = [
    "DamagedStore",
    "Entry",
    "ForeignStore",
    "Journal",
    "MemoryJournal",
    "NotCopied",
    "Primitive",
    "SafeAt",
    "Saved",
    "StaleEpoch",
    "StoreEngine",
    "StoreFailed",
    "StoreFile",
    "StoreInUse",
    "WrongStoreKey",
]

Primitive: TypeAlias = "int | float | str | bytes | bool | tuple[Primitive, ...] | None"
Entry: TypeAlias = "tuple[Primitive, ...]"
"""What the switch writes: a short `str` kind ("in", "out", "got", "end", "note"), then what that kind needs."""


SafeAt: TypeAlias = Literal["append", "sync"]
"""When what was appended outlives the death of the process: at once, or only when a `sync` has come back."""


class StoreInUse(StoreError):
    """A live process has the store open: stop it, or open with `takeover=True`, if it is another one.

    Attributes:
        path: of the store.
        pid: of that process; 0 if it cannot be seen from here.
        owner: what it calls itself, if it is on another machine.
        is_here: whether it is the very process that wants to open it.
    """

    path: str
    pid: int
    owner: str = ""
    is_here: bool = False

    def __str__(self) -> str:
        if self.owner:
            return f"store {self.path} is in use: {self.owner} leads; stop it, or wait for it with standby='warm'"
        if self.is_here:
            return f"store {self.path} is open in this very process: end the system that has it, or use another store"
        if not self.pid:
            return f"store {self.path} is open in a process that cannot be seen from here (another container?): stop it"
        how = "open with takeover=True (holdfast run --takeover), which kills it"
        return f"store {self.path} is open in process {self.pid}: stop it, or {how}"


class DamagedStore(StoreError):
    """The store holds something that cannot be trusted: `address` and `position` say where, when that is known."""

    path: str
    address: str | None
    position: int | None
    reason: str

    def __str__(self) -> str:
        where = f"store {self.path}"
        if self.address is not None:
            where += f", address {self.address}"
        if self.position is not None:
            where += f", position {self.position}"
        remedy = "restore the store from a backup"
        if self.address is not None:
            remedy += ", or erase the address to start it afresh"
        return f"{where} is damaged: {self.reason}; {remedy}"


class StoreFailed(StoreError, text="store {path} failed: {reason}"):
    """The operating system or a lock refused the store: `reason` says whether trying again makes sense."""

    path: str
    reason: str


class StaleEpoch(
    StoreFailed,
    text="store {path} was opened with epoch {epoch} and now has epoch {current}: {reason}, and this one acknowledges "
    "nothing any more; what it had taken in may be handled by the new owner; stop it",
):
    """The store was opened by somebody else since: nothing is acknowledged; stop, for you are no longer its owner.

    To whoever had asked it is what any StoreFailed is: the new owner may have handled the message, or will.
    """

    reason: str = "another opening owns it"
    epoch: int = 0
    current: int = 0


class ForeignStore(
    StoreError, text="store {path} is not opened, and nothing in it was changed: {part}: {problem}; {remedy}"
):
    """The store was not opened, and nothing in it was changed: a part of it is another's, or open to others."""

    path: str
    part: str
    problem: str
    remedy: str


class WrongStoreKey(StoreError, text="store {path} is not opened, and nothing in it was changed: {problem}; {remedy}"):
    """The store was not opened, and nothing in it was changed: its key is another one, is missing, or it has none."""

    path: str
    problem: str
    remedy: str


class NotCopied(StoreError, text="store {path} was not copied to {dest}: {problem}; {remedy}"):
    """A backup or a restore was refused or has failed: nothing of it was left behind, and nothing was overwritten."""

    path: str
    dest: str
    problem: str
    remedy: str


@dataclasses.dataclass(frozen=True, slots=True)
class StoreFile:
    """The database of a store, and the key that it is encrypted with."""

    path: str
    key: bytes | None = dataclasses.field(repr=False)


class Saved(NamedTuple):
    """What a store has of one address.

    Attributes:
        snapshot: the newest trustworthy snapshot, `None` if none was ever made.
        turn: the turn the snapshot was made after; 0 without one.
        entries: (position, entry) of everything the snapshot does not contain, oldest first.
        passed_over: why a newer snapshot was not used; empty when the newest was. Worth an event.
    """

    snapshot: bytes | None
    turn: int
    entries: list[tuple[int, Entry]]
    passed_over: str = ""


class Journal(Protocol):
    """Where a home writes what it must not forget.

    Entries come back exactly as given, in order, or not at all and loudly. Calls that write either happen completely
    or raise and leave the store as it was. `append` may be called on the event loop; `cut`, `load` and `erase` may run
    in worker threads meanwhile, but only one of them per address at a time.

    An engine may have `together()`, which returns a context manager: what is written inside, by the thread that is in
    it, stands in the store completely or not at all. Without it, a root that is killed while a transaction comes into
    force may come back with the new state of one actor and the old state of another.
    """

    durable: bool
    """Whether anything survives this process."""
    epoch: int
    """Rises at each opening of the store."""

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append (address, entry) pairs as one: all or none. Returns their positions, rising ints.

        Raises:
            TypeError: one is no entry. StoreFailed: nothing is written.
        """
        ...

    def sync(self) -> None:
        """Have everything appended so far survive a power loss; called in a worker thread, and `append` goes on.

        A failure is for good (T13): from then on everything is refused.
        """
        ...

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep the snapshot, made after `turn`, then forget the positions it contains (T10: in this order).

        With `keep=2` the one before it is kept too, with `keep=3` two of them, and so on: then `drop` is only marked
        now and physically removed by a later cut of the address, so that the older snapshots stay usable for as long as
        they are kept. With `keep=1` nothing older remains. Positions in `drop` that the address does not have are
        ignored.
        """
        ...

    def load(self, address: str, *, older: int = False) -> Saved:
        """The newest snapshot whose checksum is right, with the entries it does not contain.

        Args:
            address: unknown ones have an empty `Saved`.
            older: pass over so many of the newest snapshots that are kept (but not over the last one there is); then
                all entries since come too. True is one.

        Raises:
            DamagedStore: an entry is damaged or missing, or no snapshot is left whose later entries all exist. A
                damaged first snapshot is not replaced by "no snapshot": it may hold state from before the journal.
        """
        ...

    def erase(self, address: str) -> None:
        """Forget everything about the address; unknown ones are ignored."""
        ...

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Keep blocks of a large snapshot durably, as pack `number`: (offset, bytes). A `cut` will refer to them.

        Raises:
            StoreFailed: nothing is kept.
        """
        ...

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Blocks of a pack at these (offset, length), verified.

        Raises:
            DamagedStore: one of them is missing or damaged.
        """
        ...

    def packs(self, address: str) -> set[int]:
        """Return the numbers of the packs that are kept for the address."""
        ...

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Remove these packs of the address, which no kept snapshot needs; unknown ones are ignored."""
        ...

    def addresses(self) -> list[str]:
        """Every address that has something stored, sorted."""
        ...

    def note(self, key: str, value: bytes | None) -> None:
        """Keep a small named fact, such as a dynamic child; `None` forgets it."""
        ...

    def noted(self, key: str) -> bytes | None:
        """The fact of that name, or `None`."""
        ...

    def notes(self, prefix: str) -> dict[str, bytes]:
        """All facts whose keys begin so, in the order in which they were last written."""
        ...

    def close(self) -> None:
        """Release the store; a second call does nothing. What is closed refuses to write, with a StoreError."""
        ...


class StoreEngine(Journal, Protocol):
    """A journal with what only some engines have, and a default for those that have it not."""

    @property
    def file(self) -> StoreFile | None:
        """The database of the store, if that is one of holdfast's own on the disk."""
        ...

    @property
    def in_hand(self) -> InHand | None:
        """Which inputs are in hand, if the engine keeps that."""
        ...

    @property
    def safe_at(self) -> SafeAt:
        """When what was appended outlives the death of the process."""
        ...

    def synced(self) -> asyncio.Future[None] | None:
        """Done when all that was written so far is as safe as a `sync` makes it; `None`: call that, in a thread."""
        ...

    def has_failed(self) -> bool:
        """Whether the engine refuses for good."""
        ...

    def together(self) -> AbstractContextManager[None]:
        """Have what is written inside stand in the store completely or not at all, if the engine can do that."""
        ...


class InHand(Protocol):
    """Which inputs are in hand, as it outlives the process: what an engine may have as its attribute `in_hand`."""

    def begun(self, address: str) -> int:
        """The input at an address in whose turn the last owner of the store was killed; -1: none. It is said once.

        A turn that waits is not meant if another was at work, or if nothing works for it unseen.
        """
        ...

    def word(self, address: str) -> memoryview:
        """A word of that address, in memory that outlives the process, to be read by `turn_word.py`."""
        ...


class MemoryJournal:
    """The engine behind `durability="memory"`: it hands out positions and writes nothing.

    Within the life of the process the switch holds every unfinished entry and the newest snapshot in structures of its
    own, and nothing is to survive the process: a copy kept here would be read by nobody. So `load` is always empty,
    and an `append` costs an addition. Only notes are kept, since their writers look them up again.
    """

    __slots__ = ("_last", "_notes", "durable", "epoch")
    in_hand = None
    file = None
    safe_at: SafeAt = "append"

    def __init__(self) -> None:
        self.durable = False
        self.epoch = 1  # There is only one opening: what was in memory cannot be opened again.
        self._last = 0
        self._notes: dict[str, bytes] = {}

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Hand out one position for each entry."""
        count = len(entries)
        if count == 1:  # the common case, at half the price of the general one
            self._last = last = self._last + 1
            return [last]
        first = self._last + 1
        self._last += count
        return list(range(first, first + count))

    def has_failed(self) -> bool:
        """Return False: nothing is written that could fail."""
        return False

    def together(self) -> AbstractContextManager[None]:
        """Do nothing: nothing is written."""
        return contextlib.nullcontext()

    def sync(self) -> None:
        """Do nothing, since nothing survives the process."""

    def synced(self) -> None:
        """Return nothing to wait for: `sync` does nothing."""

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Do nothing: the switch keeps the snapshot."""

    def load(self, address: str, *, older: int = False) -> Saved:
        """Return an empty `Saved`, since nothing is stored in memory."""
        return Saved(None, 0, [])

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Do nothing: the switch keeps them."""

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Refuse: nothing is stored in memory."""
        raise DamagedStore("memory", address, None, "nothing is stored in memory")

    def packs(self, address: str) -> set[int]:
        """Return nothing: the process keeps nothing beyond itself."""
        return set()

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Do nothing: the process keeps nothing beyond itself."""

    def erase(self, address: str) -> None:
        """Do nothing: the process keeps nothing beyond itself."""

    def addresses(self) -> list[str]:
        """Return nothing: no address has anything stored."""
        return []

    def note(self, key: str, value: bytes | None) -> None:
        """Keep the fact until the process ends."""
        self._notes.pop(key, None)
        if value is not None:
            self._notes[key] = value

    def noted(self, key: str) -> bytes | None:
        """Return the fact of that name, or `None`."""
        return self._notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """Return the facts whose keys begin so."""
        return {key: value for key, value in self._notes.items() if key.startswith(prefix)}

    def close(self) -> None:
        """Do nothing: the process keeps nothing beyond itself."""
