"""Looks now and then for turns that have waited for too long, wherever they run; it tells of them, and ends nothing.

A stop is a turn, too: that of a supervisor waits for its children.

Nothing is measured per message: the looks read what the homes of actors know anyway, as those of `why` do, a
millisecond of the loop at a time.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Awaitable, Callable
from time import perf_counter
from typing import TYPE_CHECKING, Final

from ..errors import HoldfastError
from ..events import StopWaits, TurnWaits
from ..kernel.cell import DOWN, ENDING, GONE, Cell
from .orders import Status

if TYPE_CHECKING:
    from ..kernel.node import Node

LOOKS: Final = 4
"""How often all actors are looked at within the time that a turn may wait."""
SLICE: Final = 0.001
"""Seconds of looking after which the loop lets others run."""
STRIDE: Final = 16
"""Actors between two looks at the clock."""
ANSWERS_WITHIN: Final = 1.0
"""Seconds in which the process of an actor says what its turn waits for."""
RESTS: Final = ("sleep", "wait")
"""What a turn may wait for as long as it has said itself: `ctx.sleep`, `ctx.wait_for`."""


@dataclasses.dataclass(slots=True)
class WaitSeen:
    """A turn that was found at a look.

    Attributes:
        mark: what it is known by.
        since: when it began, or was found, on the loop clock.
        look_at: when its process is asked for how long it has taken.
        due: seconds from which on it is told of.
    """

    mark: object
    since: float
    look_at: float
    due: float


class WaitWatch:
    """Tells of turns that take longer than a limit with all that they wait for. Off unless it is asked for.

    Args:
        node: whose actors.
        limit: seconds; None: nobody looks.
        ask: gets the status of an actor within so many seconds, from its process if it has one.
    """

    def __init__(self, node: Node, limit: float | None, ask: Callable[[Cell, float], Awaitable[Status]]) -> None:
        self._node, self._limit, self._ask = node, limit, ask
        self._seen: dict[Cell, WaitSeen] = {}
        self._task: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Begin to look, if there is a limit; each look is a small part of that apart."""
        if self._limit is not None:
            node = self._node
            work = self._look_on(self._limit)
            self._task = node.loop.create_task(work, name="watch of waits", context=node.base_context.copy())

    def close(self) -> None:
        """Look no more; a look that is under way is given up."""
        if self._task is not None:
            self._task.cancel()

    async def _look_on(self, limit: float) -> None:
        while True:
            await asyncio.sleep(limit / LOOKS)
            for cell in await self._overdue(limit):
                await self._tell(cell)

    async def _overdue(self, limit: float) -> list[Cell]:
        """Look at all actors; whose turn is to be told of."""
        root, found, seen = self._node.root, list[Cell](), dict[Cell, WaitSeen]()
        waiting, begin, number = [] if root is None else [root], perf_counter(), 0
        while waiting:
            cell = waiting.pop()
            waiting.extend((cell.children or {}).values())
            if cell.state is not GONE and (one := self._look_at(cell, limit)) is not None:
                seen[cell] = one
                if self._node.loop.time() >= one.look_at:
                    found.append(cell)
            number += 1
            if number % STRIDE == 0 and perf_counter() - begin > SLICE:
                await asyncio.sleep(0)
                begin = perf_counter()
        self._seen = seen
        return found

    def _look_at(self, cell: Cell, limit: float) -> WaitSeen | None:
        """The turn that an actor is in, as it was found before if it is the same; None: it is in none, or may wait."""
        work, before, now = cell.host.work(cell), self._seen.get(cell), self._node.loop.time()
        if not work.is_in_turn or any(rest.kind in RESTS for rest in cell.host.rests(cell)):
            return None
        child = _stopped_first(cell) if cell.state is ENDING else None
        if child is not None and child.state is ENDING and child.host.work(child).is_in_turn:
            return None  # That one tells.
        mark = work.mark, work.since
        if before is not None and before.mark == mark:
            cell.host.ask_turns(cell)  # What its process says is looked at the next time.
            return before
        since, begun = (now, now - limit / 2) if work.since is None else (work.since, work.since)
        return WaitSeen(mark, since, begun + limit, limit)

    async def _tell(self, cell: Cell) -> None:
        seen, node = self._seen[cell], self._node
        try:
            status: Status | None = await self._ask(cell, ANSWERS_WITHIN)
        except HoldfastError:  # Its process is blocked, or has been stopped.
            status = None
        if status is not None and status.turn is None:
            return  # It is over by now.
        now = node.loop.time()
        seconds = now - seen.since if status is None else status.turn_seconds
        if seconds < seen.due:
            seen.look_at = now + seen.due - seconds
            return
        seen.due = 2.0 * seconds
        seen.look_at = now + seconds
        if not node.events.has_listeners:
            return
        message, at, state = (
            ("", "", cell.state) if status is None else (status.turn or "", status.turn_at, status.state)
        )
        if state == ENDING:
            child = _stopped_first(cell)
            node.emit(StopWaits(cell.path, "" if child is None else child.path, seconds, "" if child else at))
        else:
            node.emit(TurnWaits(cell.path, message, seconds, at))


def _stopped_first(cell: Cell) -> Cell | None:
    """Which child a cell that ends waits for: they end one by one, the last one first."""
    living = [child for child in (cell.children or {}).values() if child.state not in (DOWN, GONE)]
    return next((child for child in living if child.state is ENDING), living[-1] if living else None)
