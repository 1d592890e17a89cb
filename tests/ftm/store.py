"""A key-value store for histories that are checked for linearizability."""

from __future__ import annotations

from collections.abc import Hashable

import holdfast as hf
from holdfast.testing import Model, Operation


class Write(hf.Message[None]):
    key: str
    value: int


class Look(hf.Message[int | None]):
    key: str


class Cas(hf.Message[bool]):
    key: str
    old: int | None
    new: int


class Store(hf.Actor):
    """Keeps values by key."""

    def __init__(self) -> None:
        self.values: dict[str, int] = {}

    @hf.on(Write)
    def write(self, message: Write) -> None:
        self.values[message.key] = message.value

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> int | None:
        return self.values.get(message.key)

    @hf.on(Cas)
    def cas(self, message: Cas) -> bool:
        if self.values.get(message.key) != message.old:
            return False
        self.values[message.key] = message.new
        return True


def step(value: int | None, message: Write | Look | Cas) -> tuple[int | None, object]:
    """What the value of one key does, sequentially."""
    match message:
        case Write(value=new):
            return new, None
        case Look():
            return value, value
        case Cas(old=old, new=new):
            return (new, True) if value == old else (value, False)


def key(operation: Operation) -> Hashable:
    """Keys have nothing to do with each other."""
    found: Hashable = operation.message.key
    return found


MODEL = Model(None, step, key=key)
