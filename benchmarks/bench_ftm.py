"""Fault-tolerance mechanisms: what becomes of each fault, and what protection, failover and adaptation cost.

Baseline: the same actor unprotected, in a process of its own; a change by stopping the child and starting it with the
new spec; one comparison plus one encoding of the state.
Command: python benchmarks/bench_ftm.py [--quick] [--only JOB]; HOLDFAST_REQUESTS=10000 requests for each row of the
campaign (see ftm_campaign.py), HOLDFAST_SOAK=60 seconds of soak.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import json
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
from harness import Run, ask_all, main
from limits import echo_process

import holdfast as hf
from holdfast.ftm.events import FailedOver
from holdfast.ftm.group import group_place
from holdfast.ftm.model.detection import Detection
from holdfast.ftm.sec.authority import CertificationAuthority

sys.path.append(str(Path(__file__).resolve().parents[1]))

import ftm_timing
from ftm_campaign import campaign, soaking
from ftm_workload import Bump, Change, Count, Parts, Second, Third, Whole, is_counted

from tests.ftm import campaign as engine  # pyright: ignore[reportMissingImports]  # found by the line above

STACKS: dict[str, tuple[Any, ...]] = {
    "PBR": (hf.ftm.PBR(),),
    "LFR": (hf.ftm.LFR(),),
    "TR": (hf.ftm.TR(),),
    "PBR+TR": (hf.ftm.PBR(), hf.ftm.TR()),
    "LFR+TR": (hf.ftm.LFR(), hf.ftm.TR()),
    "TMR": (hf.ftm.TMR(),),
    "AD+PBR": (hf.ftm.AD(assertions=(is_counted,)), hf.ftm.PBR()),
    "RB": (hf.ftm.RB(alternates=(Second,), test=is_counted),),
    "NVP": (hf.ftm.NVP(versions=(Second, Third)),),
    "SEC+PBR": (hf.ftm.SEC("/bench/ca"), hf.ftm.PBR()),
}
CHANGES: dict[str, tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    "PBR to LFR and back": (STACKS["PBR"], STACKS["LFR"]),
    "PBR to PBR+TR and back": (STACKS["PBR"], STACKS["PBR+TR"]),
}
PACE = 1000  # requests per second while mechanisms are changed
WINDOW = 0.15  # seconds around a change, and of the quiet time beside it


@contextlib.asynccontextmanager
async def _system() -> AsyncGenerator[hf.ActorSystem, None]:
    # As a program does that wants short pauses: a full collection of all that was imported takes longer than a change.
    gc.collect()
    gc.freeze()
    async with hf.ActorSystem("bench", log=False, intensity=100_000) as system:
        yield system


async def _protected(system: hf.ActorSystem, name: str, layers: Sequence[Any], start: Any = None) -> hf.ActorRef[Any]:
    if any(layer.name == "sec" for layer in layers):
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
    ref = await system.start(hf.child(name, start or hf.start(Count), mechanism=tuple(layers)))
    await engine.whole(ref)
    return ref


def _pid(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> int:
    """The process of the replica that leads."""
    group = engine.group_of(ref)
    assert group is not None
    return system._workers.processes()[f"{ref.path}/ftm/{group.membership.primary}"]


# -- latency and throughput -------------------------------------------------------------------------------------------


async def latency(run: Run) -> None:
    """An ask of each mechanism beside the unprotected one, and where its time goes."""
    count = run.size(1500)
    async with _system() as system:
        plain = await system.start(hf.child("plain", hf.start(Count), isolation="process"))
        await ask_all(plain.ask, Bump(), 500)
        for name, layers in STACKS.items():
            ref = await _protected(system, f"c{len(name)}{name[0].lower()}", layers)
            await ask_all(ref.ask, Bump(), 500)

            async def ours(ref: Any = ref) -> float:
                return (await ask_all(ref.ask, Bump(), count)).p50 * 1e6

            async def limit() -> float:
                return (await ask_all(plain.ask, Bump(), count)).p50 * 1e6

            await run.compare(f"ask, {name}, beside unprotected in a process", ours, limit, unit="us", target=0.0)
    for name, layers in STACKS.items():
        await _print_bricks(name, layers, run.size(1000))


async def _print_bricks(name: str, layers: Sequence[Any], count: int) -> None:
    marks, asks = ftm_timing.root_marks(), list[tuple[float, float]]()
    with tempfile.TemporaryDirectory() as folder:
        before, group_place.replica = group_place.replica, ftm_timing.recipe(Path(folder))
        try:
            async with _system() as system:
                ref = await _protected(system, "timed", layers)
                await ask_all(ref.ask, Bump(), 300)
                for _ in range(count):
                    begin = time.perf_counter()
                    await ref.ask(Bump())
                    asks.append((begin, time.perf_counter()))
        finally:
            group_place.replica = before
        seen = list(marks.seen)
        for file in Path(folder).iterdir():
            for line in file.read_text().splitlines():
                seen += [(moment, step) for moment, step in json.loads(line)]
    steps = ftm_timing.by_brick(asks, seen)
    line = "  ".join(f"{step} {seconds * 1e6:.0f}" for step, seconds in steps)
    print(f"# {name}: us until each step  {line}", flush=True)


async def throughput(run: Run) -> None:
    """PBR in process pairs beside the unprotected process actor, 100 asks outstanding."""
    count = run.size(20_000)
    async with _system() as system:
        plain = await system.start(hf.child("plain", hf.start(Count), isolation="process"))
        for name in ("PBR", "LFR", "PBR+TR"):
            ref = await _protected(system, name.lower().replace("+", ""), STACKS[name])
            await ask_all(ref.ask, Bump(), 2000, outstanding=100)
            await ask_all(plain.ask, Bump(), 2000, outstanding=100)

            async def ours(ref: Any = ref) -> float:
                return (await ask_all(ref.ask, Bump(), count, outstanding=100)).rate

            async def limit() -> float:
                return (await ask_all(plain.ask, Bump(), count, outstanding=100)).rate

            target = 0.3 if name == "PBR" else 0.1
            await run.compare(f"asks per second, {name}, 100 outstanding", ours, limit, unit="1/s", target=target)


# -- failover ---------------------------------------------------------------------------------------------------------


async def failover(run: Run) -> None:
    """From SIGKILL of the primary to the next reply; from the detector's suspicion, if it only stands still."""
    for name in ("PBR", "LFR"):
        async with _system() as system:
            ref, events = await _protected(system, "c", STACKS[name]), system.events()
            await ask_all(ref.ask, Bump(), 300)
            waits, inner = list[float](), list[float]()
            for _ in range(run.size(50)):
                await engine.whole(ref)
                await asyncio.sleep(0.1)
                events.take()
                pid, began = _pid(system, ref), time.perf_counter()
                os.kill(pid, signal.SIGKILL)
                await ref.ask(Bump(), timeout=30.0)
                waits.append((time.perf_counter() - began) * 1e3)
                inner += [one.seconds * 1e3 for one in events.take() if isinstance(one, FailedOver)]
            print(f"# {name}: within the manager {statistics.median(inner):.2f} ms, the slowest {max(inner):.2f} ms")
            run.bound(f"SIGKILL to the next reply, {name}, median", statistics.median(waits), unit="ms", target=20.0)
            run.bound(f"SIGKILL to the next reply, {name}, slowest", max(waits), unit="ms", target=20.0)
            events.close()
    await _stopped(run)


