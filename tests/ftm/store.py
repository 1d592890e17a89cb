"""A key-value store for histories that are checked for linearizability."""

from __future__ import annotations

import holdfast as hf


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
