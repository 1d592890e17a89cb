"""Three systems that know nothing of diagnosis: a data pipeline, a gateway of devices, and a matching service."""

import asyncio
import dataclasses
import random
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
    away     so does an effect of it, as it says  age      each turn takes 0.3 s more than the last
    slow     a turn takes too long for askers     stumble  one turn in three does
    lag      a turn takes half a second           storm    it gives itself more to do than it can
    crash    each turn raises                     falter   one turn in three does
    end      it ends itself in each turn          unended  it ends itself, and that end hangs
    unborn   it raises, and so does each start    unbegun  it raises, and the start that follows hangs
    mute     it publishes nothing                 stutter  it publishes one in three
    deaf     it does nothing with what it gets    stash    it puts everything aside
    unheard  it hears its topic no more           untimed  it has lost its clock
    volley   it hands back what it gets, and gets it again, and so on
    astray   it asks somebody who has ended       circle   it asks back whoever asks it
    owe      it never answers                     refuse   it answers with an error
    """

    of: dict[str, str] = dataclasses.field(default_factory=dict)
    turns: Counter[str] = dataclasses.field(default_factory=Counter)
    aged: Counter[tuple[str, int]] = dataclasses.field(default_factory=Counter)
    """Turns of those who age, by name and life."""
    is_of_a_life: bool = False
    """Whether nothing is wrong any more with a later life."""
    refusals: float = 0.0
    """The part of what they are asked that services refuse, which is no fault."""
    rng: random.Random = dataclasses.field(default_factory=lambda: random.Random(1))
    is_spreading: bool = False
    """Whether also those fail whose asks do, who bear it else."""
    came_out: Callable[[str], None] = lambda name: None
    """Called with the name of each who takes what the system makes, whenever it has taken something."""

    def declines(self) -> bool:
        """Whether a service refuses what it is asked, as it may."""
        return self.refusals > 0 and self.rng.random() < self.refusals

    async def begin(self, actor: hf.Actor) -> None:
        """Let happen what is wrong with the start of an actor."""
        name = name_of(actor)
        kind = self.of.get(name)
        if self.is_of_a_life:
            self.of.pop(name, None)
        if kind == "unborn":
            raise RuntimeError(f"{name} cannot start")
        if kind == "unbegun":
            await asyncio.Event().wait()

    async def finish(self, actor: hf.Actor) -> None:
        """Let happen what is wrong with the end of an actor."""
        if self.of.get(name_of(actor)) == "unended":
            await asyncio.Event().wait()

    async def strike(self, actor: hf.Actor) -> str:
        """Let happen what is wrong with a turn. Returns the kind of the fault if that is the rest of it."""
        name = name_of(actor)
        self.turns[name] += 1
        kind, turn = self.of.get(name, ""), self.turns[name]
        match kind:
            case "freeze":
                await asyncio.Event().wait()
            case "away":
                await actor.ctx.effect(asyncio.Event().wait)
            case "slow":
                await asyncio.sleep(2.5 * PATIENCE)
            case "stumble" if turn % 3 == 0:
                await asyncio.sleep(2.5 * PATIENCE)
            case "pause" if turn % 10 == 0:
                await asyncio.sleep(5.0)
            case "lag":
                await asyncio.sleep(0.5)
            case "age":
                self.aged[name, id(actor)] += 1
                await asyncio.sleep(0.3 * self.aged[name, id(actor)])
            case "storm":
                actor.ctx.ref.tell(Retry())
            case "crash" | "unborn" | "unbegun":
                raise RuntimeError(f"{name} is broken")
            case "falter" if turn % 3 == 0:
                raise RuntimeError(f"{name} is broken now and then")
            case "end" | "unended":
                actor.ctx.stop()
                return "deaf"
            case "stash":
                actor.ctx.stash()
                return "deaf"
            case "stutter" if turn % 3:
                return "mute"
            case "mute" | "deaf" | "owe" | "unheard" | "untimed" | "volley" | "astray" | "circle" | "refuse":
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


class Beat(hf.Message): ...


class Retry(hf.Message): ...


class Returned(hf.Message):
    item: Item


class Unwilling(hf.Refusal): ...


class Part(hf.Actor):
    """A part of a system, with which something may be wrong."""

    def __init__(self, faults: Faults) -> None:
        self._faults = faults

    async def on_start(self, restored: bool) -> None:
        await self._faults.begin(self)

    async def on_stop(self, reason: Any) -> None:
        await self._faults.finish(self)

    @hf.on(Retry)
    async def try_again(self, message: Retry) -> None:
        await asyncio.sleep(0.02)
        for _ in range(2):
            self.ctx.ref.tell(message)

    @hf.on(Returned)
    async def give_again(self, message: Returned) -> None:
        assert self.ctx.sender is not None
        await asyncio.sleep(0.01)
        self.ctx.sender.tell(message.item)


class Stage(Part):
    """Takes what comes on a topic or is told, asks others about it, and publishes what it has made of it."""

    one: hf.Binding[Any]
    other: hf.Binding[Any]

    def __init__(self, faults: Faults, out: str = "", *, hears: str = "", asks: tuple[str, ...] = (), each: int = 1):
        super().__init__(faults)
        self._out, self._hears, self._asks, self._each = out, hears, asks, each
        self._count = 0

    async def on_start(self, restored: bool) -> None:
        await super().on_start(restored)
        if self._hears:
            self.ctx.subscribe(self._hears)

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        rest = await self._faults.strike(self)
        match rest:
            case "deaf":
                return
            case "volley":
                assert self.ctx.sender is not None
                self.ctx.sender.tell(Returned(message))
                return
            case "unheard":
                self.ctx.unsubscribe(self._hears)
            case _:
                pass
        for address in self._asks:
            asked = self._gone() if rest == "astray" else self.ctx.find(address, Service)
            await asked.ask(Wanted(message.number), timeout=PATIENCE)
        self._count += 1
        if self._out and rest != "mute" and self._count % self._each == 0:
            await self.ctx.publish(self._out, message)

    @hf.on(Wanted)
    async def answer(self, message: Wanted) -> int:
        return message.number

    def _gone(self) -> "hf.ActorRef[Service]":
        """Somebody who has ended."""
        gone = self.ctx.spawn(hf.start(Service, self._faults))
        gone.kill()
        return gone


class Patient(Stage):
    """Goes on when it gets no answer: whoever reads its errors learns nothing of them."""

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        try:
            await super().take(message)
        except hf.AskTimeout:
            if self._faults.is_spreading:
                raise


class Service(Part):
    """Answers, after it has asked others now and then."""

    def __init__(self, faults: Faults, *, asks: str = "", every: int = 1):
        super().__init__(faults)
        self._asks, self._every = asks, every

    @hf.on(Wanted)
    async def answer(self, message: Wanted) -> "int | hf.ReplyHandle[int]":
        match await self._faults.strike(self) or self._faults.declines():
            case "owe":
                return self.ctx.reply_handle()
            case "refuse" | True:
                raise Unwilling
            case "circle":
                assert self.ctx.sender is not None
                await self.ctx.sender.ask(message, timeout=PATIENCE)
            case _:
                pass
        if self._asks and message.number % self._every == 0:
            await self.ctx.find(self._asks, Service).ask(message, timeout=PATIENCE)
        return message.number


class Device(Part):
    """Publishes by its own clock."""

    def __init__(self, faults: Faults, out: str, every: float):
        super().__init__(faults)
        self._out, self._every = out, every

    async def on_start(self, restored: bool) -> None:
        await super().on_start(restored)
        self._clock = self.ctx.every(self._every, Beat())

    @hf.on(Beat)
    async def beat(self, message: Beat) -> None:
        match await self._faults.strike(self):
            case "untimed":
                self._clock.cancel()
            case "":
                await self.ctx.publish(self._out, Item(0))
            case _:
                pass


class Sink(Part):
    """Takes what comes on a topic: nobody ever asks it, and nobody hears of it."""

    def __init__(self, faults: Faults, topic: str):
        super().__init__(faults)
        self._topic = topic

    async def on_start(self, restored: bool) -> None:
        await super().on_start(restored)
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


ANY = "freeze crash falter pause end unended unborn unbegun stash storm"
"""What can be wrong with everybody."""
SERVICE = f"{ANY} slow stumble age away owe refuse circle"
SOURCE = f"{ANY} mute deaf"
DEVICE = f"{SOURCE} away untimed"
STAGE = f"{SOURCE} stumble age"
HEARER = f"{STAGE} away unheard volley"
LAST = f"{ANY} lag age"


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
                "parser": f"{HEARER} astray stutter",
                "writer": f"{HEARER} astray stutter lag",
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
                "thermometer": DEVICE,
                "meter": DEVICE,
                "uplink": f"{STAGE} astray",
                "rules": f"{HEARER} astray lag",
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
                "gate": f"{STAGE} astray",
                "book": f"{HEARER} stutter",
                "clearing": f"{HEARER} astray lag",
                "report": LAST,
            }
        ),
    ),
)
