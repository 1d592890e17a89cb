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
from ..protocol import PIECE, Kept, Lent, Marked, Restore, Shared, Snapshot
from .shared_blocks import Place, Segment, by_segment, open_segment
from .snapshot_record import IMAGES, Meta, keep, made_by, meta_now

if TYPE_CHECKING:
    from ..home.switch import Switch

MOST_GARBAGE: Final = 3
"""How many times the size of an image its packs may take before it is written anew."""


class SnapshotImages:
    """The blocks of one home's snapshots."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._segments: dict[int, Segment] = {}
        self._history: list[set[int]] = []  # segments of the snapshots that are kept, newest first
        self._packs: set[int] = set()  # what the store may have
        self._marked: Meta | None = None
        self._saving: asyncio.Task[None] | None = None

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
        except HoldfastError as error:
            self.refuse(shared, str(error))
            return
        if not home.journal.durable:
            self._finish(meta, record, shared)
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
        if {number for number, _, _ in shared.places} - {shared.number, *self._segments}:
            segment.close()
            raise HoldfastError("a snapshot refers to blocks that are not here")
        self._segments[shared.number] = segment
        return msgspec.structs.replace(
            marked,
            format=IMAGES,
            stash=record.stash,
            traps=record.traps,
            blocks=shared.places,
            earlier=self.earlier(),
            **made_by(self._home, record),
        )

    async def _save(self, meta: Meta, record: Snapshot, shared: Shared) -> None:
        home, own = self._home, [place for place in meta.blocks if place[0] == shared.number]
        segment, journal, me = self._segments[shared.number], home.journal, asyncio.current_task()
        try:
            if own:
                blocks = [(offset, segment.block(offset, length)) for _, offset, length in own]
                try:
                    await asyncio.to_thread(journal.keep_blocks, home.path, shared.number, blocks, home.method.compress)
                finally:  # Not before: whoever removes it while it is written has removed nothing.
                    self._packs.add(shared.number)
            if self._saving is not me:
                return  # Its pack goes with those that the next snapshot does not need.
            self._saving = None
            if not self._finish(meta, record, shared):
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

    def _finish(self, meta: Meta, record: Snapshot, shared: Shared) -> bool:
        """Whether it is kept now."""
        home = self._home
        try:
            keep(home, meta)
        except HoldfastError as error:
            self.refuse(shared, str(error))
            return False
        size = sum(length for _, _, length in meta.blocks)
        is_full = home.journal.durable and sum(one.size for one in self._segments.values()) > MOST_GARBAGE * size
        if home.life.port is not None:
            home.life.port.to_life(Kept(shared.number, True, is_full))
        home.limit.cut()
        home.due.kept(meta.turn)
        if home.node.events.has_listeners:
            written = sum(length for number, _, length in meta.blocks if number == shared.number)
            home.node.emit(SnapshotTaken(home.path, record.turn, size, record.pause, written))
        return True

    def refuse(self, shared: Shared, why: str) -> None:
        """It could not be kept: what was there before is still there."""
        home = self._home
        segment = self._segments.pop(shared.number, None)
        if segment is not None:
            segment.close()
        if home.life.port is not None:
            home.life.port.to_life(Kept(shared.number, False))
        home.due.failed(why)

    def earlier(self) -> list[int]:
        """The packs that the older snapshots need."""
        count = self._home.method.keep - 1
        return sorted({number for one in self._history[:count] for number in one})

    def cancel(self) -> None:
        """What is not finished will not count."""
        self._saving = None
        self._marked = None

    def tidy(self) -> None:
        """Give back the memory of blocks that no snapshot needs any more."""
        ledger = self._home.ledger
        newest = ledger.newest.blocks if ledger.newest is not None else []
        self._history = [set(by_segment(newest)), *self._history][: self._home.method.keep]
        wanted = by_segment([*newest, *(ledger.older.blocks if ledger.older is not None else ())])
        for number in list(self._segments):
            if number not in wanted:
                self._segments.pop(number).close()
            elif not self.is_saving:
                self._segments[number].keep(wanted[number])

    def lend(self, blocks: list[Place]) -> Lent | None:
        """An image for a life that maps it; None if that cannot be."""
        segments = [self._segments[number] for number in by_segment(blocks)]
        try:
            for segment in segments:
                segment.lend()
        except OSError:  # The system is too old for it.
            return None
        return Lent(os.getpid(), [(one.number, one.file, one.inode) for one in segments], blocks)

    def restore(self, blocks: list[Place]) -> Iterator[Restore]:
        """An image, in pieces for a life."""
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
        home = self._home
        made: dict[int, Segment] = {}
        try:
            for number, places in by_segment(meta.blocks).items():
                if number not in self._segments:
                    made[number] = home.journal.read_blocks(home.path, number, places)
        except BaseException:
            for segment in made.values():
                segment.close()
            raise
        self._segments.update(made)

    def loaded(self, meta: Meta) -> None:
        """The store was read: these are the packs it needs."""
        self._history = [set(by_segment(meta.blocks)), set(meta.earlier)]
        journal, path = self._home.journal, self._home.path
        self._packs = self._history[0] | self._history[1]
        journal.forget_blocks(path, journal.packs(path) - self._packs)

    def close(self) -> None:
        """The home is given up."""
        self.cancel()
        for segment in self._segments.values():
            segment.close()
        self._segments.clear()
