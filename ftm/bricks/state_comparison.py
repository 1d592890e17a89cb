"""Replicas that compute alike compare their states behind batches that the leader names in advance.

Each takes the digest when its own turns have come so far; they need not be there at the same time.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ..replica.protected_actor import Server
    from .brick_messages import Done, Request

MOST: Final = 100.0
"""Digests take at most one part in so many of the time, unless they are wanted behind each batch."""


class Looking:
    """What one replica knows of it."""

    def __init__(self) -> None:
        self._number = -1  # the last request of the batch that was named
        self._next = 0.0  # on the loop's clock

    def is_due(self, requests: list[Request], now: float, every: float) -> bool:
        """Whether the states behind these requests are to be compared."""
        if not requests or every == math.inf or (now < self._next and every):
            return False
        self._next = now + every
        self.name(requests)
        return True

    def name(self, requests: list[Request]) -> None:
        """The states behind these are compared."""
        if requests:
            self._number = requests[-1].feed.id

    def take(self, server: Server, done: Done) -> bytes:
        """The digest of the state, if these are the last outcomes of the batch that was named; else nothing."""
        life = server.life
        if (
            not done.is_last
            or life is None
            or life.feed is not None
            or all(end.id != self._number for end in done.ends)
        ):
            return b""
        self._number, begin = -1, time.perf_counter()
        try:
            digest = server.state_digest()
        except Exception:  # What the user's own values and methods raise: `ProtectionLost` tells of that elsewhere.
            return b""
        self._next += (time.perf_counter() - begin) * MOST
        return digest
