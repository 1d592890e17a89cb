"""What is protected in these tests: a counter that notes whom it has heard, and a bank that asks its accounts."""

from __future__ import annotations

import asyncio
import dataclasses
import os
from pathlib import Path
from typing import Any

import holdfast as hf


class Add(hf.Message[int]):
    tag: int
    amount: int = 1


class Total(hf.Message[int]): ...


class Tags(hf.Message[list[int]]): ...


class Die(hf.Message[None]): ...


class Boom(hf.Message[None]): ...


class Leave(hf.Message[None]): ...


class Later(hf.Message[None]):
    seconds: float
    tag: int


class Counter(hf.Actor):
    """Adds up, and notes each message's tag: what was handled twice stands there twice."""

    def __init__(self, first: int = 0) -> None:
        self.total = first
        self.tags: list[int] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.amount
        self.tags.append(message.tag)
        return self.total

    @hf.on(Total, readonly=True)
    def read(self, message: Total) -> int:
        return self.total

    @hf.on(Tags, readonly=True)
    def seen(self, message: Tags) -> list[int]:
        return self.tags

    @hf.on(Die)
    def die(self, message: Die) -> None:
        os._exit(3)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        self.total = -1
        raise ValueError("boom")

    @hf.on(Leave)
    def leave(self, message: Leave) -> None:
        self.ctx.stop()

    @hf.on(Later)
    def later(self, message: Later) -> None:
        self.ctx.tell_after(message.seconds, Add(message.tag))


class Closed(Counter):
    state_access = False


class Fussy(Counter):
    """Does not want to come back as long as there is a file."""

    def __init__(self, veto: str) -> None:
        super().__init__()
        self._veto = Path(veto)

    def on_start(self, restored: bool) -> None:
        if self._veto.exists():
            raise RuntimeError("not now")


class Put(hf.Message[int]):
    amount: int


class Account(hf.Actor):
    """An ordinary actor, which is never killed: what it has was really sent, and as often."""

    def __init__(self, balance: int) -> None:
        self.balance = balance
        self.puts = 0

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.balance += message.amount
        self.puts += 1
        return self.balance


class Pay(hf.Message[int]):
    amount: int


class Purse(hf.Actor):
    """Asks whoever it is bound to."""

    account: hf.Binding[Account]

    @hf.on(Pay)
    async def pay(self, message: Pay) -> int:
        return await self.account.ask(Put(message.amount))


class Transfer(hf.Message[int]):
    tag: int
    amount: int


class Bank(hf.Actor):
    """Moves money between two accounts, by asks in the middle of its turns; notes what it has done."""

    one: hf.Binding[Account]
    other: hf.Binding[Account]

    def __init__(self) -> None:
        self.done: list[int] = []

    @hf.on(Transfer)
    async def transfer(self, message: Transfer) -> int:
        await self.one.ask(Put(-message.amount))
        await self.other.ask(Put(message.amount))
        self.done.append(message.tag)
        return len(self.done)

    @hf.on(Tags, readonly=True)
    def seen(self, message: Tags) -> list[int]:
        return self.done


@dataclasses.dataclass
class Load:
    """Clients that ask one after the other until they are told to stop; each ask has a tag of its own."""

    ref: hf.ActorRef[Any]
    clients: int = 4
    make: Any = Add
    sent: int = 0
    answered: dict[int, int] = dataclasses.field(default_factory=dict)
    failed: dict[int, BaseException] = dataclasses.field(default_factory=dict)
    longest: float = 0.0

    def __post_init__(self) -> None:
        self._stopping = False
        self._tasks = [asyncio.create_task(self._client()) for _ in range(self.clients)]

    async def _client(self) -> None:
        loop = asyncio.get_running_loop()
        while not self._stopping:
            tag = self.sent
            self.sent += 1
            begin = loop.time()
            try:
                self.answered[tag] = await self.ref.ask(self.make(tag, 1), timeout=30.0)
            except hf.HoldfastError as error:
                self.failed[tag] = error
                return  # It is seen in the end.
            self.longest = max(self.longest, loop.time() - begin)

    async def reached(self, answers: int) -> None:
        """Wait until so many more have been answered."""
        goal = len(self.answered) + answers
        async with asyncio.timeout(60):
            while len(self.answered) < goal:
                assert len(self.failed) < self.clients, f"nobody is left who asks: {self.failed}"
                await asyncio.sleep(0.001)

    async def stop(self) -> None:
        self._stopping = True
        await asyncio.gather(*self._tasks)

    def check(self, tags: list[int]) -> None:
        """Nothing lost, nothing wrong, nothing doubled."""
        assert not self.failed, f"lost: {list(self.failed.items())[:3]}"
        assert len(tags) == len(set(tags)), "handled twice"
        lost, invented = sorted(set(range(self.sent)) - set(tags)), sorted(set(tags) - set(range(self.sent)))
        assert not lost, f"lost {len(lost)} of {self.sent}: {lost[:5]} to {lost[-1]}"
        assert not invented, f"invented: {invented[:5]}"
        place = {tag: index + 1 for index, tag in enumerate(tags)}
        wrong = {tag: (reply, place[tag]) for tag, reply in self.answered.items() if reply != place[tag]}
        assert not wrong, f"wrong answers: {list(wrong.items())[:3]}"
