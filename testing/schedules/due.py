"""The due callbacks of a loop, and which of them may be called next.

What asyncio promises is kept. Callbacks that are no steps of tasks are called in the order in which they were
scheduled, and before the steps of tasks that were scheduled after them; a task's steps are in order among themselves.
A turn that hears one outcome after another has as much time between two as in production: who tells it of them comes
behind all steps that were scheduled before.
"""

from __future__ import annotations

import asyncio
from collections.abc import Hashable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from ...actors.kernel.node import Node
from ...checkpoint.life.outcome_order import OutcomeOrder
from .places import is_dead, lane_of

if TYPE_CHECKING:
    from .reduction.watch import StepWatch

Option = tuple[Hashable, asyncio.Handle, bool]
"""Whose step it is (a node, a task, a timer, or the lane of other callbacks), what is called, and whether its place
among the others matters."""
STEPS = (None, "task_wakeup", "__step", "__wakeup")
"""How the methods of a task are named that go on with it, in C and in Python."""


class Fence(NamedTuple):
    """Whose step it is that comes behind all that was scheduled before it: a lane."""

    lane: Hashable


class TellingHandle(asyncio.Handle):
    """A callback of a controlled loop, which hears of it when one is cancelled, and need not look at each."""

    __slots__ = ()

    def cancel(self) -> None:
        loop: Any = self._loop  # type: ignore[attr-defined]  # no stub has it
        loop.due.has_cancelled = True
        super().cancel()


class Chooser(Protocol):
    """Decides which callback is called next."""

    def choose_callback(self, due: DueQueue) -> Option:
        """One of those that are due."""
        ...

    def called(self, option: Option) -> None:
        """A callback was taken, and is called now."""
        ...

    def meet(self, node: Node) -> None:
        """The actors of a node have something to do: for the first time, perhaps."""
        ...


class DueQueue:
    """Stands in for the queue of an asyncio loop: who takes the next callback gets the one that was chosen.

    Attributes:
        chooser: who chooses; None: they come in order.
        is_told: whether it hears of each callback that is called.
        has_dead: whether places have died. What is scheduled for them later must not run either.
        has_cancelled: whether some that are due may have been cancelled.
        watch: hears of each callback that is scheduled; None: nobody does.
        nodes: how many of them are of nodes.
        options: all that are due, in order.
    """

    def __init__(self) -> None:
        self.chooser: Chooser | None = None
        self.watch: StepWatch | None = None
        self.is_told = False
        self.has_dead = self.has_cancelled = False
        self.nodes = 0
        self.options: list[Option] = []
        self._ordered = 0  # so many of them have a place that matters
        self._silent = 0  # so many of them tell nobody when they are cancelled

    def append(self, handle: Any) -> None:
        """Put a callback last."""
        callback = handle._callback
        owner = getattr(callback, "__self__", None)
        key: Hashable
        if isinstance(owner, asyncio.Task):
            key, has_place = owner, getattr(callback, "__name__", None) not in STEPS
        elif type(owner) is Node:
            key, has_place = owner, False
            self.nodes += 1
        elif type(handle) is asyncio.TimerHandle:
            key, has_place = handle, False
        else:
            lane = lane_of(handle)
            key, has_place = Fence(lane) if type(owner) is OutcomeOrder else lane, True
        self._ordered += has_place
        if type(handle) is not TellingHandle:
            self._silent += 1
        self.options.append((key, handle, has_place))
        if self.watch is not None:
            self.watch.made(key, handle, has_place)
        if self.has_dead and is_dead(handle):
            handle.cancel()
        elif type(owner) is Node and self.chooser is not None:
            self.chooser.meet(owner)

    def popleft(self) -> asyncio.Handle:
        """Take the callback that is called next."""
        options, chooser = self.options, self.chooser
        if chooser is None or len(options) == 1:
            chosen = options.pop(0)
        else:
            chosen = chooser.choose_callback(self)
            for index, option in enumerate(options):
                if option is chosen:
                    del options[index]
                    break
        if self.is_told and chooser is not None:
            chooser.called(chosen)
        key, handle, has_place = chosen
        self._ordered -= has_place
        if type(key) is Node:
            self.nodes -= 1
        if type(handle) is not TellingHandle:
            self._silent -= 1
        return handle

    def next_options(self) -> list[Option]:
        """Those that may be called next. The list is not to be changed."""
        if not self._ordered:
            if not (self._silent or self.has_cancelled):
                return self.options
            living = [option for option in self.options if not option[1]._cancelled]
            self.has_cancelled = len(living) < len(self.options)
            return living
        found: list[Option] = []
        tasks: set[int] = set()
        lanes: set[Hashable] = set()
        for option in self.options:
            key, handle, has_place = option
            if handle.cancelled():
                continue
            if isinstance(key, asyncio.Task):
                # A step that is in the queue behind a callback comes after it, in production too.
                if id(key) not in tasks and not (lanes and lane_of(handle) in lanes):
                    found.append(option)
                tasks.add(id(key))
            elif not has_place:
                found.append(option)
            elif type(key) is Fence:
                if not (tasks or lanes):
                    found.append(option)
                lanes.add(key.lane)
            elif key not in lanes:
                lanes.add(key)
                found.append(option)
        return found

    def clear(self) -> None:
        """Forget all of them."""
        self.options.clear()
        self._ordered = self._silent = self.nodes = 0

    def __iter__(self) -> Iterator[asyncio.Handle]:
        return (handle for _, handle, _ in self.options)

    def __len__(self) -> int:
        return len(self.options)
