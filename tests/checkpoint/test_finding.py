"""A recorded actor comes back when those whom it has found or told are gone, elsewhere, or not there yet (T21)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.addresses import FORMER
from tests.checkpoint.guards import running
from tests.checkpoint.players import Note, Notes, Sink, start
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
        await system._node.settled()
        assert [one.address for one in events.take() if isinstance(one, hf.events.DeadLetter)] == ["/app/nobody"]


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


class Careless(hf.Actor):
    @hf.on(Tell)
    def tell(self, message: Tell) -> int:
        try:
            self.ctx.find(f"{message.to}\ud800", hf.Actor).tell(Note(""))
        except hf.SpecError:
            return 0
        return 1


async def test_an_address_that_cannot_be_written_is_refused(system: hf.ActorSystem, isolation: str) -> None:
    """What is told to it could be neither recorded nor sent, and each life would end in this turn."""
    ref = await start(system, isolation, "careless", hf.start(Careless), recovery=hf.hybrid())
    assert await ref.ask(Tell("/app/half of a pair: "), timeout=30.0) == 0


class Bound(hf.Actor):
    sink: hf.Binding[Sink]

    def __init__(self) -> None:
        self.told = 0

    @hf.on(Tell)
    async def tell(self, message: Tell) -> int:
        self.told += 1
        self.sink.tell(Note(f"told {self.told}"))
        await self.sink.ask(Note(f"asked {self.told}"))
        return self.told


async def bound(system: hf.ActorSystem, isolation: str, to: str) -> hf.ActorRef[Bound]:
    options = {"bindings": {"sink": to}, "recovery": hf.replay_only()}
    return await start(system, isolation, "bound", hf.start(Bound), **options)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_its_binding_may_lead_elsewhere_since(system: hf.ActorSystem, isolation: str) -> None:
    one, two = [await system.start(hf.child(name, hf.start(Sink))) for name in ("one", "two")]
    ref = await bound(system, isolation, one.path)
    assert await ref.ask(Tell("")) == 1
    for target in (two, one, two):
        system.bind(ref, "sink", target)
    assert await ref.ask(Tell("")) == 2
    ref.kill()
    assert await ref.ask(Tell(""), timeout=30.0) == 3
    assert await one.ask(Notes()) == ["told 1", "asked 1"]
    assert await two.ask(Notes()) == ["told 2", "asked 2", "told 3", "asked 3"]


@pytest.mark.parametrize("who", ["bound", "top"])
async def test_a_binding_that_was_changed_below_a_process_is_known_to_a_replay(who: str) -> None:
    """Whether the actor dies or the process of its supervisor, which begins as its recipe says."""
    async with hf.ActorSystem("app", log=False, intensity=1) as system:
        one, two = [await system.start(hf.child(name, hf.start(Sink))) for name in ("one", "two")]
        options: Any = {"bindings": {"sink": one.path}, "recovery": hf.hybrid(interval=3600.0)}
        ref = await start(system, "subtree", "bound", hf.start(Bound), **options)
        assert await ref.ask(Tell(""), timeout=30.0) == 1
        system.bind(ref, "sink", two)
        assert await ref.ask(Tell(""), timeout=30.0) == 2
        system.ref(ref.path if who == "bound" else ref.path.rpartition("/")[0], hf.Actor).kill()
        assert await ref.ask(Tell(""), timeout=30.0) == 3
        told = [await sink.ask(Notes()) for sink in (one, two)]
        last = two if who == "bound" else one
        assert told == [
            ["told 1", "asked 1", *(["told 3", "asked 3"] if last is one else [])],
            ["told 2", "asked 2", *(["told 3", "asked 3"] if last is two else [])],
        ]


class Outgoing(hf.Actor):
    out: hf.Binding[Sink]

    def __init__(self) -> None:
        self.told = 0

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.out.tell(message)
        self.told += 1
        return self.told


async def outgoing(system: hf.ActorSystem, to: str) -> hf.ActorRef[Outgoing]:
    for name in ("first", "second", "third"):
        await system.start(hf.child(name, hf.start(Sink), recovery=hf.hybrid()))
    recovery = hf.hybrid(interval=1000.0)
    return await system.start(hf.child("bound", hf.start(Outgoing), recovery=recovery, bindings={"out": to}))


async def notes(system: hf.ActorSystem) -> list[list[str]]:
    return [await system.ref(f"/app/{name}", Sink).ask(Notes()) for name in ("first", "second", "third")]


@pytest.mark.parametrize("saved", [False, True])
async def test_a_binding_that_the_program_has_changed_is_met_by_no_turn_before(tmp_path: Path, saved: bool) -> None:
    """A turn that is handled again has told whoever it was bound to then, and tells nobody else."""
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        ref = await outgoing(system, "/app/first")
        assert await ref.ask(Note("one")) == 1
        if saved:
            await system.checkpoint(ref)
        assert await notes(system) == [["one"], [], []]
        system._homes.journal.close()  # As if it had been killed: no snapshot at its end.
    found = list[list[str]]()
    for count, to in enumerate(("/app/second", "/app/first", "/app/third"), 2):
        async with running(store) as system:
            ref = await outgoing(system, to)
            assert await ref.ask(Note(str(count))) == count
            found = await notes(system)
            system._homes.journal.close()
    assert found == [["one", "3"], ["2"], ["4"]]


async def test_a_binding_that_transactions_have_changed_is_met_by_no_turn_before(tmp_path: Path) -> None:
    """It leads where the last one has said in the next program too, and what went elsewhere before is known there."""
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        ref = await outgoing(system, "/app/first")
        for count, to in enumerate(("second", "third", "second", "first", "third"), 1):
            assert await ref.ask(Note(str(count))) == count
            async with system.transaction() as change:
                change.bind(ref, "out", f"/app/{to}")
        assert await notes(system) == [["1", "5"], ["2", "4"], ["3"]]
        system._homes.journal.close()
    async with running(store) as system:
        ref = await outgoing(system, "/app/first")
        assert await ref.ask(Note("6")) == 6
        assert await notes(system) == [["1", "5"], ["2", "4"], ["3", "6"]]


async def test_where_a_binding_led_before_a_snapshot_is_forgotten_in_time(tmp_path: Path) -> None:
    async with running(f"sqlite:{tmp_path / 'app.db'}") as system:
        ref = await outgoing(system, "/app/first")
        assert await ref.ask(Note("1")) == 1
        system.bind(ref, "out", "/app/second")
        led = system._homes.addresses.led
        assert led.alike(ref.path, "/app/second") == {"/app/first", "/app/second"}
        for number in range(2 * FORMER):
            system.bind(ref, "out", await system.start(hf.child(f"sink{number}", hf.start(Sink))))
        assert len(led.alike(ref.path, "/app/first")) == 2 * FORMER + 2
        await system.checkpoint(ref)
        system.bind(ref, "out", "/app/third")
        assert led.alike(ref.path, "/app/first") == set()
        assert len(led.alike(ref.path, "/app/third")) == FORMER + 1
