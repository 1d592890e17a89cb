"""What another program has outstanding here, and how much that may be: one that wants more waits, and nobody else.

Messages over the limit wait in front of the actors, in order, and the other program is told to hold its own back
(`LineBatch.note`). Asks, subscriptions and ties over theirs are refused. All is counted for each program by itself.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from ...actors.errors import SpecError
from .line import WINDOW_BYTES

if TYPE_CHECKING:
    import asyncio

    from ...actors.kernel.cell import Cell

SLICE: Final = 256
"""Items of one program that are taken in one round of the loop: then others have their turn."""
MOST_HELD: Final = 3 * WINDOW_BYTES
"""Bytes that wait in front of the actors before the line is ended: a program that hears us holds back long before."""
ITEM_BYTES: Final = 64
"""Bytes that an item counts with besides its own."""
FULL_SECONDS: Final = 0.02
"""How often it is looked whether there is room again."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionLimits:
    """Limit how much one connected program may have outstanding in a system, whoever it is.

    What is over `messages` or `message_bytes` waits at that program, and what is over the other limits is refused.

    Attributes:
        messages: told, sent, published or asked, and not handled yet.
        message_bytes: of these messages together, in bytes; and of outcomes that the program has not taken yet.
        asks: that have no outcome yet; further ones fail with ConnectionFull.
        subscriptions: of its actors to topics here.
        ties: monitors and links of its actors to actors here.
        kept: messages of recorded actors that are kept for one system until it has accepted them; further ones are
            dead letters.
        kept_bytes: of these messages together, in bytes.

    Raises:
        SpecError: one of them is no whole number from 1 on.
    """

    messages: int = 10_000
    message_bytes: int = 16 << 20
    asks: int = 10_000
    subscriptions: int = 1_000
    ties: int = 10_000
    kept: int = 100_000
    kept_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value: object = getattr(self, field.name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise SpecError("ConnectionLimits", f"{field.name} must be a whole number from 1 on, not {value!r}")


DEFAULT_LIMITS: Final = ConnectionLimits()
"""Of a system that says nothing."""


class FarBelongings:
    """How many of something the actors of a program have: at most so many as were added since they were counted."""

    __slots__ = ("_most_there",)

    def __init__(self) -> None:
        self._most_there = 0

    def may_add(self, most: int, count: Callable[[], int]) -> bool:
        """Whether they may have one more; it is counted how many there are only if there may be too many."""
        self._most_there += 1
        if self._most_there > most:
            self._most_there = count() + 1
        return self._most_there <= most


class Inflow:
    """Counts what one program has outstanding here.

    Messages are handled in order, so at most as many of its own wait at an actor as wait there at all: that is asked
    only when what was sent since is over a limit. So nothing has to be counted when a message is handled.

    Args:
        limits: how much that may be.

    Attributes:
        held: items that wait in front of the actors, in order.
        held_bytes: how many bytes they have, with ITEM_BYTES for each.
        left: items that are still taken in this round of the loop.
        is_full: whether more waits at actors than may.
        beginning: of the next round, if anything makes one needed.
        told: over which limits the program has been told to be.
        topics: how many subscriptions its actors have.
        ties: how many monitors and links.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self.held: deque[bytes] = deque()
        self.held_bytes = 0
        self.left = SLICE
        self.is_full = False
        self.beginning: asyncio.Handle | None = None
        self.told: set[str] = set()
        self.topics, self.ties = FarBelongings(), FarBelongings()
        self._sizes: dict[Cell, deque[int]] = {}  # of messages that may still wait at an actor, oldest first
        self._count = self._size = 0
        self._most, self._most_bytes = limits.messages, limits.message_bytes
        self._asks: dict[int, float] = {}

    def hold(self, data: bytes) -> None:
        """Have an item wait behind those that do."""
        self.held.append(data)
        self.held_bytes += len(data) + ITEM_BYTES

    def next(self) -> bytes:
        """The item that has waited longest."""
        data = self.held.popleft()
        self.held_bytes -= len(data) + ITEM_BYTES
        return data

    def sent(self, cell: Cell, size: int) -> None:
        """A message of so many bytes goes to an actor."""
        sizes = self._sizes.get(cell)
        if sizes is None:
            sizes = self._sizes[cell] = deque()
        sizes.append(size)
        self._count += 1
        self._size += size
        if self._count > self._most or self._size > self._most_bytes:
            self.is_full = not self.has_room(1.0)

    def has_room(self, share: float = 0.5) -> bool:
        """Whether at most this share of what may wait at actors does so now."""
        for cell, sizes in list(self._sizes.items()):
            waits = 0 if cell.is_dead else cell.host.load(cell)
            while len(sizes) > waits:
                self._size -= sizes.popleft()
                self._count -= 1
            if not sizes:
                del self._sizes[cell]
        return self._count <= share * self._most and self._size <= share * self._most_bytes

    # -- asks -------------------------------------------------------------------------------------------------------

    def asked(self, number: int, until: float, now: float) -> bool:
        """Whether one more ask may be out; `until` is its deadline, on the clock of `now`."""
        if number not in self._asks and len(self._asks) >= self.limits.asks:
            self._asks = {one: last for one, last in self._asks.items() if last > now}  # Nobody waits for the others.
            if len(self._asks) >= self.limits.asks:
                return False
        self._asks[number] = until
        return True

    def answered(self, number: int) -> None:
        """The program has the outcome of an ask."""
        self._asks.pop(number, None)
