"""Hours under kills: memory, descriptors, processes, threads and the store stay as they are, and nothing is lost.

`make soak HOURS=8`, or `python -m tests.soak HOURS [SEED]` from the root of the repository. Actors of all kinds (a task
and a process without recovery, the same with recovery, one that a mechanism protects) have two clients each, which ask
without pause, and number what they say. Every round some are killed, crashed, restarted or moved. Then all have to be
well again, and a sample is taken. Each actor keeps a ledger of its own; one with recovery may have missed nothing and
got nothing twice.
"""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter as Tally
from pathlib import Path
from typing import Any

import psutil

import holdfast as hf
from tests.ftm.campaign import Stuck, whole

PATIENCE = 120.0
"""Seconds in which whatever is asked is answered."""
ENOUGH = 30
"""Samples that the second half must have, for its trend to mean anything."""
LEAST = {"pss_kb": 4096.0, "rss_kb": 4096.0, "descriptors": 3.0, "children": 1.5, "threads": 2.0, "store_kb": 512.0}
"""What each may grow by, over the second half, without being called a leak; it may also grow by its own noise."""
SHARE = 0.02
"""And by this part of what it is."""
WAL_KB = 80 * 1024.0
"""The write-ahead log of SQLite is begun anew at some moment when nobody writes, at 64 MiB at the latest."""
KINDS = ("task", "process", "recorded task", "recorded process", "protected")


class Say(hf.Message[int]):
    client: int
    number: int


class Crash(hf.Message): ...


class Read(hf.Message[tuple[int, int]]): ...


class Ledger(hf.Actor):
    """Knows how far each client is, and whether one has said anything twice, or not at all."""

    def __init__(self) -> None:
        self.last: dict[int, int] = {}
        self.twice = self.missed = 0

    @hf.on(Say)
    def hear(self, message: Say) -> int:
        expected = self.last.get(message.client, 0) + 1
        self.twice += message.number < expected
        self.missed += message.number > expected
        self.last[message.client] = message.number
        return message.number

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise RuntimeError("the soak wants it")

    @hf.on(Read, readonly=True)
    def read(self, message: Read) -> tuple[int, int]:
        return self.twice, self.missed


@dataclasses.dataclass
class Report:
    """What a soak has come to."""

    seed: int
    requests: int = 0
    done: Tally[str] = dataclasses.field(default_factory=Tally[str])
    refused: Tally[str] = dataclasses.field(default_factory=Tally[str])
    samples: list[dict[str, float]] = dataclasses.field(default_factory=list[dict[str, float]])
    problems: list[str] = dataclasses.field(default_factory=list[str])

    def __str__(self) -> str:
        last = {key: round(value) for key, value in self.samples[-1].items()} if self.samples else {}
        judged = "" if len(self.samples) >= 2 * ENOUGH else " (too few for a trend)"
        lines = [
            f"seed {self.seed}: {self.requests} requests, {dict(self.done)}, refused {dict(self.refused)}",
            f"{len(self.samples)} samples{judged}; the last: {last}",
            *(f"WRONG: {problem}" for problem in self.problems),
        ]
        return "\n".join(lines)


