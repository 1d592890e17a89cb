"""Simulated fleets: programs that stand by, lead and write on the same servers, what happens to them, and the judge."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import random
from collections.abc import Callable, Coroutine, Generator
from functools import partial
from typing import Any

import pytest

from holdfast.actors.errors import StoreError
from holdfast.checkpoint.journal import StoreFailed
from holdfast.cluster import log_records, log_writer, replicated_journal
from holdfast.cluster.leadership import Follower, Standby, lead
from holdfast.cluster.log_records import CHANGES, EPOCH, RecordReader, decode_changes
from holdfast.cluster.replicated_journal import ReplicatedJournal
from holdfast.cluster.store_contents import MemoryContents
from holdfast.testing.clock import virtual
from holdfast.testing.fleet.broker import SimBroker
from holdfast.testing.fleet.same_loop import SameLoop
from holdfast.testing.fleet.sim_engine import SimEngine

ADDRESSES = ("/app/a", "/app/b", "/app/c")
LARGE = 400
"""Bytes of a snapshot that these programs keep beside the log."""
_RUNNING: contextvars.ContextVar[Program | None] = contextvars.ContextVar("running", default=None)


@contextlib.contextmanager
def small_sizes(least_base: int = 3000) -> Generator[None, None, None]:
    """Have everything come in parts, and bases often, in tests that write little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_records, "PART", 256)
        patch.setattr(log_writer, "LEAST_BASE", least_base)
        patch.setattr(log_writer, "MOST_BYTES", 2000)
        patch.setattr(replicated_journal, "LARGE", LARGE)
        yield


def simulate(work: Callable[[], Coroutine[Any, Any, None]], seed: int) -> None:
    """Run a coroutine on the virtual clock; what fails says the seed."""
    random.seed(seed)
    with asyncio.Runner(loop_factory=virtual) as runner:
        runner.get_loop().set_task_factory(_owned_task)
        try:
            runner.run(work())
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise


def _owned_task(loop: asyncio.AbstractEventLoop, work: Any, **options: Any) -> asyncio.Task[Any]:
    task: asyncio.Task[Any] = asyncio.Task(work, loop=loop, **options)
    program = _RUNNING.get()
    if program is not None:
        program.tasks.append(task)
    return task


def everything_in(contents: MemoryContents) -> object:
    """What a store holds, to be compared."""
    entries = {address: own for address, own in contents.entries.items() if own}
    snapshots = {address: kept for address, kept in contents.snapshots.items() if kept}
    packs = {address: kept for address, kept in contents.packs.items() if kept}
    return contents.last, entries, snapshots, packs, list(contents.notes.items())


def names_in(contents: MemoryContents) -> set[str]:
    """What it refers to beside the log."""
    return {name for name in contents.kept() if isinstance(name, str)}


def _set(event: asyncio.Event, _: object) -> None:
    event.set()


class Judge:
    """Reads every record that there ever was, from the first one on."""

    def __init__(self, broker: SimBroker) -> None:
        self._broker = broker
        self._begin()

    def _begin(self) -> None:
        self.reader, self.contents = RecordReader(), MemoryContents()
        self.ids: list[Any] = []
        self._read = 0

    def read(self, until: int | None = None) -> None:
        """Read as far as the record with that number, or all."""
        if until is not None and self.reader.at > until:
            self._begin()
        records = self._broker.everything
        while self._read < len(records) and (until is None or records[self._read].sequence <= until):
            for said in self.reader.take(records[self._read]):
                assert said.kind in (EPOCH, CHANGES)
                for change in decode_changes(said.data) if said.kind == CHANGES else ():
                    if change[0] == "append":
                        self.ids += [entry[1:3] for _, entry in change[1][0]]
                    self.contents.make(change)
            self._read += 1

    def check_contents(self, contents: MemoryContents, at: int, whose: str) -> None:
        """These are what the log says up to that record."""
        self.read(at)
        assert everything_in(contents) == everything_in(self.contents), f"{whose} differs at record {at}"

    def check_ids(self, acknowledged: dict[str, int]) -> None:
        """Of each leader a beginning of what it has written is there, once and in order, and all that was safe."""
        self.read()
        found: dict[str, int] = {}
        for tag, number in self.ids:
            assert number == found.get(tag, 0), f"{number} of {tag} stands in the log behind {found.get(tag, 0)} others"
            found[tag] = number + 1
        for tag, count in acknowledged.items():
            assert found.get(tag, 0) >= count, f"{tag} was told that {count} are safe, and {found.get(tag, 0)} are"


