"""Leaks: tasks, timers, threads, child processes and open descriptors that a test leaves behind."""

from __future__ import annotations

import gc
import operator
import os
import signal
import stat
import sys
import sysconfig
import threading
import weakref
from collections.abc import Callable, Collection
from typing import Any, ClassVar

from .handlers import handlers
from .loop_leaks import LoopLeaks
from .thread_leaks import ThreadLeaks

TOLD = {
    "processes": "process was left running",
    "threads": "thread was left running",
    "descriptors": "descriptor was left open",
    "signals": "handler of a signal was left",
}
OPEN_FILES = "/proc/self/fd"
FILE: Callable[[os.stat_result], tuple[int, int]] = operator.itemgetter(stat.ST_DEV, stat.ST_INO)
"""Which file a descriptor is of."""
RANDOM = ("/dev/urandom", "/dev/random")
PAGES = ("-hands", "-hands (deleted)")
"""Of a SQLite store: mapped until the last life is gone that has a word in it (`checkpoint/sqlite/in_hand.py`)."""
INSTALLED = tuple({f"{sysconfig.get_paths()[name]}/" for name in ("stdlib", "purelib", "platlib")})
KEPT = (
    ("multiprocessing.resource_tracker", "_resource_tracker", "_fd"),
    ("multiprocessing.forkserver", "_forkserver", "_forkserver_alive_fd"),
)
"""Modules that keep a descriptor to the end of the process: the object that has it, and its attribute."""


class Leaks(LoopLeaks):
    """As LoopLeaks, with child processes, threads, open descriptors and handlers of signals."""

    _with_reserve: ClassVar[weakref.WeakKeyDictionary[Any, int]] = weakref.WeakKeyDictionary()  # as loops outlive tests

    _likely: ClassVar[tuple[int, ...]] = ()  # the descriptors that were open when the last test began

    def __init__(self, allowed: Collection[str] = ()) -> None:
        super().__init__(allowed)
        self._threads = ThreadLeaks()
        self._children = pids()
        self._handlers = handlers()
        self._files = identities(Leaks._likely)
        Leaks._likely = (*self._files,)

    def outside(self) -> list[str]:
        """What is left outside of the loop, as problems."""
        left = {
            "processes": self.processes,
            "threads": self.threads,
            "descriptors": self.files,
            "signals": self.signals,
        }
        return [
            f"a {TOLD[kind]}: {text}" for kind, look in left.items() if kind not in self._allowed for text in look()
        ]

    def processes(self) -> list[str]:
        """Child processes that did not end in time; they are killed."""
        if pids() <= self._children:
            return []
        from .process_leaks import children, end_processes  # It takes psutil, which few tests need.

        return end_processes(lambda: [child for child in children() if child.pid not in self._children])

    def threads(self) -> list[str]:
        """Threads that the test has started, and that do not end."""
        return self._threads.told()

    def signals(self) -> list[str]:
        """Signals that are handled in another way than before."""
        now = handlers()
        return [
            f"{number.name} calls {now[number]!r}" for number, before in self._handlers.items() if now[number] != before
        ]

    def lost_in_threads(self) -> list[str]:
        """Exceptions that have ended threads, as problems."""
        hint = "catch it, or if it is meant to be: actor_system.expect_exceptions()"
        return [f"an exception has ended a thread: {text}; {hint}" for text in self._threads.lost]

    def files(self) -> list[str]:
        """What is open and was not."""
        if not self._opened():
            return []
        gc.collect()  # What only a reference cycle holds is no leak.
        return sorted(self._opened().values())

    def _opened(self) -> dict[int, str]:
        found = identities(self._files)
        if found == self._files:
            return {}
        new = [number for number, file in found.items() if self._files.get(number) != file]
        targets = open_files() if new else {}
        opened = {
            number: targets[number] for number in new if number in targets and not is_kept(number, targets[number])
        }
        if opened and type(self._loop).__module__.partition(".")[0] == "uvloop":
            for number in (*self._reserve(opened), *of_uvloop(opened)):
                opened.pop(number, None)
        return opened

    def _reserve(self, opened: dict[int, str]) -> list[int]:
        """The one /dev/null that uvloop opens with the first stream of each loop, as a reserve."""
        if self._loop not in self._with_reserve:
            found = next((number for number, target in opened.items() if target == "/dev/null"), None)
            if found is None:
                return []
            self._with_reserve[self._loop] = found
            return [found]
        return [number for number in opened if number == self._with_reserve[self._loop]]

    def close(self) -> None:
        """Note nothing any more."""
        super().close()
        self._threads.close()


