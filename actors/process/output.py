"""What an actor process prints, line by line."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

LONGEST = 16 * 1024
"""Bytes after which a line without an end is passed on in pieces."""
LAST_READS = 16
"""How often a pipe is read at the end: a descendant that writes without end must not hold us up."""


class OutputReader:
    """Reads a pipe and hands on each line, and to `on_part`, if given, what is there of one that has no end yet."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        fd: int,
        on_line: Callable[[str], None],
        on_part: Callable[[str], None] | None = None,
    ) -> None:
        self._loop, self._fd, self._on_line, self._on_part = loop, fd, on_line, on_part
        self._rest = b""
        loop.add_reader(fd, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._fd, 64 * 1024)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST:
            end = _whole_characters(self._rest)
            lines.append(self._rest[:end])
            self._rest = self._rest[end:]
        for line in lines:
            self._on_line(line.decode("utf-8", "replace"))
        if self._on_part is not None:
            self._on_part(self._rest.decode("utf-8", "replace"))

    def close(self) -> None:
        """Take what is still in the pipe, then let go of it; a second call changes nothing."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        self._loop.remove_reader(fd)
        try:
            for _ in range(LAST_READS):
                self._rest += os.read(fd, 64 * 1024)
        except OSError:
            pass  # Nothing more is there, or a descendant holds the other end open.
        os.close(fd)
        for line in self._rest.split(b"\n"):
            if line:
                self._on_line(line.decode("utf-8", "replace"))
        self._rest = b""


def _whole_characters(data: bytes) -> int:
    """Where to cut so that no UTF-8 character is cut: before the last one, if it may be one of several bytes."""
    for back in (1, 2, 3):
        if data[-back] >= 0xC0:
            return len(data) - back
        if data[-back] < 0x80:
            break
    return len(data)
