"""How far the writes of a leader have come, who waits for that, and which large values are on their way."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from ..actors.errors import HoldfastError

Tell = Callable[[HoldfastError | None], None]
"""Called when what was waited for stands in the log; with an error, if it never will."""


class WriteProgress:
    """How many writes were submitted, and how many stand in the log. For one thread at a time.

    Attributes:
        submitted: how many there are.
        written: how many of them stand in the log.
    """

    def __init__(self) -> None:
        self.submitted = self.written = 0
        self._waiting: deque[tuple[int, Tell]] = deque()

    def wait(self, tell: Tell) -> bool:
        """Have it called when all that was submitted stands in the log; False: it does so already."""
        if self.written >= self.submitted:
            return False
        self._waiting.append((self.submitted, tell))
        return True

    def take(self, count: int) -> list[Tell]:
        """So many stand in the log now: return whom that is to be told."""
        self.written = count
        ready: list[Tell] = []
        while self._waiting and self._waiting[0][0] <= count:
            ready.append(self._waiting.popleft()[1])
        return ready

    def give_up(self) -> list[Tell]:
        """No more will stand there: return whom that is to be told."""
        waiting = [tell for _, tell in self._waiting]
        self._waiting.clear()
        return waiting


class BlobsUnderWay:
    """The large values of a leader that are not sent yet, and what it knows of the others. For one thread at a time.

    Attributes:
        size: bytes that are not sent yet.
        fetched: values that were read ahead, until somebody wants them.

    Args:
        known: those to which the log refers; what else there is nobody needs.
    """

    def __init__(self, known: Iterable[str]) -> None:
        self.size = 0
        self.fetched: dict[str, bytes] = {}
        self._unsent: dict[str, bytes] = {}
        self._order: deque[tuple[int, str]] = deque()
        self._known: set[str] | None = set(known)

    def add(self, write: int, name: str, data: bytes) -> None:
        """A write refers to a value, which is sent before it."""
        self._unsent[name] = data
        self._order.append((write, name))
        self.size += len(data)
        if self._known is not None:
            self._known.add(name)

    def sent(self, writes: int) -> None:
        """So many writes stand in the log, and what they refer to was sent."""
        while self._order and self._order[0][0] <= writes:
            self.size -= len(self._unsent.pop(self._order.popleft()[1]))

    def get(self, name: str) -> bytes | None:
        """A value that is not sent yet."""
        return self._unsent.get(name)

    def orphans(self, names: set[str]) -> set[str]:
        """Those of these values to which nothing refers; to be asked once, for it is not kept who they are."""
        known, self._known = self._known or set[str](), None
        return names - known
