"""Strict mode: a turn that asks the world instead of its context is stopped at the call (T21).

Nothing is patched: while a turn of a strict actor has the thread, the interpreter tells us of each call, however the
function was imported. Nobody else's turns, and no other thread's, are looked at or pay for it. What is called from
inside the standard library or holdfast (a logged line has a time stamp) is let through.
"""

from __future__ import annotations

import asyncio
import builtins
import datetime
import gc
import importlib
import os
import random
import secrets
import sys
import threading
import time
import types
import uuid
from collections.abc import Callable, Coroutine, Generator, Mapping
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, TypeVar

from ...actors.errors import HoldfastError
from ...actors.kernel.context import ActorContext

T = TypeVar("T")

CLOCK, DICE, NAME, TASK = "ctx.now()", "ctx.random", "ctx.uuid()", "ctx.pipe_to_self()"
SELF, LIVES, WORLD = "ctx.path", "a count in the state", "a message, or ctx.pipe_to_self(),"
PACKAGE = __name__.partition(".")[0]
TRUSTED = sys.stdlib_module_names | {PACKAGE, "anyio", "msgpack", "msgspec", "numpy", "structlog", "uvloop"}
"""Top packages whose own calls are their own affair."""


class NotDeterministic(
    HoldfastError, text="{what} was called at {where}: its replay would go another way; use {instead} instead"
):
    """A strict actor asked the world for what a replay could not get again."""

    what: str
    where: str
    instead: str


def _builtins() -> dict[int, tuple[str, str]]:
    """Functions written in C, by identity (they live for ever): their names, and what to use instead.

    uvloop's `loop.time` does not show as a call, but whoever calls it has asked for the loop.
    """
    found: dict[int, tuple[str, str]] = {}
    for name in ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time",
                 "localtime", "gmtime", "clock_gettime", "clock_gettime_ns"):  # fmt: skip
        found[id(getattr(time, name))] = f"time.{name}", CLOCK
    found[id(os.urandom)] = "os.urandom", DICE
    if hasattr(os, "getrandom"):
        found[id(os.getrandom)] = "os.getrandom", DICE
    for owner, names, instead in (
        (os, ("getpid", "getppid"), SELF),
        (os, ("open", "listdir", "scandir", "stat", "lstat", "getcwd"), WORLD),
        (builtins, ("id",), SELF),
        (builtins, ("open",), WORLD),
        (asyncio, ("get_running_loop", "get_event_loop"), f"{CLOCK} or {TASK}"),
    ):
        for name in names:
            found[id(getattr(owner, name))] = f"{owner.__name__.removeprefix('builtins')}.{name}".lstrip("."), instead
    return found


def _functions() -> dict[CodeType, tuple[str, str]]:
    """The same for functions written in Python, by their code."""
    found: dict[CodeType, tuple[str, str]] = {}
    listed: list[tuple[Any, str, tuple[str, ...], str]] = [
        (uuid, "uuid", ("uuid1", "uuid4"), NAME),
        (secrets, "secrets", ("token_bytes", "token_hex", "token_urlsafe", "randbelow"), DICE),
        (asyncio, "asyncio", ("create_task", "ensure_future", "to_thread"), TASK),
        (threading.Thread, "threading.Thread", ("start",), TASK),
        (asyncio.BaseEventLoop, "loop", ("time",), CLOCK),
        (os, "os", ("getenv",), WORLD),
        (type(os.environ), "os.environ", ("__getitem__",), WORLD),
        (Mapping, "os.environ", ("get",), WORLD),
        (
            Path,
            "Path",
            ("open", "read_text", "read_bytes", "write_text", "write_bytes", "stat", "exists", "iterdir"),
            WORLD,
        ),
    ]
    for owner, prefix, names, instead in listed:
        for name in names:
            found[getattr(owner, name).__code__] = f"{prefix}.{name}", instead
    life: Any = vars(ActorContext)["life"]  # A property: a replay runs in another life.
    found[life.fget.__code__] = "ctx.life", LIVES
    return found


def _drawing() -> dict[CodeType, str]:
    """Methods of generators written in Python: forbidden on the one that `random` shares, and on the system's."""
    return {
        member.__code__: name
        for name, member in {**vars(random.Random), **vars(random.SystemRandom)}.items()
        if isinstance(member, types.FunctionType) and not name.startswith("_")
    }


BUILTINS, FUNCTIONS, DRAWING = _builtins(), _functions(), _drawing()
MAPPING_GET = Mapping.get.__code__
SHARED: random.Random = random._inst
MADE = random.Random.__init__.__code__
STANDS_FOR = "stands_for"
"""What a function in place of a clock or a generator, under a simulation, calls the one that it stands for."""
CLASS_CLOCKS = {("datetime", "now"), ("datetime", "utcnow"), ("datetime", "today"), ("date", "today")}


