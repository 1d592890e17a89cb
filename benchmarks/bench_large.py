"""How does a state of 500 MB come back when its process is killed, and what does it cost everybody else?

The state is a list of ten arrays in an actor with a process of its own, saved once; another one is asked all the time.
Time: from the kill to the first answer. Its limit, measured in turn: the same of an actor with no state, and then, by
bare system calls, a mapping of as many bytes (memory), or reading the same pack into memory with its checksum (sqlite).
Delay: by how much the asks of the other actor take longer meanwhile, at the 99th percentile. Memory: of root and child
together, as multiples of the state: what is theirs alone, and the nameless files that they hold.

And what does a snapshot of a list of 200,000 records cost that has grown by ten, or of a dict of 100,000 orders ten of
which have changed? Pause: how long the actor, a task, stands still. Its limit: the time in which the list or dict is
encoded once. Written: bytes that go to the store.
Command: python benchmarks/bench_large.py [--quick]
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import mmap
import os
import signal
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from harness import Run, main

import holdfast as hf
from holdfast.actors.values import encode_value

BYTES = 500_000_000
BLOCK = 256 * 1024
ARRAYS = 10
QUIET = 2.0


class Ping(hf.Message[int]):
    """Something small."""


class Fill(hf.Message[int]):
    """Add an array of so many bytes."""

    size: int


class Large(hf.Actor):
    """A large state, when it has been filled."""

    def __init__(self) -> None:
        self.arrays: list[Any] = []
        self.turns = 0

    @hf.on(Fill)
    def fill(self, message: Fill) -> int:
        random = np.random.default_rng(len(self.arrays))
        self.arrays.append(random.integers(0, 255, message.size, dtype=np.uint8))
        return len(self.arrays)

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        self.turns += 1
        return self.turns


class Bystander(hf.Actor):
    """Has nothing to do with it."""

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 0


def status(pid: int, field: str) -> int:
    """Bytes that /proc says of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise ValueError(field)


def memory_files(*pids: int) -> int:
    """Bytes in the nameless files that these processes hold or have mapped, each once."""
    found: dict[int, int] = {}
    for pid in pids:
        for folder in ("fd", "map_files"):
            for name in os.listdir(f"/proc/{pid}/{folder}"):
                path = f"/proc/{pid}/{folder}/{name}"
                with contextlib.suppress(FileNotFoundError):  # It was that of the listing.
                    if os.readlink(path).startswith("/memfd:holdfast"):
                        info = os.stat(path)
                        found[info.st_ino] = info.st_blocks * 512
    return sum(found.values())


def total(child: int) -> int:
    """Memory of root and child together."""
    anonymous = sum(status(pid, "RssAnon") for pid in (os.getpid(), child))
    return anonymous + memory_files(os.getpid(), child)


async def killed(system: hf.ActorSystem, ref: hf.ActorRef[Large]) -> float:
    """Seconds from the kill of its process to the next answer."""
    began = time.perf_counter()
    os.kill(system.pid_of(ref), signal.SIGKILL)
    await ref.ask(Ping(), timeout=60.0)
    return time.perf_counter() - began


def mapped(size: int) -> float:
    """Seconds of a bare mapping of so many bytes, each page of which is looked at."""
    file = os.memfd_create("bare")
    os.ftruncate(file, size)
    began = time.perf_counter()
    memory = mmap.mmap(file, size, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE)
    seconds = time.perf_counter() - began
    os.close(file)
    memory.close()
    return seconds


def read(pack: Path) -> float:
    """Seconds of reading a file into nameless memory, block by block, with a checksum."""
    size, file = pack.stat().st_size, os.memfd_create("bare")
    began = time.perf_counter()
    with pack.open("rb", buffering=0) as source:
        for at in range(0, size, BLOCK):
            block = source.read(BLOCK)
            zlib.crc32(block)
            os.pwrite(file, block, at)
    seconds = time.perf_counter() - began
    os.close(file)
    return seconds


class Asker:
    """Asks the bystander without a break, each millisecond."""

    def __init__(self, ref: hf.ActorRef[Bystander]) -> None:
        self._ref, self.seconds = ref, list[float]()
        self._task = asyncio.ensure_future(self._ask())

    async def _ask(self) -> None:
        while True:
            began = time.perf_counter()
            await self._ref.ask(Ping(), timeout=60.0)
            self.seconds.append(time.perf_counter() - began)
            await asyncio.sleep(0.001)

    def take(self) -> float:
        """The 99th percentile since the last time, in milliseconds."""
        seen, self.seconds = sorted(self.seconds), []
        return seen[int(len(seen) * 0.99)] * 1e3

    def end(self) -> None:
        """Ask no more."""
        self._task.cancel()


