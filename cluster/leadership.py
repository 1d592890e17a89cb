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
import math
import os
import random
import socket
import time
import uuid
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, TypeVar

from ..actors.errors import HoldfastError
from .engine_thread import end_tasks
from .log_records import (
    EPOCH,
    FORMAT,
    DamagedLog,
    EpochBegun,
    GapInLog,
    RecordMaker,
    RecordReader,
    decode_changes,
    decode_epoch,
)
from .log_writer import FIRST_PAUSE, LONGEST_PAUSE, append_behind
from .ports import Engine, LogReader, LogRecord, Unanswered
from .store_contents import MemoryContents

T = TypeVar("T")
Standby: TypeAlias = Literal["warm", "cold"]
"""How a program waits until it leads: with what is stored in memory, or not."""
LOOK_SECONDS: Final = 0.2
"""How often a candidate looks whether the lease is free."""
GATHER_SECONDS: Final = 0.04
"""How long a follower lets records gather: a request for each takes more of a processor than all that is in them."""
FEW: Final = 64
"""Who reads as many records at once is behind, and reads on."""
QUIET_SECONDS: Final = 2.0
"""Without a record for so long, a follower asks the log whether it has missed any."""
MOST_READERS: Final = 5
"""Readers that have to begin a log with a record that begins nothing, before it is the log that is damaged."""
PATIENCE_SECONDS: Final = 30.0
"""How long a program that is not to wait tries to write that it leads."""
MOMENT_SECONDS: Final = 2.0
"""How long a program that is not to wait bears servers that cannot answer: they elect a leader, or take up a file."""
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
        self._wrong_beginnings = 0
        self.contents = MemoryContents()
        self.reader = RecordReader()
        self.leader = ""

    async def read(self, seconds: float) -> int:
        """Take in what comes within so many seconds; return how many records came.

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
                    self._begin_again(record)
                await self.begin_anew()
                break
            self._is_new = False
        return len(records)

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
                count = await self.read(QUIET_SECONDS)
                if count == 0:
                    last = await self._engine.log.last()
                    if last is not None and last.sequence > self.reader.at:
                        await self.begin_anew()
                elif count < FEW:
                    await asyncio.sleep(GATHER_SECONDS)
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

    def _begin_again(self, record: LogRecord) -> None:
        """Read the log from its beginning, which is not this record.

        Raises:
            DamagedLog: again and again it is, whichever reader is asked.
        """
        if self.reader.at == 0:
            self._wrong_beginnings += 1
            if self._wrong_beginnings == MOST_READERS:
                raise DamagedLog(record.sequence, "what stood before it is gone, and it begins no base")
        else:
            self._wrong_beginnings = 0
        self.contents, self.reader, self.leader = MemoryContents(), RecordReader(), ""

    def _take(self, record: LogRecord) -> None:
        if record.sequence <= self.reader.at:
            return
        for said in self.reader.take(record):
            if said.kind == EPOCH:
                self.leader = decode_epoch(said.data).leader
                continue
            try:
                for change in decode_changes(said.data):
                    self.contents.make(change)
            except ValueError as error:
                raise DamagedLog(said.sequence, str(error)) from error


@dataclass(slots=True)
class Leading:
    """What a leader begins with.

    Attributes:
        contents: all that its predecessors have written.
        maker: of its own records.
        grown: bytes that the log has beside the newest base.
        keeper: of its lease.
    """

    contents: MemoryContents
    maker: RecordMaker
    grown: int
    keeper: LeaseKeeper


def _nobody(what: str) -> None:
    """Tell nobody what is waited for."""


class Patience:
    """Says how long to go on asking servers that do not answer. Only for a running loop.

    Args:
        waits: for ever; else it is over MOMENT_SECONDS after they have not answered for the first time.
    """

    def __init__(self, *, waits: bool) -> None:
        self._waits = waits
        self._until = math.inf

    def is_over(self, since: float | None = None) -> bool:
        """They have not answered, now or since then: whether to give up."""
        if self._waits:
            return False
        now = asyncio.get_running_loop().time()
        self._until = min(self._until, (now if since is None else since) + MOMENT_SECONDS)
        return now >= self._until

    async def answered(self, ask: Callable[[], Awaitable[T]], silent: Callable[[str], None]) -> T:
        """Ask again and again, and tell each time why there is no answer.

        Raises:
            Unanswered: it is over. Else as `ask`.
        """
        pause, loop = FIRST_PAUSE, asyncio.get_running_loop()
        while True:
            asked = loop.time()
            try:
                return await ask()
            except Unanswered as error:
                if self.is_over(asked):
                    raise
                silent(error.problem)
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)


async def lead(
    engine: Engine,
    me: str,
    *,
    standby: Standby | None,
    waits: Callable[[str], None] = _nobody,
    unanswered: Callable[[str], None] = _nobody,
) -> Leading:
    """Wait until this process leads, and return what it begins with.

    Args:
        engine: keeps log and lease.
        me: what this process calls itself.
        standby: "warm" follows the log meanwhile, "cold" reads it only then, `None` does not wait for another leader.
        waits: told who leads, each time that this has changed.
        unanswered: told why the engine cannot be reached, each time that it was asked in vain.

    Raises:
        LeaderElsewhere: another leads, and nobody is to wait for it.
        DamagedLog: what stands in the log cannot be used.
        Unanswered: the engine cannot be reached for a moment, and nobody is to wait for it.
    """
    follower = Follower(engine)
    following = asyncio.ensure_future(follower.follow()) if standby == "warm" else None
    patience = Patience(waits=standby is not None)
    try:
        while True:
            keeper = await _take_lease(engine, me, standby, waits, unanswered, following, patience)
            if following is not None:
                await end_tasks(following)
                if not following.cancelled():
                    following.result()
                await follower.begin_anew()
            renewing = asyncio.ensure_future(keeper.renew_while_reading(follower))
            try:
                insists = math.inf if standby is not None else PATIENCE_SECONDS
                maker = await _begin_epoch(engine, me, follower, keeper, insists)
            except Unanswered as error:
                if patience.is_over():
                    raise
                unanswered(error.problem)
                maker = None
            finally:
                await end_tasks(renewing)
            if maker is not None:
                return Leading(follower.contents, maker, follower.reader.grown, keeper)
            if standby == "warm":
                following = asyncio.ensure_future(follower.follow())
    finally:
        if following is not None:
            await end_tasks(following)
        await follower.begin_anew()


async def give_up(engine: Engine, me: str) -> None:
    """Give the lease up if this process has it; so it may be that asked for it and was cancelled before the answer."""
    with contextlib.suppress(Unanswered):  # Then it expires.
        if await engine.lease.holder() == me:
            token = await engine.lease.acquire(me)
            if token is not None:
                await engine.lease.release(token)


async def _take_lease(
    engine: Engine,
    me: str,
    standby: Standby | None,
    waits: Callable[[str], None],
    unanswered: Callable[[str], None],
    following: asyncio.Future[None] | None,
    patience: Patience,
) -> LeaseKeeper:
    """Wait for the lease, and return what keeps it."""
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
                    return LeaseKeeper(engine, me, token, asked)
                # After an outage that this process has seen, too, whoever led goes first: with its state in memory.
                await engine.lease.release(token)
                await asyncio.sleep(engine.lease.seconds)
                has_failed = False
                continue
            leader = await engine.lease.holder()
        except Unanswered as error:
            if patience.is_over():
                raise
            unanswered(error.problem)
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


async def _begin_epoch(
    engine: Engine, me: str, follower: Follower, keeper: LeaseKeeper, patience: float
) -> RecordMaker | None:
    """Append the beginning of an epoch behind all that stands in the log; `None` if the lease is over before that."""
    loop = asyncio.get_running_loop()
    attempt = uuid.uuid4().hex
    while True:
        await follower.catch_up()
        reader = follower.reader
        maker = RecordMaker(reader.epoch + 1, reader.at)
        record = maker.beginning(EpochBegun(me, attempt, FORMAT, time.time()))
        stands = await append_behind(engine, record, reader.at, patience)
        if isinstance(stands, int):
            reader.check_whole()
            maker.after = stands
            return maker
        if loop.time() > keeper.deadline:
            return None


class LeaseKeeper:
    """Keeps a lease that was taken. All methods are for the loop of the engine.

    Attributes:
        deadline: until when its holder relies on it, on the clock of the loop.

    Args:
        engine: keeps the lease.
        me: what the holder calls itself.
        token: of the lease.
        asked: when it was asked for, on the clock of the loop.
    """

    def __init__(self, engine: Engine, me: str, token: int, asked: float) -> None:
        self._lease, self._me = engine.lease, me
        self._token: int | None = token
        self._is_held = False
        self.deadline = asked + TRUSTED * engine.lease.seconds

    async def renew_while_reading(self, follower: Follower) -> None:
        """Renew the lease for as long as a candidate that has it gets on with reading the log, which may be long.

        One that does not lets the lease expire: others may be able to.
        """
        loop = asyncio.get_running_loop()
        at = follower.reader.at
        while self._token is not None:
            await asyncio.sleep(self._lease.seconds / RENEWALS)
            if follower.reader.at == at:
                continue
            at, asked = follower.reader.at, loop.time()
            with contextlib.suppress(Unanswered):
                self._token = await self._lease.renew(self._me, self._token)
                self.deadline = asked + TRUSTED * self._lease.seconds if self._token is not None else self.deadline

    async def run(self, *, hold: Callable[[], None], go_on: Callable[[], None], look: Callable[[], None]) -> None:
        """Renew the lease of a leader, for ever.

        Args:
            hold: called when another has the lease: nothing more is to be written, until `go_on`.
            go_on: called when it is ours again.
            look: called when it was lost, and when another has it: the leader is to look whether it still leads.
        """
        loop = asyncio.get_running_loop()
        lease = self._lease
        while True:
            await asyncio.sleep(lease.seconds / RENEWALS)
            asked = loop.time()
            try:
                if self._token is None:
                    self._token = await lease.acquire(self._me)
                    if self._token is None:
                        if not self._is_held and await lease.holder():
                            self._is_held = True
                            hold()
                            look()
                        continue
                    self._is_held = False
                    go_on()
                    look()  # Another may have led meanwhile: nothing is relied on before the next renewal.
                    continue
                self._token = await lease.renew(self._me, self._token)
                if self._token is None:
                    look()
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
