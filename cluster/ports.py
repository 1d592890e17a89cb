"""What holdfast needs of an engine that keeps things on several machines: a log, a lease and blobs.

An engine implements these three for one system. `nats/` does so over JetStream, `holdfast.testing.fleet` on the virtual
clock. No promise rests on a clock: the log alone decides who leads, because each append names its predecessor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from ..actors.errors import HoldfastError, StoreError


class Unanswered(HoldfastError, text="{engine} has not answered: {problem}"):
    """Nobody knows whether what was asked for has happened: ask again."""

    engine: str
    problem: str


class AccessRefused(StoreError, text="store {path} does not let this program in: {problem}; {remedy}"):
    """The servers of a store have answered, and have refused: to wait or to try again changes nothing."""

    path: str
    problem: str
    remedy: str


class UnsafeServer(HoldfastError, text="{servers} may lose what was acknowledged: {problems:; }"):
    """A server, or a stream on it, is not set up such that a system may rely on it."""

    servers: str
    problems: tuple[str, ...]


class OutOfTurn(HoldfastError, text="the log goes on from another record than {after}"):
    """Nothing was appended: the last record of the log is not the one that the append named."""

    after: int


class LogGone(
    HoldfastError,
    text="{log} is gone from the servers: somebody has deleted or emptied it there; copy a backup into a new store "
    "(`holdfast store copy`), or have the system begin with nothing (`holdfast nats remove`)",
):
    """What stood in the log does not stand there any more: nothing that is written now would belong to it."""

    log: str


class LogRecord(NamedTuple):
    """One record of a log.

    Attributes:
        sequence: its number; numbers rise, and may have gaps.
        data: its bytes.
    """

    sequence: int
    data: bytes


class LogReader(Protocol):
    """Reads a log from some record on, in order."""

    async def next(self, seconds: float) -> Sequence[LogRecord]:
        """The next records, at least one if any is there within so many seconds; none is no proof of an end.

        Raises:
            Unanswered: the engine cannot be reached.
        """
        ...

    async def close(self) -> None:
        """Let go of what the engine keeps for this reader."""
        ...


class Log(Protocol):
    """A sequence of records that survives the loss of machines; every append names its predecessor."""

    async def append(self, data: bytes, after: int) -> int:
        """Append a record behind the one with the number `after` (0: the log is empty), and return its number.

        Raises:
            OutOfTurn: another record is the last one; it may be this very one, if it was appended before.
            Unanswered: it may stand there or not.
            AccessRefused: the servers have said that this program may not append any more; it does not stand there.
        """
        ...

    async def last(self) -> LogRecord | None:
        """The last record, as a majority knows it; `None` if the log is empty.

        Raises:
            Unanswered: the engine cannot be reached. LogGone: it answers that there is no such log.
        """
        ...

    async def read(self, after: int) -> LogReader:
        """A reader of what stands behind the record with that number.

        Raises:
            Unanswered: the engine cannot be reached.
        """
        ...

    async def forget(self, before: int) -> None:
        """Remove all records with smaller numbers.

        Raises:
            Unanswered: they may be there or not.
        """
        ...


class Lease(Protocol):
    """Says who may try to lead. Nothing unsafe rests on it; it expires by itself if it is not renewed."""

    @property
    def seconds(self) -> float:
        """How long it lasts after each renewal."""
        ...

    async def acquire(self, holder: str) -> int | None:
        """Take the lease if nobody has it, and return its token; `None` if somebody else has.

        Whoever has it by this name takes it again, with a new token and all of its time: an answer may have been lost.

        Raises:
            Unanswered: it may be taken or not.
        """
        ...

    async def renew(self, holder: str, token: int) -> int | None:
        """Renew what was acquired, and return the new token; `None` if it is gone, or somebody else's.

        Raises:
            Unanswered: it may be renewed or not.
        """
        ...

    async def release(self, token: int) -> None:
        """Give the lease up; nothing happens if it is gone, or somebody else's.

        Raises:
            Unanswered: it may be given up or not; then it expires.
        """
        ...

    async def holder(self) -> str:
        """Who has the lease; "" if nobody has.

        Raises:
            Unanswered: the engine cannot be reached.
        """
        ...


class Blobs(Protocol):
    """Large values by name, each written once; whoever refers to one in the log has it kept before."""

    async def put(self, name: str, data: bytes) -> None:
        """Keep a value; when this returns it survives the loss of machines. The same again changes nothing.

        Raises:
            Unanswered: it may be kept, in part or not.
        """
        ...

    async def get(self, name: str) -> bytes | None:
        """A value, or `None` if it is not there, or not all of it.

        Raises:
            Unanswered: the engine cannot be reached.
        """
        ...

    async def drop(self, name: str) -> None:
        """Remove a value.

        Raises:
            Unanswered: it may be there or not.
        """
        ...

    async def names(self) -> set[str]:
        """The names of all values.

        Raises:
            Unanswered: the engine cannot be reached.
        """
        ...


class Engine(Protocol):
    """Keeps what one system has on several machines."""

    @property
    def name(self) -> str:
        """What errors call it; without secrets."""
        ...

    @property
    def log(self) -> Log:
        """The log of the system."""
        ...

    @property
    def lease(self) -> Lease:
        """Who may try to lead the system."""
        ...

    @property
    def blobs(self) -> Blobs:
        """The large values of the system."""
        ...

    async def close(self) -> None:
        """Let go of the engine. What was not acknowledged may be lost."""
        ...
