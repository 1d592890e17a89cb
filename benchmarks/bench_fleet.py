"""What does a journal on several machines cost, and how fast does another program take over?

Servers on this machine, `sync_interval: always`, one (R1) and three (R3). Limits: the same records appended by hand,
each naming its predecessor, over the same client library.
Command: python benchmarks/bench_fleet.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import AsyncGenerator
from pathlib import Path

from harness import Run, ask_all, main

import holdfast as hf
from holdfast.cluster.leadership import Follower
from holdfast.cluster.log_records import CHANGES, FORMAT, EpochBegun, RecordMaker, encode_changes
from holdfast.cluster.nats.access import access_of
from holdfast.cluster.nats.nats_engine import NatsEngine, open_engine

sys.path.append(str(Path(__file__).parent.parent))
from tests.cluster.servers import NatsServers  # pyright: ignore[reportMissingImports]  # found by the line above

ASKS = 3_000
"""With one outstanding; ten times as many with more."""
RECORD = bytes(200)
"""About what the record of one ask takes."""


class Add(hf.Message[int]):
    n: int


class Sum(hf.Actor):
    """Adds up what it is asked to."""

    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total


@contextlib.asynccontextmanager
async def servers(count: int) -> AsyncGenerator[NatsServers]:
    """Servers of their own, in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        made = NatsServers(Path(folder), count)
        await made.start()
        try:
            yield made
        finally:
            made.close()


async def _asks(store: str, count: int, outstanding: int) -> float:
    """Asks per second to one recorded actor."""
    async with hf.ActorSystem("bench", store=store, log=False, history=False) as system:
        ref = await system.start(hf.child("sum", hf.start(Sum), recovery=hf.hybrid()))
        await ask_all(ref.ask, Add(1), 200)
        return (await ask_all(ref.ask, Add(1), count, outstanding=outstanding)).rate


class ByHand:
    """Appends records, each behind the one before, as one record for all that have gathered."""

    def __init__(self, engine: NatsEngine) -> None:
        self._engine = engine
        self._last = 0
        self._waiting: list[asyncio.Future[None]] = []
        self._running: asyncio.Task[None] | None = None

    async def ask(self, message: Add) -> None:
        """Have one more record kept."""
        done = asyncio.get_running_loop().create_future()
        self._waiting.append(done)
        if self._running is None:
            self._running = asyncio.ensure_future(self._append())
        await done

    async def _append(self) -> None:
        while self._waiting:
            taken, self._waiting = self._waiting, []
            self._last = await self._engine.log.append(RECORD * len(taken), self._last)
            for one in taken:
                one.set_result(None)
        self._running = None


async def _by_hand(store: str, count: int, outstanding: int) -> float:
    engine = await open_engine(access_of(store))
    try:
        return (await ask_all(ByHand(engine).ask, Add(1), count, outstanding=outstanding)).rate
    finally:
        await engine.close()


async def asks(run: Run) -> None:
    """Recorded asks, beside appends by hand."""
    for count in (1, 3):
        async with servers(count) as made:
            for outstanding in (1, 100, 400):
                number = run.size(ASKS) * (1 if outstanding == 1 else 10)
                target = {1: 0.6 if count == 1 else 0.8, 100: 0.5, 400: 0.6}[outstanding]

                async def ours(number: int = number, outstanding: int = outstanding) -> float:
                    return await _asks(made.store(made.new_system()), number, outstanding)

                async def limit(number: int = number, outstanding: int = outstanding) -> float:
                    return await _by_hand(made.store(made.new_system()), number, outstanding)

                job = f"asks with {outstanding} outstanding, R{count}"
                await run.compare(job, ours, limit, unit="asks/s", target=target)


