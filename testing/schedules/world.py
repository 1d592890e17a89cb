"""What a program asks the world for: random numbers and the time. In a simulated run both are the seed's.

`random`, `uuid`, `secrets`, `os.urandom`, `time.time`, `time.monotonic` and `time.perf_counter` are exchanged for the
thread of the run. What cannot be exchanged is told: threads and sockets of the program's own.
"""

from __future__ import annotations

import asyncio
import functools
import os
import random
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from anyio._backends._asyncio import CancelScope

from ..swaps import Swaps
from .numbered import as_completed, new_scope

EPOCH = 1_700_000_000.0
"""Unix time at which each simulated run begins."""
OURS = str(Path(__file__).resolve().parents[2])
"""Threads of this library are waited for, and no news."""


class EscapesSimulation(UserWarning):
    """Something decides in a simulated run that no seed has in its hand."""


class World:
    """Exchanges what the run of one seed asks the world for; leaving the context puts everything back.

    The context can be entered again: the run goes on with the random numbers that come next.

    Attributes:
        escaped: what the run has used that is not the seed's, each once.
    """

    def __init__(self, seed: int, loop: asyncio.AbstractEventLoop) -> None:
        self.escaped: dict[str, None] = {}
        self._seed, self._loop = seed, loop
        self._swaps = Swaps()
        self._thread = threading.get_ident()
        self._bytes = random.Random(f"bytes {seed}")
        self._state: Any = None
        self._own_state: Any = None

    def __enter__(self) -> World:
        self._state = random.getstate()
        if self._own_state is None:
            random.seed(f"random {self._seed}")
        else:
            random.setstate(self._own_state)
        put = self._swaps.put
        for owner, name in ((os, "urandom"), (random, "_urandom")):
            put(owner, name, self._own(getattr(owner, name), self._bytes.randbytes))
        clock = self._loop.time
        for name, made in (("time", lambda: EPOCH + clock()), ("monotonic", clock), ("perf_counter", clock)):
            put(time, name, self._own(getattr(time, name), made))
            put(time, f"{name}_ns", self._own(getattr(time, f"{name}_ns"), _in_ns(made)))
        start, add_reader = threading.Thread.start, self._loop.add_reader

        def started(thread: threading.Thread) -> None:
            if threading.get_ident() == self._thread:
                self._look_at_thread(thread)
            start(thread)

        def reads(fd: Any, callback: Any, *args: Any) -> None:
            if not _is_ours(callback):
                self._tell(f"a file or socket is read ({_name(callback)}): its data comes when the machine brings it")
            add_reader(fd, callback, *args)

        put(asyncio, "as_completed", functools.partial(as_completed, asyncio.as_completed))
        made_scope = CancelScope.__init__
        put(CancelScope, "__init__", lambda scope, *args, **named: new_scope(made_scope, scope, *args, **named))
        put(threading.Thread, "start", started)
        put(self._loop, "add_reader", reads)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._own_state = random.getstate()
        self._swaps.undo()
        random.setstate(self._state)

    def _own(self, real: Callable[..., Any], simulated: Callable[..., Any]) -> Callable[..., Any]:
        """For the thread of the run the simulated function, for all others the real one."""

        def chosen(*args: Any) -> Any:
            return (simulated if threading.get_ident() == self._thread else real)(*args)

        return chosen

    def _look_at_thread(self, thread: threading.Thread) -> None:
        target = getattr(thread, "_target", None)
        if target is None:
            target = type(thread).run
        module = getattr(target, "__module__", "") or ""
        if _is_ours(target) or module.startswith(("concurrent.", "threading", "anyio.")):
            return  # A pool's: whose result comes when nothing else can happen, as the loop sees to.
        self._tell(f"a thread was started ({_name(target)}): what it does by itself comes when the machine lets it")

    def _tell(self, what: str) -> None:
        if what not in self.escaped:
            self.escaped[what] = None
            warnings.warn(f"not the seed's: {what}", EscapesSimulation, stacklevel=4)


def _in_ns(made: Callable[[], float]) -> Callable[[], int]:
    return lambda: round(made() * 1e9)


def _is_ours(function: Any) -> bool:
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    return code is not None and code.co_filename.startswith(OURS) and "/tests/" not in code.co_filename


def _name(function: Any) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"
