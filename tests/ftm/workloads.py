"""What clients do in the campaign, and how it is judged: a counter, a bank with transfers, a key-value store."""

from __future__ import annotations

import asyncio
import dataclasses
import random
from collections import Counter as Tally
from typing import Any

import holdfast as hf
from holdfast.testing import History, linearizable
from tests.ftm import accounts, store

CLIENTS = 4


@dataclasses.dataclass
class Bad:
    """Numbers of requests that went wrong, by how."""

    lost: list[int] = dataclasses.field(default_factory=list)
    wrong: list[int] = dataclasses.field(default_factory=list)
    doubled: list[int] = dataclasses.field(default_factory=list)

    def all(self) -> set[int]:
        return {*self.lost, *self.wrong, *self.doubled}


class Workload:
    """Clients that ask one after the other; each ask has a number of its own."""

    main = ""
    """The message that changes something."""
    read = ""
    """The one whose answer says most; "": the same."""

    def __init__(self, timeout: float, rng: random.Random) -> None:
        self.timeout, self.rng = timeout, rng
        self.sent = 0
        self.answered: dict[int, Any] = {}
        self.failed: dict[int, BaseException] = {}
        self._stopping = False
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self, system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
        raise NotImplementedError

    async def one(self, client: int, number: int) -> Any:
        raise NotImplementedError

    async def bad(self) -> Bad:
        raise NotImplementedError

    def begin(self) -> None:
        self._tasks = [asyncio.create_task(self._client(client)) for client in range(CLIENTS)]

    async def _client(self, client: int) -> None:
        while not self._stopping:
            number = self.sent
            self.sent += 1
            try:
                self.answered[number] = await self.one(client, number)
            except hf.HoldfastError as error:
                self.failed[number] = error
                await asyncio.sleep(0.01)

    @property
    def done(self) -> int:
        return len(self.answered) + len(self.failed)

    async def reached(self, more: int) -> None:
        goal = self.done + more
        async with asyncio.timeout(120):
            while self.done < goal:
                await asyncio.sleep(0.001)

    async def stop(self) -> None:
        self._stopping = True
        await asyncio.gather(*self._tasks)

    def abandon(self) -> None:
        """Whoever still waits for an answer waits no longer."""
        for task in self._tasks:
            task.cancel()


def judged(answered: dict[int, Any], failed: dict[int, BaseException], tags: list[int]) -> Bad:
    """Of an actor that notes the numbers it handles, and answers how many (or their sum)."""
    bad = Bad()
    seen = Tally(tags)
    bad.doubled = [tag for tag, times in seen.items() if times > 1]
    bad.lost = [tag for tag in answered if tag not in seen]
    bad.wrong = [tag for tag in seen if tag not in answered and tag not in failed]
    offset = 0
    for place, tag in enumerate(tags, 1):
        reply = answered.get(tag)
        if reply is not None and reply != place + offset:
            bad.wrong.append(tag)
            offset = reply - place
    return bad


class Counting(Workload):
    main = "Add"

    async def start(self, system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
        self.ref = await system.start(hf.child("c", hf.start(accounts.Counter), mechanism=mechanism))
        return self.ref

    async def one(self, client: int, number: int) -> Any:
        return await self.ref.ask(accounts.Add(number, 1), timeout=self.timeout)

    async def bad(self) -> Bad:
        return judged(self.answered, self.failed, await self.ref.ask(accounts.Tags(), timeout=30))


class Banking(Workload):
    main = "Transfer"

    async def start(self, system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
        self.accounts = [
            await system.start(hf.child(name, hf.start(accounts.Account, 1000))) for name in ("one", "two")
        ]
        bindings = {"one": self.accounts[0].path, "other": self.accounts[1].path}
        spec = hf.child("bank", hf.start(accounts.Bank), mechanism=mechanism, bindings=bindings)
        self.ref = await system.start(spec)
        return self.ref

    async def one(self, client: int, number: int) -> Any:
        return await self.ref.ask(accounts.Transfer(number, 1), timeout=self.timeout)

    async def bad(self) -> Bad:
        tags = await self.ref.ask(accounts.Tags(), timeout=30)
        bad = judged(self.answered, self.failed, tags)
        moved = [1000 - await self.accounts[0].ask(accounts.Put(0)), await self.accounts[1].ask(accounts.Put(0)) - 1000]
        if not self.failed and moved != [len(tags)] * 2:
            bad.wrong.append(self.sent - 1)
        return bad


class Storing(Workload):
    main = "Write"
    read = "Look"

    async def start(self, system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
        self.history = History()
        self.ref = await system.start(hf.child("kv", hf.start(store.Store), mechanism=mechanism))
        return self.ref

    async def one(self, client: int, number: int) -> Any:
        key, rng = f"k{self.rng.randrange(8)}", self.rng
        kind = rng.choice(("write", "read", "cas"))
        old, new = rng.choice((None, number - 1, number - 3)), number
        message: Any = {"write": store.Write(key, new), "read": store.Look(key), "cas": store.Cas(key, old, new)}[kind]
        return await self.history.ask(self.ref, message, self.timeout, client=f"c{client}")

    async def bad(self) -> Bad:
        found = await asyncio.to_thread(linearizable, self.history, store.MODEL)
        return Bad() if found else Bad(wrong=[self.sent - 1])


WORKLOADS: dict[str, type[Workload]] = {"counter": Counting, "bank": Banking, "store": Storing}
