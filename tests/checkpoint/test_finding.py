"""A recorded actor that looks up others in its turns comes back without them, and before them (T21)."""

from __future__ import annotations

from pathlib import Path

import pytest

import holdfast as hf
from tests.checkpoint.guards import running
from tests.checkpoint.players import Note, Notes, start
from tests.checkpoint.strikes import sink


class Tell(hf.Message[int]):
    to: str


class Finder(hf.Actor):
    def __init__(self) -> None:
        self.told = 0

    @hf.on(Tell)
    def tell(self, message: Tell) -> int:
        self.ctx.find(message.to, hf.Actor).tell(Note(str(self.told)))
        self.told += 1
        return self.told


async def finder(system: hf.ActorSystem, isolation: str) -> hf.ActorRef[Finder]:
    return await start(system, isolation, "finder", hf.start(Finder), recovery=hf.replay_only())


async def test_whom_it_found_may_be_gone_when_it_comes_back(system: hf.ActorSystem, isolation: str) -> None:
    notes = await sink(system)
    ref = await finder(system, isolation)
    assert await ref.ask(Tell(notes.path)) == 1
    assert await notes.ask(Notes()) == ["0"]
    await system.stop(notes)
    ref.kill()
    assert await ref.ask(Tell(notes.path), timeout=30.0) == 2


async def test_whom_it_found_may_be_started_after_it(tmp_path: Path, isolation: str) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    for life in (1, 2):
        async with running(store) as system:
            ref = await finder(system, isolation)
            notes = await sink(system)
            assert await ref.ask(Tell(notes.path), timeout=30.0) == life
            assert await notes.ask(Notes(), timeout=30.0) == [str(life - 1)]  # It is told nothing twice.


async def test_what_it_tells_nobody_is_a_dead_letter(system: hf.ActorSystem) -> None:
    ref = await finder(system, "task")
    with system.events() as events:
        assert await ref.ask(Tell("/app/nobody")) == 1
        await system.node.settled()
        assert [one.address for one in events.take() if isinstance(one, hf.DeadLetter)] == ["/app/nobody"]


class Picky(hf.Actor):
    @hf.on(Tell)
    def tell(self, message: Tell) -> int:
        self.ctx.find(message.to, Finder)
        return 0


async def test_another_class_is_refused(system: hf.ActorSystem) -> None:
    notes = await sink(system)
    ref = await system.start(hf.child("picky", hf.start(Picky), recovery=hf.hybrid()))
    with pytest.raises(hf.RemoteCrash, match="WrongActor"):
        await ref.ask(Tell(notes.path))
