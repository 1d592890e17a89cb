"""Who leads a system: the lease says who may try, the log says who did.

A candidate takes the lease, reads the log to its end and appends the beginning of its own epoch, naming the last record
that it has read. If that is accepted, nothing was missed, whatever the reads have shown: it leads, and whoever led
before can append nothing any more. If it is refused, it reads on and tries again.

A leader renews its lease. When it cannot, it goes on writing: only the log can depose it. While another has the lease
it holds back, so that one of the two comes through; when the lease is free again it takes it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from ..actors.errors import HoldfastError
from .log_records import (
    EPOCH,
    FORMAT,
    EpochBegun,
    GapInLog,
    RecordMaker,
    RecordReader,
    decode_changes,
    decode_epoch,
)
from .log_writer import FIRST_PAUSE, LONGEST_PAUSE, append_behind
from .ports import Engine, LogReader, Record, Unanswered
from .store_contents import StoreContents

Standby: TypeAlias = Literal["warm", "cold"]
"""How a program waits until it leads: with what is stored in memory, or not."""
LOOK_SECONDS: Final = 0.2
"""How often a candidate looks whether the lease is free."""
QUIET_SECONDS: Final = 2.0
"""Without a record for so long, a follower asks the log whether it has missed any."""
RENEWALS: Final = 6
"""How often a leader renews its lease in the time that it lasts."""
TRUSTED: Final = 0.75
"""The part of the lease's time for which its holder relies on it: clocks run at rates within 25 % of each other."""


class LeaderElsewhere(HoldfastError, text="{leader} leads this system"):
    """The lease is somebody else's, and this program was not to wait for it."""

    leader: str


class LeadershipLost(
    HoldfastError,
    text="this program leads {system} no more: {leader} does, in epoch {epoch}; start it again, and it stands by",
):
    """Another program leads the system: the tree of this one was stopped, and what it had not acknowledged is void.

    Attributes:
        system: its name.
        leader: what the other program calls itself: its machine and process.
        epoch: in which it leads.
    """

    system: str
    leader: str
    epoch: int


def leader_name() -> str:
    """What a candidate calls itself: machine and process, for people, and what tells it from all others there."""
    return f"{socket.gethostname()}, process {os.getpid()} ({uuid.uuid4().hex[:8]})"


class Follower:
    """Has what a log says in memory, as far as it has been read.

    Attributes:
        contents: of the store, as far as it has been read.
        reader: where that is.
        leader: who leads, by what was read; "" before the first epoch.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._stream: LogReader | None = None
        self._is_new = True
        self.contents = StoreContents()
        self.reader = RecordReader()
        self.leader = ""

    async def read(self, seconds: float) -> bool:
        """Take in what comes within so many seconds; return whether anything came.

        Raises:
            Unanswered: the engine cannot be reached.
            DamagedLog: what stands there cannot be used.
        """
        try:
            if self._stream is None:
                self._stream, self._is_new = await self._engine.log.read(self.reader.at), True
            records = await self._stream.next(seconds)
        except Unanswered:
            await self.begin_anew()
            raise
        for record in records:
            try:
                self._take(record)
            except GapInLog:
                if self._is_new:  # What this follower has not read yet is gone: all of it stands in a base.
                    self.contents, self.reader, self.leader = StoreContents(), RecordReader(), ""
                await self.begin_anew()
                break
            self._is_new = False
        return bool(records)

    async def catch_up(self) -> None:
        """Read until nothing more stands there.

        Raises:
            Unanswered: the engine cannot be reached.
            DamagedLog: what stands there cannot be used.
        """
        while True:
            last = await self._engine.log.last()
            if last is None or last.sequence <= self.reader.at:
                return
            if not await self.read(LONGEST_PAUSE):
                await self.begin_anew()  # What the engine keeps for this reader may have died with a server.

    async def follow(self) -> None:
        """Read for ever, over all outages.

        Raises:
            DamagedLog: what stands there cannot be used.
        """
        pause = FIRST_PAUSE
        while True:
            try:
                if not await self.read(QUIET_SECONDS):
                    last = await self._engine.log.last()
                    if last is not None and last.sequence > self.reader.at:
                        await self.begin_anew()
                pause = FIRST_PAUSE
            except Unanswered:
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    async def begin_anew(self) -> None:
        """Read on through another reader of the engine."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(Unanswered):
                await stream.close()

    def _take(self, record: Record) -> None:
        if record.sequence <= self.reader.at:
            return
        for said in self.reader.take(record):
            if said.kind == EPOCH:
                self.leader = decode_epoch(said.data).leader
                continue
            for change in decode_changes(said.data):
                self.contents.make(change)


@dataclass(slots=True)
class Leading:
    """What a leader begins with.

    Attributes:
        contents: all that its predecessors have written.
        maker: of its own records.
        grown: bytes that the log has beside the newest base.
        token: of the lease.
        deadline: until when it relies on the lease, on the clock of the loop.
    """

    contents: StoreContents
    maker: RecordMaker
    grown: int
    token: int
    deadline: float


