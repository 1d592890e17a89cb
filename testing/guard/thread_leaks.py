"""Threads that a test leaves running."""

from __future__ import annotations

import os
import site
import sys
import sysconfig
import threading
from time import monotonic
from types import FrameType
from typing import Any

from ..library_code import is_file_of_library
from ..swaps import Swaps
from ..threads import Onlooker

GRACE = 2.0
"""Real seconds that a thread which is about to end may take."""
LIBRARIES = tuple(
    os.path.join(folder, "")
    for folder in (
        *(sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")),
        *site.getsitepackages(),
    )
)
"""Files below one of these are another library's: a thread that they start is of a pool, or is kept for later."""


class ThreadStarts:
    """`Thread.start`, exchanged once for one that tells whoever notes it, and left so.

    To exchange it for each test has the interpreter forget, twice, what it knows of the classes of threads.
    """

    def __init__(self) -> None:
        self.notes: list[ThreadLeaks] = []
        start: Any = threading.Thread.start
        notes = self.notes

        def noted(thread: threading.Thread) -> None:
            frame = _starter(sys._getframe(1)) if notes and not isinstance(thread, Onlooker) else None
            if frame is not None:
                where = f"{frame.f_code.co_filename}:{frame.f_lineno}"
                for one in notes:
                    one.started(thread, where)
            start(thread)

        noted.starts = self  # type: ignore[attr-defined]  # so that the next test finds them
        Swaps().put(threading.Thread, "start", noted)

    @staticmethod
    def standing() -> ThreadStarts:
        """What stands at the class, or a new one."""
        found = vars(threading.Thread.start).get("starts")
        return found if isinstance(found, ThreadStarts) else ThreadStarts()


class ThreadLeaks:
    """Notes from here to `told` which threads are started, and where."""

    def __init__(self) -> None:
        self._started: list[tuple[threading.Thread, str]] = []
        self._notes = ThreadStarts.standing().notes
        self._notes.append(self)

    def started(self, thread: threading.Thread, where: str) -> None:
        """A thread is about to start."""
        self._started.append((thread, where))

    def told(self) -> list[str]:
        """The threads that do not end; nothing is noted any more."""
        self.close()
        deadline = monotonic() + GRACE
        for thread, _ in self._started:
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(max(0.0, deadline - monotonic()))
        return [f"{thread.name}, started at {where}" for thread, where in self._started if thread.is_alive()]

    def close(self) -> None:
        """Note nothing any more; a second call changes nothing."""
        if self in self._notes:
            self._notes.remove(self)


def _starter(frame: FrameType | None) -> FrameType | None:
    """Where a thread was started, beyond `threading` itself; None: by a library."""
    while frame is not None and frame.f_globals.get("__name__") in ("threading", __name__):
        frame = frame.f_back
    if frame is None or frame.f_code.co_filename.startswith(LIBRARIES) or is_file_of_library(frame.f_code.co_filename):
        return None
    return frame