class DeterminismGuard:
    """Watches the turns of one strict actor."""

    def __init__(self) -> None:
        self.caught: NotDeterministic | None = None
        self._is_collecting = False

    def call(self, function: Callable[..., T], *args: Any) -> T:
        """Call it, watched.

        Raises:
            NotDeterministic: at the forbidden call; and here once more, if that was swallowed.
        """
        outer, numbers, collects = sys.getprofile(), numpy_state(), gc.isenabled()
        gc.disable()  # What others have it call, and finalisers of their garbage, are none of the turn's doing.
        sys.setprofile(self._look)
        try:
            return function(*args)
        finally:
            sys.setprofile(outer)
            if collects:
                gc.enable()
            if numbers is not None and numpy_state() != numbers:
                self.caught = self.caught or NotDeterministic("numpy.random's shared generator", "this turn", DICE)
            if self.caught is not None:
                caught, self.caught = self.caught, None
                raise caught

    @types.coroutine
    def drive(self, driven_turn: Coroutine[Any, Any, T]) -> Generator[Any, Any, T]:
        """Run a turn to its end, watched whenever it has the thread."""
        step, value = driven_turn.send, None
        while True:
            try:
                yielded = self.call(step, value)
            except StopIteration as done:
                return done.value  # type: ignore[no-any-return]  # what the turn returns
            try:
                step, value = driven_turn.send, (yield yielded)
            except GeneratorExit:
                driven_turn.close()
                raise
            except BaseException as error:
                step, value = driven_turn.throw, error

    def _look(self, frame: FrameType, event: str, arg: Any) -> None:
        """Called by the interpreter at each call; what is raised here is raised at the call, in place of it."""
        if arg is gc.collect:
            self._is_collecting = event == "c_call"  # Or it has returned.
        elif self._is_collecting:
            return
        elif event == "c_call":
            self._look_at_builtin(frame, arg)
        elif event == "call":
            known = FUNCTIONS.get(frame.f_code)
            if known is not None:
                if frame.f_code is not MAPPING_GET or frame.f_locals.get("self") is os.environ:
                    self._refuse(*known, frame.f_back)
            elif frame.f_code is MADE and frame.f_locals["x"] is None:
                self._refuse("random.Random, without a seed,", DICE, frame.f_back)
            elif STANDS_FOR in frame.f_code.co_freevars:
                function, kind = frame.f_locals[STANDS_FOR], frame.f_locals.get("kind")
                self._look_at_builtin(frame.f_back, function if kind is None else function.__get__(None, kind))
            elif frame.f_code in DRAWING:
                drawn_from = frame.f_locals.get("self")
                if drawn_from is SHARED:
                    self._refuse(f"random.{DRAWING[frame.f_code]}", DICE, frame.f_back)
                elif isinstance(drawn_from, random.SystemRandom):
                    self._refuse(f"random.SystemRandom.{DRAWING[frame.f_code]}", DICE, frame.f_back)

    def _look_at_builtin(self, frame: FrameType | None, function: Any) -> None:
        known = BUILTINS.get(id(function))
        if known is None:
            owner = getattr(function, "__self__", None)
            if owner is SHARED:
                known = f"random.{function.__name__}", DICE
            elif isinstance(owner, type) and issubclass(owner, datetime.date):
                base = "datetime" if issubclass(owner, datetime.datetime) else "date"
                if (base, function.__name__) in CLASS_CLOCKS:
                    known = f"{base}.{function.__name__}", CLOCK
        if known is not None:
            self._refuse(*known, frame)

    def _refuse(self, what: str, instead: str, frame: FrameType | None) -> None:
        if frame is None or str(frame.f_globals.get("__name__", "")).partition(".")[0] in TRUSTED:
            return
        code = frame.f_code
        error = NotDeterministic(what, f"{code.co_filename}:{frame.f_lineno} in {code.co_name}", instead)
        self.caught = self.caught or error
        raise error


def numpy_state() -> Any:
    """Where numpy's shared generator stands, if numpy is loaded: its functions do not show as calls."""
    if "numpy" not in sys.modules:
        return None
    mtrand: Any = importlib.import_module("numpy.random.mtrand")  # numpy itself loads it with its first use, in a turn.
    state = mtrand._rand.get_state(legacy=False)
    inner = state["state"]
    return state["has_gauss"], state["gauss"], inner.get("pos"), inner["key"].tobytes() if "key" in inner else None