async def takeover(run: Run) -> None:
    """From the end of the leader until the other program answers."""
    for how, target in (("killed", 3.3), ("ended in good order", 0.5)):
        taken: list[float] = []
        for _ in range(run.n):
            async with servers(1) as made:
                store = made.store(made.new_system())
                programs = [await _program(store)]
                await _answers(programs[0])
                programs.append(await _program(store))
                assert programs[1].stdout is not None
                assert (await programs[1].stdout.readline()).startswith(b"stands by")
                began = time.monotonic()
                programs[0].send_signal(signal.SIGKILL if how == "killed" else signal.SIGTERM)
                await _answers(programs[1])
                taken.append(time.monotonic() - began)
                programs[1].kill()
                for program in programs:
                    await program.wait()
        run.bound(f"takeover, the leader is {how}", max(taken), unit="s", target=target)


async def standby(run: Run) -> None:
    """Processor time of a program that stands by, beside that of its leader under load."""
    async with servers(1) as made:
        store = made.store(made.new_system())
        leader = await _program(store, "load")
        await _answers(leader)
        other = await _program(store)
        assert other.stdout is not None
        assert (await other.stdout.readline()).startswith(b"stands by")
        before = _spent(leader.pid), _spent(other.pid)
        await asyncio.sleep(3.0 if run.quick else 10.0)  # The load runs meanwhile.
        spent = [_spent(one.pid) - was for one, was in zip((leader, other), before, strict=True)]
        for program in (leader, other):
            program.kill()
            await program.wait()
    run.bound("a standby's processor time beside its leader's", 100.0 * spent[1] / spent[0], unit="%", target=15.0)


async def lag(run: Run) -> None:
    """From the acknowledgement of a record until a follower has it, at 500 records a second."""
    async with servers(1) as made:
        access = access_of(made.store(made.new_system()))
        engine, other = await open_engine(access), await open_engine(access)
        follower = Follower(other)
        following = asyncio.ensure_future(follower.follow())
        maker = RecordMaker(1, 0)
        last = await engine.log.append(maker.beginning(EpochBegun("bench", "bench", FORMAT, 0.0)), 0)
        known: deque[tuple[int, float]] = deque()
        lags: list[float] = []
        loop = asyncio.get_running_loop()
        began = loop.time()
        for number in range(run.size(5_000)):
            maker.after = last
            note = encode_changes([("note", (f"key {number % 100}", RECORD))])
            (record,) = maker.parts(CHANGES, note)
            last = await engine.log.append(record, last)
            known.append((last, loop.time()))
            await asyncio.sleep(max(0.0, began + number / 500 - loop.time()))
            while known and known[0][0] <= follower.reader.at:
                lags.append(loop.time() - known.popleft()[1])
        following.cancel()
        await asyncio.wait([following])
        await follower.begin_anew()
        await engine.close()
        await other.close()
    run.bound("a standby's lag, p99", 1e3 * sorted(lags)[int(0.99 * len(lags))], unit="ms", target=100.0)


def _spent(pid: int) -> float:
    """Seconds of processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def _program(store: str, *more: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, __file__, "--program", store, *more, stdout=asyncio.subprocess.PIPE
    )


async def _answers(program: asyncio.subprocess.Process) -> None:
    """Wait until a program has answered its own first ask."""
    assert program.stdout is not None
    while not (line := await program.stdout.readline()).startswith(b"answers"):
        assert line, "it has ended"


async def _lead(store: str, *, loads: bool) -> None:
    """The other process: stands by, leads, and asks its actor once, or for ever."""
    system = hf.ActorSystem("bench", store=store, standby="warm", log=False, history=False)
    work = asyncio.ensure_future(_work(system, loads=loads))
    await asyncio.sleep(0)
    told = system.events()
    async for event in told:
        if isinstance(event, hf.events.StandingBy):
            print("stands by", flush=True)
        if isinstance(event, hf.events.LeadershipTaken):
            break
    told.close()
    await work


async def _work(system: hf.ActorSystem, *, loads: bool) -> None:
    async with system:
        ref = await system.start(hf.child("sum", hf.start(Sum), recovery=hf.hybrid()))
        await ref.ask(Add(1))
        print("answers", flush=True)
        while loads:
            await asyncio.gather(*(ref.ask(Add(1)) for _ in range(100)))
        await asyncio.Event().wait()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--program"]:
        hf.run(_lead(sys.argv[2], loads="load" in sys.argv[3:]))
    else:
        main([asks, takeover, standby, lag])
