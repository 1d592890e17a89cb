"""Reads what a process prints, line by line."""

from __future__ import annotations

import asyncio
import os
import time
from collections import deque
from collections.abc import Callable

from ...streams import check_can_watch

LONGEST = 16 * 1024
"""Bytes after which a line without an end is passed on in pieces."""
SLICE_SECONDS = 0.002
"""How long lines are handed on before everybody else has a turn."""
UNWATCHED_SECONDS = 0.05
"""How often a pipe is looked into that the system cannot watch."""
LAST_READS = 16
"""How often a pipe is read at the end: a descendant that writes without end must not hold us up."""


class OutputReader:
    """Reads a pipe and hands on each line, a slice at a time: whoever prints without end does not hold up the others.

    While lines wait nothing more is read, so the writer waits; so it does between `hold` and `go_on`. A pipe that the
    system cannot watch is looked into now and then.

    Args:
        on_line: called with each line, or piece of a very long one.
        on_part: called with what is there of a line that has no end yet, and with that and the piece before it.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        fd: int,
        on_line: Callable[[str], None],
        on_part: Callable[[str, str], None] | None = None,
    ) -> None:
        self._loop, self._fd, self._on_line, self._on_part = loop, fd, on_line, on_part
        self._rest = b""
        self._before = b""  # the last piece, if it was not the end of its line
        self._lines: deque[tuple[bytes, bytes]] = deque()  # with what came before of the same line
        self._is_closed, self._is_paused, self._is_held = False, True, False
        self._then: Callable[[], None] | None = None
        self._slice: asyncio.Handle | None = None
        self._look: asyncio.TimerHandle | None = None
        self._watch()

    def _read(self) -> None:
        try:
            data = os.read(self._fd, 64 * 1024)
        except BlockingIOError:
            self._watch()
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._cut(data)
        self._hand_on()

    def _cut(self, data: bytes) -> None:
        """Put what has come in line, in lines."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._lines.append((line, self._before))
            self._before = b""
        if len(self._rest) > LONGEST:
            end = _whole_characters(self._rest)
            self._lines.append((self._rest[:end], self._before))
            self._before, self._rest = self._rest[max(0, end - LONGEST) : end], self._rest[end:]

    def _hand_on(self) -> None:
        """Hand on as many lines as the others can wait for, then let them have their turn."""
        self._slice = None
        until = time.perf_counter() + SLICE_SECONDS
        while self._lines and (not self._is_held or self._is_closed):
            line, before = self._lines.popleft()
            if before and self._on_part is not None:  # Nobody has seen the two together.
                self._on_part(_text(line), _text(before + line))
            self._on_line(_text(line))
            if time.perf_counter() >= until and self._lines:
                self._pause()
                self._slice = self._loop.call_soon(self._hand_on)
                return
        if self._is_held and not self._is_closed:
            return
        if self._on_part is not None and not self._is_closed:
            self._on_part(_text(self._rest), _text(self._before + self._rest))
        if self._is_closed:
            then, self._then = self._then, None
            if then is not None:
                then()
        elif self._is_paused:
            self._watch()

    def _watch(self) -> None:
        """Read, or read again: when there is something, or now and then while the system cannot watch the pipe."""
        if self._is_closed or self._is_held or not self._is_paused:
            return
        try:
            check_can_watch(self._fd)
        except OSError:
            if self._look is None:
                self._look = self._loop.call_later(UNWATCHED_SECONDS, self._read_unwatched)
            return
        self._is_paused = False
        self._loop.add_reader(self._fd, self._read)

    def _read_unwatched(self) -> None:
        self._look = None
        if not self._is_closed and not self._is_held and self._slice is None:
            self._read()

    def hold(self) -> None:
        """Hand on no line, and read nothing, until `go_on` or `close`."""
        self._is_held = True
        self._pause()

    def go_on(self) -> None:
        """Hand on lines again, from where it had stopped."""
        if self._is_held:
            self._is_held = False
            if self._slice is None and not self._is_closed:
                self._hand_on()

    def _pause(self) -> None:
        """Read no more for now."""
        if not self._is_closed and not self._is_paused:
            self._is_paused = True
            self._loop.remove_reader(self._fd)

    def close(self, then: Callable[[], None] | None = None) -> None:
        """Take what is still in the pipe and let go of it; `then` is called when all of it has been handed on."""
        if then is not None:
            self._then = then
        if not self._is_closed:
            self._pause()
            self._is_closed = True
            data = b""
            try:
                for _ in range(LAST_READS):
                    data += os.read(self._fd, 64 * 1024)
            except OSError:
                pass  # Nothing more is there, or a descendant holds the other end open.
            os.close(self._fd)
            self._cut(data)
            if self._rest:
                self._lines.append((self._rest, self._before))
                self._rest = self._before = b""
        if self._slice is None:
            self._hand_on()


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _whole_characters(data: bytes) -> int:
    """Where to cut so that no UTF-8 character is cut: before the last one, if it may be one of several bytes."""
    for back in (1, 2, 3):
        if data[-back] >= 0xC0:
            return len(data) - back
        if data[-back] < 0x80:
            break
    return len(data)
