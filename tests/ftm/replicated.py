"""What is replicated in the tests of bricks: an actor that does a bit of everything, and variants of it."""

from __future__ import annotations

import asyncio
import os
import random
from typing import Any

import holdfast as hf
from holdfast.checkpoint.protocol import OK, REPLY, Answer
from holdfast.ftm.bricks.replica_orders import SetPeer
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.driver import Driver


class Add(hf.Message[int]):
    n: int


class Fail(hf.Message[int]):
    n: int


class Read(hf.Message[list[int]]): ...


class Fetch(hf.Message[int]):
    """Ask somebody else, then add what it says."""

    n: int


class Say(hf.Message[int]):
    """Tell somebody else."""

    n: int


class Put(hf.Message[int]):
    """Put the message aside until `Back`."""

    n: int


class Back(hf.Message[int]): ...


class Guess(hf.Message[int]): ...


class Quit(hf.Message[int]): ...


class Trap(hf.Message[bool]):
    """Trap exits from now on, or say whether it does."""

    on: bool


class Spoil(hf.Message[int]):
    """Leave behind what nobody can save."""

    n: int


class Other(hf.Actor):
    """Somebody else; the driver answers in its place."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        return message.n


class Total(hf.Actor):
    """Adds up; its state says what was handled, in order."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.is_open = False

    @property
    def other(self) -> hf.ActorRef[Any]:
        return self.ctx.find("/app/other", Other)

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return sum(self.seen)

    @hf.on(Fail)
    def fail(self, message: Fail) -> int:
        self.seen.append(message.n)
        raise RuntimeError(f"no {message.n}")

    @hf.on(Read, readonly=True)
    def read(self, message: Read) -> list[int]:
        return self.seen

    @hf.on(Fetch)
    async def fetch(self, message: Fetch) -> int:
        self.seen.append(-message.n)
        self.seen.append(await self.other.ask(Add(message.n)))
        return sum(self.seen)

    @hf.on(Say)
    def say(self, message: Say) -> int:
        self.other.tell(Add(message.n))
        self.seen.append(message.n)
        return sum(self.seen)

    @hf.on(Put)
    def put(self, message: Put) -> Any:
        if not self.is_open:
            self.ctx.stash()
            return None
        self.seen.append(message.n)
        return sum(self.seen)

    @hf.on(Back)
    def back(self, message: Back) -> int:
        self.is_open = True
        self.ctx.unstash()
        return sum(self.seen)

    @hf.on(Guess)
    def guess(self, message: Guess) -> int:
        self.seen.append(int.from_bytes(os.urandom(3), "little"))
        return sum(self.seen)

    @hf.on(Trap)
    def trap(self, message: Trap) -> bool:
        if message.on:
            self.ctx.trap_exits = True
        return self.ctx.trap_exits

    @hf.on(Spoil)
    def spoil(self, message: Spoil) -> int:
        self.seen.append(message.n)
        self.spoilt = object()
        return sum(self.seen)

    @hf.on(Quit)
    def quit(self, message: Quit) -> int:
        self.ctx.stop()
        return sum(self.seen)


class Closed(Total):
    """Nobody can look into it."""

    state_access = False


class Large(hf.Actor):
    """Says what has changed."""

    def __init__(self) -> None:
        self.values: dict[int, int] = dict.fromkeys(range(1000), 0)
        self._changed: dict[int, int] = {}

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.values[message.n] = self._changed[message.n] = self.values.get(message.n, 0) + 1
        return self.values[message.n]

    @hf.on(Read, readonly=True)
    def read(self, message: Read) -> list[int]:
        return [key for key, value in self.values.items() for _ in range(value)]

    @hf.on(Fail)
    def fail(self, message: Fail) -> int:
        self.values[message.n] = self._changed[message.n] = 99
        raise RuntimeError(f"no {message.n}")

    def get_state(self) -> dict[int, int]:
        return self.values

    def set_state(self, state: dict[int, int]) -> None:
        self.values = state

    def get_delta(self) -> dict[int, int]:
        changed, self._changed = self._changed, {}
        return changed

    def apply_delta(self, delta: dict[int, int]) -> None:
        self.values.update(delta)


def doubled(system: hf.ActorSystem) -> Any:
    """Answers an ask of the protected actor: twice the number."""

    def answer(out: Any) -> Answer | None:
        if out.verb != "ask":
            return None
        message = system._node.codec.decode(Add, out.body)
        return Answer(REPLY, "", system._node.codec.encode(2 * message.n, ""))

    return answer


async def pair(
    system: hf.ActorSystem, kind: Any = Total, *layers: Any, others: tuple[str, ...] = ("r2",), **setting: Any
) -> Driver:
    """A primary that has handled turn 0, and a backup that has joined it."""
    await system.start(hf.child("other", hf.start(Other)))
    recipe = kind if isinstance(kind, hf.Start) else hf.start(kind)
    driver = Driver(system, recipe, layers or (PBR(),))
    driver.outside = doubled(system)
    await driver.start(("r1", *others), **setting)
    await driver.begin(*others)
    return driver


async def traffic(driver: Driver, dice: random.Random, sent: list[int]) -> None:
    """Bursts of requests of all kinds (their keys go to `sent`), and a moment in which some are handled."""
    for _ in range(dice.randint(1, 4)):
        kinds: list[Any] = [Add, Add, Add, Fetch, Say, Fail]
        sent += driver.send(*(dice.choice(kinds)(len(sent) + n) for n in range(dice.randint(1, 12))))
    for _ in range(dice.randint(0, 60)):
        await asyncio.sleep(0)


async def all_once(driver: Driver, system: hf.ActorSystem, sent: list[int]) -> None:
    """Each request has its answer, and has been handled once."""
    expected: list[int] = []
    for key in sent:
        end = await driver.until(key)
        message = system._node.codec.decode(driver.kinds[key], driver.feeds[key].body)
        if isinstance(message, Fetch):
            expected += [-message.n, 2 * message.n]
        elif not isinstance(message, Fail):
            expected.append(message.n)
        assert end.status == ("failed" if isinstance(message, Fail) else OK)
    assert sorted(await driver.ask(Read())) == sorted(expected)
    assert driver.doubled == []


async def kills_of_two(driver: Driver, system: hf.ActorSystem, dice: random.Random) -> None:
    """The primary or the backup ends again and again while requests flow (A44-A59): nothing is lost or doubled."""
    sent: list[int] = []
    backup = "r2"
    for step in range(12):
        await traffic(driver, dice, sent)
        new = f"n{step}"
        await driver.add(new)
        if dice.random() < 0.7:
            await driver.stop_replica(driver.primary)
            await driver.fail_over(backup)
        else:
            await driver.stop_replica(backup)
            await driver.protocol(driver.primary).ask(SetPeer(driver.epoch, None))
        await driver.join(new)
        backup = new
    await all_once(driver, system, sent)
