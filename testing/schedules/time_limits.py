"""Time limits of pytest-timeout, whose signal strikes in whatever runs just then: a callback, an actor's turn.

asyncio and actors live on after what such code raises. The run has to end all the same, and it is no failure of the
program: nothing is made again or shrunk.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType, FunctionType, TracebackType
from typing import Any, Final

from ..clock import VirtualClockLoop

PLUGIN: Final = "pytest_timeout"


class TimeLimit:
    """Ends a loop when pytest-timeout ends the test, whoever takes what its signal raises."""

    def __init__(self, loop: VirtualClockLoop) -> None:
        self._loop = loop
        self._handler: Any = None

    def __enter__(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        handler = signal.getsignal(signal.SIGALRM)
        if isinstance(handler, FunctionType) and handler.__module__ == PLUGIN:
            self._handler = handler
            signal.signal(signal.SIGALRM, self._strike)

    def _strike(self, number: int, frame: FrameType | None) -> None:
        try:
            self._handler(number, frame)
        except BaseException as error:
            self._loop.end_by(error)
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handler is not None:
            signal.signal(signal.SIGALRM, self._handler)


def is_of_time_limit(error: BaseException) -> bool:
    """Whether pytest-timeout has raised an error, or what it has come from."""
    seen: BaseException | None = error
    while seen is not None:
        trace = seen.__traceback__
        while trace is not None:
            if trace.tb_frame.f_globals.get("__name__") == PLUGIN:
                return True
            trace = trace.tb_next
        seen = seen.__cause__ or seen.__context__
    return False
