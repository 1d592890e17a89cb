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
    """A real engine that fails when it is told, or behind the append with the end of a turn of this actor."""

    def __init__(self, path: Path, actor: str = "") -> None:
        self.real, self.actor = SqliteJournal(path), actor
        self.is_over = asyncio.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        if self.is_over.is_set():
            raise StoreFailed("app.db", "the machine is gone")
        positions = self.real.append(entries)
        if any(path == self.actor and is_end(entry) for path, entry in entries):
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


class Replies(hf.Message[list[int]]): ...


class Asker(hf.Actor):
    gate: hf.Binding[Gate]

    def __init__(self) -> None:
        self.replies: list[int] = []

    @hf.on(Note)
    async def note(self, message: Note) -> int:
        self.replies.append(await self.gate.ask(message, timeout=IN_TIME))
        return self.replies[-1]

    @hf.on(Replies)
    def read(self, message: Replies) -> list[int]:
        return self.replies


RECOVERY: Any = {"recovery": hf.hybrid(interval=3600.0)}


async def started(system: hf.ActorSystem, mailbox: Any) -> hf.ActorRef[Any]:
    """The asker and its gate, and who gets what the gate hands on."""
    box = await system.start(hf.child("box", hf.start(Doer), mailbox=mailbox, **RECOVERY))
    await system.start(hf.child("gate", hf.start(Gate), bindings={"box": "/app/box"}, **RECOVERY))
    await system.start(hf.child("asker", hf.start(Asker), bindings={"gate": "/app/gate"}, shutdown=0.1, **RECOVERY))
    return box


class Meet(hf.Message[None]):
    box: hf.ActorRef[Doer]


class Knowing(hf.Actor):
    """A gate that remembers whom it hands on to."""

    def __init__(self) -> None:
        self.box: hf.ActorRef[Doer] | None = None

    @hf.on(Meet)
    def meet(self, message: Meet) -> None:
        self.box = message.box

    @hf.on(Note)
    def note(self, message: Note) -> Any:
        assert self.box is not None
        self.ctx.forward(self.box)


async def without_box(system: hf.ActorSystem) -> hf.ActorRef[Any]:
    """The asker and its gate, before anybody is started to whom the gate hands on."""
    await system.start(hf.child("gate", hf.start(Knowing), **RECOVERY))
    bound: Any = {"gate": "/app/gate"}
    return await system.start(hf.child("asker", hf.start(Asker), bindings=bound, shutdown=0.1, **RECOVERY))


async def all_are_kept(system: hf.ActorSystem, messages: int) -> None:
    """Wait until so many messages are kept for the box."""
    rejoin = system._homes.rejoin
    async with asyncio.timeout(IN_TIME):
        while len(rejoin.kept_for("/app/box")) < messages:
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("is_killed", [False, True])
async def test_who_is_not_started_yet_gets_what_was_handed_on_once_and_in_its_order(
    is_killed: bool, tmp_path: Path
) -> None:
    path = tmp_path / "app.db"
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{path}") as system:
        box = await system.start(hf.child("box", hf.start(Doer), **RECOVERY))
        gate = await system.start(hf.child("gate", hf.start(Knowing), **RECOVERY))
        await gate.ask(Meet(box), timeout=IN_TIME)
    engine: Any = Ends(path)
    with contextlib.suppress(hf.HoldfastError):
        async with hf.ActorSystem("app", log=False, store=engine) as system:
            asker = await without_box(system)
            asker.tell(Note("asked"))
            await all_are_kept(system, 1)
            system.ref("/app/gate", hf.Actor).tell(Note("told"))
            await all_are_kept(system, 2)
            await system._homes.synced()
            if is_killed:
                engine.is_over.set()
            else:
                await both_are_there(system)
    if is_killed:
        async with hf.ActorSystem("app", log=False, store=f"sqlite:{path}") as system:
            await without_box(system)
            await both_are_there(system)


async def both_are_there(system: hf.ActorSystem) -> None:
    """The box is started, and has all that was kept; the asker hears of its part."""
    box = await system.start(hf.child("box", hf.start(Doer), **RECOVERY))
    assert await system.ref("/app/asker", Asker).ask(Replies(), timeout=IN_TIME) == [1]
    assert await box.ask(Seen(), timeout=IN_TIME) == ["asked", "told"]


@pytest.mark.parametrize("mailbox", [None, hf.bounded(8)], ids=["unbounded", "bounded"])
@pytest.mark.parametrize("how", ["ask", "tell", "from a turn"])
async def test_what_is_handed_on_is_not_lost_with_the_program(how: str, mailbox: Any, tmp_path: Path) -> None:
    engine: Any = Ends(tmp_path / "app.db", "/app/gate")
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
