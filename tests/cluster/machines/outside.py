"""Clients outside of a fleet, and the judge of what they have heard, and of what stands in the log.

Clients ask whoever has a socket, also who was deposed. Each request is sent once: an answer that does not come leaves
an operation of which nobody knows. The judge wants

- what was heard, and what the books say of what nobody heard of, to be linearizable, for each key;
- no answer of a leader behind an answer of a later one;
- each add that was answered to be done once, and each that was not at most once;
- the audit to be told of all that was done, once and in order;
- a follower of the log from its beginning and one that reads it at the end to have the same.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import random
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from holdfast.cluster.leadership import Follower
from holdfast.cluster.log_writer import insist
from holdfast.cluster.nats.nats_engine import NatsEngine
from holdfast.testing import UNKNOWN, History, Model, Operation, linearizable
from tests.cluster.servers import PATIENCE

ANSWER_SECONDS = 1.5
"""How long a client waits for an answer before it asks somebody else."""
PER_KEY = 60
"""Operations on one key: the checker is quick with many small histories."""
PAUSE = 0.02
"""Seconds between two requests, and between two looks."""


def added(sums: int, message: tuple[str, int, int]) -> tuple[int, int]:
    """What an add or a look does to a key, if it is done alone."""
    what, _, amount = message
    return (sums + amount, sums + amount) if what == "add" else (sums, sums)


MODEL: Model[int] = Model(0, added, key=lambda operation: operation.to)


class Clients:
    """Clients that ask for as long as they are let.

    Attributes:
        history: what they have asked and heard.
        leader: the process that has answered last, 0 before, and `epoch` the one it leads in.
        answered: how many requests were answered.
        size: bytes that an add is made larger by.

    Args:
        socket: of whoever leads; all programs have theirs beside it.
        count: how many clients there are.
        seed: for what they ask whom.
        pause: seconds between two requests of a client; twice as long at most.
    """

    def __init__(self, socket: Path, count: int, seed: int, pause: float = PAUSE) -> None:
        self.history = History()
        self.leader = self.epoch = self.answered = self.size = 0
        self._socket, self._seed, self._pause = socket, seed, pause
        self._numbers = itertools.count(1)
        self._answers: list[tuple[int, int, int]] = []  # (epoch, number of the operation, epoch known when it began)
        self._told: set[int] = set()
        self._progress = asyncio.Event()
        self._tasks = [asyncio.ensure_future(self._ask_on(number)) for number in range(count)]

    async def progress(self, answers: int, *, beside: int = 0) -> None:
        """Wait until so many more requests were answered, by any process but that one."""
        left = answers
        async with asyncio.timeout(PATIENCE):
            while left:
                self._progress.clear()
                before = self.answered
                stopped = next((task for task in self._tasks if task.done()), None)
                assert stopped is None, stopped
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._progress.wait(), 1.0)
                if self.leader != beside:
                    left = max(0, left - (self.answered - before))

    async def request(self, what: dict[str, Any]) -> Any:
        """Ask whoever leads for something that is no operation, until it is answered."""
        async with asyncio.timeout(PATIENCE):
            while True:
                with contextlib.suppress(OSError, TimeoutError, EOFError):
                    async with asyncio.timeout(ANSWER_SECONDS), Connection(self._socket) as connection:
                        return (await connection.ask(what))["answer"]
                await asyncio.sleep(PAUSE)

    async def close(self) -> None:
        """End all clients."""
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)

    async def stop(self) -> None:
        """End all clients, and look at the keys once more."""
        await self.close()
        for key in dict.fromkeys(operation.to for operation in self.history.operations):
            number = self.history.begin("last", ("look", 0, 0), to=key)
            self.history.end(number, await self.request({"of": key}))

    async def _ask_on(self, client: int) -> None:
        draws = random.Random(f"{self._seed} client {client}")
        connection: Connection | None = None
        try:
            while True:
                await asyncio.sleep(self._pause * draws.uniform(1, 2))
                if connection is None or draws.random() < 0.05:
                    if connection is not None:
                        await connection.close()
                    connection = await self._connected(draws)
                if connection is not None and not await self._ask_once(connection, f"client {client}", draws):
                    await connection.close()
                    connection = None
        finally:
            if connection is not None:
                await connection.close()

    async def _connected(self, draws: random.Random) -> Connection | None:
        sockets = [self._socket, *self._socket.parent.glob(f"{self._socket.name}.[0-9]*")]
        connection = Connection(draws.choice(sockets))
        try:
            await connection.open()
        except OSError:
            return None
        return connection

    async def _ask_once(self, connection: Connection, client: str, draws: random.Random) -> bool:
        """One operation; false if nobody knows what has become of it."""
        number = next(self._numbers)
        key, epoch = f"key {number // PER_KEY}", self.epoch
        if draws.random() < 0.3:
            message = ("look", 0, 0)
            request: dict[str, Any] = {"of": key}
        else:
            amount = draws.randrange(1, 1000)
            message = ("add", number, amount)
            request = {"add": number, "to": key, "amount": amount, "size": self.size}
        operation = self.history.begin(client, message, to=key)
        try:
            async with asyncio.timeout(ANSWER_SECONDS):
                answer = await connection.ask(request)
        except (OSError, TimeoutError, EOFError):
            return False
        self.history.end(operation, answer["answer"])
        self._answers.append((answer["epoch"], operation, epoch))
        if message[0] == "add":
            self._told.add(number)
        if answer["epoch"] >= self.epoch:
            self.leader, self.epoch = answer["pid"], answer["epoch"]
        self.answered += 1
        self._progress.set()
        return True

    # The judge

    async def judge(self) -> None:
        """Judge all that was heard; the clients have stopped, and somebody leads."""
        for epoch, operation, known in self._answers:
            assert epoch >= known, f"operation {operation} was answered in epoch {epoch}, behind epoch {known}"
        done, audited = await self._books()
        linearizable(self._witnessed(done), MODEL).verify()
        assert len({*done}) == len(done), f"done twice: {doubled(done)}"
        assert self._told <= {*done}, f"answered and not done: {sorted(self._told - {*done})}"
        asked = {operation.message[1] for operation in self.history.operations}
        assert {*done} <= asked, f"done and never asked for: {sorted({*done} - asked)}"
        assert audited == done, f"the audit was told of others, or in another order: {doubled(audited)}"

    def _witnessed(self, done: list[int]) -> list[Operation]:
        """The history, in which the books say what became of adds that nobody answered: at a long outage there are
        so many that the checker would have to try each subset of them.
        """
        operations = self.history.operations
        adds = {one.message[1]: one for one in operations if one.message[0] == "add"}
        sums, after = Counter[str](), dict[int, int]()
        for number in dict.fromkeys(done):
            if (add := adds.get(number)) is not None:
                sums[add.to] += add.message[2]
                after[number] = sums[add.to]
        last = max((one.end for one in operations if one.outcome is not UNKNOWN), default=0.0) + 1.0
        heard = [one for one in operations if one.outcome is not UNKNOWN]
        return heard + [
            replace(one, end=last, outcome=after[one.message[1]])
            for one in operations
            if one.outcome is UNKNOWN and one.message[1] in after
        ]

    async def _books(self) -> tuple[list[int], list[int]]:
        async with asyncio.timeout(PATIENCE):
            while True:
                done, audited = await self.request({"books": True})
                if len(done) <= len(audited):
                    return done, audited
                await asyncio.sleep(PAUSE)  # What was told last is on its way.


def doubled(ids: list[int]) -> list[int]:
    """Those that are there more than once."""
    return sorted({one for one in ids if ids.count(one) > 1})


class Connection:
    """A connection to a program."""

    def __init__(self, socket: Path) -> None:
        self._socket = socket

    async def __aenter__(self) -> Connection:
        await self.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def open(self) -> None:
        """Connect."""
        self._reader, self._writer = await asyncio.open_unix_connection(str(self._socket), limit=1 << 24)

    async def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request, and return the answer with who gives it."""
        self._writer.write(json.dumps(request).encode() + b"\n")
        answer: dict[str, Any] = json.loads(await self._reader.readuntil())
        return answer

    async def close(self) -> None:
        """Let go of it."""
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()


class LogWatch:
    """Follows the log of a system from its beginning.

    Args:
        opened: makes an engine of that system; it is asked again for the comparison at the end.
    """

    def __init__(self, opened: Callable[[], Awaitable[NatsEngine]]) -> None:
        self._opened = opened

    async def start(self) -> None:
        """Begin to follow."""
        self._engine = await insist(self._opened)
        self._follower = Follower(self._engine)
        self._following = asyncio.ensure_future(self._follower.follow())

    async def judge(self) -> None:
        """Compare with what somebody else reads now; nobody writes any more."""
        engine = await insist(self._opened)
        other = Follower(engine)
        try:
            async with asyncio.timeout(PATIENCE):
                await insist(other.catch_up)
                while self._follower.reader.at < other.reader.at and not self._following.done():
                    await asyncio.sleep(PAUSE)
            assert not self._following.done(), self._following
            assert [*self._follower.contents.as_changes()] == [*other.contents.as_changes()]
            assert self._follower.reader.epoch == other.reader.epoch
        finally:
            await other.begin_anew()
            await engine.close()

    async def close(self) -> None:
        """Follow no longer."""
        self._following.cancel()
        await asyncio.wait([self._following])
        await self._follower.begin_anew()
        await self._engine.close()
