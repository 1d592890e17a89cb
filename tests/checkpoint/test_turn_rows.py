"""How few rows the journal needs for turns, and that nobody hears of a turn before all of it is safe."""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.switch import Switch
from holdfast.checkpoint.inputs import Input, spread
from holdfast.checkpoint.journal import Entry
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.players import Do, Doer, Note, Notes, Seen, Sink, Tick, start, until

pytestmark = pytest.mark.usefixtures("warm_programs")

RECOVERY = hf.hybrid(interval=1000.0)


class Noted:
    """A real engine that notes what is appended, and whose appends can be held back by `full`."""

    def __init__(self, path: Path) -> None:
        self.real = SqliteJournal(path)
        self.rows: list[Entry] = []
        self.is_full = self.is_broken = False

    def has_failed(self) -> bool:
        return self.is_broken or self.real.has_failed()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        if self.is_full:
            raise hf.errors.StoreFailed("app.db", "no room; nothing was written")
        positions = self.real.append(entries)
        self.rows += [entry for address, entry in entries if address.endswith("/doer")]
        return positions


@pytest.fixture
def engine(tmp_path: Path) -> Noted:
    return Noted(tmp_path / "app.db")


def kinds(rows: Sequence[Entry]) -> list[str]:
    return [str(row[0]) for row in rows]


async def again(path: Path) -> list[str]:
    """What the actor of a store has seen, as the next program finds it."""
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{path}") as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        return await doer.ask(Seen(), timeout=30.0)


async def test_an_ask_and_the_end_of_its_turn_are_one_row(engine: Any, tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Do(["add 0"]))
        engine.rows.clear()
        assert await asyncio.gather(*[doer.ask(Do([f"add {n}"])) for n in range(1, 9)]) == [
            str(n) for n in range(2, 10)
        ]
        [(kind, _, _, inputs, *ends)] = engine.rows
        assert (kind, len(inputs)) == ("ins", 24)
        assert [end[1:3] for end in ends] == [(number, "ok") for number in range(2, 10)]
        engine.rows.clear()
        await doer.ask(Do(["add 9"]))
        [row] = engine.rows
        assert (row[0], *row[8:10]) == ("in", 10, "ok")
        doer.kill()
        assert await doer.ask(Seen(), timeout=30.0) == [str(n) for n in range(10)]
    assert await again(tmp_path / "app.db") == [str(n) for n in range(10)]


async def test_told_messages_and_the_ends_of_their_turns_are_a_row_each(engine: Any, tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Seen())
        engine.rows.clear()
        for n in range(40):
            doer.tell(Do([f"add {n}"]))
        assert await doer.ask(Seen(), timeout=30.0) == [str(n) for n in range(40)]
        assert kinds(engine.rows).count("in") == 1  # the ask
        assert kinds(engine.rows).count("ins") == 1
        assert 1 <= kinds(engine.rows).count("ends") <= 4  # As many as there were ticks.
        assert kinds(engine.rows).count("end") <= 1
        await system.checkpoint(doer)
        for n in range(40, 60):
            doer.tell(Do([f"add {n}"]))
        await doer.ask(Seen(), timeout=30.0)
    assert await again(tmp_path / "app.db") == [str(n) for n in range(60)]


