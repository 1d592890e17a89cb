"""A system's methods for its last lines: what processes of actors print, and what holdfast logs."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from ...actors.errors import SpecError
from ...actors.seconds import check_seconds
from ..history.pages import MOST_ON_PAGE
from ..history.paths import pattern_of
from .line_memory import LineMemory
from .line_page import LogPage, LogQuestion, answer_lines, log_question

if TYPE_CHECKING:
    from ...actors.kernel.ref import Target
    from ..history.recorder import HistoryRecorder

GATHERED = 0.05
"""Seconds in which lines are gathered for whoever follows: one who prints line by line is not asked for each."""


class LineCalls:
    """What a system knows of the last lines."""

    _history: HistoryRecorder | None

    def logs(
        self,
        target: Target = "**",
        *,
        level: str = "debug",
        since: float = 0.0,
        after: int | None = None,
        limit: int = MOST_ON_PAGE,
    ) -> LogPage:
        """Return the last lines, oldest first: the newest `limit` of those that are meant, or the first behind `after`.

        They are what the processes of actors have printed, and what holdfast has logged about actors; the newest ones
        of this program, in memory.

        Args:
            target: an actor, an address, or a pattern, as `history` takes it.
            level: of the least grave lines that are meant: debug, info, warning, error or critical.
            since: Unix time.
            after: the number of a line, from `page.next`: to go on where a page ended.
            limit: lines at most, from 1 to 1000.

        Raises:
            SpecError: it cannot be asked so, or the system was made with `history=False`.
        """
        asked = log_question(pattern_of(target), level=level, since=since, after=after, limit=limit)
        return answer_lines(self._line_memory, asked)

    async def follow_logs(
        self,
        target: Target = "**",
        *,
        after: int,
        level: str = "debug",
        limit: int = MOST_ON_PAGE,
        timeout: float = 30.0,
    ) -> LogPage:
        """Return the lines behind `after` as soon as there are some; no lines if none came within `timeout` seconds.

        `page.dropped` says how many gave way to newer ones before they were asked for.

        Raises:
            SpecError: as `logs`.
        """
        check_seconds("follow_logs", "timeout", timeout)
        asked = log_question(pattern_of(target), level=level, after=after, limit=limit)
        return await self._follow_lines(asked, timeout)

    async def _follow_lines(self, asked: LogQuestion, timeout: float) -> LogPage:
        memory = self._line_memory
        try:
            async with asyncio.timeout(timeout):
                while not ((page := answer_lines(memory, asked)).lines or page.dropped):
                    await memory.followers.changed()
                if len(page.lines) < asked.limit:  # It has caught up.
                    await asyncio.sleep(GATHERED)
        except TimeoutError:
            pass  # What there is now is the answer.
        return answer_lines(memory, asked)

    @property
    def _line_memory(self) -> LineMemory:
        if self._history is None:
            raise SpecError("logs", "the system keeps none: it was made with history=False, or is not running")
        return self._history.lines
