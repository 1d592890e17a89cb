"""An effect that is tried again says which attempt it is at and what the last one has raised, wherever it is made."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from tests.console.commands import holdfast
from tests.effects.patient import IN_TIME

pytestmark = pytest.mark.usefixtures("warm_programs")

PLACES: dict[str, dict[str, Any]] = {
    "unrecorded": {"isolation": "process"},
    "task": {"recovery": hf.hybrid()},
    "pbr": {"recovery": hf.hybrid(), "mechanism": hf.ftm.PBR()},
}


class Pay(hf.Message[str]):
    """Pay when the file is there."""

    file: str


class Call(hf.Message): ...


class Wait(hf.Message): ...


def paid(file: str) -> str:
    if not Path(file).exists():
        raise OSError("card network unreachable\nat all")
    return "paid"


class Till(hf.Actor):
    def __init__(self) -> None:
        self.status = "new"

    @hf.on(Pay)
    async def pay(self, message: Pay) -> str:
        self.status = "paying"
        again = hf.Retry(attempts=999, backoff=hf.Backoff(0.01, 0.5, factor=50.0, jitter=0.0))
        return await self.ctx.effect(paid, message.file, key="pay", retry=again)

    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        self.status = "waiting"
        await self.ctx.wait_for(Call)
        self.status = "called"

    @hf.on(Call)
    def call(self, message: Call) -> None:
        self.status = "called while nobody waited"


async def rests(system: hf.ActorSystem, till: hf.ActorRef[Till], text: str) -> str:
    """What its turn waits for, as soon as the text is in it."""
    async with asyncio.timeout(IN_TIME):
        while text not in (said := (await system.get_status(till)).turn_rests):
            await asyncio.sleep(0.02)
    return said


@pytest.mark.parametrize("place", PLACES)
async def test_whoever_looks_hears_of_the_last_error(place: str, tmp_path: Path) -> None:
    net = tmp_path / "net"
    async with hf.ActorSystem("app", log=False) as system:
        till = await system.start(hf.child("till", hf.start(Till), **PLACES[place]))
        with system.events() as stream:
            asked = till.ask(Pay(str(net)), IN_TIME)
            said = await rests(system, till, "of 999: OSError: card network unreachable; the next in 0.")
            assert said.startswith("waits for the effect pay, which has been out for")
            net.touch()
            assert await asked == "paid"
            told = [one for one in stream.take() if isinstance(one, hf.events.EffectRetried)]
        assert [(one.address, one.effect, one.number, one.most, one.error) for one in told] == [
            (till.path, "pay", number, 999, "OSError: card network unreachable") for number in range(1, len(told) + 1)
        ]


@pytest.mark.parametrize("place", ["task", "pbr"])
async def test_the_state_beside_a_turn_that_rests_can_be_looked_at(place: str, tmp_path: Path) -> None:
    socket = f"{tmp_path}/s"
    async with hf.ActorSystem("app", log=False) as system, control_endpoint(system, socket):
        till = await system.start(hf.child("till", hf.start(Till), **PLACES[place]))
        till.tell(Wait())
        await rests(system, till, "has waited for")
        assert await system.get_state(till) == {"status": "waiting"}
        code, said, _ = await holdfast("inspect", till.path, "--state", "--socket", socket)
        assert code == 0
        assert "; it has waited for" in said
        assert "state status: 'waiting'" in said
        till.tell(Call())
        async with asyncio.timeout(IN_TIME):
            while await system.get_state(till) != {"status": "called"}:
                await asyncio.sleep(0.01)