@pytest.mark.parametrize("is_damaged", [False, True], ids=["newest", "older"])
@pytest.mark.parametrize("every", [1, 7, 33])
async def test_a_snapshot_may_contain_a_part_of_a_row(
    engine: Any, tmp_path: Path, every: int, is_damaged: bool
) -> None:
    """Snapshots in the middle of a burst: what they contain is not handled again, and the rest is not lost."""
    method = hf.hybrid(interval=1000.0, every=every)
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=method))
        await doer.ask(Do(["add first"]))
        for n in range(100):
            doer.tell(Do([f"add {n}"]))
        expected = ["first", *map(str, range(100))]
        gate = str(tmp_path / "gate")
        doer.tell(Do([f"gate {gate}"]))
        for n in range(100, 110):
            doer.tell(Do([f"add {n}"]))
        await until(Path(gate).exists)  # All before it has ended, the rest waits.
        assert kinds(engine.rows).count("ins") >= 1
        doer.kill()
        Path(f"{gate}.open").touch()
        expected += map(str, range(100, 110))
        assert await doer.ask(Seen(), timeout=30.0) == expected
        assert engine.real.load("/app/doer").turn > 0
    if is_damaged:
        with contextlib.closing(sqlite3.connect(tmp_path / "app.db")) as db, db:
            db.execute("UPDATE snapshots SET digest = zeroblob(16) WHERE id = (SELECT max(id) FROM snapshots)")
    assert await again(tmp_path / "app.db") == expected


@pytest.mark.parametrize("seed", range(4))
async def test_rows_that_are_cut_anywhere_lose_nothing(tmp_path: Path, seed: int) -> None:
    """Bursts of several types and senders, snapshots, kills and new programs: each message once, in its order."""
    chance = random.Random(seed)
    method = hf.hybrid(interval=1000.0, every=chance.choice((3, 8, 20)), keep=chance.choice((1, 2, 3)))
    expected: list[str] = []
    for _ in range(4):
        async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path}/app.db", intensity=1000) as system:
            doer = await system.start(hf.child("doer", hf.start(Doer), recovery=method))
            asks: list[Any] = []
            for _ in range(12):
                for _ in range(chance.randrange(40)):
                    text = str(len(expected))
                    expected.append(text)
                    match chance.randrange(8):
                        case 0:
                            asks.append(doer.ask(Do([f"add {text}"]), timeout=30.0))
                        case 1:
                            doer.tell(Tick(text))
                        case 2:
                            doer.tell(Note(text))
                        case _:
                            doer.tell(Do([f"add {text}"]))
                match chance.randrange(4):
                    case 0:
                        await system.checkpoint(doer)
                    case 1:
                        doer.kill()
                    case _:
                        pass
                for _ in range(chance.choice((0, 1, 2, 5))):
                    await asyncio.sleep(0)
            await asyncio.gather(*asks)  # What was told behind them may be left to the next program.
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path}/app.db") as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=method))
        assert await doer.ask(Seen(), timeout=30.0) == expected
        await system.checkpoint(doer)
        await system.checkpoint(doer)
        rows = [entry for _, entry in system._homes.journal.load("/app/doer").entries]
        assert [row for row in rows if row[0] in ("in", "ins")] == [], "rows stay no longer than they are needed"


class Sent(hf.Message):
    by: str


class Senders(hf.Message[list[list[str]]]): ...


class Register(hf.Actor):
    """Notes who has told it something, as the message says and as the actor is told."""

    def __init__(self) -> None:
        self.seen: list[list[str]] = []

    @hf.on(Sent)
    def note(self, message: Sent) -> None:
        self.seen.append([message.by, "" if self.ctx.sender is None else self.ctx.sender.path])

    @hf.on(Senders, readonly=True)
    def read(self, message: Senders) -> list[list[str]]:
        return list(self.seen)


class Teller(hf.Actor):
    """Tells several times what it gets."""

    def __init__(self, to: hf.ActorRef[Register]) -> None:
        self._to = to

    @hf.on(Sent)
    def pass_on(self, message: Sent) -> None:
        for _ in range(3):
            self._to.tell(message)


