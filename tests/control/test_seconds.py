"""Whoever gives a number of seconds that is none is told so, by whatever way: one error, one sentence."""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from holdfast.console.remote import RemoteSystem
from holdfast.testing import idle, probe
from tests.control.conftest import Starter
from tests.control.players import Account, Add, Total

WRONG = {
    "None": None,
    "text": "5",
    "zero": 0,
    "negative": -1.0,
    "nan": math.nan,
    "inf": math.inf,
    "bool": True,
    "list": [5],
}

wrongs = pytest.mark.parametrize("value", WRONG.values(), ids=WRONG)


def says(where: str, name: str, value: object, sign: str = ">") -> str:
    """The sentence."""
    return f"{where}: {name} must be a finite number of seconds {sign} 0, not {value!r}"


def refused(where: str, name: str, value: object, sign: str = ">") -> Any:
    return pytest.raises(hf.SpecError, match=re.escape(says(where, name, value, sign)))


class Try(hf.Message[str]):
    """Do something with a number of seconds; the reply is what is said to it."""

    what: str
    seconds: Any
    whom: hf.ActorRef[Any]


class TryInThread(Try): ...


class Impatient(hf.Actor):
    @hf.on(Try)
    async def tries(self, message: Try) -> str:
        try:
            if message.what == "ask":
                return str(await message.whom.ask(Add(1), message.seconds))
            getattr(self.ctx, message.what)(message.seconds, Total())
        except hf.SpecError as error:
            return str(error)
        return "done"

    @hf.on(TryInThread, to_thread=True)
    def tries_in_thread(self, message: TryInThread) -> str:
        try:
            getattr(self.ctx, message.what)(message.seconds, Total())
        except hf.SpecError as error:
            return str(error)
        return "done"

    @hf.on(Total)
    def total(self, message: Total) -> int:
        return 0


@wrongs
async def test_an_ask_in_a_turn_and_one_from_outside(system: hf.ActorSystem, start_one: Starter, value: object) -> None:
    asker, other = await start_one(hf.start(Impatient)), await system.start(hf.child("other", hf.start(Account)))
    assert await asker.ask(Try("ask", value, other)) == says("/app/other", "timeout", value)
    assert await asker.ask(Try("every", value, other)) == says(asker.path, "interval", value)
    if value != 0:
        assert await asker.ask(Try("tell_after", value, other)) == says(asker.path, "delay", value, ">=")
    assert await asker.ask(Try("ask", 7, other)) == "1"
    with refused(asker.path, "timeout", value):
        asker.ask(Total(), value)  # type: ignore[arg-type]  # that is the point


@wrongs
async def test_timers_of_a_blocking_handler(system: hf.ActorSystem, value: object) -> None:
    asker = await system.start(hf.child("one", hf.start(Impatient)))
    assert await asker.ask(TryInThread("every", value, asker)) == says("/app/one", "interval", value)


async def test_a_bool_is_refused_beside_asks_that_wait_as_long(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    waits = one.ask(Add(1), timeout=1.0)
    with refused("/app/one", "timeout", True):
        one.ask(Add(1), timeout=True)
    assert await waits == 1


@wrongs
async def test_calls_from_a_thread(system: hf.ActorSystem, value: Any) -> None:
    one, handle = await system.start(hf.child("one", hf.start(Account))), system.from_thread()

    def calls() -> None:
        with refused("/app/one", "timeout", value):
            handle.ask(one, Add(1), value)
        with refused("/app/one", "timeout", value):
            asyncio.run(handle.ask_async(one, Add(1), value))

    await asyncio.to_thread(calls)
    assert await one.ask(Total()) == 0


ORDERS: dict[str, Callable[[hf.ActorSystem, Any, Any], Awaitable[Any]]] = {
    "suspend": lambda system, one, value: system.suspend(one, timeout=value),
    "resume": lambda system, one, value: system.resume(one, timeout=value),
    "get_state": lambda system, one, value: system.get_state(one, timeout=value),
    "replace_state": lambda system, one, value: system.replace_state(one, dict, timeout=value),
    "replace_code": lambda system, one, value: system.replace_code(one, Account, timeout=value),
    "statistics": lambda system, one, value: system.statistics(one, timeout=value),
    "trace": lambda system, one, value: system.trace(one, timeout=value),
    "terminate": lambda system, one, value: system.terminate(one, timeout=value),
    "checkpoint": lambda system, one, value: system.checkpoint(one, timeout=value),
}


@pytest.mark.parametrize("order", ORDERS)
async def test_orders(system: hf.ActorSystem, start_one: Starter, order: str) -> None:
    one = await start_one(hf.start(Account))
    for value in WRONG.values():
        with refused(one.path, "timeout", value):
            await ORDERS[order](system, one, value)
    assert await one.ask(Add(1)) == 1


@wrongs
async def test_moves_transactions_and_groups(system: hf.ActorSystem, value: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    with refused("set_isolation", "timeout", value):
        await system.set_isolation(one, "process", timeout=value)
    with refused("transaction", "timeout", value):
        system.transaction(timeout=value)
    with refused("restore_group", "timeout", value):
        await system.restore_group("all", timeout=value)


@wrongs
async def test_a_script_beside_the_system(system: hf.ActorSystem, tmp_path: Path, value: Any) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))

    async def script(remote: RemoteSystem) -> None:
        assert "/app/one" in remote.tree()
        for order in (remote.get_status, remote.get_state, remote.suspend, remote.terminate):
            with refused("/app/one", "timeout", value):
                await order("/app/one", timeout=value)
        if value is not None:  # There it means: as the system's own.
            with refused("transaction", "timeout", value):
                async with remote.transaction(timeout=value):
                    pass

    def run() -> None:
        with RemoteSystem(where) as remote:
            asyncio.run(script(remote))

    async with control_endpoint(system, tmp_path / "app.sock") as where:
        await asyncio.to_thread(run)
    assert await one.ask(Add(1)) == 1


@wrongs
async def test_jobs(system: hf.ActorSystem, value: Any) -> None:
    ref = await system.start(hf.supervision.tasks("jobs"))
    jobs = hf.supervision.Tasks(ref)
    job = jobs.start(int)
    if value is not None and value != 0:  # No limit; and whether it is over by now.
        with refused("/app/jobs", "timeout", value, ">="):
            await jobs.run(int, timeout=value)
        with refused("/app/jobs", "timeout", value, ">="):
            jobs.stream(int, [1], timeout=value)
        with refused("/app/jobs", "timeout", value, ">="):
            await jobs.outcomes([], timeout=value)
        with refused(job.path, "timeout", value, ">="):
            await job.outcome(timeout=value)
        with pytest.raises(hf.SpecError, match="shutdown must be seconds >= 0, 'brutal_kill' or 'infinity', not"):
            await job.stop(shutdown=value)
    assert await job == 0


@wrongs
async def test_the_test_kit(system: hf.ActorSystem, value: Any) -> None:
    with refused("idle", "timeout", value):
        await idle(system, timeout=value)
    if value is None or value == 0:
        return
    one = probe(system)
    with refused(one.path, "timeout", value, ">="):
        await one.expect(Total, timeout=value)
    with refused(one.path, "timeout", value, ">="):
        await one.expect_all(Total, timeout=value)
    with refused(one.path, "timeout", value, ">="):
        await one.fish(Total, timeout=value)
    with refused(one.path, "within", value, ">="):
        await one.expect_no_message(within=value)
    with refused(one.path, "within", value, ">="):
        async with one.within(value):
            pass