class Program:
    """A program that stands by until it leads, and writes then, again and again.

    Attributes:
        journal: while it leads.
        tasks: all that it has ever begun.
    """

    def __init__(self, fleet: Fleet, name: str, standby: Standby) -> None:
        self.fleet, self.name = fleet, name
        self._standby: Standby = standby
        self.engine = SimEngine(fleet.broker)
        self.journal: ReplicatedJournal | None = None
        self.tasks: list[asyncio.Task[Any]] = []
        self.is_to_close = asyncio.Event()
        self._draw = random.Random(f"{fleet.seed} {name}")

        def begin() -> asyncio.Task[None]:
            _RUNNING.set(self)
            return asyncio.ensure_future(self._run())

        self.task = contextvars.copy_context().run(begin)

    def kill(self) -> None:
        """End all that it does, as SIGKILL would: what it has sent still arrives."""
        for task in self.tasks:
            task.cancel()
        self.fleet.programs.remove(self)

    async def _run(self) -> None:
        while True:
            leading = await lead(self.engine, self.name, standby=self._standby)
            tag = f"{self.name} in {leading.maker.epoch}"
            self.fleet.begins(leading.contents, leading.maker.after, tag, leading.maker.epoch)
            lost = asyncio.Event()
            self.journal = journal = ReplicatedJournal(self.engine, SameLoop(), leading, lost=partial(_set, lost))
            self.is_to_close.clear()
            writing = asyncio.ensure_future(self._write(journal, tag))
            ends = [asyncio.ensure_future(one.wait()) for one in (lost, self.is_to_close)]
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            for task in (*ends, writing):
                task.cancel()
            await asyncio.wait([*ends, writing])
            if not writing.cancelled():
                writing.result()
            self.journal = None
            with contextlib.suppress(StoreError):
                await journal.end()

    async def _write(self, journal: ReplicatedJournal, tag: str) -> None:
        draw, written = self._draw, 0
        waiting: list[asyncio.Future[None]] = []
        with contextlib.suppress(StoreError):
            while True:
                for _ in range(draw.randint(1, 4)):
                    written = self._write_something(journal, tag, written)
                safe = journal.synced()
                safe.add_done_callback(partial(self._acknowledge, tag, written))
                if draw.random() < 0.5:
                    await safe
                else:
                    waiting.append(safe)
                await asyncio.sleep(draw.choice([0.0, 0.05, 0.3]))

    def _acknowledge(self, tag: str, count: int, done: asyncio.Future[None]) -> None:
        if not done.cancelled() and done.exception() is None:
            self.fleet.acknowledged[tag] = max(count, self.fleet.acknowledged.get(tag, 0))

    def _write_something(self, journal: ReplicatedJournal, tag: str, written: int) -> int:
        draw = self._draw
        address = draw.choice(ADDRESSES)
        kind = draw.choice(["append"] * 5 + ["cut"] * 3 + ["note", "erase", "blocks", "forget", "together"])
        if kind == "cut":
            try:
                known = [position for position, _ in journal.load(address).entries]
            except StoreFailed:  # Its snapshot stands beside the log, and the servers do not answer.
                if journal.has_failed():
                    raise
                return written
            dropped = [position for position in known if draw.random() < 0.7]
            data = draw.randbytes(draw.choice([10, 100, LARGE + 1]))
            journal.cut(address, data, dropped, turn=written, keep=draw.choice([1, 2]))
        elif kind == "note":
            journal.note(f"key {draw.randrange(5)}", draw.choice([None, b"", b"value"]))
        elif kind == "erase":
            journal.erase(address)
        elif kind == "blocks":
            journal.keep_blocks(address, draw.randrange(3), [(0, memoryview(draw.randbytes(600)))], False)
        elif kind == "forget":
            journal.forget_blocks(address, [draw.randrange(3)])
        elif kind == "together":
            with journal.together():
                journal.note("together", tag.encode())
                written = self._append(journal, tag, written)
        else:
            written = self._append(journal, tag, written)
        return written

    def _append(self, journal: ReplicatedJournal, tag: str, written: int) -> int:
        count = self._draw.randint(1, 3)
        text = "x" * self._draw.choice([0, 0, 30, 700])
        journal.append(
            [(self._draw.choice(ADDRESSES), ("in", tag, number, text)) for number in range(written, written + count)]
        )
        return written + count


