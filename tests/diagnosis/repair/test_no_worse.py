"""Repair is never worse than supervision alone: the same faults and seeds with repair off and on, under virtual time.

A foreign pipeline (a source, two stages, a cache that one of them asks) is watched with a generated model and nothing
set. Each run strikes it once; then its output is looked at for a minute. 25 seeds of each fault, with the figures:

    HOLDFAST_REPAIRS=25 pytest -s -p no:xdist -o faulthandler_timeout=3600 tests/diagnosis/repair/test_no_worse.py
"""

import asyncio
import dataclasses
import itertools
import os
import random
import statistics
from collections import defaultdict
from collections.abc import Iterator

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.actors.events import ActorStarted, Event
from holdfast.diagnosis.repair import ActionBegan, Stance
from tests.diagnosis.repair.simulated import now

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

RUNS = int(os.environ.get("HOLDFAST_REPAIRS", "1"))
FIRST = 3
"""With this seed a slow start is over just when repair looks at it."""
BEAT = 0.1
WATCHED = 60.0
"""Seconds for which the output is looked at after a fault."""
GAP = 0.5
"""Seconds without an output that are no outage yet."""
MOST_LONGER = 2.0
"""Seconds by which an outage may be longer with repair than without."""
FAULTS = {
    "crash": {"stage"},
    "crashes": {"stage"},
    "escalation": {"stage"},
    "slow start": {"last"},
    "frozen source": {"source"},
    "hung stage": {"last"},
    "hung cache": {"cache"},
    "doubled": set[str](),
    "bursts": set[str](),
    "quiet": set[str](),
}
"""Each kind of fault, and who is faulty then: to restart anybody else is wrong."""


class Tick(hf.Message):
    """It is time to publish."""


class Item(hf.Message):
    """What flows."""


class Order(hf.Message):
    """What is wrong from now on."""

    what: str


class Fetch(hf.Message[int]):
    """Ask the cache."""


@dataclasses.dataclass
class Traffic:
    """How fast the source publishes: seconds between two items, and how many at once."""

    beat: float = BEAT
    burst: int = 1


class Part(hf.Actor):
    """Can be told to crash, or to hang in its turn."""

    deterministic = False

    @hf.on(Order)
    async def _obey(self, message: Order) -> None:
        if message.what == "crash":
            raise RuntimeError("as it was told")
        if message.what == "hang":
            await asyncio.Event().wait()
        await self.ordered(message.what)

    async def ordered(self, what: str) -> None:
        """Anything else that it was told."""


class Source(Part):
    def __init__(self, traffic: Traffic) -> None:
        self._traffic, self._is_frozen = traffic, False

    def on_start(self, restored: bool) -> None:
        self.ctx.tell_after(self._traffic.beat, Tick())

    async def ordered(self, what: str) -> None:
        self._is_frozen = True

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        self.ctx.tell_after(self._traffic.beat * self._traffic.burst, Tick())
        for _ in range(0 if self._is_frozen else self._traffic.burst):
            await self.ctx.publish("/in", Item())


class Cache(Part):
    @hf.on(Fetch)
    def _fetch(self, message: Fetch) -> int:
        return 1


class Stage(Part):
    cache: hf.Binding[Cache]

    @hf.subscribe("/in")
    @hf.on(Item)
    async def _take(self, message: Item) -> None:
        await self.cache.ask(Fetch(), timeout=1.0)
        await self.ctx.publish("/mid", Item())


class Last(Part):
    def __init__(self, slow: list[float]) -> None:
        self._slow = slow

    async def on_start(self, restored: bool) -> None:
        await asyncio.sleep(sum(self._slow))

    @hf.subscribe("/mid")
    @hf.on(Item)
    async def _take(self, message: Item) -> None:
        await self.ctx.publish("/out", Item())


