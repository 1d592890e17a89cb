"""Passive replication, brick by brick: replicas in this process, and a small home that feeds them."""

from __future__ import annotations

from typing import Any

import pytest
from tests.ftm.driver import Driver

import holdfast as hf
from holdfast.actors.exits import SHUTDOWN, pack_exit
from holdfast.ftm.mechanisms.pbr import PBR


class Add(hf.Message[int]):
    n: int


class Fail(hf.Message[int]):
    n: int


class Read(hf.Message[list[int]]): ...


class Total(hf.Actor):
    """Adds up; its state says what was handled, in order."""

    def __init__(self) -> None:
        self.seen: list[int] = []

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


async def pair(system: hf.ActorSystem, kind: Any = Total, *layers: Any) -> Driver:
    driver = Driver(system, hf.start(kind), layers or (PBR(),))
    await driver.start()
    await driver.begin("r2")
    return driver


async def test_a_backup_that_leads_goes_on_where_the_primary_was() -> None:
    async with hf.ActorSystem("app") as system:
        driver = await pair(system)
        assert await driver.ask(Add(1)) == 1
        assert await driver.ask(Add(2)) == 3
        await driver.stop_replica("r1")
        await driver.fail_over("r2")
        assert await driver.ask(Add(3)) == 6
        assert await driver.ask(Read()) == [1, 2, 3]


async def test_finish_takes_a_last_snapshot() -> None:
    from holdfast.ftm.orders import Finish

    async with hf.ActorSystem("app") as system:
        driver = await pair(system)
        assert await driver.ask(Add(1)) == 1
        await driver.protocol("r1").ask(Finish(driver.epoch, pack_exit(SHUTDOWN)))
        assert [type(one).__name__ for one in driver.more] == ["Snapshot"]
