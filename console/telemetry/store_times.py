"""How long a store takes, for as long as somebody wants to know. Nobody pays for it otherwise."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Protocol

from ...checkpoint.engine_calls import Called
from ...checkpoint.journal import Entry, Saved, StoreEngine


class TimesStore(Protocol):
    """Told what the store has done, and within how many seconds; from threads, too."""

    def __call__(self, operation: str, seconds: float, /) -> None:
        """Take in one call that has succeeded."""
        ...


class TimedCalls(Called):
    """The caller of an engine while somebody measures: it is made of a `Called` that is in use, by its class."""

    took: TimesStore

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append entries as one, and tell how long that took."""
        begin = perf_counter()
        positions = super().append(entries)
        self.took("append", perf_counter() - begin)
        return positions

    def sync(self) -> None:
        """Have everything outlive the machine, and tell how long that took."""
        begin = perf_counter()
        super().sync()
        self.took("sync", perf_counter() - begin)

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep a snapshot, and tell how long that took."""
        begin = perf_counter()
        super().cut(address, snapshot, drop, turn=turn, keep=keep)
        self.took("cut", perf_counter() - begin)

    def load(self, address: str, *, older: int = False) -> Saved:
        """Read an address back, and tell how long that took."""
        begin = perf_counter()
        saved = super().load(address, older=older)
        self.took("load", perf_counter() - begin)
        return saved


def time_store(engine: StoreEngine, took: TimesStore) -> None:
    """Measure a store from now on, until it is closed. Of one in memory nothing is told."""
    if type(engine) is Called:
        called: Called = engine
        called.__class__ = TimedCalls
        assert isinstance(called, TimedCalls)
        called.took = took
