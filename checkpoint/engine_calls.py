"""The only caller of store engines: turns whatever an engine raises into errors that callers know."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar, runtime_checkable

from ..actors.errors import HoldfastError
from .journal import Entry, InHand, Journal, SafeAt, Saved, StoreFailed, StoreFile

if TYPE_CHECKING:
    from .snapshot.shared_blocks import Segment

P = ParamSpec("P")
T = TypeVar("T")


def safe_at_of(engine: Journal) -> SafeAt:
    """When what was appended outlives the process; engines that do not say so keep it at once."""
    said: SafeAt = getattr(engine, "safe_at", "append")
    return said


@runtime_checkable
class SyncedEngine(Protocol):
    """An engine that says when what was written is safe, so that no thread has to wait for it."""

    def synced(self) -> asyncio.Future[None]:
        """Done when all that was written so far is as safe as a `sync` makes it."""
        ...


class Called:
    """A `Journal` that calls an engine, which may be a user's own and raise anything.

    An exception of a foreign kind becomes StoreFailed. If `append` or `sync` raised it, nobody knows what was written:
    from then on everything that writes is refused (T13), until the store is opened again.

    Args:
        engine: to be called.
        file: the database of its store, if that is one of ours on the disk.
    """

    def __init__(self, engine: Journal, file: StoreFile | None = None) -> None:
        self._engine = engine
        self.file = file
        self._name = str(getattr(engine, "path", type(engine).__qualname__))
        self._failure: StoreFailed | None = None
        self.keys: dict[str, str] = {}
        """The names under which the engine has addresses, where those are other ones (`addresses.py`)."""
        self.durable = engine.durable
        self.epoch = self._call(lambda: engine.epoch)
        self.in_hand: InHand | None = getattr(engine, "in_hand", None)
        self._waits_for = engine if isinstance(engine, SyncedEngine) else None
        self.safe_at: SafeAt = safe_at_of(engine)

    def _call(self, method: Callable[P, T], *args: P.args, **named: P.kwargs) -> T:
        try:
            return method(*args, **named)
        except HoldfastError:
            raise
        except Exception as error:
            raise self._failed(error) from error

    def _write(self, method: Callable[P, T], *args: P.args, **named: P.kwargs) -> T:
        self._refuse_failed()
        return self._call(method, *args, **named)

    @contextlib.contextmanager
    def _for_good(self) -> Generator[None]:
        """What fails within has failed for good."""
        self._refuse_failed()
        try:
            yield
        except HoldfastError:
            raise
        except Exception as error:
            self._failure = self._failed(error)
            raise self._failure from error

    def _failed(self, error: Exception) -> StoreFailed:
        return StoreFailed(self._name, f"the engine raised {type(error).__name__}: {error}")

    def _refuse_failed(self) -> None:
        if self._failure is not None:
            raise StoreFailed(*self._failure.args)

    def has_failed(self) -> bool:
        """Whether everything is refused from now on."""
        failed: Callable[[], bool] | None = getattr(self._engine, "has_failed", None)
        return self._failure is not None or (failed is not None and self._call(failed))

    def append(self, entries: Sequence[tuple[str, Entry]]) -> list[int]:
        """Append entries as one; a failure is for good."""
        if self._failure is not None:
            raise StoreFailed(*self._failure.args)
        try:
            if self.keys:
                entries = [(self.keys.get(address, address), entry) for address, entry in entries]
            return self._engine.append(entries)  # not within `_for_good`: this is done for every message
        except HoldfastError:
            raise
        except Exception as error:
            self._failure = self._failed(error)
            raise self._failure from error

    def sync(self) -> None:
        """Have everything outlive the machine; a failure is for good."""
        with self._for_good():
            self._engine.sync()

    def synced(self) -> asyncio.Future[None] | None:
        """Done when all is as safe as a `sync` makes it, if the engine can say so; a failure is for good."""
        if self._waits_for is None:
            return None
        with self._for_good():
            return self._waits_for.synced()

    def cut(self, address: str, snapshot: bytes, drop: Sequence[int] | range, *, turn: int, keep: int = 2) -> None:
        """Keep a snapshot, and forget what it contains."""
        self._write(self._engine.cut, self._key(address), snapshot, drop, turn=turn, keep=keep)

    @contextlib.contextmanager
    def together(self) -> Generator[None, None, None]:
        """See `Journal`. An engine that does not have it writes each on its own."""
        joint: Callable[[], AbstractContextManager[None]] | None = getattr(self._engine, "together", None)
        if joint is None:
            yield
            return
        with self._for_good(), joint():
            yield

    def load(self, address: str, *, older: int = False) -> Saved:
        """Read an address back from the engine."""
        return self._call(self._engine.load, self._key(address), older=older)

    def erase(self, address: str) -> None:
        """Have the engine forget an address."""
        self._write(self._engine.erase, self._key(address))

    def keep_blocks(
        self, address: str, number: int, blocks: Sequence[tuple[int, memoryview]], compress: bool | int
    ) -> None:
        """Have the engine keep blocks of a large snapshot."""
        self._write(self._engine.keep_blocks, self._key(address), number, blocks, compress)

    def read_blocks(self, address: str, number: int, places: Collection[tuple[int, int]]) -> Segment:
        """Read blocks of a large snapshot back."""
        return self._call(self._engine.read_blocks, self._key(address), number, places)

    def packs(self, address: str) -> set[int]:
        """Ask the engine which packs it keeps for an address."""
        return self._call(self._engine.packs, self._key(address))

    def forget_blocks(self, address: str, numbers: Collection[int]) -> None:
        """Have the engine remove packs that nothing needs."""
        self._write(self._engine.forget_blocks, self._key(address), numbers)

    def addresses(self) -> list[str]:
        """The addresses of which something is stored."""
        names = {key: address for address, key in self.keys.items()}
        return sorted(names.get(key, key) for key in self._call(self._engine.addresses))

    def _key(self, address: str) -> str:
        return self.keys.get(address, address)

    def note(self, key: str, value: bytes | None) -> None:
        """Have the engine keep a small fact."""
        self._write(self._engine.note, key, value)

    def noted(self, key: str) -> bytes | None:
        """The small fact of that name, if any."""
        return self._call(self._engine.noted, key)

    def notes(self, prefix: str) -> dict[str, bytes]:
        """The small facts whose keys begin so."""
        return self._call(self._engine.notes, prefix)

    def close(self) -> None:
        """Close the engine; nothing is written any more."""
        self._call(self._engine.close)
