"""A task that does not want to end says nothing that counts once its life is over (R34)."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import holdfast as hf
from tests.checkpoint.guards import running
from tests.checkpoint.players import Note, Notes, Seen, until
from tests.checkpoint.strikes import NEVER, sink


class Wait(hf.Message):
    to: hf.ActorRef[hf.Actor]
    gate: str
    verb: str


class Clinging(hf.Actor):
    """Waits for a file; cancelled meanwhile, it still has something to say."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    @hf.on(Wait)
    async def wait(self, message: Wait) -> None:
        message.to.tell(Note("before"))
        Path(message.gate).touch()
        try:
            while not Path(message.gate + ".open").exists():
                await asyncio.sleep(0.002)
        except asyncio.CancelledError:
            match message.verb:
                case "tell":
                    message.to.tell(Note("too late"))
                case "send":
                    await message.to.send(Note("too late"))
                case _:
                    await message.to.ask(Note("too late"))
            raise
        message.to.tell(Note("after"))
        self.seen.append("done")

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return list(self.seen)


@pytest.mark.parametrize("verb", ["tell", "send", "ask"])
async def test_what_a_killed_life_says_while_it_is_cancelled_does_not_count(
    store: str | None, tmp_path: Path, verb: str
) -> None:
    gate = tmp_path / "gate"
    async with running(store) as system:
        notes = await sink(system)
        ref = await system.start(hf.child("it", hf.start(Clinging), recovery=hf.hybrid(interval=NEVER)))
        ref.tell(Wait(notes, str(gate), verb))
        await until(gate.exists)
        for life in (2, 3):
            ref.kill()
            await until(lambda n=life: ref._cell.life == n and ref._cell.host.home.switch.life.is_released)  # type: ignore[attr-defined]
        Path(f"{gate}.open").touch()
        assert await ref.ask(Seen(), timeout=30.0) == ["done"]
        assert await notes.ask(Notes()) == ["before", "after"]
