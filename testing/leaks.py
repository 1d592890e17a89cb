"""Leaks: tasks, child processes and open descriptors that a test leaves behind."""

from __future__ import annotations

import asyncio
import gc
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import psutil

GRACE = 5.0
"""Real seconds that processes told to end may take."""
TASK_GRACE = 10
"""Turns of the loop that a cancelled task may take to end."""
FD_SLACK = 4
"""Descriptors that a library may open at its first use and keep."""
OPEN_FILES = Path("/proc/self/fd")


class TaskLeaks:
    """The tasks that there were at the beginning, so that what is more at the end is a leak.

    Made before the code under test begins, in the same loop.
    """

    def __init__(self) -> None:
        try:
            self._tasks = asyncio.all_tasks()
        except RuntimeError:  # No loop runs: tasks are looked for by whoever runs in one.
            self._tasks = set[asyncio.Task[object]]()

    async def told(self) -> list[str]:
        """What is left in this loop, as problems."""
        return [f"a task was left running: {text}" for text in await self.tasks()]

    async def tasks(self) -> list[str]:
        """Tasks that are not ours and still run after a few turns of the loop."""
        for _ in range(TASK_GRACE):
            if not self._new_tasks():
                break
            await asyncio.sleep(0)
        return [repr(task) for task in self._new_tasks()]

    def _new_tasks(self) -> set[asyncio.Task[object]]:
        return asyncio.all_tasks() - self._tasks - {asyncio.current_task()}


class Leaks(TaskLeaks):
    """As TaskLeaks, with child processes and open descriptors."""

    def __init__(self) -> None:
        super().__init__()
        self._children = set(children())
        self._files = open_files()

    def outside(self) -> list[str]:
        """What is left outside of the loop, as problems."""
        return [
            *(f"a process was left running: {text}" for text in self.processes()),
            *(f"a descriptor was left open: {text}" for text in self.files()),
        ]

    def processes(self) -> list[str]:
        """Child processes that did not end in time; they are killed."""
        return end_processes(lambda: [child for child in children() if child not in self._children])

    def files(self) -> list[str]:
        """What is open and was not, if it is more than a library's few."""
        if open_files().total() > self._files.total() + FD_SLACK:
            gc.collect()  # What only a reference cycle holds is no leak.
            grown = open_files() - self._files
            if open_files().total() > self._files.total() + FD_SLACK:
                return sorted(grown.elements())
        return []


def open_files() -> Counter[str]:
    """What is open, by target; empty where there is no /proc."""
    try:
        return Counter(_target(link) for link in OPEN_FILES.iterdir())
    except FileNotFoundError:
        return Counter()


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except FileNotFoundError:  # the descriptor of the listing itself
        return "/proc"


def children() -> list[psutil.Process]:
    """Our living descendants.

    By the kernel's own lists of children, where it keeps them: psutil reads every process of the machine, which is too
    slow to be done twice for each test.
    """
    if not any(Path("/proc/self/task").glob("*/children")):
        return [child for child in psutil.Process().children(recursive=True) if is_of_test(child)]
    found = _children_of("self")
    for pid in found:  # It grows meanwhile.
        found += _children_of(str(pid))
    living: list[psutil.Process] = []
    for pid in found:
        try:
            living.append(psutil.Process(pid))
        except psutil.Error:
            pass
    return [child for child in living if is_of_test(child)]


def _children_of(pid: str) -> list[int]:
    found: list[int] = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += map(int, path.read_text().split())
        except OSError:  # a thread, or all of it, ended meanwhile
            pass
    return found


def is_of_test(child: psutil.Process) -> bool:
    """Tell a test's process from the resource tracker, which multiprocessing keeps until the interpreter ends."""
    try:
        return child.is_running() and "multiprocessing.resource_tracker" not in " ".join(child.cmdline())
    except psutil.Error:
        return False


def end_processes(find: Callable[[], Iterable[psutil.Process]]) -> list[str]:
    """Give the processes that `find` finds time to end, kill the rest, and say which those were."""
    deadline = time.monotonic() + GRACE
    while (left := list(find())) and time.monotonic() < deadline:
        psutil.wait_procs(left, timeout=0.05)
    described: list[str] = []
    for process in left:
        try:
            described.append(f"{process.pid} {process.status()} {' '.join(process.cmdline())}")
            process.kill()
        except psutil.Error:
            pass
    psutil.wait_procs(left, timeout=1.0)
    return described
