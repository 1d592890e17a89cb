"""An engine whose records and large values are encrypted: servers keep what only programs with the key can read.

Everything passes through here on its way to the servers, so nothing above knows of it. What stands in the log is bound
to this log and what is beside it to its name, by the cipher of encrypted stores on the disk (AES-256-GCM). Servers see
how much there is, when it was written, and who holds the lease.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from typing import TYPE_CHECKING, Final

from ..checkpoint.journal import WrongStoreKey
from .log_records import SEALED, DamagedLog
from .ports import Blobs, Engine, Lease, Log, LogReader, LogRecord

if TYPE_CHECKING:
    from ..checkpoint.sqlite.sealing import Cipher

_LOG: Final = b"log"


async def sealed(engine: Engine, key: bytes | None, system: str) -> Engine:
    """The engine itself, if it is used without a key; else one that encrypts. Nothing is changed.

    Args:
        engine: of the system.
        key: 32 bytes, or None.
        system: its name on the servers.

    Raises:
        WrongStoreKey: what stands in the log was written with another key, or without one; or there is no key for it.
        Unanswered: the engine cannot be reached.
    """
    last = await engine.log.last()
    is_sealed = last is not None and last.data.startswith(SEALED)
    if key is None:
        if is_sealed:
            remedy = "give its key: store_key=..., or --key-file"
            raise WrongStoreKey(engine.name, "it is encrypted, and there is no key for it", remedy)
        return engine
    if last is not None and not is_sealed:
        remedy = "leave the key out; or have `holdfast store copy` make an encrypted copy"
        raise WrongStoreKey(engine.name, "it is not encrypted, and there is a key for it", remedy)
    from ..checkpoint.sqlite.sealing import StoreCipher  # only now: few programs have a key, and it imports sqlite3

    made = SealedEngine(engine, StoreCipher(key, blake2b(f"nats {system}".encode(), digest_size=16).digest()))
    if last is not None:
        try:
            made.log.opened(last)
        except DamagedLog as error:
            remedy = "give the one that it was made with; without that nobody can read it"
            raise WrongStoreKey(engine.name, "the key is not the one that it is encrypted with", remedy) from error
    return made


class SealedEngine:
    """An engine that encrypts what it hands on to another one, and decrypts what comes back; see `Engine`."""

    def __init__(self, engine: Engine, cipher: Cipher) -> None:
        self._engine = engine
        self.log = SealedLog(engine.log, cipher)
        self.blobs: Blobs = SealedBlobs(engine.blobs, cipher)

    @property
    def name(self) -> str:
        """What errors call it."""
        return self._engine.name

    @property
    def lease(self) -> Lease:
        """Who may try to lead: the name of who does is there for everybody to read."""
        return self._engine.lease

    async def close(self) -> None:
        """Let go of the engine."""
        await self._engine.close()


class SealedLog:
    """A log of encrypted records; see `Log`."""

    def __init__(self, log: Log, cipher: Cipher) -> None:
        self._log, self._cipher = log, cipher

    def opened(self, record: LogRecord) -> LogRecord:
        """A record as it was before it was encrypted.

        Raises:
            DamagedLog: it was changed, is not of this log, or of another key; or it is not encrypted.
        """
        if not record.data.startswith(SEALED):
            raise DamagedLog(record.sequence, "it is not encrypted, and what stands before it is")
        try:
            return LogRecord(record.sequence, self._cipher.unseal(_LOG, record.data[len(SEALED) :]))
        except ValueError as error:
            raise DamagedLog(record.sequence, str(error)) from error

    async def append(self, data: bytes, after: int) -> int:
        """Append a record; see `Log`."""
        return await self._log.append(SEALED + bytes(self._cipher.seal(_LOG, data)), after)

    async def last(self) -> LogRecord | None:
        """The last record; see `Log`."""
        last = await self._log.last()
        return None if last is None else self.opened(last)

    async def read(self, after: int) -> LogReader:
        """A reader of what stands behind that record; see `Log`."""
        return SealedReader(await self._log.read(after), self)

    async def forget(self, before: int) -> None:
        """Remove all records with smaller numbers; see `Log`."""
        await self._log.forget(before)


class SealedReader:
    """Reads encrypted records; see `LogReader`."""

    def __init__(self, reader: LogReader, log: SealedLog) -> None:
        self._reader, self._log = reader, log

    async def next(self, seconds: float) -> Sequence[LogRecord]:
        """The next records; see `LogReader`."""
        return [self._log.opened(record) for record in await self._reader.next(seconds)]

    async def close(self) -> None:
        """Let go of what the engine keeps for this reader; see `LogReader`."""
        await self._reader.close()


class SealedBlobs:
    """Large values, each encrypted for its name; see `Blobs`."""

    def __init__(self, blobs: Blobs, cipher: Cipher) -> None:
        self._blobs, self._cipher = blobs, cipher

    async def put(self, name: str, data: bytes) -> None:
        """Keep a value; see `Blobs`."""
        await self._blobs.put(name, bytes(self._cipher.seal(b"blob" + name.encode(), data)))

    async def get(self, name: str) -> bytes | None:
        """A value, or `None` if it is not there, or is not what was kept under this name; see `Blobs`."""
        kept = await self._blobs.get(name)
        try:
            return None if kept is None else self._cipher.unseal(b"blob" + name.encode(), kept)
        except ValueError:
            return None

    async def drop(self, name: str) -> None:
        """Remove a value; see `Blobs`."""
        await self._blobs.drop(name)

    async def names(self) -> set[str]:
        """The names of all values; see `Blobs`."""
        return await self._blobs.names()
