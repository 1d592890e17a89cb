"""Random numbers and time of a simulated run: both come from the seed.

`random`, `uuid`, `secrets`, `os.urandom`, numpy's global generator, the functions of `time` and the clocks of
`datetime` are exchanged for the thread of the run. What cannot be exchanged is told: threads, sockets and processes of
the program's own.
"""

from __future__ import annotations

import asyncio
import datetime
import functools
import gc
import os
import random
import re
import socket
import stat
import subprocess
import sys
import threading
import time
import uuid
import warnings
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any

from anyio._backends._asyncio import CancelScope, WorkerThread

from ..library_code import is_file_of_library
from ..swaps import Swaps
from ..threads import Onlooker
from .bound_names import BoundNames, OwnStates
from .numbered import as_completed, numbering, scope_in_order

if TYPE_CHECKING:
    from .control import ControlledLoop

EPOCH = 1_700_000_000.0
"""Unix time at which each simulated run begins."""
NODE = 0x010000000001
"""The machine in a UUID of version 1."""
SHOWN = re.compile(rb" at 0x([0-9a-f]+)")
"""How texts show the address of an object in memory, if its class says nothing else."""


class EscapesSimulation(UserWarning):
    """Something decides in a simulated run that no seed has in its hand."""


class World:
    """Exchanges what the run of one seed asks the world for; leaving the context puts everything back.

    The context can be entered again: the run goes on with the random numbers that come next.

    Args:
        names: by which the program has the same functions, and its own generators.

    Attributes:
        escaped: what the run has used that is not the seed's, each once.
    """

    def __init__(self, seed: int, loop: ControlledLoop, names: BoundNames) -> None:
        self._names, self._generators = names, OwnStates(names.generators, seed)
        self.escaped: dict[str, None] = {}
        self._seed, self._loop = seed, loop
        self._swaps = Swaps()
        self._thread = threading.get_ident()
        self._bytes = random.Random(f"bytes {seed}")
        self._state: Any = None
        self._own_state: Any = None
        self._numpy_state: Any = None  # before the run
        self._own_numpy_state: Any = None

    def __enter__(self) -> World:
        self._state = random.getstate()
        if self._own_state is None:
            random.seed(f"random {self._seed}")
        else:
            random.setstate(self._own_state)
        put = self._swaps.put
        for owner, name in ((os, "urandom"), (os, "getrandom"), (random, "_urandom")):
            put(owner, name, self._own(getattr(owner, name), self._drawn))
        put(random.Random, "seed", _seeding(random.Random.seed, self._own(_nothing, self._drawn)))
        seed: Any = random.seed
        put(random, "seed", functools.partial(random.Random.seed, seed.__self__))
        self._put_numpy()
        for name, value in (("_generate_time_safe", None), ("_last_timestamp", None), ("_node", NODE)):
            put(uuid, name, value)  # Its first version asks the C library otherwise, and goes on from the last run.
        self._put_clocks()
        loop: Any = self._loop
        start, add_signal_handler = threading.Thread.start, loop.add_signal_handler
        add_reader, add_writer = loop._add_reader, loop._add_writer  # By which transports read and write, too.

        def started(thread: threading.Thread) -> None:
            if threading.get_ident() == self._thread:
                self._look_at_thread(thread)
            start(thread)

        def reads(fd: Any, callback: Any, *args: Any) -> Any:
            if not _is_ours(callback):
                what = _kind_of_file(fd)
                self._tell(f"{what} is read ({_name(callback)}): its data comes when the machine brings it")
            return add_reader(fd, callback, *args)

        def writes(fd: Any, callback: Any, *args: Any) -> Any:
            if not _is_ours(callback):
                self._tell(
                    f"{_kind_of_file(fd)} is written ({_name(callback)}): when it takes more is up to the machine"
                )
            return add_writer(fd, callback, *args)

        def hears(number: int, callback: Any, *args: Any) -> None:
            self._tell(f"a signal is waited for ({_name(callback)}): it comes when the machine brings it")
            add_signal_handler(number, callback, *args)

        put(asyncio, "as_completed", functools.partial(as_completed, asyncio.as_completed))
        put(CancelScope, "__init__", scope_in_order(CancelScope.__init__))
        put(threading.Thread, "start", started)
        put(loop, "_add_reader", reads)
        put(loop, "_add_writer", writes)
        put(loop, "add_signal_handler", hears)
        put(WorkerThread, "__init__", numbering(WorkerThread.__init__, self._loop.number_work))
        self._tell_of(socket.socket, "__init__", "a socket was opened", "what comes through it")
        self._tell_of(subprocess.Popen, "__init__", "a process was started", "what it does")
        for name in ("fork", "forkpty", "posix_spawn", "posix_spawnp", "system"):
            self._tell_of(os, name, f"a process was started (os.{name})", "what it does")
        self._swaps.follow(self._names.functions)
        self._generators.put()
        return self

    def _put_numpy(self) -> None:
        """The state of numpy's global generator, if numpy is there: nothing else may depend on whether it is."""
        numpy: Any = sys.modules.get("numpy.random")
        if numpy is None:
            return
        self._numpy_state = numpy.get_state()
        if self._own_numpy_state is None:
            numpy.seed(random.Random(f"numpy {self._seed}").getrandbits(32))
        else:
            numpy.set_state(self._own_numpy_state)

    def _put_clocks(self) -> None:
        clock, wall, put = self._loop.time, self._loop.unix_time, self._swaps.put
        clocks = [
            ("time", wall),
            *((name, clock) for name in ("monotonic", "perf_counter", "process_time", "thread_time")),
        ]
        for name, made in clocks:
            put(time, name, self._own(getattr(time, name), made))
            put(time, f"{name}_ns", self._own(getattr(time, f"{name}_ns"), _in_ns(made)))

        def read(number: int) -> float:
            return (wall if number == time.CLOCK_REALTIME else clock)()

        def read_ns(number: int) -> int:
            return round(read(number) * 1e9)

        for name, reading in (("clock_gettime", read), ("clock_gettime_ns", read_ns)):
            put(time, name, self._own(getattr(time, name), reading))
        for name in ("localtime", "gmtime", "ctime"):
            real = getattr(time, name)
            put(time, name, self._own(real, _given(real, 0, wall)))
        for name, count in (("strftime", 1), ("asctime", 0)):
            real = getattr(time, name)
            put(time, name, self._own(real, _given(real, count, time.localtime)))
        # `today`, of both of its classes, asks `time.time`.
        for name, dated in (("now", functools.partial(_now, wall)), ("utcnow", functools.partial(_utcnow, wall))):
            put(datetime.datetime, name, self._own_of_class(vars(datetime.datetime)[name], dated))

    def _drawn(self, size: int = 16, flags: int = 0) -> bytes:
        """In place of `os.urandom` and `os.getrandom`."""
        return self._bytes.randbytes(size)

    def _tell_of(self, owner: Any, name: str, what: str, comes: str) -> None:
        """Tell of each call of a function by the program."""
        real = getattr(owner, name)

        def told(*args: Any, **options: Any) -> Any:
            if threading.get_ident() == self._thread:
                self._tell(f"{what}: {comes} comes when the machine brings it")
            return real(*args, **options)

        self._swaps.put(owner, name, told)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._generators.take_back()
        self._own_state = random.getstate()
        self._swaps.undo()
        random.setstate(self._state)
        if self._numpy_state is not None:
            numpy: Any = sys.modules["numpy.random"]
            self._own_numpy_state = numpy.get_state()
            numpy.set_state(self._numpy_state)

    def _own(self, stands_for: Callable[..., Any], simulated: Callable[..., Any]) -> Callable[..., Any]:
        """For the thread of the run the simulated function, for all others the real one.

        The guard of strict actors finds that by its name, and refuses either.
        """

        def chosen(*args: Any, **options: Any) -> Any:
            return (simulated if threading.get_ident() == self._thread else stands_for)(*args, **options)

        return chosen

    def _own_of_class(self, stands_for: Any, simulated: Callable[..., Any]) -> Any:
        """As `_own`, of a class method."""

        def chosen(kind: type, *args: Any, **options: Any) -> Any:
            if threading.get_ident() == self._thread:
                return simulated(kind, *args, **options)
            return stands_for.__get__(None, kind)(*args, **options)

        return classmethod(chosen)

    def _look_at_thread(self, thread: threading.Thread) -> None:
        if isinstance(thread, threading.Timer):
            if not isinstance(thread, Onlooker):
                called = _name(getattr(thread, "function", None))
                self._tell(f"a threading.Timer was started ({called}): it waits for real time, which is not the run's")
            return
        target = getattr(thread, "_target", None)
        if target is None:
            target = type(thread).run
        module = getattr(target, "__module__", "") or ""
        if _is_ours(target) or module.startswith(("concurrent.", "threading", "anyio.")):
            return  # A pool's: whose result comes when nothing else can happen, as the loop sees to.
        self._tell(f"a thread was started ({_name(target)}): what it does by itself comes when the machine lets it")

    def look_for_addresses(self, what: str, body: bytes) -> None:
        """Tell of what is sent, if the address of an object is shown in it."""
        shown = shown_address(body)
        if shown is not None:
            self._tell(f"{what} shows the address of an object ({shown}): send a name or a number of its own")

    def _tell(self, what: str) -> None:
        if what not in self.escaped:
            self.escaped[what] = None
            warnings.warn(f"not the seed's: {what}", EscapesSimulation, stacklevel=4)


