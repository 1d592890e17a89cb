"""Calls from other threads are refused where they would be lost, and made through a portal."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import threading
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
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
    "bounded": {"mailbox": hf.bounded(2, overflow="reject")},
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
        with pytest.raises(hf.errors.WrongThread, match=r"from_thread\(\)"):
            await in_thread(lambda: book.tell(Note(1, 1)))
    book.tell(Note(0, 0))
    assert await book.ask(Noted()) == [(0, 0)]


@pytest.mark.parametrize("call", ["ask", "stop", "kill"])
async def test_other_calls_are_refused_too(system: hf.ActorSystem, call: str) -> None:
    book = await system.start(hf.child("book", hf.start(Notebook)))
    calls: dict[str, Callable[[], object]] = {"ask": lambda: book.ask(Noted()), "stop": book.stop, "kill": book.kill}
    with pytest.raises(hf.errors.WrongThread, match="/app/book"):
        await in_thread(calls[call])
    with pytest.raises(hf.errors.WrongThread, match="/app/book"):
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
    book = await system.start(hf.child("book", hf.start(Notebook), shutdown=0.1))
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


class Waiter(hf.Actor):
    """Tells, in a thread-safe way, when it has been asked, and holds its end until it is let go."""

    deterministic = False

    def __init__(self, moments: Moments) -> None:
        self.moments = moments

    @hf.on(Hold)
    async def hold(self, message: Hold) -> None:
        self.moments.asked.set()
        await asyncio.Event().wait()

    @hf.on(Note)
    def note(self, message: Note) -> None: ...

    async def on_stop(self, reason: hf.ExitReason) -> None:
        self.moments.stops.set()
        await asyncio.get_running_loop().run_in_executor(None, self.moments.called.wait)


class Moments:
    """What the threads of a test tell each other."""

    def __init__(self) -> None:
        self.asked, self.stops, self.called = threading.Event(), threading.Event(), threading.Event()


async def begun(waiting: Coroutine[Any, Any, Any], moments: Moments) -> Any:
    """What comes of a call; the moments hear when it has been handed to the other loop."""
    task = asyncio.ensure_future(waiting)
    await asyncio.sleep(0)
    moments.called.set()
    return await task


def name_of(call: Callable[[], Any]) -> str:
    """The class of the library's own error that comes of a call; what else it raises is raised."""
    try:
        call()
    except hf.HoldfastError as error:
        return type(error).__name__
    return "nothing"


Calls = Callable[[hf.system.ThreadPortal, "hf.ActorRef[Any]"], Any]

CALLS: dict[str, Calls] = {
    "tell": lambda portal, ref: portal.tell(ref, Note(0, 0)),
    "send": lambda portal, ref: portal.send(ref, Note(0, 0)),
    "ask": lambda portal, ref: portal.ask(ref, Hold(), timeout=3600.0),
    "send_async": lambda portal, ref: asyncio.run(portal.send_async(ref, Note(0, 0))),
    "ask_async": lambda portal, ref: asyncio.run(portal.ask_async(ref, Hold(), timeout=3600.0)),
}
own_loops = pytest.mark.asyncio(loop_factories=["asyncio"])
"""The loop of the test is only the place for it: the systems run on loops of their own, in threads."""


@own_loops
@pytest.mark.parametrize("ask", ["ask", "ask_async"])
async def test_who_waits_when_the_system_ends_hears_of_it(ask: str) -> None:
    moments = Moments()
    moments.called.set()

    async def main() -> str:
        async with hf.ActorSystem("inner", log=False) as inner:
            waiter = await inner.start(hf.child("waiter", hf.start(Waiter, moments), shutdown=0.05))
            portal = inner.from_thread()
            waiting = asyncio.ensure_future(in_thread(lambda: name_of(lambda: CALLS[ask](portal, waiter))))
            await in_thread(moments.asked.wait)
        return await waiting

    assert await in_thread(lambda: asyncio.run(main())) == "AskFailed"  # Its turn was cut off.


@own_loops
async def test_who_calls_while_the_system_ends_hears_of_it() -> None:
    moments = Moments()

    async def main() -> str:
        async with hf.ActorSystem("inner", log=False) as inner:
            waiter = await inner.start(hf.child("waiter", hf.start(Waiter, moments)))
            portal = inner.from_thread()

            def call() -> str:
                moments.stops.wait()
                return name_of(lambda: asyncio.run(begun(portal.ask_async(waiter, Hold(), timeout=3600.0), moments)))

            calling = asyncio.ensure_future(in_thread(call))
        return await calling

    assert await in_thread(lambda: asyncio.run(main())) == "ActorStopped"


