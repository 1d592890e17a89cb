"""What a program prints as messages to an actor, of which only so many are on their way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from ...actors.errors import AskFailed, RemoteCrash, SendError, SpecError
from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...actors.kernel.ref import ActorRef
from .awaited_jobs import FOREVER

MOST = 100
"""Lines of one program that its receiver has not handled; at so many the program has to wait."""


class ProgramLine(Message[None]):
    """A line that a program has printed: its address, "stdout" or "stderr", and the text without its end."""

    program: str
    stream: str
    text: str


def receiver_in(where: str, lines_to: ActorRef[Any] | str | None) -> str | None:
    """An address, or a name that somebody is registered by. Raises SpecError."""
    path = lines_to.path if isinstance(lines_to, ActorRef) else lines_to
    if path is not None and (not isinstance(path, str) or not path):
        raise SpecError(where, f"lines_to must be a ref, an address or a registered name, not {lines_to!r}")
    return path


class LineSender:
    """Sends lines to whoever lives at an address, or has a name, when they come.

    A line is an ask, so that it is known when it has been handled: a program that prints faster waits. What nobody can
    take is a dead letter, and the program goes on.

    Args:
        cell: the program's own actor.
        to: an address, or a registered name.
        hold: have the program wait.
        go_on: have it go on.
    """

    def __init__(self, cell: Cell, to: str, hold: Callable[[], None], go_on: Callable[[], None]) -> None:
        self._cell, self._to, self._hold, self._go_on = cell, to, hold, go_on
        self._waiting = 0

    def check(self) -> None:
        """Refuse a receiver that is known and cannot take lines.

        Raises:
            UnknownMessage: its class has no handler for them. SpecError: names are not known in this process.
        """
        if not self._to.startswith("/") and self._cell.node.ports.uplink is not None:
            raise SpecError(self._cell.path, f"the name {self._to!r} is known in the root only: say an address")
        self._receiver().require(self._line("stdout", ""))

    def send(self, stream: str, text: str) -> None:
        """Send a line, and count it until the receiver has handled it."""
        node, to, line = self._cell.node, self._receiver(), self._line(stream, text)
        try:  # As from outside: it is no turn of ours, and waits for none.
            reply = node.base_context.copy().run(to.ref.ask, line, FOREVER)
        except SendError as error:
            node.dead_letter(to, line, str(error))
            return
        self._waiting += 1
        if self._waiting >= MOST:
            self._hold()
        reply.add_done_callback(lambda done: self._over(to, line, done))

    def _over(self, to: Cell, line: ProgramLine, done: asyncio.Future[None]) -> None:
        """A line was handled, or never will be."""
        self._waiting -= 1
        if self._waiting <= MOST // 2:
            self._go_on()
        error = None if done.cancelled() else done.exception()
        if error is not None and not isinstance(error, (AskFailed, RemoteCrash)):  # Those are told by who has crashed.
            to.node.dead_letter(to, line, str(error))

    def _receiver(self) -> Cell:
        node = self._cell.node
        if self._to.startswith("/"):
            return node.cell_at(self._to)
        return node.names.get(self._to) or node.nowhere(self._to)

    def _line(self, stream: str, text: str) -> ProgramLine:
        return ProgramLine(self._cell.path, stream, text)
