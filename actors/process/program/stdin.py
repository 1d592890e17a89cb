"""Feeds the standard input of an external program."""

from __future__ import annotations

import asyncio
import os
from collections import deque

from ...streams import check_can_watch
from .stdout import UNWATCHED_SECONDS

MOST_WAITING = 1024 * 1024
"""Bytes that may wait for a program that does not read; what would be more is refused."""
PIECE = 64 * 1024


class InputWriter:
    """Writes to a pipe, in order, as fast as the other end reads.

    Attributes:
        waiting: bytes that the pipe has not taken yet.
        is_open: whether more can be written: neither has `end` been called nor has the reader gone.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, fd: int) -> None:
        self._loop, self._fd = loop, fd
        self._pieces: deque[memoryview] = deque()
        self._is_waiting = False
        self._retry: asyncio.TimerHandle | None = None
        self.waiting = 0
        self.is_open = True

    def write(self, data: bytes) -> bool:
        """Take data; False if too much waits already, and nothing is taken then."""
        if self.waiting and self.waiting + len(data) > MOST_WAITING:
            return False
        view = memoryview(data)
        self._pieces.extend(view[at : at + PIECE] for at in range(0, len(data), PIECE))
        self.waiting += len(data)
        self._go_on()
        return True

    def end(self) -> None:
        """No more comes: the reader finds the end behind what was written."""
        self.is_open = False
        self._go_on()

    def close(self) -> None:
        """Let go of the pipe; what waits is lost. A second call changes nothing."""
        self.is_open = False
        if self._fd < 0:
            return
        self._wait(False)
        if self._retry is not None:
            self._retry.cancel()
        os.close(self._fd)
        self._fd = -1
        self._pieces.clear()
        self.waiting = 0

    def _go_on(self) -> None:
        """Write what the pipe takes now; the loop calls again when it takes more."""
        if self._fd < 0:
            return
        try:
            while self._pieces:
                count = os.write(self._fd, self._pieces[0])
                self.waiting -= count
                rest = self._pieces[0][count:]
                if rest:
                    self._pieces[0] = rest
                else:
                    self._pieces.popleft()
        except BlockingIOError:
            self._wait(True)
            return
        except OSError:  # Nobody reads any more.
            self.close()
            return
        self._wait(False)
        if not self.is_open:
            self.close()

    def _again(self) -> None:
        self._retry = None
        self._go_on()

    def _wait(self, wanted: bool) -> None:
        if wanted and not self._is_waiting:
            try:
                check_can_watch(self._fd)
            except OSError:  # Then we look now and then whether it takes more.
                if self._retry is None:
                    self._retry = self._loop.call_later(UNWATCHED_SECONDS, self._again)
                return
            self._loop.add_writer(self._fd, self._go_on)
        elif self._is_waiting and not wanted:
            self._loop.remove_writer(self._fd)
        self._is_waiting = wanted
