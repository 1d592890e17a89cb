"""SIGKILL at seeded moments: after which scans, and how long after."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Callable
from dataclasses import dataclass

from .report import MapperKill

LONGEST_DELAY = 0.05  # seconds: so that a kill falls anywhere in a turn, or between turns
RETRY = 0.005  # seconds: the process of the last kill is not replaced yet


@dataclass(frozen=True)
class Moment:
    """Kill `delay` seconds after it is known that scan `scan` was handled."""

    scan: int
    delay: float


def schedule(kills: int, scans: int, seed: int) -> list[Moment]:
    """Draw the moments of a run, in order, between the first and the last fiftieth of the log.

    >>> schedule(3, 1000, seed=7) == schedule(3, 1000, seed=7)
    True
    """
    draw = random.Random(seed)
    low, high = min(1 + scans // 50, scans), scans - scans // 50
    return sorted(
        (Moment(draw.randint(low, high), draw.uniform(0.0, LONGEST_DELAY)) for _ in range(kills)),
        key=lambda moment: moment.scan,
    )


class Killer:
    """Kills a process at each moment of a schedule, each process once.

    Args:
        moments: the schedule, in order.
        find_pid: the process to kill now, None while there is none.
        on_kill: told of each kill.
    """

    def __init__(
        self, moments: list[Moment], find_pid: Callable[[], int | None], on_kill: Callable[[MapperKill], None]
    ) -> None:
        self.kills: list[MapperKill] = []
        self._moments, self._find_pid, self._on_kill = list(moments), find_pid, on_kill
        self._open = len(moments)
        self._done = asyncio.Event()
        if not moments:
            self._done.set()

    def saw(self, scan: int) -> None:
        """Learn how far the log is handled; kills that fall due are set off."""
        loop = asyncio.get_running_loop()
        while self._moments and self._moments[0].scan <= scan:
            moment = self._moments.pop(0)
            loop.call_later(moment.delay, self._strike, moment)

    async def finish(self) -> None:
        """Wait until the whole schedule is done."""
        await self._done.wait()

    def _strike(self, moment: Moment) -> None:
        pid = self._find_pid()
        killed_before = bool(self.kills) and self.kills[-1].pid == pid
        if pid is None or killed_before or not _kill(pid):
            asyncio.get_running_loop().call_later(RETRY, self._strike, moment)
            return
        kill = MapperKill(pid, moment.scan)
        self.kills.append(kill)
        self._on_kill(kill)
        self._open -= 1
        if not self._open:
            self._done.set()


def _kill(pid: int) -> bool:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True
