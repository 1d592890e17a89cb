"""Events: what happened, as typed values for whoever looks; nobody looking costs nothing (DESIGN 9, 11)."""

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.events import (
    ActorCrashed,
    ActorStarted,
    ChildRestarted,
    ChildStopped,
    ChildTerminated,
    DeadLetter,
    event_data,
    event_from,
)


class Do(hf.Message[Any]):
    work: Any


class One(hf.Actor):
    @hf.on(Do)
    def do(self, message: Do) -> Any:
        return message.work(self)


async def crash(ref: hf.ActorRef[Any]) -> None:
    with pytest.raises(hf.RemoteCrash):
        await ref.ask(Do(lambda _: 1 / 0))


async def test_a_life_as_events(system: hf.ActorSystem) -> None:
    with system.events() as stream:
        one = await system.start(hf.child("one", hf.start(One)))
        await crash(one)
        await one.ask(Do(lambda _: None))
        await system.stop(one)
        one.tell(Do(print))
        events = stream.take()
    assert [(type(event), event.address) for event in events] == [
        (ActorStarted, "/t/one"),
        (ActorCrashed, "/t/one"),
        (ChildTerminated, "/t/one"),
        (ChildRestarted, "/t/one"),
        (ActorStarted, "/t/one"),
        (ChildStopped, "/t/one"),
        (DeadLetter, "/t/one"),
    ]
    assert [event.life for event in events if isinstance(event, ActorStarted)] == [1, 2]
    [crashed] = [event for event in events if isinstance(event, ActorCrashed)]
    assert "ZeroDivisionError" in str(crashed.reason)


async def test_an_event_of_a_class_is_waited_for(system: hf.ActorSystem) -> None:
    with system.events() as stream:
        one = await system.start(hf.child("one", hf.start(One)))
        await crash(one)
        assert (await stream.until(ChildRestarted)).address == one.path
        await one.ask(Do(lambda _: None))
        assert (await stream.until(ActorStarted)).life == 2
        with pytest.raises(hf.errors.NoSuchEvent, match=r"no DeadLetter has come within 0\.01 s"):
            await stream.until(DeadLetter, timeout=0.01)
        with pytest.raises(hf.SpecError, match="timeout must be a finite number of seconds"):
            await stream.until(DeadLetter, timeout=0)
    with pytest.raises(hf.errors.NoSuchEvent, match="before the stream was closed"):
        await stream.until(DeadLetter)


async def test_every_listener_gets_every_event_from_its_beginning_on(system: hf.ActorSystem) -> None:
    first = system.events()
    system.spawn(hf.start(One), "a")
    second = system.events()
    system.spawn(hf.start(One), "b")
    first.close()
    system.spawn(hf.start(One), "c")
    second.close()
    assert [event.address for event in first.take()] == ["/t/a", "/t/b"]
    assert [event.address for event in second.take()] == ["/t/b", "/t/c"]


async def test_a_stream_is_an_async_iterator_that_ends_when_it_is_closed(system: hf.ActorSystem) -> None:
    stream, got = system.events(), asyncio.Queue[str]()

    async def read() -> str:
        async for event in stream:
            got.put_nowait(event.address)
        return "over"

    reader = asyncio.create_task(read())
    system.spawn(hf.start(One), "a")
    assert await got.get() == "/t/a"
    system.spawn(hf.start(One), "b")
    stream.close()
    assert await reader == "over"
    assert got.get_nowait() == "/t/b"  # what waited is still read


async def test_streams_end_with_the_system() -> None:
    async with hf.ActorSystem("t", log=False) as system:
        stream = system.events()
    assert [event async for event in stream] == []


async def test_a_listener_that_falls_behind_loses_the_oldest_and_is_told_how_many(system: hf.ActorSystem) -> None:
    with system._node.events.listen(most=2) as stream:
        for name in "abcd":
            system.spawn(hf.start(One), name)
        assert stream.missed == 2
        assert [event.address for event in stream.take()] == ["/t/c", "/t/d"]


async def test_with_nobody_looking_no_event_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    async with hf.ActorSystem("t", log=False, history=False) as system:
        await no_event_is_made(system, monkeypatch)


async def no_event_is_made(system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    emitted: list[Any] = []
    hub = system._node.events
    monkeypatch.setattr(hub, "emit", emitted.append)
    system.spawn(hf.start(One)).tell(Do(lambda _: 1 / 0))
    await system._node.settled()
    assert emitted == []
    stream = system.events()
    system.spawn(hf.start(One))
    stream.close()
    system.spawn(hf.start(One))
    assert [type(event) for event in emitted] == [ActorStarted]


async def test_a_sink_sees_events_at_once(system: hf.ActorSystem) -> None:
    seen: list[str] = []
    system._node.events.add_sink(lambda event: seen.append(event.address))
    system.spawn(hf.start(One), "a")
    assert seen == ["/t/a"]
    with system.events():
        pass
    system.spawn(hf.start(One), "b")  # a stream that ends does not switch the sinks off
    assert seen == ["/t/a", "/t/b"]


@pytest.mark.parametrize(
    "event",
    [
        ActorStarted("/t/a", 3),
        ChildRestarted("/t/a", hf.Crash("ValueError", "v", "trace"), 2),
        ChildRestarted("/t/a", hf.Signal(9), 1),
    ],
)
def test_events_cross_a_process_border_with_their_fields(event: hf.events.Event) -> None:
    back = event_from(type(event).__name__, event_data(event))
    assert back is not None
    assert type(back) is type(event)
    assert event_data(back) == event_data(event)


@pytest.mark.parametrize(
    ("kind", "data"), [("Nothing", {}), ("ActorStarted", {}), ("ChildRestarted", {"address": "/", "attempt": 1})]
)
def test_an_event_that_does_not_fit_is_no_event(kind: str, data: dict[str, Any]) -> None:
    assert event_from(kind, data) is None


async def test_what_listens_and_raises_hurts_nobody_who_tells() -> None:
    """A user's log or tracer may be behind it, and a supervisor may be in the middle of a restart."""
    troubles: list[str] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: troubles.append(str(context["exception"])))

    def raises(event: hf.events.Event) -> None:
        raise RuntimeError("a log that is broken")

    async with hf.ActorSystem("app", log=False) as system:
        heard: list[hf.events.Event] = []
        system._node.events.add_sink(raises)
        system._node.events.add_sink(heard.append)
        one = await system.start(hf.child("one", hf.start(hf.Actor)))
        one.kill()
        with system.events() as events:
            one.kill()
            await events.until(hf.events.ChildRestarted)
        system._node.events.remove_sink(raises)
        assert [event for event in heard if isinstance(event, hf.events.ChildRestarted)]
    assert set(troubles) == {"a log that is broken"}
