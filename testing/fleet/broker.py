"""What outlives every program of a simulated fleet: a log, a lease and blobs, and all that can go wrong with them.

A request is a message: it arrives after a while, at whoever leads the servers then, and so does its answer. Everything
is drawn from one seed and runs on the clock of the loop, so that the virtual one repeats it.
"""

from __future__ import annotations

import asyncio
import copy
from collections.abc import Callable, Sequence
from contextvars import Context
from dataclasses import dataclass
from typing import Final, NamedTuple

from ...cluster.ports import LogRecord, OutOfTurn
from ..schedules.choices import Choices, Dice

PATH: Final = "sim:broker"
"""What errors call a simulated engine."""


@dataclass(frozen=True, slots=True)
class BrokerFaults:
    """How often what goes wrong: a share of the requests, readers or renewals, from 0 to 1.

    Attributes:
        lost_requests: never arrive.
        lost_answers: are done, and nobody hears of it.
        late_requests: arrive seconds after whoever asked has given up.
        doubled: arrive twice, the second time seconds later.
        refused: appends that are refused though they are right: a majority has not come so far.
        stale: reads that are answered as of up to `LAG` seconds ago.
        silent: reads of readers after which these never show anything again.
        skipped: reads of readers that leave a record out.
        skew: by which part at most a lease lasts longer or shorter than it should.
    """

    lost_requests: float = 0.0
    lost_answers: float = 0.0
    late_requests: float = 0.0
    doubled: float = 0.0
    refused: float = 0.0
    stale: float = 0.0
    silent: float = 0.0
    skipped: float = 0.0
    skew: float = 0.0


NO_FAULTS: Final = BrokerFaults()
LAG: Final = 2.0
"""Seconds by which a stale answer is behind at most."""
LATE: Final = 8.0
"""Seconds by which a request is late at most."""
LATENCY: Final = (0.0002, 0.003)
"""Seconds that a message between two machines takes, at least and at most, unless a test says otherwise."""


class _Kept(NamedTuple):
    """A record, when it was appended, and where the log began then."""

    record: LogRecord
    since: float
    begins: int


class SimBroker:
    """The servers of a simulated fleet, as the majority of them has everything.

    Attributes:
        faults: how often what goes wrong; may be changed at any time.
        blobs: the large values, by name.
        lease_holder, lease_token: who has the lease, and its token.
        on_request: told of every request that arrives, by its number, before it is done.
        latency: seconds that a message takes, at least and at most; may be changed, too.

    Args:
        seed: decides all that is drawn.
        faults: how often what goes wrong.
        choices: of a simulated run: keeps what is drawn.
    """

    def __init__(
        self,
        seed: int = 0,
        faults: BrokerFaults = NO_FAULTS,
        *,
        latency: tuple[float, float] = LATENCY,
        choices: Choices | None = None,
    ) -> None:
        self.dice = Dice("broker", seed, choices)
        self._nowhere = Context()  # What is on its way arrives, whatever becomes of the program that has sent it.
        self.faults, self.latency = faults, latency
        self.blobs: dict[str, bytes] = {}
        self.lease_holder, self.lease_token = "", 0
        self.on_request: Callable[[int], None] = lambda number: None
        self.requests = 0
        self._lease_until = 0.0
        self._log: list[_Kept] = []
        self._last, self._begins = 0, 0
        self._away_until = 0.0
        self._elections = 0
        self._waiting: dict[asyncio.Future[None], None] = {}

    def copy(self) -> SimBroker:
        """The same servers as they are now, with all that they have, for other programs; nobody has the lease."""
        made = SimBroker(0, latency=self.latency)
        made.dice = copy.deepcopy(self.dice)
        made.blobs = self.blobs.copy()
        made._log, made._last, made._begins = self._log.copy(), self._last, self._begins
        made.lease_token = self.lease_token
        return made

    # -- what happens to them ---------------------------------------------------------------------------------------

    def arrived(self) -> None:
        """Take note that a request has arrived at the servers."""
        self.requests += 1
        self.on_request(self.requests)

    def one_way(self) -> float:
        """Draw how many seconds a message takes."""
        return self.dice.seconds(*self.latency)

    def later(self, seconds: float, call: Callable[..., None], *args: object) -> None:
        """Have something happen between a program and the servers, or to these, so many seconds later."""
        asyncio.get_running_loop().call_later(seconds, call, *args, context=self._nowhere)

    def go_away(self, seconds: float) -> None:
        """Have nobody answer for so many seconds: an election, or an outage. Readers may fall silent for good."""
        self._away_until = max(self._away_until, _now() + seconds)
        self._elections += 1

    def expire_lease(self) -> None:
        """Have the lease end now, whatever its holder believes."""
        self.lease_holder = ""

    def is_away(self) -> bool:
        """Whether nobody answers at this moment, as during an election."""
        return _now() < self._away_until

    @property
    def elections(self) -> int:
        """How often the servers have gone away."""
        return self._elections

    # -- the log ----------------------------------------------------------------------------------------------------

    def append(self, data: bytes, after: int) -> int:
        """Append a record behind the last one; see `Log`."""
        if after != self._last or self.dice.strikes(self.faults.refused):
            raise OutOfTurn(after)
        self._last += 1 + (self.dice.random.random() < 0.1)  # Numbers may have gaps.
        self._log.append(_Kept(LogRecord(self._last, data), _now(), self._begins))
        for one in self._waiting:
            if not one.done():
                one.set_result(None)
        return self._last

    def view(self, after: int, when: float) -> list[LogRecord]:
        """The records behind the one with that number, as somebody sees them who has come as far as all had then."""
        log = self._log
        end = next((number for number in range(len(log), 0, -1) if log[number - 1].since <= when), 0)
        seen = log[:end]
        begins = self._begins if end == len(log) else log[end].begins if end else 0
        at = len(seen)
        while at and seen[at - 1].record.sequence > after and seen[at - 1].record.sequence >= begins:
            at -= 1
        return [kept.record for kept in seen[at:]]

    def forget(self, before: int) -> None:
        """Remove records with smaller numbers; see `Log`."""
        self._begins = max(self._begins, before)

    async def grown(self, seconds: float) -> None:
        """Wait for a record, for so many seconds at most."""
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[waiter] = None
        try:
            await asyncio.wait([waiter], timeout=seconds)
        finally:
            self._waiting.pop(waiter, None)

    @property
    def records(self) -> Sequence[LogRecord]:
        """All records that there are."""
        return self.view(0, float("inf"))

    @property
    def everything(self) -> Sequence[LogRecord]:
        """All records that there ever were, for judges."""
        return [kept.record for kept in self._log]

    # -- the lease --------------------------------------------------------------------------------------------------

    def held_by(self) -> str:
        """Who has the lease now; "" if nobody has."""
        if _now() >= self._lease_until:
            self.lease_holder = ""
        return self.lease_holder

    def take_lease(self, holder: str, seconds: float) -> int | None:
        """Take the lease, or renew it for whoever has it; see `Lease`."""
        if self.held_by() not in ("", holder):
            return None
        self.lease_holder, self.lease_token = holder, self.lease_token + 1
        self._lease_until = _now() + seconds * (1 + self.faults.skew * self.dice.random.uniform(-1, 1))
        return self.lease_token

    def release_lease(self, token: int) -> None:
        """Have nobody hold the lease, if its token is this one; see `Lease`."""
        if token == self.lease_token:
            self.lease_holder = ""


def _now() -> float:
    return asyncio.get_running_loop().time()
