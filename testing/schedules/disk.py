"""The store of a simulated run: a disk in memory that outlives a killed root, and a power cut as far as it was synced.

What is written is there at once for whoever opens the store next. What was not synced is lost by a power cut, from some
write on: which one is drawn. What is read or written in the loop holds the loop up for drawn seconds; a sync, and what
else has a thread in production, takes drawn seconds beside it.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import random
from array import array
from collections.abc import Callable, Collection, Generator, Sequence
from typing import Any, Final

from ...actors.errors import HoldfastError
from ...checkpoint.engine_calls import Called
from ...checkpoint.group_commit import Commits
from ...checkpoint.journal import DamagedStore, Entry, Saved, StaleEpoch, StoreFailed
from ...checkpoint.snapshot.shared_blocks import Segment
from ...checkpoint.turn_word import WAITS, blamed, is_at_work
from ...cluster.store_contents import Change, MemoryContents
from ..latencies import What
from .choices import LOSS, Choices

PATH: Final = "simulated"
"""The name of the store in errors, and in `simulate(store=...)`."""


class SimulatedDisk:
    """What outlives a root of a simulated run.

    Args:
        takes: is told of what holds the loop up.

    Attributes:
        written: what whoever opens it next finds, unless the power is cut.
        epoch: of the newest opening.
        words: by address: which input is in hand.
    """

    def __init__(self, takes: Callable[[What], None] = lambda what: None) -> None:
        self.takes = takes
        self.written = MemoryContents()
        self.epoch = 0
        self.words: dict[str, array[int]] = {}
        self._synced = MemoryContents()
        self._unsynced: list[list[Change]] = []  # what stands together is lost together

    def open(self) -> SimulatedJournal:
        """The store, opened anew: openings before it may write nothing any more."""
        self.epoch += 1
        return SimulatedJournal(self)

    def write(self, change: str, *args: Any) -> None:
        """Make a change."""
        self.written.make((change, args))
        self._unsynced.append([(change, args)])

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """All changes that are made inside are lost together, and undone if it raises."""
        before, count = copy.deepcopy(self.written), len(self._unsynced)
        try:
            yield
        except BaseException:
            self.written = before
            del self._unsynced[count:]
            raise
        made = self._unsynced[count:]
        self._unsynced[count:] = [[change for changes in made for change in changes]]

    def write_through(self, change: str, *args: Any) -> None:
        """Make a change that no power cut undoes; it must have nothing to do with those that are not synced."""
        for contents in (self.written, self._synced):
            contents.make((change, args))

    def newest(self) -> list[Change] | None:
        """The last write that is not synced: a sync that begins now covers all up to it, and none that comes later."""
        return self._unsynced[-1] if self._unsynced else None

    def sync(self, newest: list[Change] | None) -> None:
        """No power cut undoes what has been written up to this write; if it is synced already, nothing happens."""
        count = next((number for number, made in enumerate(self._unsynced, 1) if made is newest), 0)
        synced, self._unsynced = self._unsynced[:count], self._unsynced[count:]
        for changes in synced:
            for change in changes:
                self._synced.make(change)

    def cut_power(self, choices: Choices) -> None:
        """Lose what was not synced, from some change on, and which inputs are in hand."""
        count = len(self._unsynced)
        lost = choices.draw(LOSS, count + 1, random.Random(f"loss {choices.seed}").randint(0, count)) if count else 0
        del self._unsynced[count - lost :]
        self.sync(self.newest())
        self.written = copy.deepcopy(self._synced)
        self.words = {}


class Hands:
    """Which inputs are in hand, in words that outlive the root."""

    def __init__(self, words: dict[str, array[int]]) -> None:
        one_worked = any(is_at_work(word[0]) for word in words.values())
        self._begun = {address: blamed(word[0], one_works=one_worked) for address, word in words.items()}
        for word in words.values():
            if is_at_work(word[0]):
                word[0] |= WAITS  # At the next death another one was, if this does not live again.
        self._words = words

    def begun(self, address: str) -> int:
        """See `InHand`."""
        return self._begun.pop(address, -1)

    def word(self, address: str) -> memoryview:
        """The word of an address."""
        return memoryview(self._words.setdefault(address, array("Q", [0])))


class SimulatedJournal:
    """One opening of a simulated disk; see `Journal`."""

    durable = True

    def __init__(self, disk: SimulatedDisk) -> None:
        self.epoch, self.in_hand = disk.epoch, Hands(disk.words)
        self.disk = disk
        self._covers: tuple[list[Change] | None] | None = None
        self._is_open = True

    @property
    def _contents(self) -> MemoryContents:
        return self.disk.written

    @property
    def _read(self) -> MemoryContents:
        """What is written, as it is read."""
        self._take("reads")
        return self._contents

    def _write(self, change: str, *args: Any) -> None:
        self._check()
        self._take("writes")
        self.disk.write(change, *args)

    def _take(self, what: What) -> None:
        if self._covers is None:  # Else it is done beside the loop, where it takes its time before.
            self.disk.takes(what)

    def _check(self) -> None:
        if not self._is_open:
            raise StoreFailed(PATH, "it is closed")
        if self.epoch != self.disk.epoch:
            raise StaleEpoch(PATH, epoch=self.epoch, current=self.disk.epoch)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """See `Journal`."""
        self._check()
        for _, entry in entries:
            if not isinstance(entry, tuple) or not entry or not isinstance(entry[0], str):
                raise TypeError(f"{entry!r} is no entry")
            _check_entry(entry)
        first = self._contents.last + 1
        self._write("append", list(entries))
        return list(range(first, first + len(entries)))

    def sync(self) -> None:
        """See `Journal`."""
        self._check()
        self._take("syncs")
        self.disk.sync(self.disk.newest() if self._covers is None else self._covers[0])

    @contextlib.contextmanager
    def covering(self, newest: list[Change] | None) -> Generator[None, None, None]:
        """Have a sync that is made inside cover nothing behind this write."""
        self._covers = (newest,)
        try:
            yield
        finally:
            self._covers = None

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """See `Journal`."""
        dropped = drop if isinstance(drop, range) else frozenset(drop)
        self._write("cut", address, bytes(snapshot), dropped, turn, keep)

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """See `Journal`."""
        self._check()
        with self.disk.together():
            yield

    def load(self, address: str, *, older: int = False) -> Saved:
        """See `Journal`."""
        found, entries = self._read.load(address, int(older))
        return Saved(None, 0, entries) if found is None else Saved(found.data, found.turn, entries)

    def erase(self, address: str) -> None:
        """See `Journal`."""
        self._write("erase", address)

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """See `Journal`."""
        self._check()
        self._take("writes")
        pack = {(offset, len(block)): bytes(block) for offset, block in blocks}
        self.disk.write_through("keep_pack", address, number, pack)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """See `Journal`."""
        pack = self._read.packs.get(address, {}).get(number, {})
        missing = [place for place in places if place not in pack]
        if missing:
            raise DamagedStore(PATH, address, None, f"pack {number} has no block at {missing[0]}")
        return Segment.of(number, [(place[0], pack[place]) for place in places])

    def packs(self, address: str) -> set[int]:
        """Return the packs of an address that the disk has."""
        return set(self._read.packs.get(address, ()))

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """See `Journal`."""
        self._write("forget_packs", address, frozenset(numbers))

    def addresses(self) -> list[str]:
        """See `Journal`."""
        return self._read.addresses()

    def note(self, key: str, value: bytes | None) -> None:
        """See `Journal`."""
        self._write("note", key, None if value is None else bytes(value))

    def noted(self, key: str) -> bytes | None:
        """See `Journal`."""
        return self._read.notes.get(key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """See `Journal`."""
        return self._read.notes_from(prefix)

    def close(self) -> None:
        """See `Journal`. In good order nothing is in hand."""
        if self._is_open and self.epoch == self.disk.epoch:
            self.disk.sync(self.disk.newest())
            self.disk.words = {}
        self._is_open = False


def _check_entry(part: object) -> None:
    if isinstance(part, tuple):
        for one in part:
            _check_entry(one)
    elif part is not None and not isinstance(part, (int, float, str, bytes)):
        raise TypeError(f"an entry cannot hold {part!r}")


class DiskWork:
    """Work for a simulated store, which needs no thread: it begins now, and is done when its seconds are over.

    Attributes:
        takes: what it takes the time of.
    """

    def __init__(self, journal: SimulatedJournal, takes: What, call: Callable[[], Any]) -> None:
        self.takes: What = takes
        self._disk, self._journal, self._call = journal.disk, journal, call
        self._newest = journal.disk.newest()

    def __call__(self) -> Any:
        """Do it: a sync covers what had been written when it began."""
        with self._journal.covering(self._newest):
            return self._call()


WORK: Final[dict[str, What]] = {
    "sync": "syncs",
    "keep_blocks": "writes",
    "forget_blocks": "writes",
    "read_segments": "reads",
}
"""What the functions do that are called beside the loop."""


def simulated(call: Callable[..., Any], args: tuple[Any, ...]) -> DiskWork | None:
    """The work that this call is, if it is one for a simulated store."""
    is_partial = isinstance(call, functools.partial) and call.args  # of `asyncio.to_thread`
    function, *given = call.args if is_partial else (call, *args)  # type: ignore[attr-defined]  # a partial has them
    takes = WORK.get(getattr(function, "__name__", ""))
    if takes is None:
        return None
    journal = _journal_of(getattr(function, "__self__", None) or next(iter(given), None))
    return None if journal is None else DiskWork(journal, takes, functools.partial(call, *args))


def _journal_of(owner: object) -> SimulatedJournal | None:
    """The simulated store in which this writes, if there is one."""
    engine = owner.engine if isinstance(owner, Commits) else owner
    journal = engine._engine if isinstance(engine, Called) else engine
    return journal if isinstance(journal, SimulatedJournal) else None


class NoRootToKill(HoldfastError, text="the root cannot be killed: {why}"):
    """`crash_root` was called where it cannot do what it says."""

    why: str
