"""Calls from other threads are refused where they would be lost, and made through a portal."""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

import holdfast as hf
from tests.control.players import Account, Add


class Note(hf.Message):
    thread: int
    n: int


class Noted(hf.Message[list[tuple[int, int]]]): ...


class Hold(hf.Message[None]):
    """Never answered."""


class No(hf.Refusal):
    why: str


class Refuse(hf.Message[None]): ...


class Notebook(hf.Actor):
    def __init__(self) -> None:
        self.notes: list[tuple[int, int]] = []

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.notes.append((message.thread, message.n))

    @hf.on(Noted)
    def noted(self, message: Noted) -> list[tuple[int, int]]:
        return self.notes

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        await asyncio.Event().wait()

    @hf.on(Refuse)
    def refuse(self, message: Refuse) -> None:
        raise No("not today")


WAYS: dict[str, dict[str, Any]] = {
    "task": {},
    "bounded": {"mailbox": hf.bounded(2, overflow="fail")},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid()},
    "recorded process": {"recovery": hf.hybrid(), "isolation": "process"},
}


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    async with hf.ActorSystem("app", log=False) as running:
        yield running


async def in_thread(call: Callable[[], Any]) -> Any:
    """What the call gives in a thread of its own."""
    return await asyncio.get_running_loop().run_in_executor(None, call)


@pytest.mark.parametrize("way", WAYS)
async def test_a_tell_from_another_thread_is_refused_whole(system: hf.ActorSystem, way: str) -> None:
    book = await system.start(hf.child("book", hf.start(Notebook), **WAYS[way]))
    for _ in range(2):  # Room is left after a refusal, too.
        with pytest.raises(hf.WrongThread, match=r"from_thread\(\)"):
            await in_thread(lambda: book.tell(Note(1, 1)))
    book.tell(Note(0, 0))
    assert await book.ask(Noted()) == [(0, 0)]


@pytest.mark.parametrize("call", ["ask", "stop", "kill"])
async def test_other_calls_are_refused_too(system: hf.ActorSystem, call: str) -> None:
    book = await system.start(hf.child("book", hf.start(Notebook)))
    calls: dict[str, Callable[[], object]] = {"ask": lambda: book.ask(Noted()), "stop": book.stop, "kill": book.kill}
    with pytest.raises(hf.WrongThread, match="/app/book"):
        await in_thread(calls[call])
    with pytest.raises(hf.WrongThread, match="/app/book"):
        await in_thread(lambda: asyncio.run(book.send(Note(1, 1))))
    assert await book.ask(Noted()) == []


@pytest.mark.parametrize("way", ["task", "process", "recorded"])
async def test_threads_reach_actors_through_a_portal_in_order(system: hf.ActorSystem, way: str) -> None:
    book = await system.start(hf.child("book", hf.start(Notebook), **WAYS[way]))
    portal = system.from_thread()

    def write(thread: int) -> int:
        for n in range(100):
            if n % 2:
                portal.send(book, Note(thread, n))
            else:
                portal.tell(book, Note(thread, n))
        return len([n for who, n in portal.ask(book, Noted(), timeout=60.0) if who == thread])

    assert await asyncio.gather(*(in_thread(functools.partial(write, thread)) for thread in range(4))) == [100] * 4
    notes = await book.ask(Noted())
    assert len(notes) == 400
    for thread in range(4):
        assert [n for who, n in notes if who == thread] == list(range(100))


async def test_errors_arrive_as_what_they_are(system: hf.ActorSystem) -> None:
    book = await system.start(hf.child("book", hf.start(Notebook)))
    portal = system.from_thread()
    with pytest.raises(No, match="not today"):
        await in_thread(lambda: portal.ask(book, Refuse()))
    with pytest.raises(hf.UnknownMessage):
        await in_thread(lambda: portal.tell(book, Add(1)))
    with pytest.raises(hf.AskTimeout):
        await in_thread(lambda: portal.ask(book, Hold(), timeout=0.01))
    with pytest.raises(hf.HoldfastError, match="the system's own thread"):
        portal.tell(book, Note(0, 0))


async def test_another_event_loop_awaits(system: hf.ActorSystem) -> None:
    account = await system.start(hf.child("account", hf.start(Account)))
    portal = system.from_thread()

    async def elsewhere() -> int:
        await portal.send_async(account, Add(1))
        return await portal.ask_async(account, Add(2))

    assert await in_thread(lambda: asyncio.run(elsewhere())) == 3


@pytest.mark.asyncio(loop_factories=["asyncio"])  # The outer loop is only the place of the test.
async def test_when_the_system_ends_nobody_waits_for_ever() -> None:
    """Neither whoever waits then, nor whoever calls after it."""
    asked, outcomes = threading.Event(), []
    portals: list[tuple[hf.ThreadPortal, hf.ActorRef[Any]]] = []
    ready = threading.Event()

    async def main() -> None:
        async with hf.ActorSystem("inner", log=False) as inner:
            book = await inner.start(hf.child("book", hf.start(Notebook)))
            portals.append((inner.from_thread(), book))
            ready.set()
            await asyncio.get_running_loop().run_in_executor(None, asked.wait)

    def wait() -> None:
        ready.wait()
        portal, book = portals[0]
        asked.set()
        try:
            portal.ask(book, Hold(), timeout=3600.0)
        except hf.HoldfastError as error:
            outcomes.append(type(error))

    waiting = asyncio.get_running_loop().run_in_executor(None, wait)
    await in_thread(lambda: asyncio.run(main()))
    await waiting
    assert outcomes[0] in (hf.ActorStopped, hf.AskFailed)
    portal, book = portals[0]
    with pytest.raises(hf.ActorStopped):
        await in_thread(lambda: portal.ask(book, Noted()))