async def lead(
    engine: Engine, me: str, *, standby: Standby | None, waits: Callable[[str], None] = lambda leader: None
) -> Leading:
    """Wait until this process leads, and return what it begins with.

    Args:
        engine: keeps log and lease.
        me: what this process calls itself.
        standby: "warm" follows the log meanwhile, "cold" reads it only then, `None` does not wait for another leader.
        waits: told who leads, each time that this has changed.

    Raises:
        LeaderElsewhere: another leads, and nobody is to wait for it.
        DamagedLog: what stands in the log cannot be used.
        Unanswered: the engine cannot be reached, and nobody is to wait for it.
    """
    follower = Follower(engine)
    following = asyncio.ensure_future(follower.follow()) if standby == "warm" else None
    try:
        while True:
            taken, asked = await _take_lease(engine, me, standby, waits, following)
            if following is not None:
                following.cancel()
                await asyncio.wait([following])
                if not following.cancelled():
                    following.result()
                await follower.begin_anew()
            try:
                maker = await _begin_epoch(engine, me, follower, asked + engine.lease.seconds)
            except Unanswered:
                if standby is None:
                    raise
                maker = None
            if maker is not None:
                deadline = asked + TRUSTED * engine.lease.seconds
                return Leading(follower.contents, maker, follower.reader.grown, taken, deadline)
            if standby == "warm":
                following = asyncio.ensure_future(follower.follow())
    finally:
        if following is not None:
            following.cancel()
        await follower.begin_anew()


async def _take_lease(
    engine: Engine,
    me: str,
    standby: Standby | None,
    waits: Callable[[str], None],
    following: asyncio.Future[None] | None,
) -> tuple[int, float]:
    """Wait for the lease; return its token, and when it was asked for."""
    loop = asyncio.get_running_loop()
    known = ""
    has_failed = False
    while True:
        if following is not None and following.done():
            following.result()
        try:
            asked = loop.time()
            token = await engine.lease.acquire(me)
            if token is not None:
                if not has_failed:
                    return token, asked
                # After an outage that this process has seen, too, whoever led goes first: with its state in memory.
                await engine.lease.release(token)
                await asyncio.sleep(engine.lease.seconds)
                has_failed = False
                continue
            leader = await engine.lease.holder()
        except Unanswered:
            if standby is None:
                raise
            has_failed = following is not None
            await asyncio.sleep(LOOK_SECONDS)
            continue
        if leader:
            has_failed = False
            if standby is None:
                raise LeaderElsewhere(leader)
            if leader != known:
                known = leader
                waits(leader)
        await asyncio.sleep(LOOK_SECONDS * random.uniform(0.5, 1.0))


async def _begin_epoch(engine: Engine, me: str, follower: Follower, until: float) -> RecordMaker | None:
    """Append the beginning of an epoch behind all that stands in the log; `None` if the lease is over before that."""
    loop = asyncio.get_running_loop()
    attempt = uuid.uuid4().hex
    while True:
        await follower.catch_up()
        reader = follower.reader
        maker = RecordMaker(reader.epoch + 1, reader.at)
        record = maker.beginning(EpochBegun(me, attempt, FORMAT, time.time()))
        stands = await append_behind(engine, record, reader.at)
        if isinstance(stands, int):
            maker.after = stands
            return maker
        if loop.time() > until:
            return None


class LeaseKeeper:
    """Keeps a leader's lease. All methods are for the loop of the engine.

    Attributes:
        deadline: until when the leader relies on it, on the clock of the loop.

    Args:
        engine: keeps the lease.
        me: what the holder calls itself.
        leading: what it began with.
        hold: called when another has the lease: nothing more is to be written.
        go_on: called when it is ours again.
        look: called when it was lost: the leader is to look whether it still leads.
    """

    def __init__(
        self,
        engine: Engine,
        me: str,
        leading: Leading,
        *,
        hold: Callable[[], None],
        go_on: Callable[[], None],
        look: Callable[[], None],
    ) -> None:
        self._lease, self._me = engine.lease, me
        self._token: int | None = leading.token
        self._hold, self._go_on, self._look = hold, go_on, look
        self.deadline = leading.deadline

    async def run(self) -> None:
        """Renew the lease, for ever."""
        loop = asyncio.get_running_loop()
        lease = self._lease
        while True:
            await asyncio.sleep(lease.seconds / RENEWALS)
            asked = loop.time()
            try:
                if self._token is None:
                    self._token = await lease.acquire(self._me)
                    if self._token is None:
                        if await lease.holder():
                            self._hold()
                        continue
                    self._go_on()
                else:
                    self._token = await lease.renew(self._me, self._token)
                    if self._token is None:
                        self._look()
                        continue
            except Unanswered:
                continue
            self.deadline = asked + TRUSTED * lease.seconds

    async def release(self) -> None:
        """Give the lease up, so that whoever waits need not wait for its end."""
        if self._token is not None:
            token, self._token = self._token, None
            with contextlib.suppress(Unanswered):
                await self._lease.release(token)
