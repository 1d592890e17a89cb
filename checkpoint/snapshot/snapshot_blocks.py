"""Images at home: which blocks the snapshots of one actor consist of, and that they are safe before anything is cut.

In a store that lasts, changed blocks become a pack (a file of their own) in a thread, while messages go on; only then
is the journal cut. Until then the older snapshot and the whole journal stand, and what is half done does not count.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import msgspec

from ...actors.errors import HoldfastError
from ...actors.events import SnapshotTaken
from ..journal import DamagedStore
from ..protocol import PIECE, Kept, Lent, Marked, Restore, Shared, Snapshot
from .image_parts import digest
from .shared_blocks import BlocksGone, Place, Segment, by_segment, new_number, open_segment
from .snapshot_record import IMAGES, Meta, begin_with_older, keep, made_by, meta_now

if TYPE_CHECKING:
    from ..home.switch import Switch
    from ..inputs import HomeJournal

MOST_GARBAGE: Final = 3
"""How many times the size of an image its packs may take before it is written anew."""


class SnapshotImages:
    """The blocks of one home's snapshots."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._segments: dict[int, Segment] = {}  # what is in memory; a store may have it instead
        self._held: dict[int, set[tuple[int, int]]] = {}  # which blocks of these (offset, length) are really there
        self._value: Segment | None = None  # a copy of a state that was saved as one value, until it is mapped
        self._sizes: dict[int, int] = {}  # of all that the newest snapshot needs
        self._history: list[set[int]] = []  # segments of the snapshots that are kept, newest first
        self._packs: set[int] = set()  # what the store may have
        self._marked: Meta | None = None
        self._saving: asyncio.Task[None] | None = None
        self._is_missed = False  # the last image was gone when it was to be taken

    @property
    def is_saving(self) -> bool:
        """Whether an image is on its way to the store."""
        return self._saving is not None

    def mark(self, record: Marked) -> None:
        """An image of what there is now will come."""
        self._marked = meta_now(self._home, record.turn, [])

    def take(self, record: Snapshot, shared: Shared) -> None:
        """An image is complete: keep it; if that cannot be, what was there before is still there."""
        home = self._home
        try:
            meta = self._open(record, shared)
        except BlocksGone as error:
            # Most likely the life has given it up, for it saves its last state in another way, or has ended.
            if self._is_missed:
                self.refuse(shared, str(error))
            else:
                self._is_missed = True
                self._dismiss(shared)
                home.due.missed()
            return
        except HoldfastError as error:
            self.refuse(shared, str(error))
            return
        if not home.journal.durable:
            self._finish(meta, record, shared, {})
            return
        saving = home.node.loop.create_task(self._save(meta, record, shared), name=f"snapshot of {home.path}")
        self._saving = saving
        home.node.end_after(saving, home.path)

    def _open(self, record: Snapshot, shared: Shared) -> Meta:
        """Have the new blocks here too.

        Raises:
            HoldfastError: they are gone, or those they belong to are.
        """
        marked, self._marked = self._marked, None
        if marked is None or marked.turn != record.turn:
            marked = meta_now(self._home, record.turn, [])
        if self._saving is not None:
            raise HoldfastError("the snapshot before it is still on its way")
        segment = open_segment(shared.number, shared.pid, shared.file, shared.inode)
        newest = self._home.ledger.newest
        known = by_segment(newest.blocks) if newest is not None else {}
        if {number for number, _, _ in shared.places} - {shared.number, *known}:
            segment.close()
            raise HoldfastError("a snapshot refers to blocks that are not here")
        self._segments[shared.number] = segment
        self._held[shared.number] = by_segment(shared.places).get(shared.number, set())
        self._sizes[shared.number] = segment.size
        return msgspec.structs.replace(
            marked,
            format=IMAGES,
            stash=record.stash,
            blocks=shared.places,
            earlier=self.earlier(),
            **made_by(self._home, record),
        )

    async def _save(self, meta: Meta, record: Snapshot, shared: Shared) -> None:
        home, own = self._home, [place for place in meta.blocks if place[0] == shared.number]
        segment, journal, me = self._segments[shared.number], home.journal, asyncio.current_task()
        digests: dict[int, bytes] = {}
        try:
            if own:
                blocks = [(offset, segment.block(offset, length)) for _, offset, length in own]
                try:
                    await asyncio.to_thread(journal.keep_blocks, home.path, shared.number, blocks, home.method.compress)
                finally:  # Not before: whoever removes it while it is written has removed nothing.
                    self._packs.add(shared.number)
            if shared.is_idle:
                digests = await asyncio.to_thread(digests_of, self._in_memory(meta.blocks))
            if self._saving is not me:
                return  # Its pack goes with those that the next snapshot does not need.
            self._saving = None
            if not self._finish(meta, record, shared, digests):
                return  # The one before it stands, and needs its packs.
            # By number: the next snapshot may be on its way before the thread has come to that.
            unneeded = self._packs.difference(meta.earlier, [number for number, _, _ in meta.blocks])
            if unneeded:
                await asyncio.to_thread(journal.forget_blocks, home.path, unneeded)
                self._packs -= unneeded
        except Exception as error:  # Whatever it was: the next snapshot must be possible.
            if self._saving is me:
                self._saving = None
                self.refuse(shared, str(error))

    def _in_memory(self, blocks: list[Place]) -> dict[int, memoryview]:
        """Those blocks that need memory here, by their place among all."""
        return {
            index: self._segments[number].block(offset, length)
            for index, (number, offset, length) in enumerate(blocks)
            if number in self._segments
        }

    def _finish(self, meta: Meta, record: Snapshot, shared: Shared, digests: dict[int, bytes]) -> bool:
        """Whether it is kept now."""
        home = self._home
        try:
            keep(home, meta)
        except HoldfastError as error:
            self.refuse(shared, str(error))
            return False
        size = sum(length for _, _, length in meta.blocks)
        is_full = home.journal.durable and sum(self._sizes.values()) > MOST_GARBAGE * size
        for number in {meta.blocks[index][0] for index in digests}:
            self._let_go(number)
        if home.life.port is not None:
            home.life.port.to_life(Kept(shared.number, True, is_full, digests))
        self._is_missed = False
        home.limit.cut()
        home.due.kept(meta.turn)
        if home.node.events.has_listeners:
            written = sum(length for number, _, length in meta.blocks if number == shared.number)
            home.node.emit(SnapshotTaken(home.path, record.turn, size, record.pause, written))
        return True

    def refuse(self, shared: Shared, why: str) -> None:
        """It could not be kept: what was there before is still there."""
        self._dismiss(shared)
        self._home.due.failed(why)

    def _dismiss(self, shared: Shared) -> None:
        self._let_go(shared.number)
        self._sizes.pop(shared.number, None)
        if self._home.life.port is not None:
            self._home.life.port.to_life(Kept(shared.number, False))

    def earlier(self) -> list[int]:
        """The packs that the older snapshots need."""
        count = self._home.method.keep - 1
        return sorted({number for one in self._history[:count] for number in one})

    def cancel(self) -> None:
        """What is not finished will not count."""
        self._saving, self._is_missed = None, False
        self._marked = None

    def tidy(self) -> None:
        """Give back the memory of blocks that no snapshot needs any more."""
        ledger = self._home.ledger
        newest = ledger.newest.blocks if ledger.newest is not None else []
        self._history = [set(by_segment(newest)), *self._history][: self._home.method.keep]
        wanted = by_segment([*newest, *(ledger.older.blocks if ledger.older is not None else ())])
        self._sizes = {number: size for number, size in self._sizes.items() if number in wanted}
        for number in list(self._segments):
            if number not in wanted:
                self._let_go(number)
            elif not self.is_saving:
                self._segments[number].keep(wanted[number])
                self._held[number] &= wanted[number]

    def _let_go(self, number: int) -> None:
        """Give back the memory of a segment."""
        segment = self._segments.pop(number, None)
        self._held.pop(number, None)
        if segment is not None:
            segment.close()

    def let_go_of_stored(self) -> None:
        """A life elsewhere has its state: what the store has needs no memory here."""
        if not self._home.journal.durable:
            return
        for number in self._packs.intersection(self._segments):
            self._let_go(number)

    @property
    def are_here(self) -> bool:
        """Whether the newest snapshot can be handed to a life without a look into the store."""
        newest = self._home.ledger.newest
        return newest is None or not self._missing(newest.blocks)

    def _missing(self, blocks: list[Place]) -> dict[int, set[tuple[int, int]]]:
        """The segments that lack some of these blocks, with all that they are to have then."""
        held = self._held
        wanted = by_segment(blocks).items()
        return {one: places | held.get(one, set()) for one, places in wanted if not places <= held.get(one, set())}

    async def bring(self) -> None:
        """Have the newest snapshot here, while others go on; if it is damaged, an older one.

        Raises:
            HoldfastError: none can be had.
        """
        home = self._home
        missing = {} if home.ledger.newest is None else self._missing(home.ledger.newest.blocks)
        if not missing:
            return
        reading = asyncio.ensure_future(asyncio.to_thread(read_segments, home.journal, home.path, missing))
        try:
            made = await asyncio.shield(reading)
        except DamagedStore:
            begin_with_older(home)
        except asyncio.CancelledError:
            reading.add_done_callback(_close_read)
            raise
        else:
            if home.cell is None:  # Its address was erased meanwhile.
                _close(made)
                raise HoldfastError(f"{home.path} was erased while its state was read")
            self._take_in(made, missing)

    def _take_in(self, made: dict[int, Segment], held: dict[int, set[tuple[int, int]]]) -> None:
        for number, segment in made.items():
            self._let_go(number)
            self._segments[number], self._held[number] = segment, held[number]
            self._sizes[number] = segment.size

    def _read(self, blocks: list[Place]) -> None:
        """Have these blocks here, now.

        Raises:
            DamagedStore: one of them is missing or damaged.
        """
        missing = self._missing(blocks)
        self._take_in(read_segments(self._home.journal, self._home.path, missing), missing)

    def lend(self, blocks: list[Place]) -> Lent | None:
        """The newest image for a life that maps it; None if that cannot be."""
        self._read(blocks)
        segments = [self._segments[number] for number in by_segment(blocks)]
        try:
            for segment in segments:
                segment.lend()
        except OSError:  # The system is too old for it.
            return None
        return Lent(os.getpid(), [(one.number, one.file, one.inode) for one in segments], blocks)

    def lend_value(self, state: bytes) -> Lent | None:
        """A state that was saved as one value, for a life that maps it; None if that cannot be."""
        self.mapped()
        number, view = new_number(), memoryview(state)
        try:
            segment = Segment.of(number, ((at, view[at : at + PIECE]) for at in range(0, len(state), PIECE)))
            segment.lend()
        except OSError:
            return None
        self._value = segment
        return Lent(os.getpid(), [(number, segment.file, segment.inode)], [(number, 0, len(state))])

    def mapped(self) -> None:
        """A life has mapped what it was lent."""
        value, self._value = self._value, None
        if value is not None:
            value.close()

    def restore(self, blocks: list[Place]) -> Iterator[Restore]:
        """The newest image, in pieces for a life."""
        self._read(blocks)
        batch: list[memoryview] = []
        size = 0
        for number, offset, length in blocks:
            batch.append(self._segments[number].block(offset, length))
            size += length
            if size >= PIECE:
                yield Restore(b"".join(batch))
                batch, size = [], 0
        if batch:
            yield Restore(b"".join(batch))

    def fetch(self, meta: Meta) -> None:
        """Have the blocks of a stored snapshot here.

        Raises:
            DamagedStore: one of them is missing or damaged.
        """
        self._read(meta.blocks)

    def loaded(self, meta: Meta) -> None:
        """The store was read: these are the packs it needs."""
        self._history = [set(by_segment(meta.blocks)), set(meta.earlier)]
        journal, path = self._home.journal, self._home.path
        self._packs = self._history[0] | self._history[1]
        journal.forget_blocks(path, journal.packs(path) - self._packs)

    def close(self) -> None:
        """The home is given up."""
        self.cancel()
        self.mapped()
        for segment in self._segments.values():
            segment.close()
        self._segments.clear()
        self._held.clear()


def read_segments(journal: HomeJournal, path: str, wanted: dict[int, set[tuple[int, int]]]) -> dict[int, Segment]:
    """Read these blocks of an address from the store, and verify them.

    Raises:
        DamagedStore: one of them is missing or damaged.
    """
    made: dict[int, Segment] = {}
    try:
        for number, places in wanted.items():
            made[number] = journal.read_blocks(path, number, places)
    except BaseException:
        _close(made)
        raise
    return made


def digests_of(blocks: dict[int, memoryview]) -> dict[int, bytes]:
    """By which blocks are known that are in memory no more."""
    return {index: digest(block) for index, block in blocks.items()}


def _close(segments: dict[int, Segment]) -> None:
    for segment in segments.values():
        segment.close()


def _close_read(reading: asyncio.Future[dict[int, Segment]]) -> None:
    """Nobody waits any more for what was read."""
    if not reading.cancelled() and reading.exception() is None:
        _close(reading.result())