async def _stopped(run: Run) -> None:
    patched = engine.detecting(Detection(interval=0.02, pause=0.2))
    with patched:
        async with _system() as system:
            ref = await _protected(system, "c", STACKS["PBR"])
            waits = []
            for _ in range(run.size(20)):
                await engine.whole(ref)
                await asyncio.sleep(0.2)
                group = engine.group_of(ref)
                assert group is not None
                assert group.membership.primary is not None
                stopped = group.membership.primary
                os.kill(_pid(system, ref), signal.SIGSTOP)
                await ref.ask(Bump(), timeout=30.0)
                waits.append((asyncio.get_running_loop().time() - group.membership.suspected[stopped].since) * 1e3)
    job = "SIGSTOP to the next reply beyond the detector's time-out"
    run.bound(f"{job}, median", statistics.median(waits), unit="ms", target=20.0)
    run.bound(f"{job}, slowest", max(waits), unit="ms", target=20.0)


# -- adaptation -------------------------------------------------------------------------------------------------------


class Paced:
    """Clients that ask so many times a second; each reply's moment is noted."""

    def __init__(self, ask: Callable[[], Awaitable[Any]]) -> None:
        self.ask, self.replies = ask, list[float]()
        self.answered = self.failed = 0
        self._stopping = False
        self._task = asyncio.create_task(self._run())
        self._asked: set[asyncio.Task[None]] = set()

    async def _run(self) -> None:
        begin, sent = time.perf_counter(), 0
        while not self._stopping:
            due = int((time.perf_counter() - begin) * PACE)
            for _ in range(min(50, due - sent)):
                task = asyncio.create_task(self._one())
                self._asked.add(task)
                task.add_done_callback(self._asked.discard)
            sent = max(sent, due)
            await asyncio.sleep(0.0005)

    async def _one(self) -> None:
        try:
            await self.ask()
        except hf.HoldfastError:
            self.failed += 1
        else:
            self.answered += 1
            self.replies.append(time.perf_counter())

    async def stop(self) -> None:
        self._stopping = True
        await self._task
        if self._asked:
            await asyncio.wait(self._asked)

    def longest(self, begin: float, end: float) -> float:
        """Seconds of the longest gap between two replies in a window, in ms."""
        inside = [begin, *(moment for moment in self.replies if begin <= moment <= end), end]
        return max(b - a for a, b in itertools.pairwise(inside)) * 1e3


