"""What an actor process prints, line by line."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

LONGEST = 16 * 1024
"""Bytes after which a line without an end is passed on in pieces."""


class OutputReader:
    """Reads a pipe and hands on each line."""

    def __init__(self, loop: asyncio.AbstractEventLoop, fd: int, on_line: Callable[[str], None]) -> None:
        self._loop, self._fd, self._on_line = loop, fd, on_line
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
            lines.append(self._rest)
            self._rest = b""
        for line in lines:
            self._on_line(line.decode("utf-8", "replace"))

    def close(self) -> None:
        """Take what is still in the pipe, then let go of it; a second call changes nothing."""
        if self._fd < 0:
            return
        fd, self._fd = self._fd, -1
        self._loop.remove_reader(fd)
        try:
            while data := os.read(fd, 64 * 1024):
                self._rest += data
        except OSError:
            pass  # Nothing more is there, or a descendant holds the other end open.
        os.close(fd)
        for line in self._rest.split(b"\n"):
            if line:
                self._on_line(line.decode("utf-8", "replace"))
        self._rest = b""
