"""An actor whose state is large lists and dicts that share what is in them, for tests of snapshots by chunks."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import holdfast as hf
from holdfast.actors.values import encode_value, state_digest

MANY = 9_000
"""Orders: enough for an image."""
FORKED = 17 << 20
"""Bytes beside them with which a copy of the process writes it."""


class Scan(hf.Message[None]):
    """An entry that cannot change."""

    at: float
    what: str


class Step(NamedTuple):
    """The same, and a tuple."""

    n: int
    what: tuple[str, int]


@dataclass
class Order:
    """An entry that can."""

    number: int
    state: str = "new"
    lines: list[Any] = field(default_factory=list)


@dataclass(slots=True)
class Stock:
    """An entry without a `__dict__`."""

    name: str
    count: int


class Book:
    """What is changed at random, in an actor and beside it: the same seeds lead to the same state."""

    def __init__(self, count: int) -> None:
        self.log: list[Any] = []
        self.orders: dict[Any, Any] = {}
        self.open: list[Any] = []
        self.other: Any = None
        self.small: Any = {"n": 0}
        self.turns = 0
        for n in range(count):
            self.log.append(self.entry(n))
            self.orders[f"order-{n}"] = Order(n, lines=[n])
            if n % 7 == 0:
                self.open.append(self.orders[f"order-{n}"])

    def entry(self, n: int) -> Any:
        match n % 6:
            case 0:
                return Scan(n / 8, f"scan {n}")
            case 1:
                return Step(n, (f"step {n}", n))
            case 2:
                return Order(n, "in the log", [n, [n]])
            case 3:
                return Stock(f"part {n}", n)
            case 4:
                return [n, {"n": n}]
            case _:
                return f"text {n}"

    def change(self, seed: int, deed: str = "") -> None:
        """Do one thing, or several; or once what is said."""
        self.turns += 1
        dice = random.Random(seed)
        if deed:
            getattr(self, f"do_{deed}")(dice)
            return
        for _ in range(dice.choice((1, 1, 3, 20))):
            getattr(self, f"do_{dice.choice(DEEDS)}")(dice)

    def do_append(self, dice: random.Random) -> None:
        self.log += [self.entry(dice.randrange(10**6)) for _ in range(dice.choice((1, 1, 10, 300)))]

    def do_insert(self, dice: random.Random) -> None:
        self.log.insert(dice.randint(0, len(self.log)), self.entry(dice.randrange(10**6)))

    def do_delete(self, dice: random.Random) -> None:
        at = dice.randint(0, len(self.log))
        del self.log[at : at + dice.choice((1, 1, 50))]

    def do_roll(self, dice: random.Random) -> None:
        """A log that keeps the newest."""
        del self.log[:1]
        self.log.append(self.entry(dice.randrange(10**6)))

    def do_replace(self, dice: random.Random) -> None:
        if self.log:
            self.log[dice.randrange(len(self.log))] = self.entry(dice.randrange(10**6))

    def do_reorder(self, dice: random.Random) -> None:
        at = dice.randint(0, len(self.log))
        self.log[at : at + 30] = self.log[at : at + 30][::-1]

    def do_rebind(self, dice: random.Random) -> None:
        self.log = [*self.log]
        self.orders = dict(self.orders)

    def do_order(self, dice: random.Random) -> None:
        key = dice.choice((f"order-{dice.randrange(10**6)}", dice.randrange(10**6), (dice.random(), "x"), 2**70))
        self.orders[key] = dice.choice((Order(7), 2**65, None, b"x", (1, [2])))

    def do_mutate(self, dice: random.Random) -> None:
        """In place, wherever else it stands."""
        one = self.some(dice)
        match one:
            case Order():
                one.state += "!"
                one.lines.append(dice.choice((dice.random(), [], one.number)))
            case Stock():
                one.count += 1
            case list():
                one.append(dice.random())
            case _:
                pass

    def do_attribute(self, dice: random.Random) -> None:
        one = self.some(dice)
        if isinstance(one, Order):
            one.__dict__["extra"] = dice.random()
            if dice.random() < 0.5:
                one.__dict__.pop("state", None)
                one.__dict__["state"] = "behind"

    def do_forget(self, dice: random.Random) -> None:
        self.orders.pop(dice.choice([*self.orders]) if self.orders else None, None)

    def do_move(self, dice: random.Random) -> None:
        """To the end of the dict."""
        if self.orders:
            key = dice.choice([*self.orders])
            self.orders[key] = self.orders.pop(key)

    def do_share(self, dice: random.Random) -> None:
        """One more place for something."""
        one = self.some(dice)
        match dice.randrange(5):
            case 0:
                self.open.insert(dice.randint(0, len(self.open)), one)
            case 1:
                self.small["one"] = one
            case 2:
                self.log.insert(dice.randint(0, len(self.log)), one)
            case 3:
                other = self.some(dice)
                if isinstance(other, Order) and one is not other and not isinstance(one, (Order, list)):
                    other.lines.append(one)
            case _:
                self.orders[f"again-{dice.randrange(100)}"] = one

    def do_unshare(self, dice: random.Random) -> None:
        if self.open:
            self.open.pop(dice.randrange(len(self.open)))
        self.small.pop("one", None)

    def do_nest(self, dice: random.Random) -> None:
        """One list in two others."""
        inner = [dice.random(), Stock("inner", 1)]
        for _ in range(2):
            one = self.some(dice)
            if isinstance(one, Order):
                one.lines.append(inner)

    def do_small(self, dice: random.Random) -> None:
        self.small["n"] += 1

    def do_other(self, dice: random.Random) -> None:
        """A whole list or dict at a second place."""
        if dice.random() < 0.05:
            self.other = dice.choice((None, None, self.log, {"x": self.orders}, [*self.open]))

    def some(self, dice: random.Random) -> Any:
        where = dice.choice((self.log, self.open, [*self.orders.values()]))
        return dice.choice(where) if where else None


DEEDS = sorted(name.removeprefix("do_") for name in vars(Book) if name.startswith("do_"))
NAMES = ("log", "orders", "open", "other", "small", "turns")


def state_of(book: Any) -> dict[str, Any]:
    return {name: getattr(book, name) for name in NAMES}


def told(book: Any) -> bytes:
    """All of its state, in short; also what of it is one object."""
    return state_digest(encode_value(state_of(book)))


class Change(hf.Message[int]):
    """Change the state as this seed says."""

    seed: int
    deed: str = ""


class Told(hf.Message[bytes]): ...


class Turns(hf.Message[int]): ...


class Ledger(hf.Actor):
    """A book that is kept; `room` is so many bytes that never change."""

    key_variables = (*(f"book.{name}" for name in NAMES), "room")

    def __init__(self, count: int = MANY, room: int = 0) -> None:
        self.book = Book(count)
        self.room = bytes(room)

    @hf.on(Change)
    def change(self, message: Change) -> int:
        self.book.change(message.seed, message.deed)
        return self.book.turns

    @hf.on(Told, readonly=True)
    def told(self, message: Told) -> bytes:
        return told(self.book)

    @hf.on(Turns, readonly=True)
    def turns(self, message: Turns) -> int:
        return self.book.turns
