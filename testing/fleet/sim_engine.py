"""One program's connection to the simulated servers of a fleet; see `cluster.ports.Engine`."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, TypeVar

from ...cluster.ports import LogReader, LogRecord, OutOfTurn, Unanswered
from .broker import LAG, LATE, PATH, SimBroker

T = TypeVar("T")
ANSWER_SECONDS: Final = 2.0
"""How long a request waits for its answer."""
BATCH: Final = 40
"""Records that a read returns at most."""


class SimLink:
    """What gets through between one program and the servers.

    Attributes:
        sends: whether requests arrive.
        hears: whether answers do.
        stale_since: a server that is cut off with the program answers reads as of then; `None`: there is none.
        is_struck: asked at each request whether it is lost, with all that follows from that.
    """

    def __init__(self) -> None:
        self.is_struck: Callable[[], bool] = bool
        self.sends = self.hears = True
        self.stale_since: float | None = None
        self._goes_on = asyncio.Event()
        self._goes_on.set()

    def freeze(self) -> None:
        """Have the program stop where it sends something or hears of it, as a process that is paused does."""
        self._goes_on.clear()

    def thaw(self) -> None:
        """Have it go on, with what it has heard meanwhile."""
        self._goes_on.set()

    async def awake(self) -> None:
        """Wait until the program goes on."""
        await self._goes_on.wait()

    def cut(self, *, sends: bool = False, hears: bool = False, stale_since: float | None = None) -> None:
        """Have requests or answers, or both, get through no more."""
        self.sends, self.hears, self.stale_since = sends, hears, stale_since

    def heal(self) -> None:
        """Have everything get through again."""
        self.cut(sends=True, hears=True)


class SimEngine:
    """One program's engine.

    Attributes:
        link: what gets through.

    Args:
        broker: the servers.
        seconds: how long a lease lasts after each renewal.
        link: of the program, if its connections share one.
    """

    name = PATH

    def __init__(self, broker: SimBroker, *, seconds: float = 3.0, link: SimLink | None = None) -> None:
        self.link = link or SimLink()
        asks = _Asks(broker, self.link)
        self.log, self.lease, self.blobs = SimLog(asks), SimLease(asks, seconds), SimBlobs(asks)

    async def close(self) -> None:
        """Do nothing: the servers hear nothing more of this program."""


class _Asks:
    """Sends requests, and waits for their answers."""

    def __init__(self, broker: SimBroker, link: SimLink) -> None:
        self.broker, self.link = broker, link

    async def ask(self, do: Callable[[], T], read: Callable[[float], T] | None = None) -> T:
        """Have something done by the servers.

        Args:
            do: does it, when it arrives.
            read: for what changes nothing: gives the answer of somebody who has come as far as all had at that time.

        Raises:
            OutOfTurn: `do` does. Unanswered: nobody knows whether it was done.
        """
        broker, link, faults, dice = self.broker, self.link, self.broker.faults, self.broker.dice
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[T] = loop.create_future()
        await link.awake()

        def arrive(is_heard: bool) -> None:
            broker.arrived()
            if not link.sends or broker.is_away():
                return
            try:
                result: T | OutOfTurn = do()
            except OutOfTurn as error:
                result = error
            if is_heard:
                broker.later(broker.one_way(), hear, result)

        def hear(result: T | OutOfTurn) -> None:
            if answer.done() or not link.hears or broker.is_away():
                return
            if isinstance(result, OutOfTurn):
                answer.set_exception(result)
            else:
                answer.set_result(result)

        if read is not None:
            is_stale = dice.strikes(faults.stale)
            as_of = loop.time() - dice.seconds(0.0, LAG) if is_stale else loop.time()
            if link.stale_since is not None:
                broker.later(broker.one_way(), _set, answer, read(min(as_of, link.stale_since)))
            elif is_stale:
                do = partial(read, as_of)
        if link.is_struck():
            pass
        elif dice.strikes(faults.late_requests):
            broker.later(ANSWER_SECONDS + dice.seconds(0.0, LATE), arrive, False)
        elif not dice.strikes(faults.lost_requests):
            broker.later(broker.one_way(), arrive, not dice.strikes(faults.lost_answers))
            if dice.strikes(faults.doubled):
                broker.later(dice.seconds(0.0, LATE), arrive, False)
        await asyncio.wait([answer], timeout=ANSWER_SECONDS)
        await link.awake()
        if not answer.done():
            answer.cancel()
            raise Unanswered(PATH, f"no answer for {ANSWER_SECONDS:g} s")
        return answer.result()


def _set(answer: asyncio.Future[T], result: T) -> None:
    if not answer.done():
        answer.set_result(result)


class SimLog:
    """The log of simulated servers; see `cluster.ports.Log`."""

    def __init__(self, asks: _Asks) -> None:
        self._asks, self._broker = asks, asks.broker

    async def append(self, data: bytes, after: int) -> int:
        """Append a record behind the one with the number `after`; see `Log`."""
        return await self._asks.ask(lambda: self._broker.append(data, after))

    async def last(self) -> LogRecord | None:
        """The last record; see `Log`."""

        def read(when: float) -> LogRecord | None:
            seen = self._broker.view(0, when)
            return seen[-1] if seen else None

        return await self._asks.ask(lambda: read(float("inf")), read)

    async def read(self, after: int) -> LogReader:
        """A reader of what stands behind that record; see `Log`."""
        return await self._asks.ask(lambda: SimReader(self._asks, after))

    async def forget(self, before: int) -> None:
        """Remove all records with smaller numbers; see `Log`."""
        await self._asks.ask(lambda: self._broker.forget(before))


class SimReader:
    """Reads the log of simulated servers; it may fall silent when these have gone away; see `LogReader`."""

    def __init__(self, asks: _Asks, after: int) -> None:
        self._asks, self._broker, self._at = asks, asks.broker, after
        self._is_silent = False
        self._elections = self._broker.elections

    async def next(self, seconds: float) -> Sequence[LogRecord]:
        """The next records; see `LogReader`."""
        loop, broker, link = asyncio.get_running_loop(), self._broker, self._asks.link
        until = loop.time() + seconds
        dice, faults = broker.dice, broker.faults
        lag = dice.seconds(0.0, LAG) if dice.strikes(faults.stale) else 0.0
        if broker.elections > self._elections:
            self._elections = broker.elections
            self._is_silent |= dice.strikes(0.5)
        self._is_silent |= dice.strikes(faults.silent)
        await asyncio.sleep(min(broker.one_way(), seconds))
        while (left := until - loop.time()) > 0:
            if self._is_silent or not link.sends or not link.hears or broker.is_away():
                await asyncio.sleep(left)
                if not self._is_silent and dice.strikes(0.5):
                    raise Unanswered(PATH, "the reader's server is gone")
                return []
            found = broker.view(self._at, loop.time() - lag)[:BATCH]
            if not found:
                await broker.grown(left if lag == 0 else min(left, lag / 2))
                continue
            if len(found) > 1 and dice.strikes(faults.skipped):
                del found[dice.random.randrange(len(found) - 1)]
            self._at = found[-1].sequence
            await asyncio.sleep(broker.one_way())
            await link.awake()
            return found
        return []

    async def close(self) -> None:
        """Do nothing: whoever reads no more is forgotten."""


class SimLease:
    """The lease of simulated servers; see `cluster.ports.Lease`."""

    def __init__(self, asks: _Asks, seconds: float) -> None:
        self._asks, self._broker, self.seconds = asks, asks.broker, seconds

    async def acquire(self, holder: str) -> int | None:
        """Take the lease if nobody else has it; see `Lease`."""
        return await self._asks.ask(lambda: self._broker.take_lease(holder, self.seconds))

    async def renew(self, holder: str, token: int) -> int | None:
        """Renew what was acquired, also if the answer to an earlier renewal was lost; see `Lease`."""

        def do() -> int | None:
            return self._broker.take_lease(holder, self.seconds) if self._broker.held_by() == holder else None

        return await self._asks.ask(do)

    async def release(self, token: int) -> None:
        """Give the lease up; see `Lease`."""
        await self._asks.ask(lambda: self._broker.release_lease(token))

    async def holder(self) -> str:
        """Who has the lease; see `Lease`."""
        return await self._asks.ask(self._broker.held_by)


class SimBlobs:
    """The large values of simulated servers; see `cluster.ports.Blobs`."""

    def __init__(self, asks: _Asks) -> None:
        self._asks, self._broker = asks, asks.broker

    async def put(self, name: str, data: bytes) -> None:
        """Keep a value; see `Blobs`."""

        def do() -> None:
            self._broker.blobs[name] = bytes(data)

        await self._asks.ask(do)

    async def get(self, name: str) -> bytes | None:
        """A value, at once, so that a simulated program that has only one loop can wait for it; see `Blobs`."""
        if not self._asks.link.sends or not self._asks.link.hears or self._broker.is_away():
            raise Unanswered(PATH, "it cannot be reached")
        return self._broker.blobs.get(name)

    async def drop(self, name: str) -> None:
        """Remove a value; see `Blobs`."""

        def do() -> None:
            self._broker.blobs.pop(name, None)

        await self._asks.ask(do)

    async def names(self) -> set[str]:
        """The names of all values; see `Blobs`."""
        return await self._asks.ask(lambda: set(self._broker.blobs))
