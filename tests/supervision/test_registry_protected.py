"""What a registry has of holders that live on when their life ends: the keys of their start, and locks."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision import Registry, RegistryActor
from tests.checkpoint.players import until

PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "hybrid": {"recovery": hf.hybrid(interval=3600.0)},
    "hybrid process": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
    "checkpoint_only": {"recovery": hf.checkpoint_only(3600.0)},
    "pbr": {"mechanism": hf.ftm.PBR()},
    "lfr": {"mechanism": hf.ftm.LFR()},
    "tr": {"mechanism": hf.ftm.TR()},
    "hybrid pbr": {"mechanism": hf.ftm.PBR(), "recovery": hf.hybrid(interval=3600.0)},
}
PROTECTED = [place for place, options in PLACES.items() if "mechanism" in options]
GOES_ON = ("hybrid", "hybrid process", "hybrid pbr")
"""Where the next life goes on with the turn in hand."""


class Enter(hf.Message):
    """From within the block: whoever asks waits there until the door is opened."""


class Open(hf.Message): ...


class Doorkeeper(hf.Actor):
    def __init__(self, entered: asyncio.Event) -> None:
        self._entered = entered
        self._inside: list[hf.ReplyHandle[None]] = []

    @hf.on(Enter)
    def enter(self, message: Enter) -> hf.ReplyHandle[None]:
        self._inside.append(self.ctx.reply_handle())
        self._entered.set()
        return self._inside[-1]

    @hf.on(Open)
    def open(self, message: Open) -> None:
        for handle in self._inside:
            handle.reply(None)


class Work(hf.Message):
    crashes: str = ""
    begun: str = ""  # a file, to which each life adds a letter when it is in the block, and waits there


class Count(hf.Message[int]): ...


class Locker(hf.Actor):
    names: hf.Binding[RegistryActor]
    door: hf.Binding[Doorkeeper]

    def __init__(self) -> None:
        self.count = 0

    async def on_start(self, restored: bool) -> None:
        await Registry[str, None](self.names).register("locker")

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        async with Registry[str, None](self.names).lock("k"):
            if message.crashes == "inside":
                raise RuntimeError("in the block")
            if message.begun:
                with Path(message.begun).open("a") as file:
                    file.write("x")
                await asyncio.Event().wait()
            if not message.crashes:
                await self.door.ask(Enter(), timeout=60.0)
        if message.crashes:
            raise RuntimeError("behind the block")

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.count += 1
        return self.count


async def open_house(
    system: hf.ActorSystem, place: str, above: Any = "task"
) -> tuple[hf.ActorRef[Locker], Registry[str, None], asyncio.Event]:
    entered = asyncio.Event()
    await system.start(hf.child("door", hf.start(Doorkeeper, entered)))
    bindings = {"names": "/app/house/names", "door": "/app/door"}
    locker = hf.child("locker", hf.start(Locker), bindings=bindings, **PLACES[place])
    names = hf.supervision.registry("names")
    await system.start(hf.supervisor("house", children=[names, locker], intensity=100, isolation=above))
    registry = system.ref("/app/house/names", RegistryActor)
    return system.ref("/app/house/locker", Locker), Registry(registry, timeout=60.0), entered


@pytest.mark.parametrize("where", ["inside", "behind"])
@pytest.mark.parametrize("place", PLACES)
async def test_a_lock_is_free_again_when_the_turn_has_crashed(place: str, where: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        locker, names, _ = await open_house(system, place)
        with pytest.raises(hf.RemoteCrash, match="the block"):
            await locker.ask(Work(where), timeout=60.0)
        async with names.lock("k"):
            assert await locker.ask(Count(), timeout=60.0) == 1


@pytest.mark.parametrize("above", ["task", "process"])
@pytest.mark.parametrize("place", PLACES)
async def test_a_lock_is_kept_over_a_kill_only_where_the_turn_goes_on(place: str, above: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        locker, names, entered = await open_house(system, place, above)
        working = locker.ask(Work(), timeout=60.0)
        await asyncio.wait_for(entered.wait(), 60.0)
        if place in GOES_ON:
            waiting = asyncio.ensure_future(names.lock("k").__aenter__())
            with system.events() as events:
                locker.kill()
                await until(lambda: any(isinstance(event, hf.events.Recovered) for event in events.take()))
            assert await names.count() == 1
            assert not waiting.done()
            system.ref("/app/door", Doorkeeper).tell(Open())
            await working
            await waiting
            return
        locker.kill()
        async with names.lock("k"):
            with pytest.raises(hf.errors.AskFailed):
                await working


@pytest.mark.parametrize("place", GOES_ON)
async def test_a_lock_of_a_turn_that_is_put_aside_is_free(place: str, tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    begun.touch()
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        locker, names, _ = await open_house(system, place)
        working = asyncio.ensure_future(locker.ask(Work(begun=str(begun)), timeout=60.0))
        for times in (1, 2, 3):
            await until(lambda times=times: begun.read_text() == "x" * times)
            locker.kill()
        async with names.lock("k"):
            with pytest.raises(hf.Quarantined):
                await working
            assert await locker.ask(Count(), timeout=60.0) == 1


@pytest.mark.parametrize("how", ["crash", "kill"])
@pytest.mark.parametrize("place", PROTECTED)
async def test_a_protected_actor_has_the_key_of_its_start_in_all_its_lives(place: str, how: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        locker, names, _ = await open_house(system, place)
        if how == "kill":
            locker.kill()
        else:
            with pytest.raises(hf.RemoteCrash, match="the block"):
                await locker.ask(Work("inside"), timeout=60.0)
        assert await locker.ask(Count(), timeout=60.0) == 1
        assert [entry.holder.path for entry in await names.lookup("locker")] == ["/app/house/locker"]
