"""Three systems that know nothing of diagnosis: a data pipeline, a gateway of devices, and a matching service."""

import asyncio
import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any

import holdfast as hf

PATIENCE = 1.0
"""Seconds that those who ask wait."""


@dataclasses.dataclass
class Faults:
    """What is wrong with whom, by the last part of the address.

    freeze   a turn waits for ever                pause    one turn in ten waits for five seconds
    slow     a turn takes too long for askers     stumble  one turn in three does
    lag      a turn takes half a second
    crash    each turn raises                     falter   one turn in three does
    end      it ends itself in each turn          unborn   it raises, and so does each start of it
    mute     it publishes nothing                 stutter  it publishes one in three
    deaf     it does nothing with what it gets    stash    it puts everything aside
    owe      it never answers
    """

    of: dict[str, str] = dataclasses.field(default_factory=dict)
    turns: Counter[str] = dataclasses.field(default_factory=Counter)
    is_of_a_life: bool = False
    """Whether nothing is wrong any more with a later life."""
    came_out: Callable[[str], None] = lambda name: None
    """Called with the name of each who takes what the system makes, whenever it has taken something."""

    def begin(self, actor: hf.Actor) -> None:
        """Let happen what is wrong with the start of an actor."""
        name = name_of(actor)
        is_unborn = self.of.get(name) == "unborn"
        if self.is_of_a_life:
            self.of.pop(name, None)
        if is_unborn:
            raise RuntimeError(f"{name} cannot start")

    async def strike(self, actor: hf.Actor) -> str:
        """Let happen what is wrong with a turn. Returns "mute", "deaf" or "owe" if that is the rest of it."""
        name = name_of(actor)
        self.turns[name] += 1
        kind, turn = self.of.get(name, ""), self.turns[name]
        match kind:
            case "freeze":
                await asyncio.Event().wait()
            case "slow":
                await asyncio.sleep(2.5 * PATIENCE)
            case "stumble" if turn % 3 == 0:
                await asyncio.sleep(2.5 * PATIENCE)
            case "pause" if turn % 10 == 0:
                await asyncio.sleep(5.0)
            case "lag":
                await asyncio.sleep(0.5)
            case "crash" | "unborn":
                raise RuntimeError(f"{name} is broken")
            case "falter" if turn % 3 == 0:
                raise RuntimeError(f"{name} is broken now and then")
            case "end":
                actor.ctx.stop()
                return "deaf"
            case "stash":
                actor.ctx.stash()
                return "deaf"
            case "stutter" if turn % 3:
                return "mute"
            case "mute" | "deaf" | "owe":
                return kind
            case _:
                pass
        return ""


def name_of(actor: hf.Actor) -> str:
    """Return the last part of an actor's address."""
    return actor.ctx.path.rpartition("/")[2]


class Item(hf.Message):
    number: int


class Wanted(hf.Message[int]):
    number: int


class Stage(hf.Actor):
    """Takes what comes on a topic or is told, asks others about it, and publishes what it has made of it."""

    one: hf.Binding[Any]
    other: hf.Binding[Any]

    def __init__(self, faults: Faults, out: str = "", *, hears: str = "", asks: tuple[str, ...] = (), each: int = 1):
        self._faults, self._out, self._hears, self._asks, self._each = faults, out, hears, asks, each
        self._count = 0

    def on_start(self, restored: bool) -> None:
        self._faults.begin(self)
        if self._hears:
            self.ctx.subscribe(self._hears)

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        rest = await self._faults.strike(self)
        if rest == "deaf":
            return
        for address in self._asks:
            await self.ctx.find(address, Service).ask(Wanted(message.number), timeout=PATIENCE)
        self._count += 1
        if self._out and not rest and self._count % self._each == 0:
            await self.ctx.publish(self._out, message)


class Patient(Stage):
    """Goes on when it gets no answer: whoever reads its errors learns nothing of them."""

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        try:
            await super().take(message)
        except hf.AskTimeout:
            return


class Service(hf.Actor):
    """Answers, after it has asked others now and then."""

    def __init__(self, faults: Faults, *, asks: str = "", every: int = 1):
        self._faults, self._asks, self._every = faults, asks, every

    def on_start(self, restored: bool) -> None:
        self._faults.begin(self)

    @hf.on(Wanted)
    async def answer(self, message: Wanted) -> "int | hf.ReplyHandle[int]":
        if await self._faults.strike(self) == "owe":
            return self.ctx.reply_handle()
        if self._asks and message.number % self._every == 0:
            await self.ctx.find(self._asks, Service).ask(message, timeout=PATIENCE)
        return message.number


