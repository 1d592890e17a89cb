"""`ref.kill()` and `ref.stop()` in a turn of a recorded actor are outputs of it: carried out once, and compared."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import start, until
from tests.checkpoint.strikes import event, strike, struck
from tests.checkpoint.test_verbs import PATHS, method

pytestmark = [pytest.mark.pairs, pytest.mark.usefixtures("warm_programs")]

IN_TIME = 30.0
STARTED, RECOVERED = "on_start", "on_recovered"


class Give(hf.Message[int]):
    """Orders to the victim ("kill", "stop"), and "flush", "look" (an ask), "raise"."""

    steps: list[str]
    whom: str = ""


class Given(hf.Message[int]): ...


class Life(hf.Message[int]): ...


class Victim(hf.Actor):
    @hf.on(Life, readonly=True)
    def number(self, message: Life) -> int:
        return self.ctx.life


class Boss(hf.Actor):
    victim: hf.Binding[Victim]

    def __init__(self, hook: str = "") -> None:
        self.given = 0
        self._hook = hook

    def on_start(self, restored: bool) -> None:
        if self._hook == STARTED and not restored:
            self.victim.kill()

    def on_recovered(self) -> None:
        if self._hook == RECOVERED:
            self.victim.kill()

    @hf.on(Give)
    async def give(self, message: Give) -> int:
        self.given += 1
        victim: hf.ActorRef[Any] = self.ctx.find(message.whom, hf.Actor) if message.whom else self.victim
        for step in message.steps:
            match step:
                case "kill":
                    victim.kill()
                case "stop":
                    victim.stop()
                case "flush":
                    await self.ctx.flush()
                case "look":
                    await victim.ask(Life(), IN_TIME)
                case "link":
                    self.ctx.link(victim)
                case "wait":
                    await self.ctx.sleep(0.3)
                case "crash":
                    self.ctx.stop(hf.Crash("Tired", "of it"))
                case _:
                    raise RuntimeError("boom")
        return self.given

    @hf.on(Given, readonly=True)
    def count(self, message: Given) -> int:
        return self.given


VICTIMS: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
}


async def victim_at(system: hf.ActorSystem, victim: str = "task") -> hf.ActorRef[Victim]:
    return await system.start(hf.child("victim", hf.start(Victim), **VICTIMS[victim]))


async def boss_of(system: hf.ActorSystem, isolation: str, name: str = "hybrid", hook: str = "") -> hf.ActorRef[Boss]:
    bindings = {"victim": "/app/victim"}
    return await start(system, isolation, "boss", hf.start(Boss, hook), recovery=method(name), bindings=bindings)


async def is_in_life(victim: hf.ActorRef[Victim], number: int) -> None:
    """It comes to that life, and to no further one."""
    async with asyncio.timeout(IN_TIME):
        while await victim.ask(Life(), IN_TIME) < number:
            await asyncio.sleep(0.005)
    for _ in range(3):
        assert await victim.ask(Life(), IN_TIME) == number


@pytest.mark.parametrize("order", ["kill", "stop"])
@pytest.mark.parametrize("name", ["hybrid", "replay_only"])
@pytest.mark.parametrize("victim", list(VICTIMS))
async def test_it_is_carried_out_once(victim: str, name: str, order: str, isolation: str, store: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        other = await victim_at(system, victim)
        boss = await boss_of(system, isolation, name)
        for number in (1, 2):
            assert await boss.ask(Give([order]), IN_TIME) == number
            await is_in_life(other, number + 1)
        for _ in range(3):
            await struck(system, boss)
            assert await boss.ask(Given(), IN_TIME) == 2
            await is_in_life(other, 3)


@pytest.mark.parametrize("between", ["flush", "look"])
async def test_it_leaves_with_what_precedes_it(between: str, isolation: str, store: str) -> None:
    """A turn that raises has given no order, but for what it has released before."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        other = await victim_at(system)
        boss = await boss_of(system, isolation)
        for steps, number in ((["kill", "raise"], 1), (["kill", between, "raise"], 2)):
            with pytest.raises(hf.RemoteCrash):
                await boss.ask(Give(steps), IN_TIME)
            await boss.ask(Given(), IN_TIME)
            await is_in_life(other, number)