def _seeding(real: Any, drawn: Callable[[], Any]) -> Any:
    """As `Random.seed`; but what is seeded with nothing is seeded with what is drawn."""

    def seed(generator: random.Random, a: Any = None, version: int = 2) -> None:
        real(generator, drawn() if a is None else a, version)

    return seed


def _given(real: Callable[..., Any], count: int, made: Callable[[], object]) -> Callable[..., Any]:
    """As a function of `time`, whose last argument, after `count` others, is made now if it is left out or None."""

    def called(*args: Any) -> Any:
        return real(*args[:count], made() if args[count:] in ((), (None,)) else args[count])

    return called


def _now(
    wall: Callable[[], float], kind: type[datetime.datetime], tz: datetime.tzinfo | None = None
) -> datetime.datetime:
    """In place of `datetime.now`: what virtual time shows in the zone `tz`."""
    return kind.fromtimestamp(wall(), tz)


def _utcnow(wall: Callable[[], float], kind: type[datetime.datetime]) -> datetime.datetime:
    """In place of `datetime.utcnow`, which Python advises against from 3.12 on."""
    if sys.version_info >= (3, 12):
        text = "datetime.datetime.utcnow() is deprecated: use datetime.datetime.now(datetime.UTC)"
        warnings.warn(text, DeprecationWarning, stacklevel=3)
    return kind.fromtimestamp(wall(), datetime.UTC).replace(tzinfo=None)


