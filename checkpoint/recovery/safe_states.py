"""Counts who is in safe state and why: entered with the first recovery, left with the last.

One owner with a count (T27). Each step is taken at once or not at all, so whoever takes it, a receiver is told once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError, MailboxFull, UnknownMessage, type_name
from ...actors.events import SafeStateEntered, SafeStateLeft, SafeStateMissed, SafeStateOverdue
from ...actors.kernel import mailbox
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import DOWN, Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.lifecycle import LOCAL
from ...actors.kernel.node import cell_kind
from ...actors.safe_state import SafeStateChange
from ..home.recorded_home import switch_of
from ..recovery_settings import SafeState

if TYPE_CHECKING:
    from ...actors.kernel.node import Node

Key = tuple[str, tuple[str, bytes] | None, tuple[str, bytes] | None]
"""A receiver, and the messages it is told with."""


class Receiver:
    """One that is safe, or is being told that it is not any more."""

    __slots__ = ("because", "holders", "is_missed", "is_told", "life", "outbox", "path", "timeout", "timer", "words")

    def __init__(self, key: Key, timeout: float) -> None:
        self.path, self.words = key[0], key[1:]
        self.holders: dict[str, None] = {}  # the recoveries that want it to be safe, oldest first
        self.is_missed = False  # whether telling it makes nobody safe
        self.is_told = False  # whether the last word it was given is that it has to be safe
        self.because = ""
        self.timeout = timeout
        self.life = 0
        self.timer: asyncio.TimerHandle | None = None
        self.outbox: list[bool] = []  # what could not be put in its mailbox yet


class Safety:
    """All receivers of a root."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._receivers: dict[Key, Receiver] = {}
        self.on_entered: Callable[[Receiver], None] = lambda receiver: None

    def enter(self, path: str, state: SafeState, timeout: float) -> None:
        """The recovery of `path` wants its receivers to be safe; a second time changes nothing."""
        for to in state.to:
            address = self._address(path, state, to)
            if address is None:
                self._node.emit(SafeStateMissed(to, path, "this binding leads nowhere"))
                continue
            key = address, state.enter, state.leave
            receiver = self._receivers.get(key)
            if receiver is None:
                receiver = self._receivers[key] = Receiver(key, timeout)
            receiver.holders[path] = None
            if not receiver.is_told:
                self._enter(receiver, path)

    def _enter(self, receiver: Receiver, path: str) -> None:
        receiver.is_told, receiver.because = True, path
        receiver.timer = self._node.loop.call_later(receiver.timeout, self._overdue, receiver)
        problem = self._problem(receiver)
        receiver.is_missed = bool(problem)
        self._say(receiver, entered=True)
        self._node.emit(
            SafeStateMissed(receiver.path, path, problem) if problem else SafeStateEntered(receiver.path, path)
        )
        self.on_entered(receiver)

    def _problem(self, receiver: Receiver) -> str:
        """Why telling this receiver makes nobody safe, as far as it is known here; "" if it does."""
        cell = self._node.cell_at(receiver.path)
        if cell.is_dead:
            return "nobody lives there"
        kind, enter = cell_kind(cell), receiver.words[0]
        if kind is None:
            return ""
        if enter is None:
            return f"{type_name(kind)} has no on_safe_state" if kind.on_safe_state is Actor.on_safe_state else ""
        try:
            kind._table.kind_named(enter[0])
        except UnknownMessage as error:
            return str(UnknownMessage(type_name(kind), error.message))
        return ""

    def leave(self, path: str) -> None:
        """The recovery of `path` is over; a second time changes nothing."""
        for key, receiver in list(self._receivers.items()):
            if receiver.holders.pop(path, 0) is None and not receiver.holders:
                del self._receivers[key]
                if receiver.timer is not None:
                    receiver.timer.cancel()
                receiver.because = path
                self._say(receiver, entered=False)
                if not receiver.is_missed:
                    self._node.emit(SafeStateLeft(receiver.path, path))

    def holds(self, path: str) -> tuple[str, ...]:
        """Who is safe because of the recovery of `path`."""
        return tuple(receiver.path for receiver in self._receivers.values() if path in receiver.holders)

    def safe(self) -> list[Receiver]:
        """The receivers that are safe now."""
        return list(self._receivers.values())

    def check(self, receiver: Receiver) -> None:
        """A receiver that keeps no journal and has begun a new life does not know that it has to be safe."""
        if receiver not in self._receivers.values():
            return
        cell = self._node.cell_at(receiver.path)
        ended = cell.state is DOWN or cell.life != receiver.life
        if ended and switch_of(cell) is None:
            self._say(receiver, entered=True, again=True)

    def close(self) -> None:
        """Nobody needs to be told any more."""
        for receiver in self._receivers.values():
            if receiver.timer is not None:
                receiver.timer.cancel()
        self._receivers.clear()

    # -- telling ----------------------------------------------------------------------------------------------------

    def _address(self, path: str, state: SafeState, to: str) -> str | None:
        """Of a receiver that a method names; a binding leads where it leads now."""
        if to.startswith("/"):
            return to
        more = self._node.cell_at(path).more
        bound = more.bindings.get(to) if more is not None else None
        return bound.path if bound is not None else dict(state.ports).get(to)

    def _say(self, receiver: Receiver, *, entered: bool, again: bool = False) -> None:
        if receiver.outbox and not entered:
            receiver.outbox.clear()  # It has not heard of the beginning: it need not hear of the end.
            return
        cell = self._node.cell_at(receiver.path)
        receiver.life = cell.life + (cell.state is DOWN)
        message = self._message(receiver, cell, entered)
        if message is None:
            return
        if again and cell.state is DOWN and cell.host is LOCAL and (cell.more is None or cell.more.bound is None):
            mailbox.put_back(cell, [message])  # Ahead of what it was told to do before.
            return
        try:
            cell.admit(cell, message)
        except MailboxFull:
            receiver.outbox.append(entered)
            self._wait(receiver, cell)
        except HoldfastError as error:
            self._node.dead_letter(cell, message, f"safe state: {error}")

    def _message(self, receiver: Receiver, cell: Cell, entered: bool) -> Any:
        enter, leave = receiver.words
        if enter is None:
            return SafeStateChange(entered, receiver.because, receiver.timeout)
        parcel = enter if entered else leave
        if parcel is None:
            return None
        try:
            return self._node.codec.message_in(cell, *parcel)
        except HoldfastError as error:
            self._node.dead_letter(cell, Parcel(*parcel), f"safe state: {error}")
            return None

    def _wait(self, receiver: Receiver, cell: Cell) -> None:
        """Its mailbox is full: say it when there is room."""
        try:
            room = cell.room()
        except HoldfastError:
            return
        if room is None:
            self._node.loop.call_soon(self._again, receiver)
        else:
            room.add_done_callback(lambda _: self._again(receiver))

    def _again(self, receiver: Receiver) -> None:
        if receiver.outbox:
            entered = receiver.outbox.pop()
            self._say(receiver, entered=entered)

    # -- the dead man's switch --------------------------------------------------------------------------------------

    def _overdue(self, receiver: Receiver) -> None:
        """The receiver's own switch has raised the alarm, if it is told by its hook and has not begun anew since."""
        receiver.timer = None
        cell = self._node.cell_at(receiver.path)
        if receiver.words[0] is not None or cell.life != receiver.life:
            self._node.emit(SafeStateOverdue(receiver.path, receiver.timeout, receiver.because))
