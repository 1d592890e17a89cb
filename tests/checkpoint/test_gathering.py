"""What many turns have to write is written together, also when a write takes longer than a slice of the loop."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

import holdfast as hf
from holdfast.checkpoint.journal import Entry
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.root_player import All, Ledger, Put

TELLS = 10_000
BURST = 1_000


class Counting(SqliteJournal):
    """A store that counts how often it is written to."""

    appends = 0

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        self.appends += 1
        return super().append(entries)


async def test_turns_of_a_recorded_actor_share_their_writes(tmp_path: Path) -> None:
    engine = Counting(tmp_path / "app.db")
    async with hf.ActorSystem("app", store=engine, log=False) as system:
        ledger = await system.start(hf.child("a", hf.start(Ledger), recovery=hf.hybrid(interval=1000.0)))
        before = engine.appends
        for number in range(TELLS):
            ledger.tell(Put(number))
            if number % BURST == BURST - 1:
                await asyncio.sleep(0)
        assert await ledger.ask(All(), timeout=60.0) == [*range(TELLS)]
        assert engine.appends - before < TELLS / 4, "each turn was written on its own"


class Do(hf.Message[int]):
    """Have so many effects, then tell somebody."""

    count: int


class Told(hf.Message): ...


class Look(hf.Message[int]): ...


class Plain(hf.Actor):
    def __init__(self, told: asyncio.Event) -> None:
        self.told = told

    @hf.on(Told)
    def take(self, message: Told) -> None:
        self.told.set()


class Doer(hf.Actor):
    def __init__(self) -> None:
        self.done = 0

    @hf.on(Do)
    async def do(self, message: Do) -> int:
        for number in range(message.count):
            self.done += await self.ctx.effect(one, key=f"n{number}")
        WENT_ON.set()
        self.ctx.find("/app/plain", Plain).tell(Told())
        return self.done

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> int:
        return self.done


WENT_ON = asyncio.Event()
HOLDS: list[bool] = []


async def one() -> int:
    HOLDS.append(True)
    return 1


class Holding(Counting):
    """A store whose syncs wait as soon as an effect has been made, until they are let go."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.let_go = asyncio.Event()

    def synced(self) -> asyncio.Future[None]:
        return asyncio.ensure_future(self._synced(bool(HOLDS)))

    async def _synced(self, waits: bool) -> None:
        if waits:
            await self.let_go.wait()
        self.sync()


async def test_what_a_turn_has_heard_is_written_with_what_it_says_next(tmp_path: Path) -> None:
    """Each effect makes one append: what came of the one before it, and that it is about to be made."""
    engine = Counting(tmp_path / "app.db")
    async with hf.ActorSystem("app", store=engine, log=False) as system:
        await system.start(hf.child("plain", hf.start(Plain, asyncio.Event())))
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        await system._homes.settled()
        before = engine.appends
        assert await doer.ask(Do(20)) == 20
        assert engine.appends - before < 30


async def test_a_turn_goes_on_before_what_it_has_heard_is_safe_and_lets_nothing_out(tmp_path: Path) -> None:
    WENT_ON.clear()
    HOLDS.clear()
    told, engine = asyncio.Event(), Holding(tmp_path / "app.db")
    async with hf.ActorSystem("app", store=engine, durability="fsync", log=False) as system:
        await system.start(hf.child("plain", hf.start(Plain, told)))
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        asked = asyncio.ensure_future(doer.ask(Do(1), timeout=60.0))
        await WENT_ON.wait()
        looked = asyncio.ensure_future(doer.ask(Look(), timeout=60.0))
        for _ in range(50):
            await asyncio.sleep(0)
        assert not any((told.is_set(), asked.done(), looked.done()))
        engine.let_go.set()
        assert await asked == await looked == 1
        await told.wait()
