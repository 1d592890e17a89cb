"""Latencies: what is said is what is drawn, of whatever takes time, and it is repeated and shrunk with the run."""

import asyncio
import math
import random
import re
from typing import Any, cast

import pytest

import holdfast as hf
from holdfast.testing import Faults, GuardedSystem, simulate
from holdfast.testing.latencies import (
    Distribution,
    Latency,
    exponential,
    log_normal,
    long_tail,
    mixture,
    row_of,
    said_latencies,
)
from holdfast.testing.schedules.choices import Production, Walk, from_text
from holdfast.testing.simulation import run_schedule

DISK: dict[str, Any] = {"store": "simulated", "durability": "fsync"}


class Add(hf.Message[int]):
    number: int


class Adds(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.number
        return self.total


class Rings(hf.Actor):
    def __init__(self) -> None:
        self.at: list[float] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.every(10.0, Add(1))

    @hf.on(Add)
    def ring(self, message: Add) -> int:
        self.at.append(self.ctx.now())
        return len(self.at)


def row(said: Latency) -> tuple[float, ...]:
    return row_of("a test", "latency", said, random.Random(1))


@pytest.mark.parametrize(
    ("said", "mean", "median", "longest"),
    [
        (0.25, 0.25, 0.25, 0.25),
        ((0.0, 1.0), 0.5, 0.5, 1.0),
        (exponential(2.0), 2.0, 2.0 * math.log(2), 15.25),
        (log_normal(1.0, spread=math.e), math.exp(0.5), 1.0, 26.9),
        (long_tail(1.0, exponent=3.0), 1.5, 2 ** (1 / 3), 12.7),
        (mixture((0.9, 1.0), (0.1, (10.0, 20.0))), 0.9 + 1.5, 1.0, 20.0),
        (lambda draw: draw.uniform(2.0, 4.0), 3.0, 3.0, 4.0),
    ],
    ids=["a number", "bounds", "exponential", "log-normal", "long tail", "mixture", "a function"],
)
def test_a_row_has_the_shape_that_was_said(said: Any, mean: float, median: float, longest: float) -> None:
    found = row(said)
    assert list(found) == sorted(found)
    assert sum(found) / len(found) == pytest.approx(mean, rel=0.05)
    assert found[len(found) // 2] == pytest.approx(median, rel=0.05)
    assert found[-1] == pytest.approx(longest, rel=0.01)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (-1.0, "must be >= 0 seconds"),
        (math.nan, "must be >= 0 seconds"),
        (math.inf, "must be >= 0 seconds"),
        (True, "must be >= 0 seconds"),
        ("quick", "must be >= 0 seconds"),
        ((2.0, 1.0), "must be >= 0 seconds"),
        ((0.0, 1.0, 2.0), "must be >= 0 seconds"),
        ((0.0, math.inf), "must be >= 0 seconds"),
        (lambda draw: -draw.random() - 1.0, "must be finite and >= 0, not -1"),
        (lambda draw: None, "must be finite and >= 0, not None"),
        ({"frame": 1.0}, "there are no 'frame'"),
        ({"starts": -1.0}, "latency of starts must be >= 0"),
    ],
)
def test_what_is_no_latency_is_refused_at_once(wrong: Any, why: str) -> None:
    with pytest.raises(hf.SpecError, match=re.escape(why)):
        simulate(latency=wrong)
    if not isinstance(wrong, dict):
        with pytest.raises(hf.SpecError, match=re.escape(why)):
            simulate(sync=wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: exponential(0.0),
        lambda: exponential(math.nan),
        lambda: exponential(cast("Any", "long")),
        lambda: log_normal(-1.0),
        lambda: log_normal(1.0, spread=0.5),
        lambda: log_normal(1.0, spread=1e300),
        lambda: long_tail(0.0),
        lambda: long_tail(1.0, exponent=0.0),
        lambda: mixture(),
        lambda: mixture((0.5, 1.0)),
        lambda: mixture((1.0, 1.0), (0.0, 2.0)),
        lambda: mixture((0.5, 1.0), (0.5, -1.0)),
        lambda: mixture(cast("Any", 1.0)),
        lambda: mixture((1.0, cast("Any", random.Random.random))),
        lambda: Distribution("none", []),
        lambda: said_latencies({"syncs": 1.0}, sync=1.0),
    ],
)
def test_a_wrong_distribution_is_refused(wrong: Any) -> None:
    with pytest.raises(hf.SpecError):
        wrong()


def test_the_store_takes_time_only_where_it_is_simulated() -> None:
    async def nothing(system: GuardedSystem) -> None: ...

    for what in ("reads", "writes", "syncs"):
        with pytest.raises(hf.SpecError, match=f"{what} of the simulated store would take time"):
            simulate(nothing, seed=0, latency={what: 1.0})()


async def started(system: GuardedSystem, took: dict[str, float], **options: Any) -> hf.ActorRef:
    """An actor; how long its start and an ask have taken is noted."""
    loop = asyncio.get_running_loop()
    before = loop.time()
    ref = await system.start(hf.child("adds", hf.start(Adds), **options))
    took["start"] = loop.time() - before
    before = loop.time()
    await ref.ask(Add(1))
    took["ask"] = loop.time() - before
    return ref