class Beat(hf.Message): ...


class Device(hf.Actor):
    """Publishes by its own clock."""

    def __init__(self, faults: Faults, out: str, every: float):
        self._faults, self._out, self._every = faults, out, every

    def on_start(self, restored: bool) -> None:
        self._faults.begin(self)
        self.ctx.every(self._every, Beat())

    @hf.on(Beat)
    async def beat(self, message: Beat) -> None:
        if not await self._faults.strike(self):
            await self.ctx.publish(self._out, Item(0))


class Sink(hf.Actor):
    """Takes what comes on a topic: nobody ever asks it, and nobody hears of it."""

    def __init__(self, faults: Faults, topic: str):
        self._faults, self._topic = faults, topic

    def on_start(self, restored: bool) -> None:
        self._faults.begin(self)
        self.ctx.subscribe(self._topic)

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        if not await self._faults.strike(self):
            self._faults.came_out(name_of(self))


def child(name: str, kind: Callable[..., Any], *args: Any, **kwargs: Any) -> hf.ChildSpec:
    """A child that is restarted after a moment."""
    return hf.child(name, hf.start(kind, *args, **kwargs), backoff=hf.Backoff(initial=0.2, maximum=0.2, jitter=0.0))


@dataclasses.dataclass(frozen=True)
class Foreign:
    """A system, whom traffic is told to, and what can be wrong with whom."""

    name: str
    children: Callable[[Faults], list[hf.ChildSpec]]
    entry: str
    faults: tuple[tuple[str, str], ...]


def _pipeline(faults: Faults) -> list[hf.ChildSpec]:
    return [
        child("upstream", Service, faults),
        child("cache", Service, faults, asks="/app/all/upstream", every=5),
        child("reader", Stage, faults, "/raw"),
        child("parser", Stage, faults, "/rows", hears="/raw", asks=("/app/all/cache",)),
        child("writer", Patient, faults, "/written", hears="/rows", asks=("/app/all/cache",)),
        child("sink", Sink, faults, "/written"),
    ]


def _gateway(faults: Faults) -> list[hf.ChildSpec]:
    return [
        child("registry", Service, faults),
        child("thermometer", Device, faults, "/temperature", 0.25),
        child("meter", Device, faults, "/power", 0.5),
        child("uplink", Patient, faults, "/commands", asks=("/app/all/registry",)),
        child("rules", Patient, faults, "/alarms", hears="/temperature", asks=("/app/all/registry",)),
        child("board", Sink, faults, "/alarms"),
        child("bill", Sink, faults, "/power"),
        child("motor", Sink, faults, "/commands"),
    ]


def _matching(faults: Faults) -> list[hf.ChildSpec]:
    return [
        child("ledger", Service, faults),
        child("risk", Service, faults),
        child("gate", Patient, faults, "/orders", asks=("/app/all/risk",)),
        child("book", Stage, faults, "/trades", hears="/orders", each=2),
        child("clearing", Stage, faults, "/cleared", hears="/trades", asks=("/app/all/ledger",)),
        child("report", Sink, faults, "/cleared"),
    ]


ANY = "freeze crash falter pause end unborn stash"
"""What can be wrong with everybody."""
SERVICE = f"{ANY} slow stumble owe"
SOURCE = f"{ANY} mute deaf"
STAGE = f"{SOURCE} stumble"
LAST = f"{ANY} lag"


def _each(names: dict[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple((name, kind) for name, kinds in names.items() for kind in kinds.split())


SYSTEMS = (
    Foreign(
        "pipeline",
        _pipeline,
        "reader",
        _each(
            {
                "upstream": SERVICE,
                "cache": SERVICE,
                "reader": STAGE,
                "parser": f"{STAGE} stutter",
                "writer": f"{STAGE} stutter lag",
                "sink": LAST,
            }
        ),
    ),
    Foreign(
        "gateway",
        _gateway,
        "uplink",
        _each(
            {
                "registry": SERVICE,
                "thermometer": SOURCE,
                "meter": SOURCE,
                "uplink": STAGE,
                "rules": f"{STAGE} lag",
                "motor": LAST,
            }
        ),
    ),
    Foreign(
        "matching",
        _matching,
        "gate",
        _each(
            {
                "ledger": SERVICE,
                "risk": SERVICE,
                "gate": STAGE,
                "book": f"{STAGE} stutter",
                "clearing": f"{STAGE} lag",
                "report": LAST,
            }
        ),
    ),
)