@own_loops
@pytest.mark.parametrize("call", CALLS)
async def test_who_calls_after_the_system_is_refused(call: str) -> None:
    """Whether its event loop goes on, or is closed: also by the thread that ran it."""
    found: list[tuple[hf.system.ThreadPortal, hf.ActorRef[Any]]] = []

    async def main() -> str:
        async with hf.ActorSystem("inner", log=False) as inner:
            book = await inner.start(hf.child("book", hf.start(Notebook)))
            found.append((inner.from_thread(), book))
        return await in_thread(lambda: name_of(lambda: CALLS[call](*found[0])))

    with concurrent.futures.ThreadPoolExecutor(1) as one:  # The very thread that has run the system.
        assert await asyncio.wrap_future(one.submit(lambda: asyncio.run(main()))) == "ActorStopped"
        after = one.submit(lambda: name_of(lambda: CALLS[call](*found[0])))
        assert await asyncio.wrap_future(after) == "ActorStopped"
    assert await in_thread(lambda: name_of(lambda: CALLS[call](*found[0]))) == "ActorStopped"


@own_loops
@pytest.mark.parametrize("call", CALLS)
async def test_what_a_closed_loop_never_did_is_not_waited_for(call: str) -> None:
    """It was handed over when the loop had taken its last step."""
    ended = asyncio.new_event_loop()
    found: list[tuple[hf.system.ThreadPortal, hf.ActorRef[Any]]] = []

    async def main() -> None:
        async with hf.ActorSystem("inner", log=False) as inner:
            book = await inner.start(hf.child("book", hf.start(Notebook)))
            found.append((inner.from_thread(), book))

    handed_over = threading.Event()
    hand_over = ended.call_soon_threadsafe

    def handing_over(*args: Any, **kwargs: Any) -> asyncio.Handle:
        handle = hand_over(*args, **kwargs)
        handed_over.set()
        return handle

    with concurrent.futures.ThreadPoolExecutor(1) as own:  # Its thread is never the one that calls.
        await asyncio.wrap_future(own.submit(ended.run_until_complete, main()))
        ended.call_soon_threadsafe = handing_over  # type: ignore[assignment]
        calling = asyncio.ensure_future(in_thread(lambda: name_of(lambda: CALLS[call](*found[0]))))
        await in_thread(handed_over.wait)
        ended.close()
    assert await calling == "ActorStopped"


@pytest.mark.parametrize("call", ["tell", "ask", "send"])
def test_another_event_loop_of_the_thread_is_told_so(call: str) -> None:
    with asyncio.Runner() as first, asyncio.Runner() as second:
        system = hf.ActorSystem("app", log=False)
        first.run(system.__aenter__())
        book = first.run(system.start(hf.child("book", hf.start(Notebook))))

        async def calls() -> None:
            if call == "tell":
                book.tell(Note(1, 1))
            else:
                await (book.ask(Noted()) if call == "ask" else book.send(Note(1, 1)))

        async def elsewhere() -> None:
            with pytest.raises(hf.errors.WrongLoop, match="/app/book was called from another event loop"):
                await calls()

        async def here() -> list[tuple[int, int]]:
            return await book.ask(Noted())

        second.run(elsewhere())
        assert first.run(here()) == []  # Nothing of it has come.
        book.tell(Note(2, 2))  # While no loop runs, it is as in a callback of its own.
        assert first.run(here()) == [(2, 2)]
        first.run(system.shutdown())


@pytest.mark.parametrize("way", [*WAYS, "durable"])
def test_another_event_loop_is_told_so_while_the_system_has_something_to_do(way: str, tmp_path: Path) -> None:
    """Nothing comes of a call, wherever the actor lives, and the system goes on."""
    options, store = (WAYS["recorded"], f"sqlite:{tmp_path}/app.db") if way == "durable" else (WAYS[way], None)
    with asyncio.Runner() as first, asyncio.Runner() as second:
        system = hf.ActorSystem("app", store=store, log=False)
        first.run(system.open())
        book = first.run(system.start(hf.child("book", hf.start(Notebook), **options)))
        another = hf.child("another", hf.start(Notebook))
        calls: dict[str, Callable[[], Any]] = {
            "ask": lambda: book.ask(Noted()),
            "send": lambda: book.send(Note(7, 7)),
            "stop": book.stop,
            "kill": book.kill,
            "start": lambda: system.start(another),
            "get_state": lambda: system.get_state(book),
            "suspend": lambda: system.suspend(book),
            "stop for good": lambda: system.stop(book),
            "publish": lambda: system.publish("/notes", Note(7, 7)),
            "shutdown": system.shutdown,
        }
        if way not in ("task", "bounded"):  # While such a task has something to do, it gets what it is told.
            calls["tell"] = lambda: book.tell(Note(7, 7))

        async def called(call: Callable[[], Any]) -> None:
            with pytest.raises(hf.errors.WrongLoop, match="/app"):
                await call()

        async def noted() -> list[tuple[int, int]]:
            return await book.ask(Noted())

        book.tell(Note(1, 1))  # Neither loop runs: it is to be handled when the first one does.
        for call in calls.values():
            second.run(called(call))
        assert first.run(noted()) == [(1, 1)]
        first.run(system.start(another))  # It was not started before.
        first.run(system.shutdown())
