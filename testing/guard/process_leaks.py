"""Child processes that a test leaves running: which of ours they are, and their end."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable
from time import monotonic

import psutil

from ..library_code import is_file_of_library
from .leaks import descendants

GRACE = 5.0
"""Real seconds that the library's own processes may take to end."""
SHORT_GRACE = 1.0
"""Real seconds that a process of the test's may take: one that it has told to end, and not waited for."""


def children() -> list[psutil.Process]:
    """Our living descendants.

    By the kernel's own lists of children, where it keeps them: psutil reads every process of the machine, which is too
    slow to be done twice for each test.
    """
    if (found := descendants()) is None:
        return [child for child in all_children() if is_of_test(child)]
    living: list[psutil.Process] = []
    for pid in found:
        try:
            living.append(psutil.Process(pid))
        except psutil.Error:
            pass
    return [child for child in living if is_of_test(child)]


def all_children() -> list[psutil.Process]:
    """Our descendants, from a look at every process of the machine."""
    return psutil.Process().children(recursive=True)


def is_of_test(child: psutil.Process) -> bool:
    """Tell a test's process from the resource tracker, which multiprocessing keeps until the interpreter ends."""
    try:
        return child.is_running() and "multiprocessing.resource_tracker" not in " ".join(child.cmdline())
    except psutil.Error:
        return False


def is_of_library(child: psutil.Process) -> bool:
    """Whether a process is one of the library's own (a fork server, what it has forked, a reaper with its program)."""
    try:
        line = itertools.takewhile(lambda process: process.pid != os.getpid(), (child, *child.parents()))
        return any(is_file_of_library(word) for process in line for word in process.cmdline())
    except psutil.Error:
        return False


def end_processes(find: Callable[[], Iterable[psutil.Process]], grace: float | None = None) -> list[str]:
    """Give the processes that `find` finds time to end, kill the rest, and say which those were.

    Args:
        grace: seconds for those that are not the library's own; SHORT_GRACE if it is not said.
    """
    short = SHORT_GRACE if grace is None else grace
    began = monotonic()
    described: list[str] = []
    killed: list[psutil.Process] = []
    while left := [process for process in find() if process not in killed]:
        passed = monotonic() - began
        late = [one for one in left if passed >= GRACE or (passed >= short and not is_of_library(one))]
        for process in late:
            try:
                described.append(f"{process.pid} {process.status()} {' '.join(process.cmdline())}")
                process.kill()
            except psutil.Error:
                pass
        killed += late
        psutil.wait_procs(left, timeout=0.05)
    psutil.wait_procs(killed, timeout=1.0)
    return described
