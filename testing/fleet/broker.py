"""A simulated engine for several machines: a log, a lease and blobs in memory, on the virtual clock."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Final

from ...cluster.ports import OutOfTurn, Record

PATH: Final = "sim:broker"
"""What errors call a simulated engine."""


class SimBroker:
    """What outlives every program of a simulated fleet.

    Attributes:
        records: of the log, as the majority has them.
        forgotten: the number below which records were removed.
        blobs: the large values, by name.
        lease_holder, lease_token, lease_until: who has the lease, its token, and when it ends on the clock of the loop.
    """

    def __init__(self) -> None:
        self.records: list[Record] = []
        self.forgotten = 0
        self.last = 0
        self.blobs: dict[str, bytes] = {}
        self.lease_holder, self.lease_token, self.lease_until = "", 0, 0.0
        self.grown = asyncio.Event()

    def append(self, data: bytes, after: int) -> int:
        """Append a record, if the last one has the number `after`."""
        if after != self.last:
            raise OutOfTurn(after)
        self.last += 1
        self.records.append(Record(self.last, data))
        self.grown.set()
        return self.last


class SimReader:
    """Reads the log of a simulated engine."""

    def __init__(self, broker: SimBroker, after: int) -> None:
        self._broker, self._at = broker, after

    async def next(self, seconds: float) -> Sequence[Record]:
        """See `LogReader`."""
        broker = self._broker
        if self._at >= broker.last:
            broker.grown.clear()
            try:
                async with asyncio.timeout(seconds):
                    await broker.grown.wait()
            except TimeoutError:
                return []
        found = [record for record in broker.records if record.sequence > self._at]
        if found:
            self._at = found[-1].sequence
        return found

    async def close(self) -> None:
        """See `LogReader`."""


class SimEngine:
    """One program's connection to a simulated engine; see `cluster.ports.Engine`."""

    name = PATH

    def __init__(self, broker: SimBroker, *, seconds: float = 3.0) -> None:
        self._broker = broker
        self.log = self.lease = self.blobs = self
        self.seconds = seconds

    async def append(self, data: bytes, after: int) -> int:
        """See `Log`."""
        return self._broker.append(data, after)
