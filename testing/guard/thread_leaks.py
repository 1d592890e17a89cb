"""Threads that a test leaves running."""

from __future__ import annotations

import os
import site
import sys
import sysconfig
import threading
from concurrent.futures import thread as pools
from time import monotonic
from types import FrameType
from typing import Any

from ..library_code import is_file_of_library
from ..swaps import Swaps
from ..threads import Onlooker

GRACE = 2.0
"""Real seconds that a thread which is about to end may take."""
LOOK_AGAIN = 0.02
"""Seconds between two looks at a thread of a pool, whose end of work wakes nobody here."""
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
        self.lost: list[str] = []
        self._swaps = Swaps()
        hook = threading.excepthook

        def ended(args: Any) -> None:
            if args.exc_type is not SystemExit:
                self.lost.append(f"{args.exc_type.__name__}: {args.exc_value}, in {_name(args.thread)}")
            hook(args)

        self._swaps.put(threading, "excepthook", ended)

    def started(self, thread: threading.Thread, where: str) -> None:
        """A thread is about to start."""
        self._started.append((thread, where))

    def told(self) -> list[str]:
        """The threads that do not end, and those of pools that are at work; nothing is noted any more."""
        if self in self._notes:
            self._notes.remove(self)
        deadline = monotonic() + GRACE
        for thread, _ in self._started:
            while _goes_on(thread) and thread is not threading.current_thread() and monotonic() < deadline:
                thread.join(LOOK_AGAIN if thread in pools._threads_queues else deadline - monotonic())
        self._swaps.undo()
        return [f"{thread.name}, started at {where}" for thread, where in self._started if _goes_on(thread)]

    def close(self) -> None:
        """Note nothing any more; a second call changes nothing."""
        self._swaps.undo()
        if self in self._notes:
            self._notes.remove(self)


def _goes_on(thread: threading.Thread) -> bool:
    """Whether a thread has something to do; that of a pool has nothing while it waits for work."""
    if not thread.is_alive():
        return False
    frame = sys._current_frames().get(thread.ident or 0) if thread in pools._threads_queues else None
    return frame is None or frame.f_code is not pools._worker.__code__


def _name(thread: threading.Thread | None) -> str:
    return "a thread" if thread is None else thread.name


def _starter(frame: FrameType | None) -> FrameType | None:
    """Where a thread was started, beyond `threading` and its pools; None: by a library."""
    while frame is not None and frame.f_globals.get("__name__") in ("threading", pools.__name__, __name__):
        frame = frame.f_back
    return None if frame is None or is_installed(frame.f_code.co_filename) else frame


def is_installed(file: str) -> bool:
    """Whether a file of code is a library's, this one's or another's."""
    return file.startswith(LIBRARIES) or is_file_of_library(file)