class Sink(hf.Actor):
    """Notes when something has come out, and what repair does."""

    deterministic = False

    def __init__(self, came: list[float], acted: list[str]) -> None:
        self._came, self._acted = came, acted

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe("/repair")

    @hf.subscribe("/out")
    @hf.on(Item)
    def _note(self, message: Item) -> None:
        self._came.append(now())

    @hf.on(ActionBegan)
    def _acts(self, message: ActionBegan) -> None:
        self._acted.append(message.step.args[0])

    @hf.on(hf.Message)
    def _other(self, message: hf.Message) -> None:
        pass


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a run cost: seconds of outage, lives that were begun, and what repair did."""

    outage: float
    starts: int
    acted: tuple[str, ...]


async def run(fault: str, seed: int, stance: Stance) -> Outcome:
    """One run; everything that is random is drawn from the seed."""
    draw, traffic, slow = random.Random(f"{fault} {seed}"), Traffic(), list[float]()
    came, acted, starts = list[float](), list[str](), list[str]()
    async with hf.ActorSystem("t", log=False, seed=seed) as system:
        backoff = hf.Backoff(initial=draw.uniform(0.05, 1.0), jitter=0.0)
        children = [
            hf.child("cache", hf.start(Cache)),
            hf.child("stage", hf.start(Stage), bindings={"cache": "/t/pipe/cache"}),
            hf.child("last", hf.start(Last, slow), backoff=backoff),
        ]
        pipe = hf.supervisor("pipe", children=children, intensity=3, period=10.0)
        await system.start(hf.supervisor("top", children=[hf.child("source", hf.start(Source, traffic))]))
        await system.start(pipe)
        system.spawn(hf.start(Sink, came, acted), name="sink")
        await diagnosis.watch(system, repair=stance, hung_after=2.0, seconds=2.0)
        await asyncio.sleep(15.0 + draw.uniform(0.0, 5.0))

        def heard(event: Event) -> None:
            if isinstance(event, ActorStarted) and event.life > 1:
                starts.append(event.address)

        system._node.events.add_sink(heard)
        began = now()
        await strike(system, fault, draw, traffic, slow)
        await asyncio.sleep(began + WATCHED - now())
        system._node.events.remove_sink(heard)
        moments = [began, *(when for when in came if when > began), now()]
        gaps = [later - earlier for earlier, later in itertools.pairwise(moments)]
        return Outcome(
            sum(gap for gap in gaps if gap > max(GAP, 2 * traffic.beat * traffic.burst)), len(starts), tuple(acted)
        )


async def strike(system: hf.ActorSystem, fault: str, draw: random.Random, traffic: Traffic, slow: list[float]) -> None:
    """Let one fault happen."""
    part = lambda name: system.ref(f"/t/{'top' if name == 'source' else 'pipe'}/{name}", Part)  # noqa: E731
    match fault:
        case "crash" | "crashes" | "escalation":
            for _ in range({"crash": 1, "crashes": 3, "escalation": 4}[fault]):
                part("stage").tell(Order("crash"))
                await asyncio.sleep(draw.uniform(0.2, 0.6))
        case "slow start":
            slow.append(draw.uniform(1.0, 4.0))
            part("last").tell(Order("crash"))
        case "frozen source":
            part("source").tell(Order("freeze"))
        case "hung stage":
            part("last").tell(Order("hang"))
        case "hung cache":
            part("cache").tell(Order("hang"))
        case "doubled":
            traffic.beat = BEAT / 2
        case "bursts":
            traffic.burst = 10
        case _:
            traffic.beat = BEAT / 0.4


class Figures:
    """What all runs have cost, by the kind of fault."""

    def __init__(self) -> None:
        self.runs = defaultdict[str, list[tuple[Outcome, Outcome]]](list)

    def __str__(self) -> str:
        head = ("fault", "runs", "outage off", "on", "worse by", "starts off", "on", "wrong")
        lines = ["{:<15}{:>5}{:>12}{:>8}{:>10}{:>12}{:>6}{:>7}".format(*head)]
        for fault, both in self.runs.items():
            off, on = zip(*both, strict=True)
            worst = max(one.outage - other.outage for other, one in both)
            wrong = sum(name.rpartition("/")[2] not in FAULTS[fault] for one in on for name in one.acted)
            lines.append(
                f"{fault:<15}{len(both):>5}{statistics.fmean(one.outage for one in off):>10.2f} s"
                f"{statistics.fmean(one.outage for one in on):>6.2f} s{worst:>8.2f} s"
                f"{sum(one.starts for one in off):>12}{sum(one.starts for one in on):>6}{wrong:>7}"
            )
        return "\n".join(lines)


@pytest.fixture(scope="module")
def figures() -> Iterator[Figures]:
    made = Figures()
    yield made
    if RUNS > 1:
        print(f"\n{made}")


@pytest.mark.parametrize("seed", range(FIRST, FIRST + RUNS))
@pytest.mark.parametrize("fault", FAULTS)
async def test_repair_is_no_worse_than_supervision_alone(fault: str, seed: int, figures: Figures) -> None:
    off, on = await run(fault, seed, "off"), await run(fault, seed, "on")
    figures.runs[fault].append((off, on))
    told = (fault, seed, off, on)
    assert off.acted == (), told
    assert on.outage <= off.outage + MOST_LONGER, told
    wrong = [name for name in on.acted if name.rpartition("/")[2] not in FAULTS[fault]]
    assert wrong == [], told
