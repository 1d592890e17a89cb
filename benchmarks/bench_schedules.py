"""How fast is a simulated run, and how many runs does each strategy need to find a bug?

Baseline: the same program on the virtual clock without a schedule. The planted bugs are those of
tests/testing/schedules/planted.py: a run of each strategy is a number of schedules, not a time.
Command: python benchmarks/bench_schedules.py [--quick]
"""

from __future__ import annotations

import asyncio
import functools
import importlib.util
import time
from pathlib import Path
from typing import Any

from harness import Run, main

import holdfast as hf
from holdfast.testing import GuardedSystem, simulate, virtual
from holdfast.testing.schedules.choices import Walk
from holdfast.testing.schedules.strategies import NAMES, strategy
from holdfast.testing.simulation import run_schedule

PLANTED = Path(__file__).resolve().parents[1] / "tests/testing/schedules/planted.py"
MOST = 1000
"""Runs after which a strategy is given up."""


class Clock:
    """Holds the real clock: a simulated run has functions of its own in `time`, and wherever they were imported."""

    thread_time = staticmethod(time.thread_time)


class Get(hf.Message[int]):
    """Answered at once."""


class Echo(hf.Actor):
    """Answers."""

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return 1


class Hop(hf.Message):
    """Passed on so many times."""

    left: int
    to: hf.ActorRef[hf.Actor]


class Hopper(hf.Actor):
    """Passes a hop back."""

    @hf.on(Hop)
    def hop(self, message: Hop) -> None:
        if message.left:
            message.to.tell(Hop(message.left - 1, self.ctx.ref))


async def ask(system: GuardedSystem, count: int) -> float:
    """Turns per second of eight tasks that ask four actors."""
    refs = [system.spawn(hf.start(Echo), f"echo{number}") for number in range(4)]

    async def client(number: int) -> None:
        for _ in range(count // 8):
            await refs[number % 4].ask(Get())

    begin = Clock.thread_time()
    await asyncio.gather(*map(client, range(8)))
    return count / (Clock.thread_time() - begin)


async def tell(system: GuardedSystem, count: int) -> float:
    """Turns per second of four pairs that tell each other."""
    refs = [system.spawn(hf.start(Hopper), f"hopper{number}") for number in range(8)]
    for number in range(4):
        refs[2 * number].tell(Hop(count // 4, refs[2 * number + 1]))
    begin = Clock.thread_time()
    await system._node.settled()
    return count / (Clock.thread_time() - begin)


def speed(program: Any) -> Any:
    """The job of one program."""

    async def job(run: Run) -> None:
        count = run.size(16_000)  # More rounds without time passing would be told as a program that does not rest.

        def simulated() -> float:
            measured: list[float] = []

            async def test(system: GuardedSystem) -> None:
                measured.append(await program(system, count))

            run_schedule(test, Walk(1), {"system"}, {}, looks=False)
            return measured[0]

        def plain() -> float:
            async def test() -> float:
                async with GuardedSystem() as system:
                    system.look_away()
                    return float(await program(system, count))

            with asyncio.Runner(loop_factory=virtual) as runner:
                return runner.run(test())

        # A loop of its own needs a thread of its own.
        ours, limit = (functools.partial(asyncio.to_thread, measured) for measured in (simulated, plain))
        await run.compare(f"turns of a simulated run, {program.__name__}", ours, limit, unit="1/s", target=0.3)

    job.__name__ = f"speed_of_{program.__name__}"
    return job


def planted() -> dict[str, Any]:
    """The planted bugs, by name."""
    spec = importlib.util.spec_from_file_location("planted", PLANTED)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: dict[str, Any] = module.PLANTED
    return found


def needed(test: Any, name: str, most: int) -> int | None:
    """How many runs a strategy needs until the bug shows; None: more than `most`, or all there are."""
    tried = strategy(name)
    for number in range(most):
        choices = tried.choices(number)
        if choices is None:
            return None
        try:
            run = run_schedule(test, choices, {"system"}, {}, looks=False)
        except Exception:  # The bug, whatever it raises.
            return number + 1
        tried.learn(choices, run.trace)
    return None


async def table(run: Run) -> None:
    """Runs until each bug shows, by strategy."""
    most = run.size(MOST)
    for bug, test in planted().items():
        for name in NAMES:
            count = await asyncio.to_thread(needed, test, name, most)
            run.bound(f"runs of {name} until {bug}", count or most + 1, unit="runs", target=most)


async def shrinking(run: Run) -> None:
    """Seconds to find, repeat and shrink each bug."""
    for bug, test in planted().items():
        begin = time.perf_counter()
        try:
            await asyncio.to_thread(simulate(test))
        except Exception:  # The bug.
            run.bound(f"{bug}, found, repeated and shrunk", time.perf_counter() - begin, unit="s", target=30.0)


if __name__ == "__main__":
    main([speed(ask), speed(tell), table, shrinking])