class Fleet:
    """Servers, programs, and what was promised to whom.

    Attributes:
        acknowledged: by leader and epoch, how many of its entries are safe.
        epochs: in which somebody has begun to lead, in order.
    """

    def __init__(self, broker: SimBroker, seed: int) -> None:
        self.broker, self.seed = broker, seed
        self.draw = random.Random(f"fleet {seed}")
        self.programs: list[Program] = []
        self.acknowledged: dict[str, int] = {}
        self.judge = Judge(broker)
        self.epochs: list[str] = []
        self._started = 0

    def start(self, standby: Standby = "warm") -> Program:
        """One program more."""
        self._started += 1
        program = Program(self, f"program {self._started}", standby)
        self.programs.append(program)
        return program

    def begins(self, contents: MemoryContents, at: int, tag: str, epoch: int) -> None:
        """Judge what a leader begins with; whoever leads since its epoch began may have removed what it refers to."""
        self.epochs.append(tag)
        self.judge.check_contents(contents, at, tag)
        missing = names_in(contents) - self.broker.blobs.keys()
        self.judge.read()
        assert not missing or self.judge.reader.epoch > epoch, f"{tag} needs {missing}, which was removed"

    def check(self) -> None:
        """Judge the log as it is, and whether any program has failed."""
        for program in self.programs:
            if program.task.done():
                program.task.result()
        self.judge.check_ids(self.acknowledged)

    async def settle(self, seconds: float = 90.0) -> None:
        """With all well again somebody leads, and goes on being told that what it writes is safe.

        Then whoever leads next drops what nobody needs, and whoever only follows has the same.
        """
        loop = asyncio.get_running_loop()
        until = loop.time() + seconds
        before = sum(self.acknowledged.values())
        while sum(self.acknowledged.values()) < before + 20:
            assert loop.time() < until, f"nobody writes for {seconds:g} s though all is well"
            await asyncio.sleep(0.5)
            self.check()
        for program in [*self.programs]:
            program.kill()
        await asyncio.sleep(10.0)  # What was late has arrived.
        self.check()
        follower = Follower(SimEngine(self.broker))
        await follower.catch_up()
        self.judge.check_contents(follower.contents, follower.reader.at, "a new follower")
        await self._lead_quietly()
        self.check()

    async def _lead_quietly(self) -> None:
        engine = SimEngine(self.broker)
        leading = await lead(engine, "the last one", standby="cold")
        self.begins(leading.contents, leading.maker.after, "the last one", leading.maker.epoch)
        journal = ReplicatedJournal(engine, SameLoop(), leading)
        await asyncio.sleep(1.0)
        journal.note("the end", b"")
        await journal.synced()
        await journal.end()
        self.judge.read()
        assert names_in(self.judge.contents) == set(self.broker.blobs)