async def test_each_message_keeps_its_sender(engine: Any) -> None:
    """Messages of one type from several senders, and from nobody, come in one tick."""

    async def seen(register: hf.ActorRef[Register]) -> list[list[str]]:
        found: list[list[str]] = []
        while len(found) < 21:
            found = await register.ask(Senders(), timeout=30.0)
        return found

    async with hf.ActorSystem("app", log=False, store=engine) as system:
        register = await system.start(hf.child("register", hf.start(Register), recovery=RECOVERY))
        tellers = [await system.start(hf.child(f"teller{n}", hf.start(Teller, register))) for n in range(3)]
        for _ in range(2):
            for teller in tellers:
                teller.tell(Sent(teller.path))
        for _ in range(3):
            register.tell(Sent(""))
        assert all(said == by for said, by in await seen(register))
        rows = [one for _, entry in engine.real.load("/app/register").entries for one in spread(entry)]
        kept = [one for one in rows if one[0] == "in" and one[3] == f"{__name__}:Sent"]
        assert len(kept) == 21
        for one in kept:
            assert (one[6] or "") == system._node.codec.decode(Sent, one[4]).by


async def test_a_full_disk_refuses_each_message_of_a_row(engine: Any, tmp_path: Path) -> None:
    """Who waits is told, the others are dead letters; all of them are, and the next ones are taken again."""
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Do(["add a"]))
        engine.is_full = True
        with system.events() as events:
            for n in range(5):
                doer.tell(Do([f"add {n}"]))
            sends = [asyncio.ensure_future(doer.send(Do([f"add {n}"]))) for n in range(3)]
            outcomes = await asyncio.gather(*sends, return_exceptions=True)
            letters = [event for event in events.take() if isinstance(event, hf.events.DeadLetter)]
        assert all(isinstance(one, hf.errors.StoreError) for one in outcomes)
        assert len(letters) == 5
        engine.is_full = False
        await until(lambda: system._homes.journal.blocked is None)
        await doer.send(Do(["add b"]))
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "b"]
    assert await again(tmp_path / "app.db") == ["a", "b"]


async def test_the_trouble_of_one_message_in_a_row_is_not_anothers(engine: Any, monkeypatch: Any) -> None:
    troubles: list[Any] = []
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Do(["add a"]))
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: troubles.append(context["exception"]))
        admitted = Switch.admitted

        def troubled(self: Switch, source: Input) -> None:
            if source.body == bad:
                raise RuntimeError("of one message")
            admitted(self, source)

        bad = system._node.codec.encode(Do(["add 1"]), "/app/doer")
        monkeypatch.setattr(Switch, "admitted", troubled)
        for n in range(3):
            doer.tell(Do([f"add {n}"]))
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "0", "2"]
    assert [str(one) for one in troubles] == ["of one message"]


async def test_an_ask_that_runs_ahead_overtakes_no_message(engine: Any, isolation: str) -> None:
    """What was told before waits until it is safe; an ask behind it waits for that."""
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
        await doer.ask(Do(["add first"]))
        doer.tell(Do(["add told"]))
        asked = [doer.ask(Do([f"add asked {n}"])) for n in range(3)]
        doer.tell(Do(["add behind"]))
        last = doer.ask(Do(["add last"]))
        await asyncio.gather(*asked, last)
        expected = ["first", "told", "asked 0", "asked 1", "asked 2", "behind", "last"]
        assert await doer.ask(Seen(), timeout=30.0) == expected


async def test_nothing_leaves_a_turn_that_runs_ahead_before_its_ask_is_safe(engine: Any, isolation: str) -> None:
    """Neither its reply nor what it tells, asks or answers on the way; when there is room, all of it."""
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        sink = await system.start(hf.child("sink", hf.start(Sink)))
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
        await doer.ask(Do(["add a"]))
        engine.is_full = True
        plain = doer.ask(Do(["add b"]), timeout=30.0)
        told = doer.ask(Do(["add c", "tell c"], sink), timeout=30.0)
        asked = doer.ask(Do(["add d", "ask d"], sink), timeout=30.0)
        await until(lambda: system._homes.journal.blocked is not None)
        for _ in range(50):
            await asyncio.sleep(0.001)
        assert await sink.ask(Notes()) == []
        assert not any(one.done() for one in (told, asked, plain))
        engine.is_full = False
        await asyncio.gather(told, asked, plain)
        assert await sink.ask(Notes()) == ["c", "d"]
        assert await doer.ask(Seen(), timeout=30.0) == ["a", "b", "c", "d", "d:2"]


