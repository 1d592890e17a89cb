"""What an actor does to others is the same from inside a process: links, monitors, topics, bindings, stop and kill.

Each test runs with both sides as tasks and with both in processes of their own.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

import holdfast as hf
from tests.actors.process.observers import (
    AskPort,
    Cancel,
    Heard,
    HeardSome,
    Observer,
    Publish,
    Send,
    Spawn,
    StopChild,
    Subscribe,
    Trap,
    Watch,
)
from tests.actors.process.players import Fail, Note, Notebook, Notes, Pass, Where, WhoSent
from tests.actors.process.waiting import until

pytestmark = pytest.mark.pairs

Make = Callable[..., Awaitable[hf.ActorRef[Observer]]]


@pytest.fixture
def make(system: hf.ActorSystem, isolation: str) -> Make:
    async def make(name: str, **options: Any) -> hf.ActorRef[Observer]:
        spec: dict[str, Any] = {"isolation": isolation, "restart": "temporary", **options}
        return await system.start(hf.child(name, hf.start(Observer), **spec))

    return make


# -- monitors and links


async def test_monitor_tells_of_the_end_of_a_life(make: Make) -> None:
    watcher, target = await make("watcher"), await make("target", restart="permanent")
    watcher.tell(Watch("monitor", target))
    await watcher.ask(Heard())
    target.tell(Fail("no"))
    assert await watcher.ask(HeardSome(1)) == [["down", "/app/target", "ValueError: no", "False"]]
    await target.ask(Heard())  # the next life, which nobody monitors
    target.tell(Fail("again"))
    await target.ask(Heard())
    heard = await watcher.ask(Heard())
    assert len(heard) == 1


async def test_two_monitors_tell_twice_and_a_cancelled_one_does_not(make: Make) -> None:
    watcher, canceller, target = await make("watcher"), await make("canceller"), await make("target")
    for _ in range(2):
        watcher.tell(Watch("monitor", target))
        canceller.tell(Watch("monitor", target))
    canceller.tell(Cancel())
    await watcher.ask(Heard())
    await canceller.ask(Heard())
    target.stop()
    assert await watcher.ask(HeardSome(2)) == [["down", "/app/target", "shutdown", "False"]] * 2
    assert await canceller.ask(Heard()) == []


async def test_a_cancelled_monitor_leaves_nothing_behind(make: Make) -> None:
    watcher, target = await make("watcher"), await make("target")
    for _ in range(10):
        watcher.tell(Watch("monitor", target))
    watcher.tell(Cancel())
    await watcher.ask(Heard())
    await until(lambda: not target._cell.extra().ties.monitors)


async def test_watch_tells_once_when_the_address_is_gone(make: Make, system: hf.ActorSystem) -> None:
    watcher, target = await make("watcher"), await make("target", restart="permanent")
    watcher.tell(Watch("watch", target))
    await watcher.ask(Heard())
    target.tell(Fail("no"))
    await target.ask(Heard())
    assert await watcher.ask(Heard()) == []
    await system.stop(target)
    assert await watcher.ask(HeardSome(1)) == [["down", "/app/target", "shutdown", "False"]]


@pytest.mark.parametrize("how", ["monitor", "watch"])
async def test_monitor_of_nobody_tells_at_once(make: Make, system: hf.ActorSystem, how: str) -> None:
    watcher, target = await make("watcher"), await make("target")
    await system.stop(target)
    watcher.tell(Watch(how, target))
    assert await watcher.ask(HeardSome(1)) == [["down", "/app/target", "no such actor", "False"]]


async def test_down_keeps_its_place_behind_what_was_sent_before(make: Make) -> None:
    """DESIGN 3: EXIT and DOWN keep their place after earlier messages of the same sender."""
    watcher, target = await make("watcher"), await make("target")
    watcher.tell(Watch("monitor", target))
    await watcher.ask(Heard())
    target.tell(Pass(watcher, "last words"))
    target.tell(Fail("the end"))
    await watcher.ask(HeardSome(1))
    assert await watcher.ask(Notes()) == ["last words"]


async def test_linked_lives_end_together(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    one.tell(Watch("link", other))
    await one.ask(Heard())
    ended = other._cell.ended()
    one.tell(Fail("both"))
    assert str(await ended) == "ValueError: both"


async def test_a_link_works_both_ways_and_trapped_it_informs(make: Make) -> None:
    one, other = await make("one"), await make("other")
    one.tell(Trap())
    one.tell(Watch("link", other))
    await one.ask(Heard())
    other.tell(Fail("me only"))
    assert await one.ask(HeardSome(1)) == [["exit", "/app/other", "ValueError: me only", ""]]


async def test_unlinked_nothing_comes(make: Make) -> None:
    one, other = await make("one"), await make("other")
    one.tell(Trap())
    one.tell(Watch("link", other))
    one.tell(Watch("unlink", other))
    await one.ask(Heard())
    gone = other._cell.ended()
    other.tell(Fail("alone"))
    await gone
    assert await one.ask(Heard()) == []


async def test_link_to_nobody_is_an_exit(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    await system.stop(other)
    one.tell(Trap())
    one.tell(Watch("link", other))
    assert await one.ask(HeardSome(1)) == [["exit", "/app/other", "no such actor", ""]]


async def test_kill_9_is_told_over_links_and_monitors(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Observer), isolation="process"))
    other = await system.start(hf.child("other", hf.start(Observer), isolation="process"))
    one.tell(Trap())
    one.tell(Watch("link", other))
    one.tell(Watch("monitor", other))
    await one.ask(Heard())
    os.kill(system.pid_of(other), signal.SIGKILL)
    heard = await one.ask(HeardSome(2))
    assert sorted(heard) == [["down", "/app/other", "SIGKILL", "False"], ["exit", "/app/other", "SIGKILL", ""]]


async def test_stop_and_kill_by_ref(make: Make) -> None:
    stopped, killed = await make("stopped"), await make("killed")
    one = await make("one", bindings={"port": "/app/stopped", "second": "/app/killed"})
    ends = stopped._cell.ended(), killed._cell.ended()
    one.tell(StopChild(stopped))
    one.tell(StopChild(killed, kill=True))
    assert [await end for end in ends] == [hf.SHUTDOWN, hf.KILLED]


# -- topics and bindings


async def test_publish_reaches_all_subscribers_and_names_the_sender(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    here = await system.start(hf.child("here", hf.start(Observer)))
    await one.ask(Publish("/news", ["first", "second"]))
    for ref in (one, other, here):
        assert await ref.ask(Notes()) == ["first", "second"]
        assert await ref.ask(WhoSent()) == ["/app/one"] * 2


async def test_subscribe_at_run_time_and_no_more(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    one.tell(Subscribe("/more"))
    await one.ask(Heard())
    await other.ask(Publish("/more", ["yes"]))
    assert await one.ask(Notes()) == ["yes"]
    one.tell(Subscribe("/more", wanted=False))
    await one.ask(Heard())
    await other.ask(Publish("/more", ["no"]))
    assert await one.ask(Notes()) == ["yes"]
    assert "/more" not in system._node.topics.names()


async def test_subscriptions_end_with_the_life(make: Make, system: hf.ActorSystem) -> None:
    one = await make("one", restart="permanent")
    one.tell(Subscribe("/more"))
    await one.ask(Heard())
    assert "/more" in system._node.topics.names()
    one.kill()
    await one.ask(Heard())
    assert system._node.topics.names() == ["/news"], "what the class subscribes to, and nothing else"


async def test_bindings(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    three = await make("three", bindings={"port": "/app/one"}, restart="permanent")
    assert await three.ask(AskPort()) == await one.ask(Where())
    system.bind(three, "port", other)
    assert await three.ask(AskPort()) == await other.ask(Where())
    three.kill()
    assert await three.ask(AskPort()) == await other.ask(Where()), "a binding outlives the life"


# -- actors inside the process, seen from outside


async def test_a_spawned_actor_is_reached_from_everywhere(make: Make, system: hf.ActorSystem) -> None:
    one, other = await make("one"), await make("other")
    inner = await one.ask(Spawn("inner"))
    assert inner.path == "/app/one/inner"
    assert await inner.ask(Where()) == await one.ask(Where()) == system.pid_of(inner)
    assert await system.ref("/app/one/inner", Observer).ask(Heard()) == []
    inner.tell(Note("from here"))
    await other.ask(Publish("/news", ["from there"]))
    assert await inner.ask(Notes()) == ["from here", "from there"]
    with pytest.raises(hf.errors.NoSuchActor):
        system.ref("/app/one/nobody", Notebook)
    with pytest.raises(hf.errors.WrongActor):
        system.ref("/app/one/inner", Stranger)
    with pytest.raises(hf.UnknownMessage):
        inner.tell(Unheard())
    assert "/app/one/inner" in system.tree()


class Stranger(hf.Actor):
    pass


class Unheard(hf.Message):
    pass


async def test_a_spawned_actor_is_watched_and_linked_from_outside(make: Make) -> None:
    one, other = await make("one"), await make("other")
    inner = await one.ask(Spawn("inner"))
    other.tell(Trap())
    other.tell(Watch("link", inner))
    other.tell(Watch("monitor", inner))
    other.tell(Watch("watch", inner))
    await other.ask(Heard())
    await inner.ask(Heard())
    inner.tell(Fail("inside"))
    heard = await other.ask(HeardSome(3))
    down, gone = ["down", "/app/one/inner", "ValueError: inside", "False"], ["exit", "/app/one/inner"]
    assert sorted(heard)[:2] == [down, down]
    assert sorted(heard)[2][:3] == [*gone, "ValueError: inside"]
    heard = await other.ask(Heard())
    assert len(heard) == 3


async def test_a_spawned_actor_watches_and_links_outwards(make: Make) -> None:
    one, other = await make("one"), await make("other")
    inner = await one.ask(Spawn("inner"))
    inner.tell(Watch("monitor", other))
    inner.tell(Watch("link", other))
    inner.tell(Trap())
    await inner.ask(Heard())
    other.tell(Fail("outside"))
    heard = await inner.ask(HeardSome(2))
    assert sorted(line[0] for line in heard) == ["down", "exit"]
    assert await one.ask(Heard()) == [], "it was the inner one that watched"


async def test_a_spawned_actor_ends_with_its_process(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Observer), isolation="process"))
    other = await system.start(hf.child("other", hf.start(Observer), isolation="process"))
    inner = await one.ask(Spawn("inner"))
    other.tell(Watch("monitor", inner))
    await other.ask(Heard())
    waiting = inner.ask(HeardSome(1))
    os.kill(system.pid_of(one), signal.SIGKILL)
    assert await other.ask(HeardSome(1)) == [["down", "/app/one/inner", "SIGKILL", "False"]]
    with pytest.raises(hf.AskFailed, match="SIGKILL"):
        await waiting
    with pytest.raises(hf.ActorStopped):
        await inner.ask(Heard())
    await one.ask(Spawn("inner"))
    assert await inner.ask(Heard()) == [], "somebody lives at the address again"


async def test_who_has_ended_is_said_to_have_ended_by_whatever_way_he_is_told(
    system: hf.ActorSystem, make: Make
) -> None:
    """Nobody there has a class that could say that it does not know the message."""
    one, other = await make("one"), await system.start(hf.child("other", hf.start(Observer)))
    system.bind(one, "port", other)
    assert await one.ask(AskPort()) == os.getpid()
    assert await one.ask(Send(other, 1)) == "1 sent"
    with system.events() as events:
        await system.stop(other)
        one.tell(Pass(other, "too late"))
        assert await one.ask(Send(other, 1)) == "0 ActorStopped"
        with pytest.raises(hf.RemoteCrash, match="ActorStopped: /app/other has stopped"):
            await one.ask(AskPort())
        letters = [event.why for event in events.take() if isinstance(event, hf.events.DeadLetter)]
    assert len(letters) == 1
