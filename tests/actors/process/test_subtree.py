"""A supervisor in a process of its own: its children live there with it, and are reached as anywhere (DESIGN 4)."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import ChildRestarted, ProcessDied, SupervisorGaveUp
from holdfast.supervision.admin import WhichChildren
from tests.actors.process.observers import AskPort, Heard, HeardSome, Observer, Publish, Send, Watch
from tests.actors.process.players import Account, Add, Fail, Introduce, Note, Notebook, Notes, Picky, Seen, Total, Where
from tests.actors.process.waiting import next_event, until


def subtree(**options: Any) -> hf.ChildSpec:
    team: dict[str, Any] = {
        "intensity": 3,
        "children": [
            hf.child("alice", hf.start(Account, 100)),
            hf.child("bob", hf.start(Account, 10)),
            hf.child("book", hf.start(Observer)),
            hf.supervisor("inner", children=[hf.child("carol", hf.start(Account, 1))], intensity=2),
        ],
        **options,
    }
    return hf.supervisor("team", isolation="process", **team)


async def test_children_are_reached_by_address_from_the_root(system: hf.ActorSystem) -> None:
    team = await system.start(subtree())
    alice, carol = system.ref("/app/team/alice", Account), system.ref("/app/team/inner/carol", Account)
    assert await alice.ask(Add(5)) == 105
    assert await carol.ask(Add(5)) == 6
    pids = {await ref.ask(Where()) for ref in (alice, carol)}
    assert pids == {system.pid_of(team)} == {system.pid_of(carol)}
    assert os.getpid() not in pids
    assert system.tree()[1:] == [
        f"/app/team{name}" for name in ("", "/alice", "/bob", "/book", "/inner", "/inner/carol")
    ]
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref("/app/team/nobody", Account)
    with pytest.raises(hf.errors.WrongActor):
        system.ref("/app/team/book", Account)
    children = await team.ask(WhichChildren())
    assert [child.id for child in children] == ["alice", "bob", "book", "inner"]


async def test_refs_to_inner_actors_travel(system: hf.ActorSystem) -> None:
    await system.start(subtree())
    book, alice = system.ref("/app/team/book", Observer), system.ref("/app/team/alice", Account)
    other = await system.start(hf.child("other", hf.start(Observer), isolation="process"))
    here = await system.start(hf.child("here", hf.start(Observer)))
    assert await other.ask(Introduce(alice)) == "/app/other knows /app/team/alice elsewhere"
    assert await here.ask(Introduce(alice)) == "/app/here knows /app/team/alice elsewhere"
    assert await book.ask(Introduce(alice)) == "/app/team/book knows /app/team/alice here"
    assert await book.ask(Introduce(other)) == "/app/team/book knows /app/other elsewhere"
    assert await other.ask(Send(book, 3)) == "3 sent"
    await other.ask(Publish("/news", ["extra"]))
    assert await book.ask(Notes()) == ["0", "1", "2", "extra"]


async def test_a_crash_inside_restarts_inside(system: hf.ActorSystem) -> None:
    team = await system.start(subtree())
    pid = system.pid_of(team)
    alice, bob = system.ref("/app/team/alice", Account), system.ref("/app/team/bob", Account)
    await bob.ask(Add(1))
    with system.events() as events:
        with pytest.raises(hf.RemoteCrash, match="ValueError: inside"):
            await alice.ask(Fail("inside"))
        restarted = await next_event(events, ChildRestarted)
    assert (restarted.address, str(restarted.reason)) == ("/app/team/alice", "ValueError: inside")
    assert await alice.ask(Total()) == 100, "a fresh life"
    assert await bob.ask(Total()) == 11, "its sibling was not touched"
    assert system.pid_of(team) == pid


async def test_messages_queued_behind_a_crash_inside_are_kept(system: hf.ActorSystem) -> None:
    await system.start(subtree())
    alice = system.ref("/app/team/alice", Account)
    broken = alice.ask(Fail("inside"))
    queued = [alice.ask(Add(1)) for _ in range(10)]
    with pytest.raises(hf.RemoteCrash):
        await broken
    assert await asyncio.gather(*queued) == list(range(101, 111))


async def test_death_of_the_process_restarts_the_whole_subtree(system: hf.ActorSystem) -> None:
    team = await system.start(subtree())
    alice, carol = system.ref("/app/team/alice", Account), system.ref("/app/team/inner/carol", Account)
    await alice.ask(Add(1))
    await carol.ask(Add(1))
    pid = system.pid_of(team)
    with system.events() as events:
        os.kill(pid, signal.SIGKILL)
        assert (await next_event(events, ProcessDied)).reason == hf.Signal(signal.SIGKILL)
    await team.ask(WhichChildren())
    assert await alice.ask(Total()) == 100
    assert await carol.ask(Total()) == 1
    assert system.pid_of(alice) != pid
    assert await system.ref("/app/team/inner/carol", Account).ask(Add(1)) == 2


async def test_death_of_the_process_ends_what_was_asked_inside(system: hf.ActorSystem) -> None:
    await system.start(subtree())
    book = system.ref("/app/team/book", Observer)
    watcher = await system.start(hf.child("watcher", hf.start(Observer)))
    watcher.tell(Watch("monitor", book))
    watcher.tell(Watch("watch", book))
    await watcher.ask(Heard())
    never = book.ask(HeardSome(1))
    os.kill(system.pid_of(book), signal.SIGKILL)
    with pytest.raises(hf.AskFailed, match="SIGKILL"):
        await never
    assert await watcher.ask(HeardSome(2)) == [["down", "/app/team/book", "SIGKILL", "False"]] * 2


async def test_a_ref_from_before_its_process_died_sends_to_who_lives_there_now(system: hf.ActorSystem) -> None:
    team = await system.start(subtree(intensity=100))
    other = await system.start(hf.child("other", hf.start(Observer), isolation="process"))
    book = system.ref("/app/team/book", Observer)
    await book.send(Note("before"))
    os.kill(system.pid_of(team), signal.SIGKILL)
    await team.ask(WhichChildren())
    await until(lambda: "/app/team/book" in system.tree())
    async with asyncio.timeout(30.0):
        await book.send(Note("from outside"))
        assert await other.ask(Send(book, 1)) == "1 sent"
    assert await book.ask(Notes()) == ["from outside", "0"]
    await system.stop(team)
    with pytest.raises(hf.ActorStopped):
        await book.send(Note("to nobody"))


async def test_a_subscriber_whose_process_dies_is_no_trouble_of_the_publisher_and_the_others(
    system: hf.ActorSystem,
) -> None:
    team = await system.start(subtree())
    here = await system.start(hf.child("here", hf.start(Notebook)))
    pid = system.pid_of(team)
    os.kill(pid, signal.SIGSTOP)  # It takes what is published, and does not say so.
    published = asyncio.ensure_future(system.publish("/news", Seen("extra")))
    await asyncio.wait((published,), timeout=0.05)
    os.kill(pid, signal.SIGKILL)
    await published
    assert await here.ask(Notes()) == ["extra"]


async def test_strategies_hold_inside(system: hf.ActorSystem) -> None:
    await system.start(subtree(strategy="one_for_all"))
    alice, bob = system.ref("/app/team/alice", Account), system.ref("/app/team/bob", Account)
    await bob.ask(Add(1))
    with pytest.raises(hf.RemoteCrash):
        await alice.ask(Fail("all"))
    await until(lambda: bob._cell.state == "gone" or bob._cell.life == 2)
    assert await bob.ask(Total()) == 10


async def test_intensity_reached_inside_goes_up(system: hf.ActorSystem) -> None:
    team = await system.start(subtree(intensity=1, period=60.0))
    pid = system.pid_of(team)
    with system.events() as events:
        for _ in range(2):
            with pytest.raises(hf.RemoteCrash):
                await system.ref("/app/team/alice", Account).ask(Fail("again"))
            await next_event(events, (ChildRestarted, SupervisorGaveUp))  # type: ignore[arg-type]
        await next_event(events, ProcessDied)
    await team.ask(WhichChildren())
    assert await system.ref("/app/team/alice", Account).ask(Total()) == 100
    assert system.pid_of(team) != pid


async def test_a_child_that_cannot_start_fails_the_start_of_the_subtree(system: hf.ActorSystem) -> None:
    with pytest.raises(hf.StartFailed, match="not like this"):
        await system.start(subtree(children=[hf.child("picky", hf.start(Picky))]))
    assert system._workers.processes() == {}


async def test_stop_of_the_subtree_and_of_one_child(system: hf.ActorSystem) -> None:
    team = await system.start(subtree())
    alice, bob = system.ref("/app/team/alice", Account), system.ref("/app/team/bob", Account)
    await system.stop(alice)
    with pytest.raises(hf.ActorStopped):
        await alice.ask(Total())
    assert [child.id for child in await team.ask(WhichChildren())] == ["bob", "book", "inner"]
    await system.stop(team)
    assert system.tree() == ["/app"]
    with pytest.raises(hf.ActorStopped):
        await bob.ask(Total())


async def test_options_of_inner_children_travel(system: hf.ActorSystem) -> None:
    children = [
        hf.child("book", hf.start(Notebook), mailbox=hf.bounded(5, overflow="drop_oldest")),
        hf.child(
            "last",
            hf.start(Observer),
            restart="transient",
            shutdown="brutal_kill",
            backoff=hf.Backoff(initial=0.01, jitter=0.0),
            bindings={"port": "/app/team/book"},
        ),
    ]
    await system.start(subtree(children=children))
    last, book = system.ref("/app/team/last", Observer), system.ref("/app/team/book", Notebook)
    assert await last.ask(AskPort()) == await book.ask(Where())
    for number in range(10):
        book.tell(Note(str(number)))
    assert "9" in await book.ask(Notes())
