"""Gathers recoveries for the log: those below one supervisor are told of together."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ...actors.events import Recovered

QUIET = 1.0
"""Seconds without one more recovery after which those of a supervisor are told of."""
MOST_LOOKS = 10
"""Times that this is waited for."""
MOST_RESTARTED = 1_000
"""Addresses of which it is remembered that they were restarted, the newest."""

Tell = Callable[[str, list[Recovered]], None]


class LogRecoveries:
    """The recoveries that were not told of yet, by the address above them that was restarted, else by their parent's.

    Args:
        tell: is called with that address and its recoveries, in the order in which they came.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, tell: Tell) -> None:
        self._loop, self._tell = loop, tell
        self._restarted: dict[str, None] = {}
        self._groups: dict[str, list[Recovered]] = {}
        self._timers: dict[str, asyncio.TimerHandle] = {}

    def restarted(self, address: str) -> None:
        """Note that a child is being restarted: what recovers below it from now on does so with it."""
        self._restarted.pop(address, None)
        self._restarted[address] = None
        if len(self._restarted) > MOST_RESTARTED:
            del self._restarted[next(iter(self._restarted))]

    def add(self, event: Recovered) -> None:
        """Note a recovery, to be told of soon."""
        above = self._above(event.address)
        group = self._groups.setdefault(above, [])
        group.append(event)
        if len(group) == 1:
            self._wait(above, MOST_LOOKS)

    def close(self) -> None:
        """Tell of what is left."""
        for above in list(self._groups):
            self._over(above)

    def _above(self, address: str) -> str:
        """The topmost supervisor above the address that was restarted; its parent if none was."""
        parts = address.split("/")
        above = ("/".join(parts[:count]) for count in range(2, len(parts)))
        return next((one for one in above if one in self._restarted), address.rpartition("/")[0])

    def _wait(self, above: str, looks: int) -> None:
        known = len(self._groups[above])
        self._timers[above] = self._loop.call_later(QUIET, self._look, above, known, looks)

    def _look(self, above: str, known: int, looks: int) -> None:
        if len(self._groups[above]) > known and looks > 1:
            self._wait(above, looks - 1)
        else:
            self._over(above)

    def _over(self, above: str) -> None:
        self._timers.pop(above).cancel()
        self._tell(above, self._groups.pop(above))
