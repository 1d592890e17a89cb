"""Handlers of signals that a test leaves behind."""

from __future__ import annotations

import asyncio
import functools
import signal
from types import FunctionType, MethodType
from typing import Any, Final

WATCHED: Final = tuple(
    signal.Signals[name]
    for name in ("SIGHUP", "SIGINT", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGPIPE", "SIGALRM", "SIGTERM", "SIGCHLD")
    if name in signal.Signals.__members__
)


def handlers() -> dict[signal.Signals, Any]:
    """What handles each signal now; for what a runner of asyncio or pytest-timeout has put there, what was before."""
    return {number: _own(signal.getsignal(number)) for number in WATCHED}


def _own(handler: Any) -> Any:
    if isinstance(handler, functools.partial):
        method: Any = handler.func
        if isinstance(method, MethodType) and isinstance(method.__self__, asyncio.Runner):
            return signal.default_int_handler
    if isinstance(handler, FunctionType) and handler.__module__ == "pytest_timeout":
        return signal.SIG_DFL
    return handler
