"""What a program prints as messages to an actor, of which only so many are on their way."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from ...actors.errors import ActorStopped, AskFailed, RemoteCrash, SendError, SpecError
from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...actors.kernel.ref import ActorRef
from .awaited_jobs import FOREVER

MOST = 100
"""Lines of one program that its receiver has not handled; at so many the program has to wait."""

MOST_KEPT, MOST_KEPT_CHARACTERS = 1_000, 1_000_000
"""Lines that are kept for a receiver that was not there yet, and their characters; of more, the oldest are lost."""
PATIENCE = 10.0
"""Seconds for which they are kept."""
LOOK_AGAIN = 0.02
"""Seconds between two looks whether the receiver is there."""


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


@dataclasses.dataclass(slots=True)
class FirstLines:
    """Lines that wait for a receiver that was not there yet.

    Attributes:
        until: when they are given up, on the loop's clock.
        lines: oldest first.
        characters: in them.
        is_trying: the oldest is out, or is sent soon.
    """

    until: float
    lines: deque[ProgramLine] = dataclasses.field(default_factory=deque[ProgramLine])
    characters: int = 0
    is_trying: bool = False

    def add(self, line: ProgramLine) -> None:
        """Keep one more line, behind the others."""
        self.lines.append(line)
        self.characters += len(line.text)

    def surplus(self) -> Iterator[ProgramLine]:
        """Take out those that are too many, oldest first."""
        while len(self.lines) > MOST_KEPT or (self.characters > MOST_KEPT_CHARACTERS and len(self.lines) > 1):
            yield self.take()

    def take(self) -> ProgramLine:
        """Take out the line that was kept first."""
        line = self.lines.popleft()
        self.characters -= len(line.text)
        return line

    def put_back(self, line: ProgramLine) -> None:
        """It is the oldest again."""
        self.lines.appendleft(line)
        self.characters += len(line.text)


class LineSender:
    """Sends lines to whoever lives at an address, or has a name, when they come.

    A line is an ask, so that it is known when it has been handled: a program that prints faster waits. Until the
    receiver is there for the first time lines are kept, for a while. Later, what nobody can take is a dead letter, and
    the program goes on.

    Args:
        cell: the program's own actor.
        to: an address, or a registered name.
        hold: have the program wait.
        go_on: have it go on.
    """

    def __init__(self, cell: Cell, to: str, hold: Callable[[], None], go_on: Callable[[], None]) -> None:
        self._cell, self._to, self._hold, self._go_on = cell, to, hold, go_on
        self._waiting = 0
        self._first: FirstLines | None = FirstLines(cell.node.loop.time() + PATIENCE)

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
        line, first = self._line(stream, text), self._first
        if first is None:
            self._ask(line, self._over)
            return
        first.add(line)
        if not first.is_trying:
            self._try(first)
        if not self._waiting:
            to = self._receiver()
            for lost in first.surplus():
                to.node.dead_letter(to, lost, str(ActorStopped(to.path, "nobody has lived there yet")))
        elif len(first.lines) >= MOST:  # The oldest is out, and it is known soon whether anybody is there.
            self._hold()

    def _try(self, first: FirstLines) -> None:
        """Send all that is kept if the receiver is there; from another process that is known by the oldest line."""
        is_there = self._cell.node.ports.uplink is None and not self._receiver().is_dead
        first.is_trying = True
        if is_there:
            self._send_kept(first)
        else:
            self._ask(first.take(), self._tried)

    def _tried(self, to: Cell, line: ProgramLine, error: BaseException | None) -> None:
        first, loop = self._first, self._cell.node.loop
        assert first is not None
        root = to.node.root
        is_over = (root is not None and root.is_dead) or loop.time() >= first.until
        if isinstance(error, ActorStopped) and not is_over:
            first.put_back(line)
            loop.call_later(LOOK_AGAIN, self._try, first, context=to.node.base_context.copy())
            return
        self._over(to, line, error)
        self._send_kept(first)

    def _send_kept(self, first: FirstLines) -> None:
        self._first = None
        for line in first.lines:
            self._ask(line, self._over)

    def _ask(self, line: ProgramLine, over: Callable[[Cell, ProgramLine, BaseException | None], None]) -> None:
        """Ask the receiver, as from outside: it is no turn of ours, and waits for none."""
        node, to = self._cell.node, self._receiver()

        def done(reply: asyncio.Future[None]) -> None:
            self._waiting -= 1
            if self._waiting <= MOST // 2:
                self._go_on()
            over(to, line, None if reply.cancelled() else reply.exception())

        try:
            reply = node.base_context.copy().run(to.ref.ask, line, FOREVER)
        except SendError as error:
            over(to, line, error)
            return
        self._waiting += 1
        if self._waiting >= MOST:
            self._hold()
        reply.add_done_callback(done)

    def _over(self, to: Cell, line: ProgramLine, error: BaseException | None) -> None:
        """A line was handled, or never will be."""
        if error is not None and not isinstance(error, (AskFailed, RemoteCrash)):  # Those are told by who has crashed.
            to.node.dead_letter(to, line, str(error))

    def _receiver(self) -> Cell:
        node = self._cell.node
        if self._to.startswith("/"):
            return node.cell_at(self._to)
        return node.names.get(self._to) or node.nowhere(self._to)

    def _line(self, stream: str, text: str) -> ProgramLine:
        return ProgramLine(self._cell.path, stream, text)