def _nothing() -> None:
    """What seeds a generator in a thread that is not the run's."""


def _in_ns(made: Callable[[], float]) -> Callable[[], int]:
    return lambda: round(made() * 1e9)


def _is_ours(function: Any) -> bool:
    """Whether a function is of this library, whose threads are waited for, and no news."""
    code = getattr(getattr(function, "__func__", function), "__code__", None)
    return code is not None and is_file_of_library(code.co_filename)


def _kind_of_file(fd: Any) -> str:
    """What a loop watches, in words."""
    try:
        mode = os.fstat(fd if isinstance(fd, int) else fd.fileno()).st_mode
    except (OSError, ValueError):
        return "a file or socket"
    return "a pipe" if stat.S_ISFIFO(mode) else "a socket" if stat.S_ISSOCK(mode) else "a file"


def _name(function: Any) -> str:
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', repr(function))}"


def shown_address(body: bytes) -> str | None:
    """Of which class the object is whose address is shown in a value's bytes; None: of nothing that lives.

    To find out whether it lives takes milliseconds, and is done only where there is such a text. Objects that the
    collector does not know, such as those of `object` itself, are not found.

    >>> class Account: ...
    >>> account = Account()
    >>> shown_address(f"opened {account}".encode()), shown_address(b"<Account object at 0x10>")
    ('Account', None)
    """
    addresses = {int(number, 16) for number in SHOWN.findall(body)}
    if not addresses:
        return None
    return next((type(one).__qualname__ for one in gc.get_objects() if id(one) in addresses), None)
