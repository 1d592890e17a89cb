"""Since when servers have not answered, and who is told of that: not of each attempt, and once when they do again."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

SILENT_SECONDS: Final = 30.0
"""How often it is said that the servers do not answer."""


class SilenceOfServers:
    """Takes in what was asked of servers in vain, and that they have answered. Only for a running loop.

    Args:
        silent: told why they do not answer, once that has lasted for a moment, and each SILENT_SECONDS from then on.
        answered: told after how many seconds they answer again, if `silent` was told before.
        moment: seconds that nobody is told of.
    """

    def __init__(
        self, silent: Callable[[str], None], answered: Callable[[float], None], *, moment: float = 0.0
    ) -> None:
        self._silent, self._answered, self._moment = silent, answered, moment
        self._since: float | None = None
        self._next = 0.0
        self._is_told = False

    def unanswered(self, problem: str, since: float | None = None) -> None:
        """They have not answered, now or what was asked at that time, and why."""
        now = asyncio.get_running_loop().time()
        if self._since is None:
            self._since = now if since is None else since
            self._next = self._since + self._moment
        if now >= self._next:
            self._next, self._is_told = now + SILENT_SECONDS, True
            self._silent(problem)

    def answered(self) -> None:
        """The servers have answered something just now."""
        if self._since is None:
            return
        since, self._since = self._since, None
        if self._is_told:
            self._is_told = False
            self._answered(asyncio.get_running_loop().time() - since)
