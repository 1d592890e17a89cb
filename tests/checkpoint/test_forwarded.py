"""What a recorded actor hands on is in the same append as the end of its turn: a program that dies loses neither."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Entry, StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.players import Doer, Note, Seen

IN_TIME = 20.0


class Ends:
    """A real engine that fails behind the append with the end of a turn of the gate, which was to hand something on."""

    def __init__(self, path: Path) -> None:
        self.real = SqliteJournal(path)
        self.is_over = asyncio.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        if self.is_over.is_set():
            raise StoreFailed("app.db", "the machine is gone")
        positions = self.real.append(entries)
        if any(path == "/app/gate" and is_end(entry) for path, entry in entries):
            self.is_over.set()
        return positions

    def has_failed(self) -> bool:
        return self.is_over.is_set()


def is_end(entry: tuple[Any, ...]) -> bool:
    """Whether a row ends a turn that was not the first one."""
    return (entry[0] in ("end", "ends") and entry[1] > 0) or (entry[0] == "in" and len(entry) > 8)


class Gate(hf.Actor):
    box: hf.Binding[Doer]

    @hf.on(Note)
    def note(self, message: Note) -> Any:
        self.ctx.forward(self.box)


class Asker(hf.Actor):
    gate: hf.Binding[Gate]

    @hf.on(Note)
    async def note(self, message: Note) -> int:
        return await self.gate.ask(message, timeout=IN_TIME)


async def started(system: hf.ActorSystem, mailbox: Any) -> hf.ActorRef[Any]:
    """The asker and its gate, and who gets what the gate hands on."""
    recovery: Any = {"recovery": hf.hybrid(interval=3600.0)}
    box = await system.start(hf.child("box", hf.start(Doer), mailbox=mailbox, **recovery))
    await system.start(hf.child("gate", hf.start(Gate), bindings={"box": "/app/box"}, **recovery))
    await system.start(hf.child("asker", hf.start(Asker), bindings={"gate": "/app/gate"}, shutdown=0.1, **recovery))
    return box


@pytest.mark.parametrize("mailbox", [None, hf.bounded(8)], ids=["unbounded", "bounded"])
@pytest.mark.parametrize("how", ["ask", "tell", "from a turn"])
async def test_what_is_handed_on_is_not_lost_with_the_program(how: str, mailbox: Any, tmp_path: Path) -> None:
    engine: Any = Ends(tmp_path / "app.db")
    with contextlib.suppress(hf.HoldfastError):
        async with hf.ActorSystem("app", log=False, store=engine) as system:
            await started(system, mailbox)
            ref = system.ref("/app/asker" if how == "from a turn" else "/app/gate", hf.Actor)
            if how == "tell":
                ref.tell(Note("handed on"))
            else:
                ref.ask(Note("handed on"), timeout=IN_TIME).add_done_callback(asyncio.Future.exception)
            await asyncio.wait_for(engine.is_over.wait(), IN_TIME)
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}") as system:
        box = await started(system, mailbox)
        assert await box.ask(Seen(), timeout=IN_TIME) == ["handed on"]
