"""How every benchmark here measures and prints.

A job measures the library and a limit in turn (ABAB), with the garbage collected between, and prints one JSON line:

    bench, job         the question, and the part of it
    value, unit        the library's best of five, or by how much that is worse than the limit's (`added` jobs)
    limit              the limit's, measured between the library's runs
    ratio              value over limit **in speed** (times are inverted), larger is better; null for absolute targets
    target, ok         the least ratio, or the most `value` where there is no ratio
    python, commit, seed

Each side's best counts, not the best pair: a disturbed limit would flatter the library. The exit status speaks of
broken benchmarks only, never of missed targets.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import gc
import inspect
import json
import os
import platform
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import uvloop

TIMES: Final = frozenset({"s", "ms", "us", "%", "bytes", "GB"})  # units of which less is better
BURST: Final = 1000  # messages sent between two yields to the loop

Measure = Callable[[], float | Awaitable[float]]


class Pairs(NamedTuple):
    """Interleaved measurements, in order."""

    ours: list[float]
    limit: list[float]


async def pairs(ours: Measure, limit: Measure, n: int = 5) -> Pairs:
    """Measure `ours` and `limit` in turn, `n` times each; either may be a coroutine function."""
    measured = Pairs([], [])
    for _ in range(n):
        for measure, values in zip((ours, limit), measured, strict=True):
            gc.collect()
            value = measure()
            values.append(await value if inspect.isawaitable(value) else value)
    return measured


async def rate(call: Callable[[], Awaitable[object]], callers: int, count: int) -> float:
    """Calls per second, made by so many callers at once, each of which waits for its last one."""
    each = max(1, count // callers)

    async def caller() -> None:
        for _ in range(each):
            await call()

    began = time.perf_counter()
    await asyncio.gather(*[caller() for _ in range(callers)])
    return each * callers / (time.perf_counter() - began)


@dataclasses.dataclass(frozen=True, slots=True)
class Run:
    """One run of one benchmark file: its options, and the lines it prints."""

    bench: str
    quick: bool
    seed: int

    @property
    def n(self) -> int:
        """Interleaved pairs to measure."""
        return 2 if self.quick else 5

    def size(self, full: int) -> int:
        """A number of messages, actors or restarts, a tenth of it in a quick run."""
        return max(1, full // 10) if self.quick else full

    async def compare(self, job: str, ours: Measure, limit: Measure, *, unit: str, target: float) -> None:
        """The library beside a limit: the ratio in speed is to be at least `target`."""
        measured = await pairs(ours, limit, self.n)
        best = min if unit in TIMES else max
        value, floor = best(measured.ours), best(measured.limit)
        ratio = floor / value if unit in TIMES else value / floor
        self._print(job, value, unit, floor, ratio, target, ratio >= target)

    async def added(self, job: str, ours: Measure, limit: Measure, *, unit: str, target: float) -> None:
        """What the library adds to a baseline, the best of each: at most `target`."""
        measured = await pairs(ours, limit, self.n)
        baseline = min(measured.limit)
        value = min(measured.ours) - baseline
        self._print(job, value, unit, baseline, None, target, value <= target)

    def bound(self, job: str, value: float, *, unit: str, target: float) -> None:
        """An absolute figure: at most `target`."""
        self._print(job, value, unit, None, None, target, value <= target)

    def fresh(self, worker: str, env: Mapping[str, str] | None = None) -> float:
        """What a worker of the same benchmark file measures in a new process, with `env` added to its environment."""
        command = [sys.executable, sys.argv[0], "--worker", worker, "--seed", str(self.seed), *["--quick"] * self.quick]
        done = subprocess.run(command, env={**os.environ, **(env or {})}, stdout=subprocess.PIPE, check=True)
        return float(done.stdout.split()[-1])

    def _print(
        self, job: str, value: float, unit: str, limit: float | None, ratio: float | None, target: float, ok: bool
    ) -> None:
        line = {
            "bench": self.bench,
            "job": job,
            "value": _rounded(value),
            "unit": unit,
            "limit": _rounded(limit),
            "ratio": _rounded(ratio),
            "target": target,
            "ok": ok,
            "python": platform.python_version(),
            **_commit(),
            "seed": self.seed,
        }
        print(json.dumps(line), flush=True)


Job = Callable[[Run], Awaitable[None]]
Worker = Callable[[Run], Awaitable[float]]


def main(jobs: Sequence[Job], workers: Mapping[str, Worker] | None = None) -> None:
    """The command line of a benchmark: each job in turn, each on a uvloop of its own.

    Args:
        jobs: coroutine functions that print their lines through the `Run` they are given.
        workers: what `Run.fresh` measures in a new process, by name.
    """
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--quick", action="store_true", help="a tenth of the messages, two pairs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", metavar="TEXT", help="only jobs with TEXT in their function's name")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    run = Run(Path(sys.argv[0]).stem.removeprefix("bench_"), options.quick, options.seed)
    if options.worker:
        print(_on_uvloop((workers or {})[options.worker](run)))
        return
    broken = False
    for job in jobs:
        if options.only in getattr(job, "__name__", ""):
            try:
                _on_uvloop(job(run))
            except Exception:
                traceback.print_exc()
                broken = True
    sys.exit(broken)


def _on_uvloop(measured: Awaitable[Any]) -> Any:
    async def run() -> Any:
        return await measured

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(run())


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def _commit() -> dict[str, str]:
    """The commit of the checkout, or nothing without git."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "--verify", "HEAD"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return {}
    return {"commit": found.stdout.strip()}


