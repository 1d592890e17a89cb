"""Actors that the benchmarks of mechanisms protect; replicas import them from here."""

from __future__ import annotations

import holdfast as hf


class Bump(hf.Message[int]):
    """Count one more."""


class Count(hf.Actor):
    """A small state that changes with each request."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Bump)
    def bump(self, message: Bump) -> int:
        self.count += 1
        return self.count


class Second(Count):
    """Another version of it."""

    @hf.on(Bump)
    def bump(self, message: Bump) -> int:
        self.count = sum((self.count, 1))
        return self.count


class Third(Count):
    """And another one."""

    @hf.on(Bump)
    def bump(self, message: Bump) -> int:
        self.count -= -1
        return self.count


def is_counted(reply: int) -> bool:
    """Assertion and acceptance test."""
    return reply > 0


class Change(hf.Message[int]):
    """Change one entry."""

    key: int


class Whole(hf.Actor):
    """Many entries; nobody is told which have changed."""

    def __init__(self, entries: int, size: int) -> None:
        self.entries = [bytes(size) for _ in range(entries)]
        self.count = 0

    @hf.on(Change)
    def change(self, message: Change) -> int:
        self.count += 1
        at = message.key % len(self.entries)
        old = self.entries[at]
        self.entries[at] = self.count.to_bytes(8, "little") + old[8:]
        return self.count


class Parts(Whole):
    """The same, and it says what has changed."""

    def __init__(self, entries: int, size: int) -> None:
        super().__init__(entries, size)
        self._changed: dict[int, bytes] = {}

    @hf.on(Change)
    def change(self, message: Change) -> int:
        super().change(message)
        at = message.key % len(self.entries)
        self._changed[at] = self.entries[at]
        return self.count

    def get_state(self) -> tuple[list[bytes], int]:
        return self.entries, self.count

    def set_state(self, state: tuple[list[bytes], int]) -> None:
        self.entries, self.count = list(state[0]), state[1]
        self._changed = {}

    def get_delta(self) -> tuple[dict[int, bytes], int]:
        changed, self._changed = self._changed, {}
        return changed, self.count

    def apply_delta(self, delta: tuple[dict[int, bytes], int]) -> None:
        for at, value in delta[0].items():
            self.entries[at] = value
        self.count = delta[1]