async def _windows(clients: Paced, change: Any) -> tuple[float, float]:
    """The longest gap in a quiet window, and that around the change behind it."""
    quiet = time.perf_counter()
    await asyncio.sleep(WINDOW)
    begin = time.perf_counter()
    await change()
    rest = WINDOW - (time.perf_counter() - begin)
    if rest > 0:
        await asyncio.sleep(rest)
    end = time.perf_counter()
    gaps = clients.longest(quiet, begin), clients.longest(begin, end)
    del clients.replies[:-10]
    return gaps


async def transitions(run: Run) -> None:
    """Client gaps while mechanisms are changed, beside stopping the child and starting it with the new spec."""
    machine = await _machine(run.size(200))
    print(f"# two bare processes, a quiet window beyond another, ms: {_spread(machine)}", flush=True)
    for name, (first, second) in CHANGES.items():
        windows = await _transitions(first, second, run.size(200))
        gaps = [around - quiet for quiet, around in windows]
        noise = _differences([quiet for quiet, _ in windows])
        restarts = [around - quiet for quiet, around in await _restarts(first, second, run.size(20))]
        print(
            f"# {name}: longest client gap beyond that of the quiet window before, ms: {_spread(gaps)}; "
            f"of a quiet window beyond that of another: {_spread(noise)}; "
            f"by stopping and starting the child: {_spread(restarts)}",
            flush=True,
        )
        job = f"transition, {name}, client gap, p99 of {len(gaps)}"
        run.bound(job, _percentile(gaps, 99), unit="ms", target=5.0)


async def _machine(count: int) -> list[float]:
    """What the machine alone does to the longest gap: the same clients ask an echo between two bare processes."""
    async with echo_process() as bare:
        clients, gaps = Paced(lambda: bare.ask(b"")), list[float]()
        await asyncio.sleep(0.3)
        for _ in range(count):
            begin = time.perf_counter()
            await asyncio.sleep(WINDOW)
            gaps.append(clients.longest(begin, time.perf_counter()))
            del clients.replies[:-10]
        await clients.stop()
    return _differences(gaps)


def _differences(gaps: list[float]) -> list[float]:
    return [after - before for before, after in itertools.pairwise(gaps)]


def _percentile(values: list[float], at: int) -> float:
    return statistics.quantiles(values, n=100, method="inclusive")[at - 1]


def _spread(values: list[float]) -> str:
    return (
        f"median {statistics.median(values):.2f} p90 {_percentile(values, 90):.2f} "
        f"p99 {_percentile(values, 99):.2f} worst {max(values):.2f}"
    )


