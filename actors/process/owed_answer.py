"""Helper processes that owe an answer: who is stopped by a signal is told to go on, and who is late is given up."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import signal
from collections.abc import Callable
from typing import Final, Self

LOOK_SECONDS: Final = 0.1
"""Seconds between two looks at a helper that owes an answer."""


def is_stopped(pid: int, parent: int) -> bool:
    """Whether a child of `parent` is stopped by a signal; False if it is gone, or its number means another one now."""
    try:
        with open(f"/proc/{pid}/stat", "rb", buffering=0) as file:
            state, found = file.read(4096).rpartition(b")")[2].split()[:2]
    except (OSError, ValueError):
        return False
    return state == b"T" and int(found) == parent


def go_on(pid: int) -> bool:
    """Have a child of this process go on (SIGCONT) if a signal has stopped it. Returns whether it was stopped."""
    if not is_stopped(pid, os.getpid()):
        return False
    with contextlib.suppress(OSError):  # It has ended, or a security module forbids it: then it is late.
        os.kill(pid, signal.SIGCONT)
    return True


class OwedAnswer:
    """From now until `close` a child of this process owes an answer.

    Args:
        pid: of the child; it is looked at every `LOOK_SECONDS`, at once for the first time.
        stopped: called each time that it was found stopped by a signal, and was told to go on.
        within: seconds that it has. Time for which this process stood still does not count.
        late: called once, when they are over.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        pid: int,
        stopped: Callable[[], object] | None = None,
        *,
        within: float = math.inf,
        late: Callable[[], object] | None = None,
    ) -> None:
        self._loop, self._pid, self._stopped, self._late = loop, pid, stopped, late
        self._looks_left = within / LOOK_SECONDS
        self._timer: asyncio.TimerHandle | None = None
        self._look()

    def _look(self) -> None:
        if go_on(self._pid) and self._stopped is not None:
            self._stopped()
        if self._looks_left > 0:
            self._looks_left -= 1
            self._timer = self._loop.call_later(LOOK_SECONDS, self._look)
        elif self._late is not None:
            self._late()

    def close(self) -> None:
        """It has answered, or nobody waits for it any more."""
        if self._timer is not None:
            self._timer.cancel()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