async def _measure(run: Run, where: str) -> None:
    size = run.size(BYTES)
    with tempfile.TemporaryDirectory() as folder:
        store = f"sqlite:{folder}/app.db" if where == "sqlite" else None
        async with hf.ActorSystem("bench", store=store, log=False, intensity=1000) as system:
            recovery = hf.hybrid(interval=3600.0, max_deliveries=1000)

            async def begun(name: str, size: int) -> hf.ActorRef[Large]:
                spec = hf.child(name, hf.start(Large), isolation="process", recovery=recovery)
                ref = await system.start(spec)
                for _ in range(ARRAYS):
                    await ref.ask(Fill(size // ARRAYS), timeout=60.0)
                return ref

            small = await begun("small", ARRAYS)
            base = total(system.pid_of(small))
            large = await begun("large", size)
            await system.checkpoint(large, timeout=60.0)
            await asyncio.sleep(1.0)
            name = f"{size // 1_000_000} MB in {where}"
            told = (total(system.pid_of(large)) - base) / size
            target = 1.1 if where == "sqlite" else 2.1
            run.bound(f"{name}: memory of root and child while it works", told, unit="of the state", target=target)

            asker = Asker(await system.start(hf.child("bystander", hf.start(Bystander))))
            await asyncio.sleep(QUIET)
            quiet = asker.take()
            Path("/proc/self/clear_refs").write_text("5")
            root = status(os.getpid(), "VmRSS")
            for _ in range(run.n):
                await killed(system, large)
            run.bound(f"{name}: 99 % of other asks, added", asker.take() - quiet, unit="ms", target=2.0)
            asker.end()
            peak = (status(os.getpid(), "VmHWM") - root) / size
            run.bound(f"{name}: what the root takes for it", peak, unit="of the state", target=0.1)
            child = (status(system.pid_of(large), "VmHWM") - status(system.pid_of(small), "VmHWM")) / size
            run.bound(f"{name}: what the child takes for it", child, unit="of the state", target=1.1)
            told = (total(system.pid_of(large)) - base) / size
            run.bound(f"{name}: memory of root and child after it", told, unit="of the state", target=1.1)

            pack = max(Path(folder).glob("*-packs/*/*.pack"), key=lambda one: one.stat().st_size, default=None)

            async def bare() -> float:
                return await killed(system, small) + (mapped(size) if pack is None else read(pack))

            await run.compare(
                f"{name}: from the kill to the next answer",
                lambda: killed(system, large),
                bare,
                unit="s",
                target=1 / 1.2,
            )


class Scan(hf.Message[None]):
    """A record that cannot change."""

    at: float
    robot: int
    text: str


@dataclasses.dataclass
class Order:
    """A record that can."""

    number: int
    customer: str
    cents: int
    state: str
    lines: list[str]


class Work(hf.Message[int]):
    """Add ten scans, and change ten orders."""


class Ledger(hf.Actor):
    """Large lists and dicts of records."""

    key_variables = ("entries",)

    def __init__(self, kind: str, count: int) -> None:
        self.entries: list[Scan] | dict[str, Order] = []
        self.turns = 0
        if kind == "dict":
            self.entries = {f"order-{n}": Order(n, f"customer {n}", n, "new", ["a", str(n)]) for n in range(count)}
        else:
            self.entries = [Scan(n / 8, n % 7, f"text {n}") for n in range(count)]

    @hf.on(Work)
    def work(self, message: Work) -> int:
        self.turns += 1
        for n in range(10):
            if isinstance(self.entries, dict):
                order = self.entries[f"order-{(self.turns * 7919 + n * 104729) % len(self.entries)}"]
                order.state, order.cents = "sent", order.cents + 1
            else:
                self.entries.append(Scan(n / 8, n, f"text {self.turns}"))
        return self.turns


async def _entries(run: Run, kind: str, count: int, what: str) -> None:
    count = run.size(count)
    written: list[int] = []
    with tempfile.TemporaryDirectory() as folder:
        async with hf.ActorSystem("bench", store=f"sqlite:{folder}/app.db", log=False) as system:
            recovery = hf.hybrid(interval=3600.0)
            ref = await system.start(hf.child("ledger", hf.start(Ledger, kind, count), recovery=recovery))
            model: Any = Ledger.__new__(Ledger)
            Ledger.__init__(model, kind, count)

            async def saved() -> float:
                await ref.ask(Work(), timeout=60.0)
                with system.events() as stream:
                    await system.checkpoint(ref, timeout=60.0)
                    taken = [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]
                written.append(taken[-1].written_bytes)
                return taken[-1].pause

            def encoded() -> float:
                began = time.perf_counter()
                encode_value(model.entries)
                return time.perf_counter() - began

            for _ in range(3):  # As one value, as an image, and once by chunks.
                await saved()
            written.clear()
            await run.compare(f"{count} {what}: pause", saved, encoded, unit="s", target=4.0)
            run.bound(f"{count} {what}: written", max(written) / 1e3, unit="kB", target=500.0)


async def grown_list(run: Run) -> None:
    await _entries(run, "list", 200_000, "records in a list, ten more")


async def changed_dict(run: Run) -> None:
    await _entries(run, "dict", 100_000, "orders in a dict, ten changed")


async def memory(run: Run) -> None:
    await _measure(run, "memory")


async def sqlite(run: Run) -> None:
    await _measure(run, "sqlite")


if __name__ == "__main__":
    main([memory, sqlite, grown_list, changed_dict])
