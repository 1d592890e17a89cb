"""The turns of a run, in the order in which they began, and who waits for a number of them."""

from __future__ import annotations

import asyncio
from typing import Any

from ...actors.kernel.cell import NEXT_URGENT, Cell
from ...actors.kernel.envelope import Ask
from ...actors.kernel.message import Message, message_of
from ...actors.kernel.node import Node
from ...checkpoint.life.recorded_inbox import Fed


class TurnLog:
    """Notes each turn in a trace.

    Args:
        trace: (address, what was handled) of each turn; before the address that of which program, if it has a name.
    """

    def __init__(self, trace: list[tuple[str, str]]) -> None:
        self._trace = trace
        self._names: dict[type, str] = {}
        self._places: dict[object, str] = {}  # what is written before the addresses of a node
        self._moments: list[tuple[int, asyncio.Future[None]]] = []  # after so many turns of the run

    @property
    def turns(self) -> int:
        """How many there have been."""
        return len(self._trace)

    def call(self, node: Node, name: str) -> None:
        """The place of a node has this name, or none."""
        if name:
            self._places[node] = f"{name}:"

    def note(self, cell: Cell) -> None:
        """A cell has the next turn."""
        if self._moments:
            self._tell_moments()
        queue = cell.queue
        if queue:
            item = queue[0]
            message: Any = item.message if type(item) is Ask else item
            name = self._names.get(type(message))
            if name is None:
                name = told(cell, item)
                if isinstance(message, Message):
                    self._names[type(message)] = name
            place = self._places.get(cell.node)
            self._trace.append((cell.path if place is None else place + cell.path, name))

    def await_turns(self, turns: int, moment: asyncio.Future[None]) -> None:
        """Have a future done after so many turns, if it is not done before."""
        self._moments.append((len(self._trace) + turns, moment))

    def _tell_moments(self) -> None:
        for number, moment in self._moments:
            if number <= len(self._trace) and not moment.done():
                moment.set_result(None)
        self._moments = [one for one in self._moments if not one[1].done()]


def told(cell: Cell, item: Any) -> str:
    """What a turn handles, in a word or two."""
    if item is NEXT_URGENT:
        commands = cell.more.urgent if cell.more is not None else None
        item = commands[0] if commands else item
    elif isinstance(item, Fed):
        feed = item.feed
        return feed.name.rpartition(":")[2] or feed.kind
    message = message_of(item)
    return type(item if message is None else message).__name__
