"""What was submitted takes effect when it is as safe as it has to be, in order, whatever the store does meanwhile."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.engine_calls import Called
from holdfast.checkpoint.group_commit import RETRY_SECONDS, Commits
from holdfast.checkpoint.journal import Entry, StoreFailed
from holdfast.checkpoint.protocol import SnapshotNow
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.players import Do, Doer, Note, Seen, Sink, start, until


class Slow:
    """A real engine whose syncs wait for us, and whose calls are noted."""

    def __init__(self, path: Path) -> None:
        self.real = SqliteJournal(path)
        self.let_sync = threading.Event()
        self.appends: list[int] = []
        self.syncs = 0
        self.full = False
        self.broken = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        if self.full:
            raise StoreFailed("app.db", "no room; nothing was written")
        self.appends.append(len(entries))
        return self.real.append(entries)

    def sync(self) -> None:
        self.let_sync.wait(20.0)
        self.syncs += 1
        if self.broken:
            raise StoreFailed("app.db", "the disk is gone")
        self.real.sync()


class Effect:
    weight = 1

    def __init__(self, name: str, done: list[str], paths: Sequence[str] = ("/a",), *, may_refuse: bool = False) -> None:
        self.entries = [(path, ("in", name)) for path in paths]
        self.name, self.done, self.may_refuse = name, done, may_refuse

    def written(self, positions: Sequence[int]) -> None:
        assert len(positions) == len(self.entries)

    def safe(self) -> None:
        self.done.append(self.name)

    def refused(self, error: hf.HoldfastError) -> bool:
        if self.may_refuse:
            self.done.append(f"{self.name} refused")
        return self.may_refuse

    def abandoned(self, error: hf.HoldfastError) -> None:
        pass


@pytest.fixture
def engine(tmp_path: Path) -> Any:
    return Slow(tmp_path / "app.db")


@asynccontextmanager
async def opened(engine: Any, events: list[Any] | None = None, durability: Any = "os") -> AsyncGenerator[Commits]:
    emit = (lambda event: None) if events is None else events.append
    commits = Commits(Called(engine), asyncio.get_running_loop(), durability=durability, emit=emit)
    try:
        yield commits
    finally:
        engine.let_sync.set()
        commits.close()


async def ticks(count: int = 5) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


async def test_all_of_a_tick_is_one_append(engine: Any) -> None:
    done: list[str] = []
    async with opened(engine) as commits:
        commits.want("/a", None)
        for name in "abc":
            commits.submit(Effect(name, done))
        assert done == []
        await ticks()
        assert (done, engine.appends, engine.syncs) == (["a", "b", "c"], [3], 0)


async def test_what_wants_a_sync_waits_for_it_and_gathers_meanwhile(engine: Any) -> None:
    done: list[str] = []
    async with opened(engine, durability="fsync") as commits:
        commits.want("/a", None)
        commits.submit(Effect("a", done))
        await ticks()
        for name in "bcd":
            commits.submit(Effect(name, done))
            await ticks()
        assert (done, engine.appends) == ([], [1])  # Nothing counts, and the loop goes on.
        engine.let_sync.set()
        await commits.settled()
        assert (done, engine.appends, engine.syncs) == (list("abcd"), [1, 3], 2)


async def test_what_is_safe_only_when_it_is_synced_waits_for_that_whatever_is_wanted(engine: Any) -> None:
    done: list[str] = []
    engine.safe_at = "sync"
    async with opened(engine) as commits:
        commits.want("/a", "os")
        commits.submit(Effect("a", done))
        await ticks()
        assert (done, engine.appends) == ([], [1])
        engine.let_sync.set()
        await commits.settled()
        assert (done, engine.syncs) == (["a"], 1)


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_what_is_waited_for_needs_no_time_if_the_message_handler_was_woken_and_does_not_come(engine: Any) -> None:
    done: list[str] = []
    async with opened(engine) as commits:
        commits.wake_handler = lambda: None
        commits.submit(Effect("a", done))
        began = asyncio.get_running_loop().time()
        await commits.settled()
        assert (done, asyncio.get_running_loop().time()) == (["a"], began)


async def test_each_has_its_own_lane_but_never_overtakes_itself(engine: Any) -> None:
    done: list[str] = []
    async with opened(engine) as commits:
        commits.want("/slow", "fsync")
        commits.want("/quick", "os")
        commits.want("/other", "os")
        commits.submit(Effect("quick", done, ["/quick"]))
        commits.submit(Effect("both", done, ["/quick", "/slow"]))
        commits.submit(Effect("behind both", done, ["/quick"]))  # What it gives to others must not come before.
        commits.submit(Effect("other", done, ["/other"]))
        await ticks()
        assert done == ["quick", "other"]
        engine.let_sync.set()
        await commits.settled()
        commits.submit(Effect("quick again", done, ["/quick"]))
        await ticks()
        assert done == ["quick", "other", "both", "behind both", "quick again"]


@pytest.mark.parametrize("default", ["os", "fsync"])
async def test_what_is_kept_for_somebody_who_is_not_started_may_have_to_be_synced(engine: Any, default: Any) -> None:
    done: list[str] = []
    async with opened(engine, durability=default) as commits:
        commits.want("/quick", "os")
        if default == "os":
            commits.want("/slow", "fsync")
        commits.submit(Effect("told", done, ["/quick", "/not started"]))
        await ticks()
        assert done == []
        engine.let_sync.set()
        await commits.settled()
        assert done == ["told"]


async def test_without_room_what_can_be_refused_is_and_the_rest_waits(engine: Any) -> None:
    done: list[str] = []
    events: list[Any] = []
    async with opened(engine, events) as commits:
        commits.want("/a", None)
        engine.full = True
        commits.submit(Effect("turn", done))
        commits.admit(Effect("message", done, may_refuse=True))
        await ticks()
        assert done == ["message refused"]
        with pytest.raises(StoreFailed, match="no room"):
            commits.admit(Effect("later", done))
        commits.submit(Effect("next turn", done))
        with pytest.raises(StoreFailed, match="no room"):
            commits.barrier()
        engine.full = False
        await until(lambda: len(done) == 3)
        assert done == ["message refused", "turn", "next turn"]
        commits.admit(Effect("accepted", done))
        await ticks()
        assert done[-1] == "accepted"
    assert [type(one) for one in events] == [hf.events.JournalBlocked, hf.events.JournalGoesOn]


async def test_a_failed_sync_stops_it_for_good(engine: Any) -> None:
    """T13: what it has left on the disk is unknown, so nothing that waited for it ever takes effect."""
    done: list[str] = []
    events: list[Any] = []
    async with opened(engine, events, "fsync") as commits:
        commits.want("/a", None)
        engine.broken = True
        engine.let_sync.set()
        commits.submit(Effect("turn", done))
        commits.admit(Effect("message", done, may_refuse=True))
        await until(lambda: commits.stopped is not None)
        assert done == ["message refused"]
        engine.broken = False
        commits.submit(Effect("turn", done))
        for call in (lambda: commits.admit(Effect("x", done)), commits.barrier, commits.sync):
            with pytest.raises(StoreFailed, match="the disk is gone"):
                call()
        await ticks()
        assert done == ["message refused"]
    assert [type(one) for one in events] == [hf.events.JournalStopped]


async def test_without_a_thread_to_be_had_the_loop_itself_waits_for_the_disk(
    engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*args: Any, **named: Any) -> None:
        raise RuntimeError("can't start new thread")

    engine.let_sync.set()
    name = "_start_joinable_thread" if hasattr(threading, "_start_joinable_thread") else "_start_new_thread"
    with monkeypatch.context() as patch:
        patch.setattr(threading, name, refused)
        async with hf.ActorSystem("app", log=False, store=engine, durability="fsync") as system:
            doer = await start(system, "task", "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
            before = engine.syncs
            assert await doer.ask(Note("one"), timeout=30.0) == 1
            assert engine.syncs > before
            patch.undo()
            assert await doer.ask(Note("two"), timeout=30.0) == 2


async def test_a_handler_that_does_not_come_is_done_without(engine: Any) -> None:
    done: list[str] = []
    woken: list[int] = []
    async with opened(engine) as commits:
        commits.want("/a", None)
        commits.wake_handler = lambda: woken.append(1)
        commits.submit(Effect("a", done))
        await until(lambda: done == ["a"])
        assert woken == [1]

        def gone() -> None:
            raise hf.ActorStopped("/app/recovery/messages")

        commits.wake_handler = gone
        commits.submit(Effect("b", done))
        await ticks()
        assert done == ["a", "b"]


async def test_an_effect_that_fails_does_not_hold_up_the_others(engine: Any) -> None:
    done: list[str] = []
    troubles: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: troubles.append(context["exception"]))
    async with opened(engine) as commits:
        commits.want("/a", None)
        bad = Effect("bad", done)
        bad.safe = lambda: 1 / 0  # type: ignore[assignment, method-assign]
        commits.submit(bad)
        commits.submit(Effect("good", done))
        await ticks()
    assert done == ["good"]
    assert [type(one) for one in troubles] == [ZeroDivisionError]


# -- in a system -----------------------------------------------------------------------------------------------------


async def test_nothing_counts_before_the_sync(engine: Any, isolation: str) -> None:
    """Send does not return, an ask is not fed, a reply does not leave."""
    async with hf.ActorSystem("app", log=False, store=engine, durability="fsync", intensity=1000) as system:
        engine.let_sync.set()
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        sink = system.spawn(hf.start(Sink), "sink")
        await system._homes.settled()
        engine.let_sync.clear()
        reply = doer.ask(Do(["add a", "tell out"], sink), timeout=30.0)
        sent = asyncio.ensure_future(doer.send(Note("b")))
        waiting: list[asyncio.Future[Any]] = [reply, sent]
        done, _ = await asyncio.wait(waiting, timeout=0.1)
        assert done == set()
        home = system._homes.at(doer.path)
        assert home is not None
        assert home.turn == 0  # on_start: nothing was fed.
        engine.let_sync.set()
        assert await reply == "1"
        await sent
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "b"]


async def test_the_death_of_an_actor_before_the_sync_feeds_nothing_twice(engine: Any, isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, store=engine, durability="fsync", intensity=1000) as system:
        engine.let_sync.set()
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        await system._homes.settled()
        engine.let_sync.clear()
        replies = [doer.ask(Note(text), timeout=30.0) for text in "abc"]
        await ticks()
        with system.events() as events:
            doer.kill()
            async for event in events:
                if isinstance(event, hf.events.Recovered):
                    break
        later = doer.ask(Note("d"), timeout=30.0)
        await asyncio.sleep(0.05)
        assert not any(reply.done() for reply in (*replies, later))  # Nobody hears of what is not safe.
        engine.let_sync.set()
        assert [await reply for reply in (*replies, later)] == [1, 2, 3, 4]
        assert await doer.ask(Seen(), timeout=30.0) == list("abcd")


async def test_a_full_disk_refuses_clearly_and_when_there_is_room_all_goes_on(engine: Any, isolation: str) -> None:
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        await doer.ask(Note("a"))
        engine.full = True
        begun = doer.ask(Note("b"), timeout=30.0)  # It is handled before anybody can know, and its reply waits.
        await until(lambda: system._homes.journal.blocked is not None)
        with pytest.raises(StoreFailed, match="no room"):
            await doer.ask(Note("refused"), timeout=30.0)
        with pytest.raises(StoreFailed, match="no room"):
            await doer.send(Note("c"))
        with pytest.raises(StoreFailed, match="no room"):
            doer.tell(Note("d"))
        assert not begun.done()
        engine.full = False
        assert await begun == 2
        async with asyncio.timeout(30.0):
            while True:
                try:
                    await doer.ask(Note("e"), timeout=30.0)
                    break
                except StoreFailed:
                    await asyncio.sleep(0.01)
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "b", "e"]


async def test_an_ask_that_has_met_a_full_disk_says_so_when_its_time_is_over(engine: Any, isolation: str) -> None:
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        await doer.ask(Note("a"))
        engine.full = True
        with pytest.raises(hf.AskTimeout) as late:
            await doer.ask(Note("b"), timeout=0.3)
        assert "do not ask again, for it goes on with this when its store takes something again: " in str(late.value)
        assert "no room" in str(late.value)
        assert str(late.value).endswith("it may have been handled")
        engine.full = False
        await until(lambda: system._homes.journal.blocked is None)


async def test_the_first_who_comes_when_there_is_room_is_taken(engine: Any) -> None:
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, "task", "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        await doer.ask(Note("a"))
        commits = system._homes.journal
        engine.full = True
        begun = doer.ask(Note("b"), timeout=30.0)
        await until(lambda: commits._retry.delay >= 0.4)  # So far apart are its own attempts by now.
        clock = asyncio.get_running_loop()
        await until(lambda: clock.time() - commits._retry.tried_at >= RETRY_SECONDS)
        engine.full = False
        assert await doer.ask(Note("c"), timeout=30.0) == 3
        assert await begun == 2


async def test_a_store_without_room_is_tried_by_one_timer_however_many_come(engine: Any) -> None:
    """Else each that comes leaves one behind."""
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, "task", "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        await doer.ask(Note("a"))
        commits, timers = system._homes.journal, set[asyncio.TimerHandle]()
        engine.full = True
        begun = doer.ask(Note("b"), timeout=30.0)
        await until(lambda: commits._retry.timer is not None)
        for _ in range(5):
            with pytest.raises(StoreFailed, match="no room"):
                await doer.ask(Note("c"), timeout=30.0)
            await until(lambda: asyncio.get_running_loop().time() - commits._retry.tried_at >= RETRY_SECONDS)
            if commits._retry.timer is not None:
                timers.add(commits._retry.timer)
        now = asyncio.get_running_loop().time()
        assert sum(not one.cancelled() and one.when() > now for one in timers) <= 1
        engine.full = False
        assert await begun == 2


class Spread(hf.Message[None]):
    text: str


class Station(hf.Actor):
    @hf.on(Spread)
    async def spread(self, message: Spread) -> None:
        await self.ctx.publish("/news", Note(message.text))


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_was_published_and_has_no_room_is_a_dead_letter_and_the_others_get_it(
    engine: Any, isolation: Any
) -> None:
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await system.start(hf.child("doer", hf.start(Listener), recovery=hf.hybrid(interval=1000.0)))
        other = await system.start(hf.child("other", hf.start(Listener)))
        station = await system.start(hf.child("station", hf.start(Station), isolation=isolation))
        await station.ask(Spread("a"), timeout=30.0)
        engine.full = True
        with system.events() as events:
            await station.ask(Spread("b"), timeout=30.0)
            assert await other.ask(Seen(), timeout=30.0) == ["a", "b"]
            await system._homes.settled()
            letters = [one for one in events.take() if isinstance(one, hf.events.DeadLetter)]
            assert [(one.address, "no room" in one.why) for one in letters] == [(doer.path, True)]
            engine.full = False
            async with asyncio.timeout(30.0):
                async for event in events:
                    if isinstance(event, hf.events.JournalGoesOn):
                        break
        assert await doer.ask(Seen(), timeout=30.0) == ["a"]


class Listener(Doer):
    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/news")


async def test_a_turn_that_ends_without_room_answers_when_there_is(engine: Any, isolation: str, gate: Path) -> None:
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0))
        reply = doer.ask(Do([f"gate {gate}", "add a"]), timeout=30.0)
        await until(gate.exists)
        engine.full = True
        Path(f"{gate}.open").touch()
        home = system._homes.at(doer.path)
        assert home is not None
        await until(lambda: home.turn == 1)
        await asyncio.sleep(0.1)
        assert not reply.done()
        engine.full = False
        assert await reply == "1"


async def test_a_snapshot_has_timers_and_topics_that_have_not_taken_effect_yet(
    engine: Any, tmp_path: Path, gate: Path
) -> None:
    """They are in turns that the snapshot covers, so nothing else is left of them in the journal (T10)."""
    engine.let_sync.set()
    recovery = hf.hybrid(interval=1000.0)
    async with hf.ActorSystem("app", log=False, store=engine, durability="fsync", intensity=1000) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=recovery))
        doer.tell(Do([f"gate {gate}", "after 1000", "subscribe /news"]))
        await until(gate.exists)
        engine.let_sync.clear()
        Path(f"{gate}.open").touch()
        home = system._homes.at(doer.path)
        assert home is not None
        await until(lambda home=home: home.turn == 1)
        assert home.life.port is not None
        assert home.timers.saved() == {}
        home.life.port.to_life(SnapshotNow())
        await until(lambda home=home: home.ledger.newest is not None and home.ledger.newest.turn == 1)
        assert home.ledger.newest is not None
        assert [name.rpartition(":")[2] for name, *_ in home.ledger.newest.timers.values()] == ["Tick"]
        assert home.ledger.newest.topics == ["/news"]
        engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}") as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=recovery))
        home = system._homes.at(doer.path)
        assert home is not None
        assert (len(home.timers.saved()), list(home.topics)) == (1, ["/news"])


async def test_a_real_disk_without_room(tmp_path: Path) -> None:
    engine = SqliteJournal(tmp_path / "app.db")
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        db = engine._store.db
        (pages,) = db.execute("PRAGMA page_count").fetchone()
        db.execute(f"PRAGMA max_page_count = {pages + 2}")
        accepted: list[str] = []

        async def fill() -> None:
            for n in range(1000):
                accepted.append(f"{n} {'x' * 1000}")
                await doer.send(Note(accepted[-1]))  # An ask whose turn has no room waits until there is.

        with pytest.raises(StoreFailed, match="make room"):
            await fill()
        refused = accepted.pop()
        db.execute("PRAGMA max_page_count = 100000")
        await until(lambda: system._homes.journal.blocked is None)
        await doer.ask(Note("last"), timeout=30.0)
        assert await doer.ask(Seen(), timeout=30.0) in ([*accepted, "last"], [*accepted, refused, "last"])
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}") as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        assert await doer.ask(Seen(), timeout=30.0) in ([*accepted, "last"], [*accepted, refused, "last"])


async def test_a_killed_message_handler_loses_nothing(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with hf.ActorSystem("app", log=False, store=store, durability="fsync", intensity=1000) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=0.05))
        await until(lambda: system._homes.journal.wake_handler is not None)  # It is up.
        handler = system.ref("/app/recovery/messages", hf.Actor)
        replies: list[Any] = []
        for n in range(300):
            replies.append(doer.ask(Note(str(n)), timeout=60.0))
            if n % 10 == 0:
                handler.kill()
                await asyncio.sleep(0)
        assert [await reply for reply in replies] == list(range(1, 301))


async def test_each_child_may_say_what_it_wants(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    specs = {word: hf.hybrid(interval=1000.0, durability=word) for word in ("memory", "os", "fsync")}
    async with hf.ActorSystem("app", log=False, store=store, intensity=1000) as system:
        for word, recovery in specs.items():
            doer = await system.start(hf.child(word, hf.start(Doer), recovery=recovery))
            await doer.ask(Note(word))
            doer.kill()
            assert await doer.ask(Seen(), timeout=20.0) == [word]
        memory = system.ref("/app/memory", Doer)
        await memory.ask(Do(["tell passed on"], system.ref("/app/os", Doer)))
    async with hf.ActorSystem("app", log=False, store=store, intensity=1000) as system:
        refs = [await system.start(hf.child(word, hf.start(Doer), recovery=one)) for word, one in specs.items()]
        assert [await ref.ask(Seen(), timeout=20.0) for ref in refs] == [[], ["os", "passed on"], ["fsync"]]


async def test_durability_without_a_store_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="needs a store"):
        hf.ActorSystem("app", durability="fsync")
    with pytest.raises(hf.SpecError, match="durability must be one of"):
        hf.ActorSystem("app", durability="disk")  # type: ignore[arg-type]
    with pytest.raises(hf.SpecError, match="has no 'append'"):
        hf.ActorSystem("app", store=object())  # type: ignore[arg-type]
    async with hf.ActorSystem("app", log=False) as system:
        with pytest.raises(hf.HoldfastError, match="needs a store"):
            await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(durability="os")))


async def test_a_handler_that_has_ended_in_good_order_is_woken_no_more(engine: Any) -> None:
    """What woke it was a dead letter, and the log of an orderly end looked as if something had been lost."""
    engine.let_sync.set()
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await start(system, "task", "doer", hf.start(Doer), recovery=hf.hybrid())
        await doer.send(Note("a"))
        async with asyncio.timeout(20.0):
            while (handler := system._node.cell_at("/app/recovery/messages").actor) is None:
                await asyncio.sleep(0.001)
        handler.on_stop(hf.SHUTDOWN)
        await doer.send(Note("b"))
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "b"]
        assert system._homes.journal.wake_handler is None
