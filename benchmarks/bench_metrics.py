"""What does a scrape of 10,000 actors cost the event loop?

`time` is how long the walk over all actors takes on the loop, in all; `slice` is the median of the longest times for
which each scrape held the loop, the others' included; `asks` is the rate of asks while the system is scraped once a
second, beside that while it is not.

Command: python benchmarks/bench_metrics.py [--quick]
"""

from __future__ import annotations

import asyncio
import statistics

from harness import Job, Run, ask_all, main
from prometheus_client import generate_latest
from workload import Ping, Responder

import holdfast as hf
from holdfast.console.telemetry.metrics import Metrics

ACTORS = 10_000
SCRAPES = 20


async def walk(run: Run) -> None:
    """The time on the loop, and the longest time for which it is held."""
    async with hf.ActorSystem("bench", log=False) as system:
        metrics = Metrics(system)
        for _ in range(ACTORS):
            system.spawn(hf.start(Responder))
        await system._node.settled()
        times, slices = list[float](), list[float]()
        for _ in range(run.size(SCRAPES)):
            await asyncio.to_thread(generate_latest, metrics)
            look = metrics._last
            assert look is not None
            times.append(look.survey.seconds * 1e3)
            slices.append(look.survey.longest_slice * 1e3)
        run.bound("time", statistics.median(times), unit="ms", target=30.0)
        run.bound("slice", statistics.median(slices), unit="ms", target=2.0)


async def asks(run: Run) -> None:
    """Asks while the system is scraped once a second, beside asks while it is not."""
    async with hf.ActorSystem("bench", log=False) as system:
        metrics = Metrics(system)
        echo, *_ = [system.spawn(hf.start(Responder)) for _ in range(ACTORS)]
        count = run.size(100_000)

        async def scraping() -> None:
            while True:
                await asyncio.to_thread(generate_latest, metrics)
                await asyncio.sleep(1.0)  # A scrape in a second is what the most eager of Prometheus' servers do.

        async def scraped() -> float:
            work = asyncio.ensure_future(scraping())
            rate = (await ask_all(echo.ask, Ping(), count)).rate
            work.cancel()
            return rate

        async def alone() -> float:
            return (await ask_all(echo.ask, Ping(), count)).rate

        await run.compare("asks", scraped, alone, unit="asks/s", target=0.9)


JOBS: tuple[Job, ...] = (walk, asks)

if __name__ == "__main__":
    main(JOBS)