def growth(values: list[float]) -> tuple[float, float]:
    """By how much a series grows from its first value to its last, and its noise, in its own unit.

    The slope is the median of the slopes between any two values (Theil and Sen), the noise three times the median
    distance to that line: a spike moves neither.

    >>> growth([5.0, 5.0, 90.0, 5.0, 5.0])
    (0.0, 0.0)
    >>> growth([float(n) for n in range(11)])
    (10.0, 0.0)
    """
    step = max(1, len(values) // 400)
    values = values[::step]
    pairs = [(values[j] - values[i]) / (j - i) for i in range(len(values)) for j in range(i + 1, len(values))]
    slope = statistics.median(pairs)
    base = statistics.median(value - slope * at for at, value in enumerate(values))
    noise = statistics.median(abs(value - base - slope * at) for at, value in enumerate(values))
    return slope * (len(values) - 1), 3 * noise


def leaks(samples: list[dict[str, float]]) -> list[str]:
    """What grows in the second half, in words; nothing if there are too few samples to say so."""
    half = samples[len(samples) // 2 :]
    if len(half) < ENOUGH:
        return []
    found: list[str] = []
    if (wal := max(sample["wal_kb"] for sample in half)) > WAL_KB:
        found.append(f"the write-ahead log has {wal:.0f} kB; it should be begun anew before")
    for name, least in LEAST.items():
        values = [sample[name] for sample in half]
        more, noise = growth(values)
        allowed = max(least, SHARE * statistics.median(values), noise)
        if more > allowed:
            start, end = values[0], values[-1]
            found.append(
                f"{name} grows by {more:.0f} over the second half ({start:.0f} to {end:.0f}, {len(half)} samples); "
                f"{allowed:.0f} would be noise"
            )
    return found


def sample(store: Path) -> dict[str, float]:
    """What the root, its children and its store take now."""
    gc.collect()
    own = psutil.Process()
    pss, children = own.memory_full_info().pss, 0
    for child in own.children(recursive=True):
        try:
            pss += child.memory_full_info().pss
            children += 1
        except psutil.NoSuchProcess:
            pass
    stored = {"wal": 0, "rest": 0}
    for file in store.rglob("*"):
        try:
            stored["wal" if file.name.endswith("-wal") else "rest"] += file.stat().st_size
        except FileNotFoundError:  # A log that was sealed, or a snapshot that a newer one replaces.
            pass
    return {
        "seconds": time.monotonic(),
        "pss_kb": pss / 1024,
        "rss_kb": own.memory_info().rss / 1024,
        "descriptors": own.num_fds(),
        "children": children,
        "threads": own.num_threads(),
        "store_kb": stored["rest"] / 1024,
        "wal_kb": stored["wal"] / 1024,
    }


class Client:
    """Asks one actor without pause; what it says has a number."""

    def __init__(self, ref: hf.ActorRef[Any], kind: str, name: int, report: Report) -> None:
        self._ref, self._kind, self._name, self._report = ref, kind, name, report
        self.number = 0
        self.is_over = False

    async def run(self) -> None:
        """Until it is told to end; only an actor without recovery may lose what it has in hand."""
        while not self.is_over:
            self.number += 1
            try:
                answer = await self._ref.ask(Say(self._name, self.number), timeout=PATIENCE)
            except (hf.AskFailed, hf.RemoteCrash) as error:
                if self._kind not in ("task", "process"):
                    self._wrong(f"request {self.number} ended with {error!r}")
            except hf.HoldfastError as error:
                self._wrong(f"request {self.number} ended with {error!r}")
                return
            else:
                if answer != self.number:
                    self._wrong(f"request {self.number} was answered {answer}")
            self._report.requests += 1
            await asyncio.sleep(0)

    def _wrong(self, what: str) -> None:
        self._report.problems.append(f"{self._kind}, client {self._name}: {what}")


class Soak:
    """The actors, and what is done to them."""

    def __init__(self, system: hf.ActorSystem, rng: random.Random, report: Report) -> None:
        self._system, self._rng, self._report = system, rng, report
        self.refs: dict[str, hf.ActorRef[Any]] = {}

    async def start(self) -> None:
        for kind in KINDS:
            options: dict[str, Any] = {"isolation": "process"} if kind.endswith("process") else {}
            if kind not in ("task", "process"):
                options["recovery"] = hf.hybrid(interval=0.5)
            if kind == "protected":
                options["mechanism"] = hf.ftm.PBR()
            spec = hf.child(kind.replace(" ", "_"), hf.start(Ledger), **options)
            self.refs[kind] = await self._system.start(spec)

    async def strike(self) -> None:
        """Do something to somebody."""
        kind = self._rng.choice(KINDS)
        ref = self.refs[kind]
        what = self._rng.choice(("kill", "crash", "end", "move") if kind != "protected" else ("kill", "kill", "crash"))
        try:
            match what:
                case "kill":
                    what = f"kill {self._kill(kind)}"
                case "crash":
                    ref.tell(Crash())
                case "end":
                    await self._system.terminate(ref, timeout=PATIENCE)
                case _:
                    to: Any = self._rng.choice(("task", "process"))
                    await self._system.set_isolation(ref, to, timeout=PATIENCE)
        except hf.HoldfastError as error:
            self._report.refused[f"{what}: {type(error).__name__}"] += 1
        else:
            self._report.done[what] += 1

    def _kill(self, kind: str) -> str:
        """SIGKILL for a process of the actor; an actor that is a task here has none."""
        path = self.refs[kind].path
        pids = [
            pid for address, pid in self._system._workers.processes().items()
            if address == path or address.startswith(f"{path}/ftm/r")
        ]  # fmt: skip
        if not pids:
            return "nobody"
        try:
            os.kill(self._rng.choice(pids), signal.SIGKILL)
        except ProcessLookupError:  # It has just ended by itself, as one that has been moved to a task does.
            return "nobody"
        return "a replica" if kind == "protected" else "a process"

    async def well(self) -> None:
        """Wait until each of them answers, and the group is whole; a problem if that never comes."""
        try:
            await whole(self.refs["protected"])
            read = {kind: await ref.ask(Read(), timeout=PATIENCE) for kind, ref in self.refs.items()}
        except (Stuck, hf.HoldfastError) as error:
            self._report.problems.append(f"they are not well again: {error!r}")
            return
        for kind, (twice, missed) in read.items():
            if kind not in ("task", "process") and (twice or missed):
                self._report.problems.append(f"{kind}: {missed} lost, {twice} doubled")


async def run(seconds: float, seed: int, *, strikes: int = 4, least: int = 1) -> Report:
    """Soak for so long, and for so many rounds; stops at the first problem."""
    report, rng = Report(seed), random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="holdfast-soak-") as folder:
        store = Path(folder)
        options: dict[str, Any] = {"log": False, "intensity": 1_000_000, "store": f"sqlite:{store / 'soak.db'}"}
        async with hf.ActorSystem("app", **options) as system:
            soak = Soak(system, rng, report)
            await soak.start()
            clients = [
                Client(ref, kind, name, report) for kind, ref in soak.refs.items() for name in (1, 2)
            ]  # fmt: skip
            running = [asyncio.ensure_future(client.run()) for client in clients]
            end, rounds = time.monotonic() + seconds, 0
            while (time.monotonic() < end or rounds < least) and not report.problems:
                rounds += 1
                for _ in range(strikes):
                    await soak.strike()
                    await asyncio.sleep(rng.uniform(0.0, 0.2))
                await soak.well()
                report.samples.append(sample(store))
            for client in clients:
                client.is_over = True
            await asyncio.gather(*running)
            await soak.well()
            for client in clients:
                if client._kind not in ("task", "process"):
                    state = await system.get_state(soak.refs[client._kind], timeout=PATIENCE)
                    if state["last"].get(client._name) != client.number:
                        report.problems.append(f"{client._kind}: the last request of client {client._name} is lost")
    report.problems += leaks(report.samples)
    return report


if __name__ == "__main__":
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 8.0
    found = asyncio.run(run(hours * 3600, int(sys.argv[2]) if len(sys.argv) > 2 else random.randrange(2**32)))
    sys.stdout.write(f"{found}\n")
    sys.exit(1 if found.problems else 0)
