"""One trial: a foreign system under traffic, perhaps with a fault, and what diagnosis says of it."""

import asyncio
import contextlib
import dataclasses
import random
from collections.abc import AsyncGenerator, Collection, Coroutine
from typing import Any, Literal, TypeVar

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis import DIAGNOSIS
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.testing.clock import VirtualClockLoop
from tests.diagnosis.foreign.systems import Faults, Foreign, Item, Stage

T = TypeVar("T")

TRAFFICS = ("steady", "bursty", "doubled", "quiet")
WARM = 40.0
"""Seconds in which the usual traffic comes."""
CHANGED = 20.0
"""Seconds of the changed traffic before the fault."""
WITHIN = 30.0
"""Seconds in which a fault is to be named."""
COMES, GOES = (4.0, 10.0), (2.0, 6.0)
"""Seconds for which a fault that comes and goes is there, and is not, at least and at most."""
Mode = Literal["lasting", "intermittent", "cascading"]
"""What becomes of a fault: it stays, it comes and goes, or whoever asks the one with it fails, too."""
JUMPS = 1_000_000_000
"""Jumps of the virtual clock in a run; a day takes about two million."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What was said: false alarms before the fault, who was named first, for certain or not, and after how long.

    `found`: those who are faulty that were named, while whoever was named before them was mended.
    """

    false_alarms: tuple[str, ...]
    first: tuple[str, ...] = ()
    certain: tuple[str, ...] = ()
    seconds: float = float("inf")
    found: frozenset[str] = frozenset()


class Listener(hf.Actor):
    """Notes each diagnosis that names somebody, with its time."""

    def __init__(self, said: list[tuple[float, Diagnosis]]) -> None:
        self._said = said

    @hf.subscribe(DIAGNOSIS)
    @hf.on(Diagnosis)
    def note(self, message: Diagnosis) -> None:
        if message.state is State.FAULTY and message.candidates:
            self._said.append((asyncio.get_running_loop().time(), message))


async def _traffic(entry: hf.ActorRef[Stage], kind: str, rng: random.Random) -> None:
    """Ten messages in a second, in bursts, twice as many, or a tenth."""
    loop = asyncio.get_running_loop()
    begin = loop.time()
    number = 0
    while True:
        is_changed = loop.time() - begin > WARM
        count, pause = 1, 0.1
        if kind == "bursty":
            count, pause = rng.randint(5, 40), rng.uniform(0.5, 3.0)
        elif kind == "doubled" and is_changed:
            pause = 0.05
        elif kind == "quiet" and is_changed:
            pause = 1.0
        for _ in range(count):
            number += 1
            entry.tell(Item(number))
        await asyncio.sleep(pause * rng.uniform(0.7, 1.3))


async def _named(said: list[tuple[float, Diagnosis]], until: float, struck: Collection[str]) -> set[str]:
    """Those of the struck whom the best candidate of a diagnosis names; none: nobody is named in time."""
    while asyncio.get_running_loop().time() < until:
        for _, one in said:
            if named := {*_names(one.candidates[0].bad)} & {*struck}:
                return named
        await asyncio.sleep(0.1)
    return set()


async def _mend(system: hf.ActorSystem, faults: Faults, names: Collection[str]) -> None:
    """Take away what is wrong with these, and begin them anew, as a person would who was told of them."""
    for name in names:
        del faults.of[name]
        with contextlib.suppress(hf.HoldfastError):
            keeper = system.ref("/app/all", hf.Supervisor)
            await keeper.ask(hf.TerminateChild(name), timeout=WITHIN)  # It may be starting, or hang in its end.
            await keeper.ask(hf.RestartChild(name))


def _names(components: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name.rpartition("/")[2] for name in components)


async def _come_and_go(faults: Faults, struck: dict[str, str], rng: random.Random) -> None:
    while True:
        await asyncio.sleep(rng.uniform(*COMES))
        for name in struck:
            faults.of.pop(name, None)
        await asyncio.sleep(rng.uniform(*GOES))
        faults.of |= struck


async def trial(
    foreign: Foreign,
    struck: dict[str, str],
    kind: str,
    seed: int,
    healthy: float = 0.0,
    refusals: float = 0.0,
    mode: Mode = "lasting",
) -> Outcome:
    """Let a system run, change its traffic, and strike it; it is looked at `healthy` seconds longer before that.

    `struck`: what is wrong with whom then, all at once; with nobody the trial ends before.
    `refusals`: the part of what they are asked that services refuse as usual.
    `mode`: what becomes of the faults; of one that comes and goes only one at a time.
    """
    faults = Faults(refusals=refusals, rng=random.Random(seed), is_spreading=mode == "cascading")
    said: list[tuple[float, Diagnosis]] = []
    loop = asyncio.get_running_loop()
    async with under_traffic(foreign, faults, kind, seed) as system:
        system.spawn(hf.start(Listener, said))
        await diagnosis.watch(system, seconds=3.0)
        await asyncio.sleep(WARM + CHANGED + healthy)
        false_alarms = tuple(str(one) for _, one in said)
        if not struck:
            return Outcome(false_alarms)
        said.clear()
        began = loop.time()
        faults.of |= struck
        changing = (
            asyncio.create_task(_come_and_go(faults, struck, random.Random(f"{seed} {struck}")))
            if mode == "intermittent"
            else None
        )
        found = set[str]()
        for _ in struck:
            if named := await _named(said, loop.time() + WITHIN, struck.keys() - found):
                found |= named
                if found != struck.keys():
                    await _mend(system, faults, named)
        if changing is not None:
            changing.cancel()
        if not said:
            return Outcome(false_alarms)
        at, first = said[0]
        names = _names(first.candidates[0].bad)
        return Outcome(false_alarms, names, _names(first.certain), at - began, frozenset(found))


@contextlib.asynccontextmanager
async def under_traffic(foreign: Foreign, faults: Faults, kind: str, seed: int) -> AsyncGenerator[hf.ActorSystem]:
    """A system in which a foreign one runs, and is told what comes."""
    async with hf.ActorSystem("app", log=False, seed=seed) as system:
        await system.start(hf.supervisor("all", children=foreign.children(faults), intensity=1000, period=5.0))
        entry = system.ref(f"/app/all/{foreign.entry}", Stage)
        driving = asyncio.create_task(_traffic(entry, kind, random.Random(seed)))
        try:
            yield system
        finally:
            driving.cancel()


def in_its_own_loop(trial: Coroutine[Any, Any, T]) -> T:
    """Run one trial in a loop of its own, for as long as it takes."""
    with asyncio.Runner(loop_factory=lambda: VirtualClockLoop(jumps=JUMPS)) as runner:
        return runner.run(trial)
