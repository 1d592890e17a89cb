"""What stands in a record of a log, and how its bytes are read back.

A record names the one before it, so that whoever follows the log sees a gap, and carries the epoch of the leader that
wrote it. What does not fit into one record goes on in the next ones: it counts when its last part stands there, and an
epoch in between says that it never will.

Epoch    who leads from here on, and the format of what follows.
Changes  what a leader's store has done at one time; see `MemoryContents`.
Base     all that there was when its first part was written, for those who read from there: once its last part stands
         there, what is older may be removed. Changes may stand between its parts.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import msgspec

from ..actors.errors import HoldfastError
from ..checkpoint.encoding.entry_codec import decode_entries, entry_packer
from .ports import LogRecord
from .store_contents import Change

FORMAT: Final = 1
"""Of the records that are written. Whoever finds a higher one does not read on."""
PART: Final = 512 << 10
"""Most bytes of what stands in one record."""
SEALED: Final = b"\xc1hf1"
"""How encrypted records begin; no record does that is not (MessagePack never uses that byte)."""
EPOCH, CHANGES, BASE = "epoch", "changes", "base"


class DamagedLog(HoldfastError, text="record {sequence} of the log cannot be used: {problem}"):
    """A record that was acknowledged is damaged, missing, or of a version of holdfast that is not known here."""

    sequence: int
    problem: str


class LogPart(msgspec.Struct, array_like=True, gc=False):
    """One record of a log.

    Attributes:
        previous: the number of the record before it; 0: it is the first one.
        epoch: of the leader that wrote it.
        kind: EPOCH, CHANGES or BASE.
        part: which part of that it is, from 0 on.
        is_last: whether it completes that.
        crc: of the data.
        data: the bytes of this part.
    """

    previous: int
    epoch: int
    kind: str
    part: int
    is_last: bool
    crc: int
    data: bytes


class EpochBegun(msgspec.Struct, array_like=True, frozen=True):
    """Who leads from here on.

    Attributes:
        leader: what the leader calls itself, for people.
        attempt: tells this attempt to lead from all others.
        format: of what follows.
        when: Unix time on the leader's clock, for people.
    """

    leader: str
    attempt: str
    format: int
    when: float


_encode_part = msgspec.msgpack.Encoder().encode
_decode_part = msgspec.msgpack.Decoder(LogPart).decode


def read_part(record: LogRecord) -> LogPart:
    """What stands in a record.

    Raises:
        DamagedLog: it is none of ours, or damaged.
    """
    if record.data.startswith(SEALED):
        raise DamagedLog(record.sequence, "it is encrypted, and there is no key for it: give store_key=...")
    try:
        part = _decode_part(record.data)
    except msgspec.DecodeError as error:
        raise DamagedLog(record.sequence, f"it is no record of holdfast ({error})") from error
    if zlib.crc32(part.data) != part.crc:
        raise DamagedLog(record.sequence, "its checksum is wrong")
    return part


def decode_epoch(data: bytes) -> EpochBegun:
    """Who leads from here on, from the data of a record that begins an epoch."""
    return msgspec.msgpack.decode(data, type=EpochBegun)


def encode_changes(changes: Iterable[Change]) -> Iterator[bytes]:
    """The bytes of changes, one after another; their arguments are primitives, and tuples of them."""
    pack = entry_packer()
    for name, args in changes:
        yield pack((name, *args))


def decode_changes(data: bytes) -> list[Change]:
    """The changes whose bytes stand one behind the other.

    Raises:
        ValueError: they do not.
    """
    made: Iterator[Any] = decode_entries(data)
    return [(name, tuple(args)) for name, *args in made]


class RecordMaker:
    """Makes the records of one epoch, each behind the one before.

    Args:
        epoch: of the leader.
        after: the number of the last record that there is.
    """

    def __init__(self, epoch: int, after: int) -> None:
        self.epoch, self.after = epoch, after

    def parts(self, kind: str, data: Iterable[bytes]) -> Iterator[bytes]:
        """The records of all these bytes. Set `after` to the number of each before the next one is taken."""
        part, size = 0, 0
        pieces: list[bytes] = []
        for one in data:
            pieces.append(one)
            size += len(one)
            if size <= PART:
                continue
            joined, at = b"".join(pieces), 0
            while size - at > PART:
                yield self._record(kind, part, joined[at : at + PART], is_last=False)
                part, at = part + 1, at + PART
            pieces, size = [joined[at:]], size - at
        yield self._record(kind, part, b"".join(pieces), is_last=True)

    def _record(self, kind: str, part: int, data: bytes, *, is_last: bool) -> bytes:
        return _encode_part(LogPart(self.after, self.epoch, kind, part, is_last, zlib.crc32(data), data))

    def beginning(self, begun: EpochBegun) -> bytes:
        """The record that begins the epoch."""
        return self._record(EPOCH, 0, msgspec.msgpack.encode(begun), is_last=True)


class Said(NamedTuple):
    """What the log says, put together from its records.

    Attributes:
        sequence: the number of the record that completes it.
        epoch: of the leader that wrote it.
        kind: EPOCH, CHANGES or BASE.
        data: its bytes.
        first: the number of the record that begins it.
    """

    sequence: int
    epoch: int
    kind: str
    data: bytes
    first: int


class GapInLog(HoldfastError, text="the log goes on behind record {expected}, but {found} was the last one read"):
    """Records were missed: they have to be read again."""

    expected: int
    found: int


class RecordReader:
    """Puts the records of a log together, one after another.

    Attributes:
        at: the number of the last record that was taken in; 0: none.
        epoch: of the newest leader that was read of.
        grown: bytes that were taken in beside the newest base.
    """

    def __init__(self) -> None:
        self.at = self.epoch = self.grown = 0
        self._grown_before = 0  # beside the base before the one of which parts were taken in
        self._parts: dict[str, list[tuple[int, LogPart]]] = {}
        self._held: list[Said] | None = None  # behind the first part of a base that this reader began with

    def take(self, record: LogRecord) -> list[Said]:
        """Take in the next record; return what it completes, in the order in which it counts.

        A base is returned only if what stood before it was not read.

        Raises:
            GapInLog: it does not follow the last one that was taken in, which stays so.
            DamagedLog: it cannot be used.
        """
        sequence = record.sequence
        part = self._checked(record)
        if part.kind == EPOCH:
            self.check_whole()
            if self._parts.get(BASE):
                self.grown += self._grown_before + sum(len(one.data) for _, one in self._parts[BASE])
            self._parts.clear()  # What was not finished never was.
        elif self.at == 0:
            self._held = []  # What is older than this base was removed.
        parts = self._parts.setdefault(part.kind, [])
        if part.part != len(parts):
            raise DamagedLog(sequence, f"it is part {part.part} of {part.kind}, and {len(parts)} came before it")
        self.at, self.epoch = sequence, part.epoch
        if part.kind != BASE:
            self.grown += len(record.data)
        elif part.part == 0:
            self._grown_before, self.grown = self.grown, 0
        parts.append((sequence, part))
        if not part.is_last:
            return []
        said = Said(sequence, part.epoch, part.kind, b"".join(one.data for _, one in parts), parts[0][0])
        parts.clear()
        if self._held is not None and part.kind != BASE:
            self._held.append(said)
            return []
        if part.kind != BASE:
            return [said]
        held, self._held = self._held, None
        return [] if held is None else [said, *held]

    def check_whole(self) -> None:
        """See to it that the base that this reader began with is complete: it was, before what is older was removed.

        Raises:
            DamagedLog: the base that the log begins with has no end.
        """
        if self._held is not None:
            raise DamagedLog(self.at, "the log begins with a base that was never finished")

    def _checked(self, record: LogRecord) -> LogPart:
        part = read_part(record)
        begins = self.at == 0 and part.kind == BASE and part.part == 0
        if part.previous != self.at and not begins:
            raise GapInLog(part.previous, self.at)
        if not (begins or (part.epoch > self.epoch if part.kind == EPOCH else part.epoch == self.epoch)):
            raise DamagedLog(record.sequence, f"it is of epoch {part.epoch}, and stands behind epoch {self.epoch}")
        if part.kind == EPOCH and decode_epoch(part.data).format > FORMAT:
            raise DamagedLog(record.sequence, "a newer version of holdfast wrote what follows: update this one")
        return part
