"""What does a journal on several machines cost, how fast does another program take over, and what does a line cost?

Servers on this machine, `sync_interval: always`, one (R1) and three (R3). Limits: the same records appended by hand,
each naming its predecessor, over the same client library; for lines, bytes of the same size between two programs, as
requests and as publications.
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
from typing import NamedTuple

import msgspec
import nats
from harness import BURST, Run, ask_all, main
from nats.aio.client import Client
from nats.aio.msg import Msg

import holdfast as hf
from holdfast.cluster.leadership import Follower
from holdfast.cluster.log_records import CHANGES, FORMAT, EpochBegun, RecordMaker, encode_changes
from holdfast.cluster.nats.access import access_of, connect_options
from holdfast.cluster.nats.nats_engine import NatsEngine, open_engine

sys.path.append(str(Path(__file__).parent.parent))
from tests.cluster.servers import NatsServers  # pyright: ignore[reportMissingImports]  # found by the line above

ASKS = 3_000
"""With one outstanding; ten times as many with more."""
RECORD = bytes(200)
"""About what the record of one ask takes."""
TELLS = 200_000
ASKED, ANSWERED = bytes(130), bytes(70)
"""As many bytes as the batches of one ask between programs, and of its reply."""


class Add(hf.Message[int]):
    n: int


class Total(hf.Message[int]): ...


class Sum(hf.Actor):
    """Adds up what it is asked to."""

    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total

    @hf.on(Total)
    def told(self, message: Total) -> int:
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


class Neighbour(NamedTuple):
    """Another program, which leads a system, and answers raw messages besides."""

    store: str
    by_hand: Client

    def subject(self, what: str) -> str:
        """Where it answers what is sent by hand."""
        return _subject(self.store, what)

    async def asks(self, actor: str, count: int, outstanding: int) -> float:
        """Asks per second to an actor there."""
        async with hf.connect(self.store, system="bench") as far:
            ref = far.ref(f"/bench/{actor}", Sum)
            await ask_all(ref.ask, Add(1), 200)
            return (await ask_all(ref.ask, Add(1), count, outstanding=outstanding)).rate

    async def requests(self, count: int, outstanding: int) -> float:
        """Requests per second by hand."""
        to = self.subject("asked")

        async def ask(message: bytes) -> None:
            await self.by_hand.request(to, message, timeout=10.0)

        await ask_all(ask, ASKED, 200)
        return (await ask_all(ask, ASKED, count, outstanding=outstanding)).rate

    async def tells(self, count: int) -> float:
        """Tells per second to an actor there, until it has handled the last one."""
        async with hf.connect(self.store, system="bench") as far:
            ref = far.ref("/bench/plain", Sum)
            before = await ref.ask(Total())
            began = time.perf_counter()
            for sent in range(count):
                ref.tell(Add(1))
                if sent % BURST == 0:
                    await asyncio.sleep(0)
            assert await ref.ask(Total(), 60.0) == before + count
            return count / (time.perf_counter() - began)

    async def publications(self, count: int) -> float:
        """The same messages per second by hand: each is encoded, and decoded there; as many in one publication."""
        encode = msgspec.msgpack.Encoder().encode
        began = time.perf_counter()
        for _ in range(count // BURST):
            await self.by_hand.publish(self.subject("told"), encode([encode(Add(1)) for _ in range(BURST)]))
            await asyncio.sleep(0)
        total = await self.by_hand.request(self.subject("total"), b"", timeout=60.0)
        assert int(total.data) == count // BURST * BURST
        return count / (time.perf_counter() - began)


@contextlib.asynccontextmanager
async def neighbour() -> AsyncGenerator[Neighbour]:
    """Another program that leads a system and answers raw messages; and a client for those."""
    async with servers(1) as made:
        store = made.store(made.new_system())
        program = await _program(store, "neighbour")
        by_hand = await nats.connect(**connect_options(access_of(store)))
        try:
            await _answers(program)
            yield Neighbour(store, by_hand)
        finally:
            await by_hand.close()
            program.kill()
            await program.wait()


async def lines(run: Run) -> None:
    """Asks and tells between two programs, beside requests and publications by hand."""
    async with neighbour() as other:
        for actor, outstanding, target in (
            ("plain", 1, 0.67),
            ("plain", 100, 0.67),
            ("sum", 1, 0.3),
            ("sum", 100, 0.3),
        ):
            number = run.size(ASKS) * (1 if outstanding == 1 else 10)

            async def ours(actor: str = actor, number: int = number, outstanding: int = outstanding) -> float:
                return await other.asks(actor, number, outstanding)

            async def limit(number: int = number, outstanding: int = outstanding) -> float:
                return await other.requests(number, outstanding)

            kind = "a recorded" if actor == "sum" else "an"
            job = f"asks of {kind} actor of another program, {outstanding} outstanding, R1"
            await run.compare(job, ours, limit, unit="asks/s", target=target)
        number = run.size(TELLS)
        job = "tells to an actor of another program"
        await run.compare(
            job, lambda: other.tells(number), lambda: other.publications(number), unit="tells/s", target=0.6
        )


def _subject(store: str, what: str) -> str:
    return f"hf.{access_of(store).system}.bench.{what}"


async def _neighbour(store: str) -> None:
    """The other process of `lines`."""
    client = await nats.connect(**connect_options(access_of(store)))
    decoder, total = msgspec.msgpack.Decoder(list[bytes]), 0
    message = msgspec.msgpack.Decoder(Add)

    async def asked(request: Msg) -> None:
        await client.publish(request.reply, ANSWERED)

    async def told(batch: Msg) -> None:
        nonlocal total
        for one in decoder.decode(batch.data):
            total += message.decode(one).n

    async def summed(request: Msg) -> None:
        nonlocal total
        was, total = total, 0
        await client.publish(request.reply, str(was).encode())

    for what, take in (("asked", asked), ("told", told), ("total", summed)):
        await client.subscribe(_subject(store, what), cb=take)
    await client.flush()
    async with hf.ActorSystem("bench", store=store, log=False, history=False) as system:
        await system.start(hf.child("sum", hf.start(Sum), recovery=hf.hybrid()))
        await system.start(hf.child("plain", hf.start(Sum)))
        print("answers", flush=True)
        await asyncio.Event().wait()


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
        store, does = sys.argv[2], sys.argv[3:]
        hf.run(_neighbour(store) if "neighbour" in does else _lead(store, loads="load" in does))
    else:
        main([asks, takeover, standby, lag, lines])