@pytest.mark.parametrize("seed", range(6))
async def test_the_rows_of_a_mixture_stand_in_the_order_of_its_turns(engine: Any, tmp_path: Path, seed: int) -> None:
    """Told, asked, with outputs and without: the journal has each end once, in order, and gives back the same state."""
    chance = random.Random(seed)
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        sink = await system.start(hf.child("sink", hf.start(Sink)))
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Do([]))
        asks: list[Any] = []
        expected: list[str] = []
        for n in range(200):
            expected.append(str(n))
            match chance.randrange(5):
                case 0 | 1:
                    doer.tell(Do([f"add {n}"]))
                case 2:
                    doer.tell(Do([f"add {n}", f"tell {n}"], sink))
                case 3:
                    asks.append(doer.ask(Do([f"add {n}"]), timeout=30.0))
                case _:
                    asks.append(doer.ask(Do([f"add {n}", f"tell {n}"], sink), timeout=30.0))
            for _ in range(chance.choice((0, 0, 0, 1, 2, 5))):
                await asyncio.sleep(0)
        await asyncio.gather(*asks)
        assert await doer.ask(Seen(), timeout=30.0) == expected
        await system._homes.settled()
        ends: list[int] = []
        for row in [one for entry in engine.rows for one in spread(entry)]:
            match row:
                case ("in", *_) if len(row) > 8:
                    ends.append(int(row[8]))
                case ("ends", int() as first, tuple() as inputs):
                    ends += range(first, first + len(inputs))
                case ("end", int() as number, *_):
                    ends.append(number)
                case _:
                    pass
        assert ends == list(range(len(ends)))
        doer.kill()
        assert await doer.ask(Seen(), timeout=30.0) == expected
    assert await again(tmp_path / "app.db") == expected


async def test_a_kill_of_the_actor_costs_no_ask_that_runs_ahead(engine: Any, isolation: str) -> None:
    """Its input is not written yet when its life ends: the next one gets it."""
    async with hf.ActorSystem("app", log=False, store=engine, intensity=1000) as system:
        doer = await start(system, isolation, "doer", hf.start(Doer), recovery=RECOVERY)
        await doer.ask(Do(["add a"]))
        engine.is_full = True
        begun = [doer.ask(Do([f"add {text}"]), timeout=60.0) for text in "bcd"]
        await until(lambda: system._homes.journal.blocked is not None)
        doer.kill()
        engine.is_full = False
        await asyncio.gather(*begun)
        assert await doer.ask(Seen(), timeout=30.0) == list("abcd")


async def test_an_ask_whose_store_stops_before_its_turn_ends_is_told(engine: Any, tmp_path: Path) -> None:
    """Its row is given up while the turn goes on: what comes of the turn has nothing to stand in, and says so."""
    gate = str(tmp_path / "gate")
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Do(["add a"]))
        engine.is_full = engine.is_broken = True
        asked = doer.ask(Do([f"gate {gate}"]), timeout=25.0)
        await until(lambda: system._homes.journal.stopped is not None)
        Path(f"{gate}.open").touch()
        with pytest.raises(hf.errors.StoreFailed):
            await asked


PROGRAM = """
import asyncio, os, signal, sys
import holdfast as hf

class Add(hf.Message[int]):
    n: int
    killed: int = 0

class Sums(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[int] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        if message.killed == os.getpid():
            os.kill(message.killed, signal.SIGKILL)  # In the middle of a turn that may have run ahead of its row.
        return len(self.seen)

async def main(store: str, count: int) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        sums = await system.start(hf.child("sums", hf.start(Sums), recovery=hf.hybrid(interval=0.01)))
        first = await sums.ask(Add(-1)) - 1
        print("had", first, flush=True)
        for n in range(count):
            sums.tell(Add(n)) if n % 3 == 0 else print("done", await sums.ask(Add(n)), flush=True)
        await sums.ask(Add(count))  # What was told is in the journal, and nothing waits for it.
        await sums.ask(Add(count, os.getpid()))

asyncio.run(main(sys.argv[1], int(sys.argv[2])))
"""