def identities(likely: Collection[int] = ()) -> dict[int, tuple[int, int]]:
    """Which file is open, by number: its device and inode, which are read in a third of the time of its name.

    The likely numbers are tried first: if as many are open as the kernel counts (Linux from 6.2 on), there are no
    others, and its list, which takes as long as all the rest, need not be read.
    """
    try:
        count = os.stat(OPEN_FILES).st_size
        found = _identified(likely) if count else {}
        return found if len(found) == count > 0 else _identified([*map(int, os.listdir(OPEN_FILES))])
    except FileNotFoundError:  # There is no /proc.
        return {}


def _identified(numbers: Collection[int]) -> dict[int, tuple[int, int]]:
    try:
        return dict(zip(numbers, map(FILE, map(os.fstat, numbers)), strict=True))
    except OSError:  # One of them is not open.
        pass
    found: dict[int, tuple[int, int]] = {}
    for number in numbers:
        try:
            status = os.fstat(number)
        except OSError:  # the descriptor of the listing itself, or it is closed now
            continue
        found[number] = FILE(status)
    return found


def open_files() -> dict[int, str]:
    """What is open, by number; empty where there is no /proc."""
    found: dict[int, str] = {}
    try:
        for name in os.listdir(OPEN_FILES):
            try:
                found[int(name)] = os.readlink(f"{OPEN_FILES}/{name}")
            except FileNotFoundError:  # the descriptor of the listing itself
                pass
    except FileNotFoundError:
        pass
    return found


def is_kept(number: int, target: str) -> bool:
    """Whether a library opens this once and keeps it: a source of random numbers, what multiprocessing talks to its
    own processes through, files of installed packages, and the page of a closed store that a ref still refers to.
    """
    if target in RANDOM or target.startswith(INSTALLED) or target.endswith(PAGES):
        return True
    for module, name, attribute in KEPT:
        holder = getattr(sys.modules.get(module), name, None)
        if getattr(holder, attribute, None) == number:
            return True
    return False


def of_uvloop(opened: dict[int, str]) -> list[int]:
    """The pair of sockets that uvloop makes for signals, anew with each `run_until_complete` of a loop.

    One is the wake-up descriptor, and the inode of the other is its neighbour.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    wake = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    sockets = {number: _inode(target) for number, target in opened.items() if target.startswith("socket:")}
    if wake not in sockets:
        return []
    own = sockets.pop(wake)
    return [wake, *sorted(sockets, key=lambda number: abs(sockets[number] - own))[:1]]


def _inode(target: str) -> int:
    return int(target.partition("[")[2].rstrip("]"))


def pids() -> set[int]:
    """The numbers of our descendants; those that have ended may be among them."""
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:  # There are none, which is told in a tenth of the time of a look at the lists.
        return set()
    found = descendants()
    if found is None:
        from .process_leaks import all_children

        return {child.pid for child in all_children()}
    return set(found)


def descendants() -> list[int] | None:
    """The numbers of our descendants by the kernel's lists; None where it keeps none."""
    found = _children_of("self")
    if found is None:
        return None
    for pid in found:  # It grows meanwhile.
        found += _children_of(str(pid)) or []
    return found


def _children_of(pid: str) -> list[int] | None:
    found: list[int] = []
    try:
        threads = os.listdir(f"/proc/{pid}/task")
    except OSError:
        return None
    for thread in threads:
        try:
            with open(f"/proc/{pid}/task/{thread}/children", "rb", buffering=0) as told:
                found += map(int, told.read().split())
        except FileNotFoundError:
            if not os.path.exists(f"/proc/self/task/{os.getpid()}/children"):
                return None
        except OSError:  # The thread, or all of it, ended meanwhile.
            pass
    return found