# --- drivers, the same for the library and for a limit --------------------------------------------------------------


class Gate:
    """Called by each of `count` receivers when it has handled its share; `done` is set by the last."""

    def __init__(self, count: int = 1) -> None:
        self.left = count
        self.done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def __call__(self) -> None:
        self.left -= 1
        if not self.left:
            self.done.set_result(None)


class Tellable(Protocol):
    """An `ActorRef`, or the limit in its place."""

    def tell(self, message: Any, /) -> object: ...


async def tell_one(target: Tellable, message: object, count: int, *, burst: int = BURST) -> None:
    """Tell `target` `count` times, with a yield to the loop after each burst."""
    tell = target.tell
    for i in range(count):
        tell(message)
        if not i % burst:
            await asyncio.sleep(0)


async def tell_round(targets: Sequence[Tellable], message: object, rounds: int) -> None:
    """Tell every one of `targets`, `rounds` times, with a yield to the loop after each round."""
    for _ in range(rounds):
        for target in targets:
            target.tell(message)
        await asyncio.sleep(0)


class Latencies(NamedTuple):
    """What the asking clients saw."""

    rate: float  # asks per second
    p50: float  # seconds


async def ask_all(
    ask: Callable[[Any], Awaitable[object]], message: object, count: int, *, outstanding: int = 1
) -> Latencies:
    """Ask `count` times in all, from `outstanding` clients that each wait for one reply at a time."""
    clock = time.perf_counter_ns
    seen: list[int] = []

    async def client() -> None:
        for _ in range(count // outstanding):
            asked = clock()
            await ask(message)
            seen.append(clock() - asked)

    began = clock()
    if outstanding == 1:
        await client()
    else:
        await asyncio.gather(*[client() for _ in range(outstanding)])
    elapsed = clock() - began
    return Latencies(len(seen) / elapsed * 1e9, statistics.median(seen) / 1e9)


async def compare_asks(
    run: Run,
    job: str,
    ours: tuple[Callable[[Any], Awaitable[object]], object],
    limit: tuple[Callable[[Any], Awaitable[object]], object],
    count: int,
    *,
    target: float,
    outstanding: int = 1,
) -> None:
    """Compare asks with the limit's, each a call and its message: the median time of one, or the rate of several."""

    async def measure(ask: Callable[[Any], Awaitable[object]], message: object) -> float:
        seen = await ask_all(ask, message, count, outstanding=outstanding)
        return seen.p50 * 1e6 if outstanding == 1 else seen.rate

    unit = "us" if outstanding == 1 else "1/s"
    await run.compare(job, lambda: measure(*ours), lambda: measure(*limit), unit=unit, target=target)


def resident_bytes(field: str = "VmRSS") -> int:
    """Memory of this process now, or its peak (`VmHWM`)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise ValueError(field)
