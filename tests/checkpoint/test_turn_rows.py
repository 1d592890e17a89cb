"""How few rows the journal needs for turns, and that nobody hears of a turn before all of it is safe."""

from __future__ import annotations

import asyncio
import random
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Entry
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.players import Do, Doer, Notes, Seen, Sink, start, until

RECOVERY = hf.hybrid(interval=1000.0)


class Noted:
    """A real engine that notes what is appended, and whose appends can be held back by `full`."""

    def __init__(self, path: Path) -> None:
        self.real = SqliteJournal(path)
        self.rows: list[Entry] = []
        self.is_full = False

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
        assert kinds(engine.rows) == ["in"] * 8
        assert [row[8:10] for row in engine.rows] == [(number, "ok") for number in range(2, 10)]
        doer.kill()
        assert await doer.ask(Seen(), timeout=30.0) == [str(n) for n in range(9)]
    assert await again(tmp_path / "app.db") == [str(n) for n in range(9)]


async def test_the_ends_of_told_turns_are_one_row(engine: Any, tmp_path: Path) -> None:
    async with hf.ActorSystem("app", log=False, store=engine) as system:
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=RECOVERY))
        await doer.ask(Seen())
        engine.rows.clear()
        for n in range(40):
            doer.tell(Do([f"add {n}"]))
        assert await doer.ask(Seen(), timeout=30.0) == [str(n) for n in range(40)]
        assert kinds(engine.rows).count("in") == 41
        assert 1 <= kinds(engine.rows).count("ends") <= 4  # As many as there were ticks.
        assert kinds(engine.rows).count("end") <= 1
        await system.checkpoint(doer)
        for n in range(40, 60):
            doer.tell(Do([f"add {n}"]))
        await doer.ask(Seen(), timeout=30.0)
    assert await again(tmp_path / "app.db") == [str(n) for n in range(60)]


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
        for row in engine.rows:
            match row:
                case ("in", *_) if len(row) > 8:
                    ends.append(int(str(row[8])))
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