BURSTS = """
import asyncio, os, random, signal, sys
import holdfast as hf

class Add(hf.Message[int]):
    n: int

class Other(hf.Message):
    n: int

class Aside(hf.Message): ...

class Back(hf.Message): ...

class Sums(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[int] = []
        self.aside = self.back = 0
        self.is_open = True

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return len(self.seen)

    @hf.on(Other)
    def other(self, message: Other) -> None:
        self.seen.append(message.n)

    @hf.on(Aside)
    def put_aside(self, message: Aside) -> None:
        if self.is_open:
            self.back += 1
        else:
            self.aside += 1
            self.ctx.stash()

    @hf.on(Back)
    def take_back(self, message: Back) -> None:
        self.is_open = not self.is_open
        if self.is_open:
            self.ctx.unstash()

class State(hf.Message[tuple[list[int], int]]): ...

async def main(store: str, seed: int) -> None:
    chance = random.Random(seed)
    method = hf.hybrid(interval=1000.0, every=chance.choice((3, 9, 40)), keep=chance.choice((1, 2, 3)))
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        sums = await system.start(hf.child("sums", hf.start(Sums), recovery=method))
        await sums.ask(Add(-1))  # It is behind all that was recorded.
        state = await system.get_state(sums)
        seen = [n for n in state["seen"] if n >= 0]
        print(seen == list(range(len(seen))), len(seen), flush=True)
        count = len(seen)
        for _ in range(chance.randrange(1, 12)):
            for _ in range(chance.randrange(30)):
                match chance.randrange(10):
                    case 0:
                        sums.tell(Other(count))
                        count += 1
                    case 1:
                        sums.tell(Aside())
                    case 2:
                        sums.tell(Back())
                    case 3:
                        asyncio.ensure_future(sums.ask(Add(-2)))
                    case _:
                        sums.tell(Add(count))
                        count += 1
            match chance.randrange(4):
                case 0:
                    await system.checkpoint(sums)
                case 1:
                    await sums.send(Add(count))
                    count += 1
                    print("safe", count, flush=True)
                case _:
                    for _ in range(chance.randrange(4)):
                        await asyncio.sleep(0)
        os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(main(sys.argv[1], int(sys.argv[2])))
"""


@pytest.mark.parametrize("seed", range(3))
def test_bursts_survive_kills_of_the_root(tmp_path: Path, seed: int) -> None:
    """Rows that several messages share, snapshots in the middle of them: each message once, in its order."""
    safe = 0
    for run in range(5):
        command = [sys.executable, "-c", BURSTS, str(tmp_path / "app.db"), str(100 * seed + run)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
        assert done.returncode == -signal.SIGKILL, done.stderr
        (is_in_order, count), *words = [line.split() for line in done.stdout.splitlines()]
        assert is_in_order == "True", f"seed {100 * seed + run}"
        assert int(count) >= safe, f"seed {100 * seed + run}"
        safe = max([safe, *(int(number) for _, number in words)])


@pytest.mark.parametrize("count", [2, 7, 50])
def test_the_root_may_be_killed_in_a_turn_that_runs_ahead(tmp_path: Path, count: int) -> None:
    """Whatever was answered is there; the ask that was not may be, or not: nobody was told."""
    known = 0
    for _ in range(4):
        command = [sys.executable, "-c", PROGRAM, str(tmp_path / "app.db"), str(count)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
        assert done.returncode == -signal.SIGKILL, done.stderr
        words = [line.split() for line in done.stdout.splitlines()]
        had = int(words[0][1])
        assert had in (known, known + 1)
        known = had + 2 + count
        assert [int(n) for _, n in words[1:]] == [had + 2 + n for n in range(count) if n % 3]
