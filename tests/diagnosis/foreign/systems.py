"""Three systems that know nothing of diagnosis: a data pipeline, a gateway of devices, and a matching service."""

import asyncio
import dataclasses
from collections.abc import Callable
from typing import Any

import holdfast as hf

PATIENCE = 1.0
"""Seconds that those who ask wait."""


@dataclasses.dataclass
class Faults:
    """What is wrong with whom, by the last part of the address: "freeze", "slow", "lag", "mute" or "crash"."""

    of: dict[str, str] = dataclasses.field(default_factory=dict)

    async def strike(self, name: str) -> bool:
        """Let happen what is wrong with an actor. Returns whether it is to keep silent."""
        match self.of.get(name):
            case "freeze":
                await asyncio.Event().wait()
            case "slow":
                await asyncio.sleep(2.5 * PATIENCE)
            case "lag":
                await asyncio.sleep(0.5)
            case "crash":
                raise RuntimeError(f"{name} is broken")
            case "mute":
                return True
            case _:
                pass
        return False


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
        if self._hears:
            self.ctx.subscribe(self._hears)

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        is_mute = await self._faults.strike(self.ctx.path.rpartition("/")[2])
        for address in self._asks:
            await self.ctx.find(address, Service).ask(Wanted(message.number), timeout=PATIENCE)
        self._count += 1
        if self._out and not is_mute and self._count % self._each == 0:
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

    @hf.on(Wanted)
    async def answer(self, message: Wanted) -> int:
        await self._faults.strike(self.ctx.path.rpartition("/")[2])
        if self._asks and message.number % self._every == 0:
            await self.ctx.find(self._asks, Service).ask(message, timeout=PATIENCE)
        return message.number


class Beat(hf.Message): ...


class Device(hf.Actor):
    """Publishes by its own clock."""

    def __init__(self, faults: Faults, out: str, every: float):
        self._faults, self._out, self._every = faults, out, every

    def on_start(self, restored: bool) -> None:
        self.ctx.every(self._every, Beat())

    @hf.on(Beat)
    async def beat(self, message: Beat) -> None:
        if not await self._faults.strike(self.ctx.path.rpartition("/")[2]):
            await self.ctx.publish(self._out, Item(0))


class Sink(hf.Actor):
    """Takes what comes on a topic: nobody ever asks it, and nobody hears of it."""

    def __init__(self, faults: Faults, topic: str):
        self._faults, self._topic = faults, topic

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe(self._topic)

    @hf.on(Item)
    async def take(self, message: Item) -> None:
        await self._faults.strike(self.ctx.path.rpartition("/")[2])


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


def _each(names: dict[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple((name, kind) for name, kinds in names.items() for kind in kinds.split())


SYSTEMS = (
    Foreign(
        "pipeline",
        _pipeline,
        "reader",
        _each(
            {
                "upstream": "freeze slow crash",
                "cache": "freeze slow crash",
                "reader": "freeze mute crash",
                "parser": "freeze mute crash",
                "writer": "freeze mute crash lag",
                "sink": "freeze crash lag",
            }
        ),
    ),
    Foreign(
        "gateway",
        _gateway,
        "uplink",
        _each(
            {
                "registry": "freeze slow crash",
                "thermometer": "freeze mute crash",
                "meter": "freeze mute crash",
                "uplink": "freeze mute crash",
                "rules": "freeze mute crash lag",
                "motor": "freeze crash lag",
            }
        ),
    ),
    Foreign(
        "matching",
        _matching,
        "gate",
        _each(
            {
                "ledger": "freeze slow crash",
                "risk": "freeze slow crash",
                "gate": "freeze mute crash",
                "book": "freeze mute crash",
                "clearing": "freeze mute crash lag",
                "report": "freeze crash lag",
            }
        ),
    ),
)
