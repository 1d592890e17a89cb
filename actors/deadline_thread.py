"""A thread that ends an actor's process when blocked code keeps its event loop from meeting a time limit.

The limits of starts and stops are timers of the loop, and no timer comes while code such as `time.sleep` keeps the
loop's thread. At the root there is nobody else who could go on; in an actor process the root starts it again.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import traceback
from collections.abc import Callable
from time import monotonic

LATE = 2.0
"""Seconds by which the loop may come late to a time limit."""
LOOKS = 4
"""How often it is looked whether the loop has come, within that time."""
BLOCKED = 70
"""The exit code of a process that was ended for it: EX_SOFTWARE."""


class OpenLimit:
    """A time limit of something that is not over."""

    __slots__ = ("at", "timer", "what")

    def __init__(self, what: str, at: float) -> None:
        self.what, self.at = what, at
        self.timer: asyncio.TimerHandle | None = None


class Overdue:
    """Ends this process when its loop does not come to a time limit. Its thread runs while there is one."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._blocked = loop, threading.get_ident()
        self._due: set[OpenLimit] = set()
        self._changed = threading.Condition()
        self._is_watched = False

    def begin(self, what: str, seconds: float) -> Callable[[], None]:
        """Something has to be over in so many seconds; the caller says when it is, by calling what is returned."""
        due = OpenLimit(what, monotonic() + seconds)
        due.timer = self._loop.call_later(seconds, self._came, due)
        with self._changed:
            self._due.add(due)
            if self._is_watched:
                self._changed.notify()
            else:
                self._is_watched = True
                threading.Thread(target=self._look, name="holdfast overdue", daemon=True).start()

        def end() -> None:
            if due.timer is not None:
                due.timer.cancel()
            with self._changed:
                self._due.discard(due)
                self._changed.notify()

        return end

    def _came(self, due: OpenLimit) -> None:
        """The loop has come to the limit: whoever keeps it has, too. What follows may block it as well."""
        with self._changed:
            due.at = monotonic() + LATE
        due.timer = self._loop.call_later(LATE / 2, self._came, due)

    def _look(self) -> None:
        late = 0
        with self._changed:
            while self._due:
                first = min(self._due, key=lambda due: due.at)
                left = first.at - monotonic()
                if left > 0:
                    late = 0
                    self._changed.wait(left)
                elif late == LOOKS:
                    self._end(first)
                else:
                    begin = monotonic()
                    self._changed.wait(LATE / LOOKS)
                    # Were we late ourselves, it was the machine, or somebody who had stopped the whole process.
                    late = late + 1 if monotonic() - begin < LATE else 0
            self._is_watched = False

    def _end(self, due: OpenLimit) -> None:
        stack = traceback.format_stack(sys._current_frames()[self._blocked])
        told = f"holdfast: the process ends, for its thread is blocked, and {due.what}; it is here:\n{''.join(stack)}"
        os.write(2, told.encode(errors="backslashreplace"))  # The streams of Python may be locked by who blocks.
        os._exit(BLOCKED)
