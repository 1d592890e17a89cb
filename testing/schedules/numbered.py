"""Gives the sets that asyncio and anyio keep the same order in each run.

Tasks are in sets there, and sets of them come back: `asyncio.wait`, `all_tasks`, the children that a `TaskGroup`
cancels. By default the order of such a set is that of the addresses of objects, which no seed decides. Here tasks and
futures have the hash of a counter.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from queue import Queue
from typing import Any, TypeVar

T = TypeVar("T")


class NumberedFuture(asyncio.Future[T]):
    """A future of a simulated run."""

    __slots__ = ("number",)

    number: int

    def __hash__(self) -> int:
        return self.number


class NumberedTask(asyncio.Task[T]):
    """A task of a simulated run."""

    __slots__ = ("number",)

    def __init__(self, number: int, *args: Any, **options: Any) -> None:
        self.number = number  # First: the task is put into a set while it is made.
        super().__init__(*args, **options)

    def __hash__(self) -> int:
        return self.number


class InOrder(dict[T, None]):
    """As a set, but in the order in which its members were added."""

    def add(self, member: T) -> None:
        """Put a member last, if it is none."""
        self.setdefault(member)

    def discard(self, member: T) -> None:
        """Take a member out, if it is one."""
        self.pop(member, None)

    def remove(self, member: T) -> None:
        """Take a member out."""
        del self[member]


def scope_in_order(real: Callable[..., None]) -> Callable[..., None]:
    """As the `__init__` of a cancel scope of anyio; it cancels those inside of it in the order of their entry."""

    def made(scope: Any, *args: Any, **options: Any) -> None:
        real(scope, *args, **options)
        scope._child_scopes = InOrder()

    return made


class NumberingQueue(Queue[Any]):
    """The work of a thread of anyio; the future of each piece has its number from when it was given."""

    def __init__(self, number: Callable[[asyncio.Future[Any]], None]) -> None:
        super().__init__(2)  # as anyio's
        self._number = number

    def put_nowait(self, item: Any) -> None:
        if item is not None:  # None ends the thread.
            self._number(item[3])
        super().put_nowait(item)


def numbering(real: Callable[..., None], number: Callable[[asyncio.Future[Any]], None]) -> Callable[..., None]:
    """As the `__init__` of a thread of anyio, whose work is numbered."""

    def made(thread: Any, *args: Any, **options: Any) -> None:
        real(thread, *args, **options)
        thread.queue = NumberingQueue(number)

    return made


def as_completed(real: Any, awaitables: Any, *, timeout: float | None = None) -> Any:
    """As `asyncio.as_completed`, but the tasks for coroutines are made in the order in which these are given."""
    if asyncio.isfuture(awaitables) or asyncio.iscoroutine(awaitables):
        return real(awaitables, timeout=timeout)  # It says what is wrong.
    return real([asyncio.ensure_future(one) for one in dict.fromkeys(awaitables)], timeout=timeout)
