"""Threads at work: which threads of this process may yet do something by themselves.

A thread that waits for a lock without a time limit (a pool's idle thread does) goes on only when another thread lets
it. The kernel tells these from all others: they are in a futex call without a timeout.
"""

from __future__ import annotations

import platform
import threading
from collections.abc import Callable
from concurrent.futures import thread as pools

FUTEX = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), -1)
"""The number of the system call that waits for a lock."""
WAITS = (0, 9)
"""Its operations FUTEX_WAIT and FUTEX_WAIT_BITSET."""
MUTEX = (0, 2)
"""The operation, and the expected value, by which the C library waits for a mutex, such as that of the interpreter's
lock: it is held for an instant, and who waits for it is at work."""


class Onlooker(threading.Timer):
    """A thread that waits to tell what hangs, and does nothing else: no clock need wait for it."""

    def __init__(self, seconds: float, tell: Callable[[], None]) -> None:
        super().__init__(seconds, tell)
        self.daemon = True


class Threads:
    """The threads that began after this was made, and those of pools; what else ran before is no business of ours."""

    def __init__(self) -> None:
        self._foreign = {thread for thread in threading.enumerate() if thread not in pools._threads_queues}

    def at_work(self) -> list[str]:
        """The names of the threads that do not merely wait for another thread; none where the kernel does not tell."""
        if threading.active_count() == 1:
            return []
        own = threading.current_thread()
        others = [thread for thread in threading.enumerate() if thread is not own and thread not in self._foreign]
        return [thread.name for thread in others if not isinstance(thread, Onlooker) and _is_at_work(thread)]


def _is_at_work(thread: threading.Thread) -> bool:
    """Whether a thread runs, sleeps, or waits for something other than a lock."""
    try:
        with open(f"/proc/self/task/{thread.native_id}/syscall", encoding="ascii") as file:
            words = file.read().split()
    except OSError:
        return False  # It has ended meanwhile, or this system has no such file.
    if words[0] != str(FUTEX):
        return FUTEX >= 0
    operation, value, timeout = int(words[2], 16) & 0x7F, int(words[3], 16), int(words[4], 16)
    return operation not in WAITS or timeout != 0 or (operation, value) == MUTEX