async def _transitions(first: Sequence[Any], second: Sequence[Any], count: int) -> list[tuple[float, float]]:
    async with _system() as system:
        ref = await _protected(system, "c", first)
        clients, gaps = Paced(lambda: ref.ask(Bump(), timeout=10.0)), list[tuple[float, float]]()
        await asyncio.sleep(0.3)
        for number in range(count):
            target = first if number % 2 else second

            async def change(target: Sequence[Any] = target) -> None:
                async with system.transaction(timeout=30) as steps:
                    steps.protect(ref, tuple(target))

            gaps.append(await _windows(clients, change))
        await clients.stop()
        assert clients.failed == 0, f"{clients.failed} asks have failed"
        handled = await ref.ask(Bump()) - 1
        assert handled == clients.answered, f"{clients.answered} answers, {handled} requests were handled"
    return gaps


async def _restarts(first: Sequence[Any], second: Sequence[Any], count: int) -> list[tuple[float, float]]:
    async with _system() as system:
        holder = [await _protected(system, "c", first)]
        clients, gaps = Paced(lambda: holder[0].ask(Bump(), timeout=10.0)), list[tuple[float, float]]()
        await asyncio.sleep(0.3)
        for number in range(count):
            target = first if number % 2 else second

            async def change(target: Sequence[Any] = target) -> None:
                await system.stop(holder[0])
                holder[0] = await system.start(hf.child("c", hf.start(Count), mechanism=tuple(target)))

            gaps.append(await _windows(clients, change))
        await clients.stop()
    return gaps


# -- size of the state ------------------------------------------------------------------------------------------------


async def state_size(run: Run) -> None:
    """One request after the other under PBR, as the state grows to 10 MB."""
    sizes = (10_000, 100_000, 1_000_000, 10_000_000)
    times: dict[type, list[float]] = {Whole: [], Parts: []}
    used: dict[type, list[float]] = {Whole: [], Parts: []}
    bounds: list[float] = []
    for kind in (Parts, Whole):
        for size in sizes:
            start = hf.start(kind, size // 1000, 1000)
            async with _system() as system:
                ref = await _protected(system, "big", STACKS["PBR"], start)
                count = run.size(200 if size < 10**7 or kind is Parts else 40)
                await _changes(ref, 5)
                pids = [*system._workers.processes().values(), os.getpid()]
                before, rounds = sum(map(_processor, pids)), max(5, count // 2)
                times[kind].append(min([await _changes(ref, rounds) for _ in range(run.n)]))
                used[kind].append((sum(map(_processor, pids)) - before) / rounds / run.n)
            if kind is Whole:
                bounds.append(_encoded_and_compared(size))
    print("# size of the state: " + ", ".join(f"{size / 1000:g} kB" for size in sizes))
    for kind, name in ((Parts, "with deltas"), (Whole, "whole")):
        print(f"#   {name}, us a request: " + ", ".join(f"{one * 1e6:.0f}" for one in times[kind]))
        print(f"#   {name}, us of processor, all processes: " + ", ".join(f"{one * 1e6:.0f}" for one in used[kind]))
    print("#   one comparison plus one encoding, us: " + ", ".join(f"{one * 1e6:.0f}" for one in bounds), flush=True)
    growth = times[Parts][-1] / times[Parts][0]
    run.bound("cost of a request with deltas, state of 10 MB over 10 kB", growth, unit="x", target=2.0)
    added = (times[Whole][-1] - times[Whole][0]) / bounds[-1]
    job = "cost of a request beyond that with 10 kB, whole state of 10 MB, over one comparison plus one encoding"
    run.bound(job, added, unit="x", target=1.5)


def _processor(pid: int) -> float:
    """Seconds that a process has computed."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9


async def _changes(ref: hf.ActorRef[Any], count: int) -> float:
    begin = time.perf_counter()
    for key in range(count):
        await ref.ask(Change(key), timeout=30.0)
    return (time.perf_counter() - begin) / count


def _encoded_and_compared(size: int) -> float:
    actor = Whole(size // 1000, 1000)
    before = msgspec.msgpack.encode(vars(actor))
    best = 1e9
    for _ in range(5):
        begin = time.perf_counter()
        data = msgspec.msgpack.encode(vars(actor))
        assert data == before
        best = min(best, time.perf_counter() - begin)
    return best


if __name__ == "__main__":
    main([latency, throughput, failover, transitions, state_size, campaign, soaking])