@pytest.mark.parametrize(("hook", "each_life"), [(STARTED, 0), (RECOVERED, 1)])
async def test_hooks_give_orders_as_they_tell(hook: str, each_life: int, isolation: str) -> None:
    """`on_start(False)` is a turn; `on_recovered` does it at each life."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        other = await victim_at(system)
        boss = await boss_of(system, isolation, hook=hook)
        number = 2 if hook == STARTED else 1
        await is_in_life(other, number)
        for life in (1, 2):
            await struck(system, boss)
            await boss.ask(Given(), IN_TIME)
            await is_in_life(other, number + life * each_life)


class Fickle(Boss):
    """Its code has changed since it was recorded."""

    @hf.on(Give)
    async def give(self, message: Give) -> int:
        self.given += 1
        if os.environ.get("FICKLE") != "spares":
            self.victim.kill()
        else:
            self.victim.stop()
        return self.given


async def test_a_replay_that_gives_another_order_diverges(monkeypatch: pytest.MonkeyPatch) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        other = await victim_at(system)
        backoff = hf.Backoff(0.01, 60.0, factor=1000.0)
        spec = hf.child(
            "boss", hf.start(Fickle), recovery=hf.hybrid(), bindings={"victim": other.path}, backoff=backoff
        )
        boss = await system.start(spec)
        await boss.ask(Give([]), IN_TIME)
        await is_in_life(other, 2)
        monkeypatch.setenv("FICKLE", "spares")
        with system.events() as stream:
            strike(system, boss)
            failed = await event(stream, hf.events.RecoveryFailed)
        assert "stop /app/victim" in failed.reason
        await is_in_life(other, 2)


@pytest.mark.parametrize("stack", ["pbr", "lfr", "tr", "tmr"])
async def test_behind_a_mechanism_it_is_given_once_per_request(stack: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        other = await victim_at(system)
        boss = await boss_of(system, "task")
        async with system.transaction(timeout=IN_TIME) as change:
            change.protect(boss, stack)
        for number in (1, 2, 3):
            assert await boss.ask(Give(["kill"]), IN_TIME) == number
            await is_in_life(other, number + 1)


LOSSES = (hf.events.TrustBreached, hf.events.ReplicaLost, hf.events.FailedOver, hf.events.MessageQuarantined)


@pytest.mark.parametrize("mechanism", [hf.ftm.LFR(), hf.ftm.TR()], ids=lambda one: one.name)
async def test_behind_a_mechanism_a_turn_ends_its_actor_once(mechanism: hf.ftm.Mechanism) -> None:
    """Whoever computes the turn does not die of it: its end is carried out once, at home."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await victim_at(system)
        options: dict[str, Any] = {"recovery": method("hybrid"), "bindings": {"victim": "/app/victim"}}
        boss = await system.start(hf.child("boss", hf.start(Boss), mechanism=mechanism, **options))
        for number, end in enumerate(("kill", "stop", "crash", "link"), 1):
            steps, whom = (["link", "kill"], "") if end == "link" else ([end], boss.path)
            with system.events() as stream:
                assert await boss.ask(Give(steps, whom), IN_TIME) == number
                told = [one async for one in until_recovered(stream)]
                assert await boss.ask(Given(), IN_TIME) == number
                told += stream.take()
            kinds = [type(one) for one in told if isinstance(one, (*LOSSES, hf.events.Recovered))]
            assert kinds == [hf.events.Recovered], end


async def until_recovered(stream: hf.events.EventStream) -> AsyncIterator[hf.events.Event]:
    async with asyncio.timeout(IN_TIME):
        async for one in stream:
            yield one
            if isinstance(one, hf.events.Recovered):
                return


