"""An actor with a large state of many kinds, changed a little at a time."""

from __future__ import annotations

import hashlib
from collections import deque
from typing import Any

import numpy as np

import holdfast as hf
from holdfast.actors.values import state_digest

ENTRIES, SIZE = 3000, 100


class Touch(hf.Message[int]):
    """Change one entry of a variable."""

    what: str
    at: int


class Resize(hf.Message[int]):
    """Have a variable, small or large, that was not there, or no more; or grow and shrink one."""

    what: str
    entries: int


class Sum(hf.Message[bytes]): ...


class Break(hf.Message[int]):
    """Change much, and fail."""


def made(what: str, entries: int) -> Any:
    """A variable of a kind."""
    match what:
        case "array":
            return np.arange(entries * SIZE // 8, dtype=np.float64)
        case "matrix":
            return np.asfortranarray(np.zeros((entries, SIZE // 8), dtype=np.int64))
        case "bytes":
            return bytes(entries * SIZE)
        case "bytearray":
            return bytearray(entries * SIZE)
        case "dict":
            return {key: hashlib.sha256(str(key).encode()).hexdigest() for key in range(entries)}
        case "nested":
            return {"rows": [[key, str(key) * 20] for key in range(entries)], "last": deque([1, 2], maxlen=2)}
        case _:
            return [bytes(SIZE) for _ in range(entries)]


KINDS = ("array", "matrix", "bytes", "bytearray", "dict", "nested", "list")


class Warehouse(hf.Actor):
    """All of its variables are its state."""

    def __init__(self, *kinds: str) -> None:
        self.count = 0
        for one in kinds:
            setattr(self, one, made(one, ENTRIES))

    @hf.on(Touch)
    def touch(self, message: Touch) -> int:
        self.count += 1
        what, at = message.what, message.at
        value: Any = getattr(self, what)
        match what:
            case "array":
                value[at] = -self.count
            case "matrix":
                value[at, 1] += self.count
            case "bytes":
                self.bytes: Any = value[:at] + self.count.to_bytes(2) + value[at + 2 :]
            case "bytearray":
                value[at] = self.count % 256
            case "dict":
                value[at] = hashlib.sha256(str(self.count).encode()).hexdigest()
            case "nested":
                value["rows"][at][0] = at - 1 if at % 2 else at
                value["last"].append(self.count)
            case _:
                value[at] = self.count.to_bytes(SIZE)
        return self.count

    @hf.on(Resize)
    def resize(self, message: Resize) -> int:
        self.count += 1
        if message.entries:
            setattr(self, message.what, made(message.what, message.entries))
        else:
            delattr(self, message.what)
        return self.count

    @hf.on(Break)
    def fail(self, message: Break) -> int:
        for name in KINDS:
            if hasattr(self, name):
                setattr(self, name, made(name, 10))
        raise RuntimeError("broken")

    @hf.on(Sum, readonly=True)
    def sum(self, message: Sum) -> bytes:
        return state_digest(
            {name: value for name, value in sorted(vars(self).items()) if name[0] != "_" and name != "ctx"}
        )


class Ledger(hf.Actor):
    """It says itself what has changed."""

    def __init__(self) -> None:
        self.values: dict[int, int] = dict.fromkeys(range(20_000), 0)
        self._changed: dict[int, int] = {}

    @hf.on(Touch)
    def touch(self, message: Touch) -> int:
        self.values[message.at] = self._changed[message.at] = self.values.get(message.at, 0) + 1
        return self.values[message.at]

    @hf.on(Sum, readonly=True)
    def sum(self, message: Sum) -> bytes:
        return state_digest(self.values)

    def get_state(self) -> dict[int, int]:
        return self.values

    def set_state(self, state: dict[int, int]) -> None:
        self.values = state

    def get_delta(self) -> dict[int, int]:
        changed, self._changed = self._changed, {}
        return changed

    def apply_delta(self, delta: dict[int, int]) -> None:
        self.values.update(delta)
