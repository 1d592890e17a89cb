"""A pytest plugin that reports where a test hangs: every thread, task and waiting turn.

A pytest plugin, for `pytest_plugins = ["holdfast.testing.hanging"]` in a conftest.py. It goes by pytest's own option
`faulthandler_timeout`, and adds three things. pytest prints the stacks of threads only, which for a program of tasks
is that of the event loop. An async test that hangs is cancelled when that was told: it fails, and the run goes on. And
pytest's limit ends with the first failure: a teardown behind a test that has failed, or that hangs itself, would hang
for ever; here each teardown has the time anew.
"""

from __future__ import annotations

import asyncio
import faulthandler
import gc
import os
from collections.abc import Generator
from contextlib import contextmanager
from typing import TypeVar

import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key

T = TypeVar("T")

SOONER = 0.9
"""We tell, and cancel, at this part of the time; then pytest prints its own, and ends the run if it is to."""


def what_waits() -> str:
    """The tasks of every event loop, and the turns of every node, with their stacks. Called from any thread."""
    from ..actors.kernel.node import Node  # pytest loads plugins before coverage begins to measure.
    from ..actors.turn_stacks import blocked_below, stack_of

    found = gc.get_objects()
    lines: list[str] = []
    for loop in [one for one in found if isinstance(one, asyncio.AbstractEventLoop) and not one.is_closed()]:
        for task in asyncio.all_tasks(loop):
            lines.append(f"task {task.get_name()}:")
            coroutine = task.get_coro()
            lines.extend(stack_of(coroutine) if asyncio.iscoroutine(coroutine) else ())
    nodes = [one for one in found if isinstance(one, Node) and not one.loop.is_closed()]
    roots = [node.root for node in nodes if node.root is not None and not node.root.is_dead]
    lines.extend(blocked_below(root) or f"no turn waits below {root.path}" for root in roots)
    return "\n".join(lines)


def cancel(function: str) -> None:
    """Cancel a test: the tasks of all event loops that run the coroutine of this function. Called from any thread."""
    loops = [one for one in gc.get_objects() if isinstance(one, asyncio.AbstractEventLoop) and one.is_running()]
    for loop in loops:
        for task in asyncio.all_tasks(loop):
            if getattr(task.get_coro(), "__name__", "") == function:
                loop.call_soon_threadsafe(task.cancel, "the test hangs")


@contextmanager
def watched(item: pytest.Item, what: str) -> Generator[None, None, None]:
    """Tell what waits if this takes nearly as long as it may."""
    from .threads import Onlooker

    seconds = float(item.config.getini("faulthandler_timeout") or 0.0)
    if seconds <= 0 or item.config.getoption("usepdb"):
        yield
        return
    target = item.config.stash[fault_handler_stderr_fd_key]

    def tell() -> None:
        os.write(target, f"\n{item.nodeid}: {what} hangs\n{what_waits()}\n".encode())
        if what == "the test":
            cancel(item.name.partition("[")[0])

    timer = Onlooker(seconds * SOONER, tell)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, T, T]:
    """The test itself."""
    with watched(item, "the test"):
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, T, T]:
    """What comes behind it."""
    seconds = float(item.config.getini("faulthandler_timeout") or 0.0)
    if seconds > 0 and not item.config.getoption("usepdb"):
        ends = bool(item.config.getini("faulthandler_exit_on_timeout"))
        faulthandler.dump_traceback_later(seconds, file=item.config.stash[fault_handler_stderr_fd_key], exit=ends)
    with watched(item, "the teardown"):
        return (yield)