@pytest.mark.parametrize(
    ("what", "options", "simulated", "start", "ask"),
    [
        ("frames", {"isolation": "process"}, {}, None, 2.0),
        ("starts", {"isolation": "process"}, {}, 1.0, 0.0),
        ("reads", {"recovery": hf.hybrid()}, DISK, None, 0.0),
        ("writes", {"recovery": hf.hybrid()}, DISK, None, None),
        ("syncs", {"recovery": hf.hybrid()}, DISK, 0.0, None),
        ("replies", {}, {}, 0.0, 1.0),
    ],
)
def test_each_takes_what_was_said(
    what: str, options: dict[str, Any], simulated: dict[str, Any], start: float | None, ask: float | None
) -> None:
    def seconds(latency: Any) -> dict[str, float]:
        took: dict[str, float] = {}

        async def run(system: GuardedSystem) -> None:
            await started(system, took, **options)

        run_schedule(run, Production(0), {"system"}, dict(simulated), latency=latency)
        return took

    assert seconds({}) == {"start": 0.0, "ask": 0.0}
    took = seconds({what: 1.0})
    for name, expected in (("start", start), ("ask", ask)):
        assert took[name] >= 1.0 if expected is None else took[name] == expected


def test_a_timer_is_late_and_never_early() -> None:
    late: list[float] = []

    async def rings(system: GuardedSystem) -> None:
        ref = await system.start(hf.child("rings", hf.start(Rings)))
        began = system._node.clock.wall()
        await asyncio.sleep(100.0)
        actor: Any = ref._cell.actor
        late.extend(at - began - 10.0 * number for number, at in enumerate(actor.at, 1))

    run_schedule(rings, Walk(1), {"system"}, {}, latency={"timers": exponential(0.5)})
    assert len(late) >= 9
    assert all(seconds >= 0.0 for seconds in late)
    assert len({round(seconds, 3) for seconds in late}) > 5


def test_replies_of_one_actor_keep_their_order() -> None:
    orders: list[list[int]] = []

    @simulate(seeds=10, latency={"replies": (0.0, 1.0)})
    async def asks(system: GuardedSystem) -> None:
        ref = system.spawn(hf.start(Adds))
        got: list[int] = []
        futures = [ref.ask(Add(1)) for _ in range(5)]
        for future in futures:
            future.add_done_callback(lambda done: got.append(done.result()))
        await asyncio.gather(*futures)
        orders.append(got)

    asks()
    assert all(got == [1, 2, 3, 4, 5] for got in orders)


async def slow(system: GuardedSystem) -> None:
    """It fails if an ask takes more than a tenth of a second: most do not."""
    ref = await system.start(hf.child("adds", hf.start(Adds), isolation="process"))
    loop = asyncio.get_running_loop()
    for _ in range(4):
        began = loop.time()
        await ref.ask(Add(1))
        assert loop.time() - began < 0.1


def test_a_late_frame_is_found_repeated_and_made_as_short_as_it_may_be() -> None:
    late = mixture((0.98, 0.001), (0.02, long_tail(0.05, exponent=1.0)))
    with pytest.raises(AssertionError) as raised:
        simulate(slow, latency=late)()
    [note] = raised.value.__notes__
    schedule = note.partition('replay="')[2].partition('"')[0]
    [(number, level)] = from_text(schedule)[1]["latency"].items()
    assert late.row[level - 1] + late.row[0] < 0.1 <= late.row[level] + late.row[0]
    assert number > 0
    with pytest.raises(AssertionError) as again:
        simulate(slow, latency=late, replay=schedule)()
    assert schedule in again.value.__notes__[0]


def test_a_delay_of_faults_is_a_latency_too() -> None:
    took = set[float]()

    async def delayed(system: GuardedSystem, faults: Faults) -> None:
        ref, loop = system.spawn(hf.start(Adds)), asyncio.get_running_loop()
        async with faults.on(ref, at="reply", delay=1.0, seconds=log_normal(0.1)):
            for _ in range(5):
                began = loop.time()
                await ref.ask(Add(1))
                took.add(round(loop.time() - began, 6))
        with pytest.raises(hf.SpecError, match="seconds must be"):
            faults.on(ref, at="reply", delay=1.0, seconds=(1.0, 0.0))

    run_schedule(delayed, Walk(3), {"system", "faults"}, {})
    assert len(took) == 5
    assert took <= {round(seconds, 6) for seconds in log_normal(0.1).row}


def test_a_function_draws_from_the_seed() -> None:
    def seconds(seed: int) -> float:
        took: dict[str, float] = {}

        async def run(system: GuardedSystem) -> None:
            await started(system, took, isolation="process")

        run_schedule(run, Walk(seed), {"system"}, {}, latency=lambda draw: draw.expovariate(10.0))
        return took["ask"]

    assert seconds(1) == seconds(1)
    assert len({seconds(seed) for seed in range(5)}) == 5
