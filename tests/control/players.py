"""Actors that control is tried on, and the functions that change their state in another process."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import holdfast as hf


async def until_there(path: Path) -> None:
    """What another process does is seen by the files it makes."""
    async with asyncio.timeout(30.0):
        while not path.exists():
            await asyncio.sleep(0.005)


class Add(hf.Message[int]):
    n: int = 1


class Total(hf.Message[int]): ...


class Crash(hf.Message): ...


class No(hf.Refusal):
    why: str = ""


class Refuse(hf.Message): ...


class Wait(hf.Message[str]):
    """Wait until the file is there."""

    path: str


class Pass(hf.Message):
    to: hf.ActorRef[Any]
    n: int


class Account(hf.Actor):
    """Counts, and notes what it is told on the way."""

    def __init__(self, total: int = 0) -> None:
        self.total = total
        self.seen: list[int] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        self.seen.append(message.n)
        return self.total

    @hf.on(Total, readonly=True)
    def read(self, message: Total) -> int:
        return self.total

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise ValueError("told to")

    @hf.on(Refuse)
    def refuse(self, message: Refuse) -> None:
        raise No("never")

    @hf.on(Pass)
    def hand_on(self, message: Pass) -> None:
        message.to.tell(Add(message.n))

    @hf.on(Wait)
    async def wait(self, message: Wait) -> str:
        Path(f"{message.path}.begun").touch()
        while not Path(message.path).exists():
            await asyncio.sleep(0.005)
        return "waited"


class Stops(Account):
    """Tells of its end by a file: its process may be gone by then."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path

    def on_stop(self, reason: hf.ExitReason) -> None:
        Path(self._path).write_text(f"{reason}")


class Euros(hf.Message[int]): ...


@hf.renamed(f"{__name__}:Account")
class Cents(Account):
    """The next release of `Account`: the total in cents, and one more message."""

    schema_version = 2

    @classmethod
    def migrate(cls, state: dict[str, Any], from_version: int) -> dict[str, Any]:
        assert from_version == 1
        return {"total": state["total"] * 100, "seen": state["seen"], "release": 2}

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n * 100
        return self.total

    @hf.on(Euros)
    def euros(self, message: Euros) -> int:
        return self.total // 100


class Puts(hf.Message[int]): ...


@hf.renamed(f"{__name__}:Account")
class Tally(Account):
    """The next release of `Account`: it has two variables more, one of which is no part of the state."""

    def __init__(self, total: int = 0) -> None:
        super().__init__(total)
        self.puts = 100
        self._add = self.more

    def more(self) -> None:
        self.puts += 1

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self._add()
        self.total += message.n
        return self.total

    @hf.on(Puts)
    def count(self, message: Puts) -> int:
        return self.puts


@hf.renamed(f"{__name__}:Account")
class Summed(hf.Actor):
    """One variable of `Account` has another name, and nobody has said so."""

    def __init__(self, total: int = 0) -> None:
        self.sum = total
        self.seen: list[int] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.sum += message.n
        return self.sum


@hf.renamed(f"{__name__}:Account", sum="total")
class SaidSummed(Summed):
    """The same, and somebody has said so."""


@hf.renamed(f"{__name__}:Account")
class Sum(hf.Actor):
    """Begins with one variable alone."""

    def __init__(self, total: int = 0) -> None:
        self.sum = total

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.sum += message.n
        return self.sum


@hf.renamed(f"{__name__}:Account")
class Timed(Account):
    """Has a variable more, and its `__init__` does more than set it."""

    def __init__(self, total: int = 0) -> None:
        super().__init__(total)
        self.timer = "set"
        self.ctx.every(3600.0, Add())


class Deaf(Account):
    """A newer class that cannot read an older state."""

    schema_version = 2


class News(hf.Message):
    what: str


class Heard(hf.Message[list[str]]): ...


class Reader(hf.Actor):
    """Has heard what was published on two topics."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    @hf.subscribe("/old")
    @hf.subscribe("/both")
    @hf.on(News)
    def news(self, message: News) -> None:
        self.heard.append(message.what)

    @hf.on(Crash)
    def crash(self, message: Crash) -> None:
        raise RuntimeError("crashed")

    @hf.on(Heard)
    def tell(self, message: Heard) -> list[str]:
        return self.heard


class NewReader(Reader):
    """One of the topics is another one."""

    @hf.subscribe("/new")
    @hf.subscribe("/both")
    @hf.on(News)
    def news(self, message: News) -> None:
        self.heard.append(message.what)


class Whole(hf.Actor):
    """Its state is one value, through hooks."""

    def __init__(self) -> None:
        self._values = [1, 2]

    def get_state(self) -> list[int]:
        return self._values

    def set_state(self, state: list[int]) -> None:
        self._values = sorted(state)


class Holder(Account):
    """Holds something that cannot leave its process."""

    def __init__(self) -> None:
        super().__init__()
        self.file = Path(os.devnull).open()  # noqa: SIM115  # closed with the actor

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.file.close()


class Opened(Account):
    def on_start(self, restored: bool) -> None:
        self.total = 5


class Strict(Account):
    """Refuses a state that is not good."""

    def __init__(self) -> None:
        super().__init__()
        self.level = 1

    def __setattr__(self, name: str, value: object) -> None:
        if name == "level" and value == 0:
            raise ValueError("in debt")
        super().__setattr__(name, value)


class StrictWhole(Whole):
    def set_state(self, state: list[int]) -> None:
        self._values.clear()
        if len(state) > 2:
            raise ValueError("too many")
        self._values.extend(state)


class Stasher(hf.Actor):
    """Stashes what is added until it is told to add."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self._met: list[int] = []

    @hf.on(Add)
    def add(self, message: Add) -> int:
        if not self._met:
            self._met.append(message.n)
            self.ctx.stash()
        else:
            self.seen.append(message.n)
        return 0

    @hf.on(Total)
    def total(self, message: Total) -> int:
        return len(self.seen)


def in_debt(state: dict[str, Any]) -> dict[str, Any]:
    return {"total": 5, "seen": [5], "level": 0}


def plus(n: int, state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "total": state["total"] + n}


def spoil(state: dict[str, Any]) -> dict[str, Any]:
    state["total"] = -1
    state["seen"].append("spoilt")
    raise KeyError("no such account")


def large(state: dict[str, Any]) -> dict[str, Any]:
    return {"total": 1000, "seen": [b"x" * 3_000_000]}


def no_state(state: dict[str, Any]) -> list[int]:
    return [1, 2]


def reverse(state: list[int]) -> list[int]:
    return [*reversed(state), 7]


def as_sum(state: dict[str, Any]) -> dict[str, Any]:
    return {"sum": state["total"], "seen": state["seen"]}


def with_timer(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "timer": "said"}


def keep(state: Any) -> Any:
    return state


def cannot(state: Any) -> Any:
    raise RuntimeError("no way from there")
