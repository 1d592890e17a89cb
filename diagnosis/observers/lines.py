"""Lines that programs print for an actor (`lines_to=`): diagnosis takes them for a topic of the program."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ...actors.events import Event, LogLine
from ...actors.kernel.cell import Cell
from ...actors.kernel.node import Node
from ...supervision.services.program import Program


def lines_topic(program: str) -> str:
    """The name under which the lines of the program at an address are a topic."""
    return f"{program}.lines"


def told_lines(cell: Cell) -> str | None:
    """The address of whoever is told the lines of this program of this process; None: nobody, or it is none."""
    to = cell.actor.lines_to if isinstance(cell.actor, Program) else None
    if to is None or to.startswith("/"):
        return to
    named = cell.node.names.get(to)
    return None if named is None else named.path


async def hear_lines(node: Node, heard: Callable[[str], None]) -> None:
    """Call `heard` with the program's address for each line that an actor is told; without end."""

    def listen(event: Event) -> None:
        if isinstance(event, LogLine):
            cell = node.find(event.address)
            if cell is not None and isinstance(cell.actor, Program) and cell.actor.lines_to is not None:
                heard(event.address)

    node.events.add_sink(listen)
    try:
        await asyncio.get_running_loop().create_future()
    finally:
        node.events.remove_sink(listen)
