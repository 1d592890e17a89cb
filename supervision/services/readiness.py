"""Signs that a program is ready: what it prints, what it opens, how long it has run, or what a function says."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import importlib
import os
import re
import stat
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Literal, cast

from ...actors.errors import SpecError
from ...actors.kernel.blocking_handlers import HandlerThreads, is_async
from ...actors.seconds import is_seconds
from ...actors.streams import Address, connect

FIRST_LOOK, LAST_LOOK = 0.01, 0.2
"""Seconds between two looks at the world outside, which tells nobody when it changes; they grow."""
CONNECT_SECONDS = 5.0
"""How long one connection may take to come about."""

Kind = Literal["line", "path", "port", "seconds", "call"]


@dataclasses.dataclass(frozen=True, slots=True)
class ReadySign:
    """One kind of sign, as plain data where it can be."""

    kind: Kind
    value: Any

    @classmethod
    def of(cls, where: str, ready: object) -> ReadySign:
        """What a user gave.

        Raises:
            SpecError: saying what it may be.
        """
        match ready:
            case str() | re.Pattern():
                return cls("line", _pattern(where, ready))
            case Path():
                return cls("path", os.fspath(ready))
            case (str() as host, int() as port):
                return cls("port", (host, port))
            case bool():
                pass
            case int() | float() if is_seconds(ready, or_zero=True):
                return cls("seconds", float(ready))
            case _ if callable(ready):
                return cls("call", by_name(ready))
            case _:
                pass
        raise SpecError(
            where, f"ready must be a pattern, a Path, (host, port), seconds >= 0 or a function, not {ready!r}"
        )


def _pattern(where: str, ready: str | re.Pattern[Any]) -> tuple[str, int]:
    """As text and flags it can be sent to another process."""
    text: object = ready if isinstance(ready, str) else ready.pattern
    flags = 0 if isinstance(ready, str) else int(ready.flags & ~re.UNICODE)
    if not isinstance(text, str):
        raise SpecError(where, "ready must be a pattern for text, not for bytes: output is decoded")
    try:
        re.compile(text, flags)
    except re.error as error:
        raise SpecError(where, f"ready is no regular expression: {error}") from error
    return text, flags


@dataclasses.dataclass(frozen=True, slots=True)
class Named:
    """A function by its name: as such it can be sent to another process."""

    module: str
    name: str

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    @property
    def function(self) -> Callable[..., Any]:
        """The function itself. Raises LookupError."""
        function = _found(self.module, self.name)
        if function is None:
            raise LookupError(f"there is no {self.module}.{self.name} here")
        return cast("Callable[..., Any]", function)


def by_name(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, by its name if it can be found by that; a lambda, say, stays as it is, and in this process."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    if isinstance(module, str) and isinstance(name, str) and _found(module, name) is function:
        return Named(module, name)
    return function


def _found(module: str, name: str) -> Any:
    found: Any = sys.modules.get(module) or importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


class Sign:
    """The wait for one sign; made before the program is started, so that what was there before is no sign."""

    def __init__(self, ready: ReadySign) -> None:
        self.ready = ready
        self.seen = asyncio.Event()  # a line with the pattern has come
        self._pattern = re.compile(*ready.value) if ready.kind == "line" else None
        self.before = _stamp(ready.value) if ready.kind == "path" else None

    def line(self, text: str) -> None:
        """A line of output, or the beginning of one: a prompt has no end."""
        if self._pattern is not None and self._pattern.search(text.rstrip("\r\n")):
            self.seen.set()

    def close(self) -> None:
        """Nobody looks at lines any more."""
        self._pattern = None


async def reached(sign: Sign, threads: HandlerThreads) -> None:
    """Wait until the sign is there; a function that may block is asked in a thread."""
    match sign.ready.kind:
        case "line":
            await sign.seen.wait()
        case "seconds":
            await asyncio.sleep(sign.ready.value)
        case _:
            pause = FIRST_LOOK
            while not await _there(sign, threads):
                await asyncio.sleep(pause)
                pause = min(LAST_LOOK, pause * 1.5)


async def _there(sign: Sign, threads: HandlerThreads) -> bool:
    value = sign.ready.value
    if sign.ready.kind == "port":
        return await _answers(value)
    if sign.ready.kind == "call":
        found: object = value() if is_async(_plain(value)) else await threads.run(value)
        answer = await found if isinstance(found, Awaitable) else found
        if not isinstance(answer, bool):
            raise TypeError(f"it must return True or False, not {answer!r}")
        return answer
    stamp = _stamp(value)
    if stamp is None:
        return False
    if stamp.is_socket:  # The file of a dead listener stays: only a connection says that somebody is there.
        return await _answers(value)
    return stamp != sign.before


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return function.function if isinstance(function, Named) else function


async def _answers(address: Address) -> bool:
    """Whether somebody takes connections there, as far as can be seen."""
    try:
        async with asyncio.timeout(CONNECT_SECONDS):
            _, writer = await connect(address)
    except (OSError, TimeoutError):
        return False
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return True


@dataclasses.dataclass(frozen=True, slots=True)
class _Stamp:
    """Which file it is, in which version."""

    inode: int
    changed_ns: int
    size: int
    is_socket: bool


def _stamp(path: str) -> _Stamp | None:
    """None: there is nothing at `path`."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return _Stamp(found.st_ino, found.st_mtime_ns, found.st_size, stat.S_ISSOCK(found.st_mode))