@pytest.mark.parametrize("end", ["killed", "stopped"])
@pytest.mark.parametrize("name", ["hybrid", "replay_only"])
async def test_the_next_program_does_not_give_it_again(tmp_path: Path, name: str, end: str, isolation: str) -> None:
    store = tmp_path / "app.db"
    command = [sys.executable, "-m", "tests.checkpoint.orders_once_player", str(store), isolation, name, end]
    first = subprocess.run(command, env={**os.environ, "PYTHONPATH": PATHS}, timeout=60, check=False)
    assert first.returncode == (-9 if end == "killed" else 0)
    for _ in range(2):
        async with hf.ActorSystem("app", log=False, intensity=1000, store=f"sqlite:{store}") as system:
            other = await victim_at(system)
            boss = await boss_of(system, isolation, name)
            assert await boss.ask(Given(), IN_TIME) == 1
            await is_in_life(other, 1)


async def test_its_own_kill_comes_behind_the_turn(isolation: str, store: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        await victim_at(system)
        boss = await boss_of(system, isolation)
        path = boss.path
        with system.events() as stream:
            assert await boss.ask(Give(["kill"], path), IN_TIME) == 1
            assert (await event(stream, hf.events.Recovered)).address == path
            assert await boss.ask(Given(), IN_TIME) == 1
        with system.events() as stream:
            await struck(system, boss)
            assert await boss.ask(Give(["flush"]), IN_TIME) == 2


async def test_its_own_stop_is_an_end_by_itself(isolation: str) -> None:
    """As `ctx.stop`: its supervisor decides, here that a transient child is not started again."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await victim_at(system)
        bindings = {"victim": "/app/victim"}
        options = {"recovery": method("hybrid"), "bindings": bindings, "restart": "transient"}
        boss = await start(system, isolation, "boss", hf.start(Boss), **options)
        assert await boss.ask(Give(["stop"], boss.path), IN_TIME) == 1
        await until(lambda: boss._cell.is_dead or not boss._cell.host.is_up(boss._cell))


async def test_its_own_stop_behind_a_crash_is_carried_out_once(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await victim_at(system)
        boss = await boss_of(system, isolation)
        asked = boss.ask(Give(["wait", "stop"], boss.path), IN_TIME)
        await until(lambda: bool(boss._cell.host.rests(boss._cell)))
        with system.events() as stream:
            strike(system, boss)
            assert await asked == 1
            await event(stream, hf.events.Recovered)
            await event(stream, hf.events.Recovered)
            assert await boss.ask(Give([]), IN_TIME) == 2
            assert not [one for one in stream.take() if isinstance(one, hf.events.Recovered)]


async def test_one_that_has_moved_is_found_at_its_new_address() -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        await system.start(hf.supervisor("here", children=[hf.child("one", hf.start(Victim))], intensity=100))
        await system.start(hf.supervisor("there", intensity=100))
        await victim_at(system)
        boss = await boss_of(system, "task")
        one = system.ref("/app/here/one", Victim)
        async with system.transaction(timeout=IN_TIME) as change:
            change.bind(boss, "victim", one)
            change.move(one, "/app/there")
        before = await one.ask(Life(), IN_TIME)
        for path in ("/app/here/one", ""):
            before += 1
            await boss.ask(Give(["kill"], path), IN_TIME)
            await is_in_life(one, before)


async def test_one_that_is_not_started_hears_of_nothing(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        first = await victim_at(system)
        boss = await boss_of(system, isolation)
        await system.stop(first)
        for number, order in enumerate(("kill", "stop"), 1):
            assert await boss.ask(Give([order]), IN_TIME) == number
        other = await victim_at(system)
        await struck(system, boss)
        await is_in_life(other, 1)


class Meddler(hf.Actor):
    """Orders somebody from its process whom nothing grants."""

    @hf.on(Give)
    def give(self, message: Give) -> int:
        self.ctx.find(message.whom, Victim).kill()
        return 1


async def test_a_process_orders_those_alone_whom_a_binding_grants() -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        other = await victim_at(system)
        spec = hf.child("meddler", hf.start(Meddler), recovery=hf.hybrid(), isolation="process")
        meddler = await system.start(spec)
        with pytest.raises(hf.RemoteCrash, match="NotGranted"):
            await meddler.ask(Give([], other.path), IN_TIME)
        await is_in_life(other, 1)
