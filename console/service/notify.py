"""What a service manager is told over NOTIFY_SOCKET, by systemd's protocol `sd_notify`."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections import deque
from collections.abc import Mapping

SEND_AGAIN = 0.05
"""Seconds until a manager that had no room is told again."""


class Notifier:
    """Tells the service manager how the program is; nothing if none has asked.

    Args:
        environment: that of the process; it is read once.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{path[1:]}" if path.startswith("@") else path
        kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        self._socket = socket.socket(socket.AF_UNIX, kind) if path else None
        self._beat: asyncio.TimerHandle | None = None
        self._again: asyncio.TimerHandle | None = None
        self._waiting: deque[bytes] = deque()  # what the manager had no room for: it must not hold up the program
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        is_watched = usec.isdecimal() and int(usec) > 0 and pid in ("", str(os.getpid()))
        self.beat_seconds = int(usec) / 2e6 if is_watched else 0.0
        """How often the manager wants to hear that the event loop turns: twice within its time; 0: not at all."""

    def _tell(self, *lines: str) -> None:
        self._waiting.append("\n".join(lines).encode())
        self._send()

    def _send(self) -> None:
        if self._again is not None:
            self._again.cancel()
            self._again = None
        while self._socket is not None and self._waiting:
            try:
                self._socket.sendto(self._waiting[0], self._address)
            except BlockingIOError:
                self._again = asyncio.get_running_loop().call_later(SEND_AGAIN, self._send)
                return
            except OSError:  # The manager is being restarted itself: it hears the next one.
                pass
            self._waiting.popleft()

    def ready(self, status: str) -> None:
        """All is up; from now on the manager hears that the loop turns."""
        self._tell("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")
        if self._beat is None and self.beat_seconds and self._socket is not None:
            self._next_beat()

    def _next_beat(self) -> None:
        if not self._waiting:
            self._tell("WATCHDOG=1")
        self._beat = asyncio.get_running_loop().call_later(self.beat_seconds, self._next_beat)

    def reloading(self) -> None:
        """Another tree is on its way; `ready` follows, whether it has come or not."""
        self._tell("RELOADING=1", f"MONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """The program ends. The manager still hears that the loop turns, for that may take a while."""
        self._tell("STOPPING=1", "STATUS=stopping")

    def close(self) -> None:
        """Close the socket: the service manager is told nothing more."""
        for timer in (self._beat, self._again):
            if timer is not None:
                timer.cancel()
        if self._socket is not None:
            self._socket.close()
