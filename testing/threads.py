"""Threads at work: which threads of this process may yet do something by themselves.

A thread that waits for a lock without a time limit (a pool's idle thread does) goes on only when another thread lets
it. The kernel tells these from all others: they are in a futex call without a timeout. So does a thread that waits for
a future, such as that of what it has handed to an event loop, whatever its time limit: where time is virtual, a limit
of real time is never reached. Its stack tells.
"""

from __future__ import annotations

import platform
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import thread as pools
from types import CodeType
from typing import Final

from ..actors.kernel.blocking_handlers import wait_on_loop

FUTEX = {"x86_64": 202, "aarch64": 98}.get(platform.machine(), -1)
"""The number of the system call that waits for a lock."""
WAITS = (0, 9)
"""Its operations FUTEX_WAIT and FUTEX_WAIT_BITSET."""
MUTEX = (0, 2)
"""The operation, and the expected value, by which the C library waits for a mutex, such as that of the interpreter's
lock: it is held for an instant, and who waits for it is at work."""
WAITED_FOR: Final[dict[CodeType, str]] = {
    Future.result.__code__: "self",
    Future.exception.__code__: "self",
    wait_on_loop.__code__: "outcome",
}
"""The functions in which a thread waits for a future, and what they call it."""
DEEPEST: Final = 6
"""How many frames are between such a function and the wait for a lock, at most."""


class Onlooker(threading.Timer):
    """A thread that waits to tell what hangs, and does nothing else: no clock need wait for it."""

    def __init__(self, seconds: float, tell: Callable[[], None]) -> None:
        super().__init__(seconds, tell)
        self.daemon = True


class NewThreads:
    """The threads that began after this was made, and those of pools; what else ran before is no business of ours.

    Args:
        told: what the kernel tells of a thread, in its file of this name; `task_file`, unless a test says otherwise.
    """

    def __init__(self, told: Callable[[threading.Thread, str], str] | None = None) -> None:
        self._told = told or task_file
        self._foreign = {thread for thread in threading.enumerate() if thread not in pools._threads_queues}

    def at_work(self) -> list[str]:
        """The names of the threads that do not merely wait for another thread; none where the kernel does not tell.

        Two looks must be alike: between two looks at one thread, another may have woken it and come to rest itself.
        """
        if threading.active_count() == 1:
            return []
        before = self._look()
        at_work = [thread for thread, runs in before.items() if runs is None]
        if not at_work and before:
            at_work = [thread for thread, runs in self._look().items() if runs is None or runs != before.get(thread)]
        return [thread.name for thread in at_work]

    def waiting(self) -> int:
        """How many threads wait for a future that is not done."""
        return sum(_waits_for_a_future(thread) for thread in threading.enumerate())

    def _look(self) -> dict[threading.Thread, str | None]:
        """How often each of the others had run when it began to wait for a lock; None: it is at work."""
        own = threading.current_thread()
        others = [thread for thread in threading.enumerate() if thread is not own and thread not in self._foreign]
        return {thread: self._runs(thread) for thread in others if not isinstance(thread, Onlooker)}

    def _runs(self, thread: threading.Thread) -> str | None:
        """How often a thread has run until it began to wait for a lock; None: it is at work."""
        try:
            # In this order: who has been woken is in its futex call until it runs, and only its status tells.
            status, syscall = (self._told(thread, file) for file in ("status", "syscall"))
        except OSError:
            return ""  # It has ended meanwhile, or this system has no such files.
        is_limited = not _waits_for_a_future(thread)
        return status.partition("ctxt_switches:")[2] if waits_for_a_lock(status, syscall, is_limited) else None


def _waits_for_a_future(thread: threading.Thread) -> bool:
    """Whether a thread goes on only when a future is done that is not done yet."""
    frame = sys._current_frames().get(thread.ident or 0)
    for _ in range(DEEPEST):
        if frame is None:
            return False
        name = WAITED_FOR.get(frame.f_code)
        if name is not None:
            future: Future[object] = frame.f_locals[name]
            return not future.done()
        frame = frame.f_back
    return False


def task_file(thread: threading.Thread, file: str) -> str:
    """What the kernel tells of a thread in one of its files below /proc/self/task."""
    with open(f"/proc/self/task/{thread.native_id}/{file}", encoding="ascii", errors="replace") as told:
        return told.read()


def waits_for_a_lock(status: str, syscall: str, is_limited: bool = True) -> bool:
    """Whether a thread of which the kernel tells this goes on only when another thread lets it.

    Args:
        status, syscall: of the thread, as in /proc.
        is_limited: whether a thread whose wait has a time limit may go on by itself.
    """
    words = syscall.split()
    if words[0] != str(FUTEX):
        return FUTEX < 0
    operation, value, timeout = int(words[2], 16) & 0x7F, int(words[3], 16), int(words[4], 16)
    is_lock = operation in WAITS and not (timeout and is_limited) and (operation, value) != MUTEX
    return is_lock and "State:\tS" in status
