"""Counts who is in safe state and why: entered with the first recovery, left with the last.

One owner with a count (T27). Each step is taken at once or not at all, so whoever takes it, a receiver is told once.
A receiver is an address. Each life that begins there meanwhile is told before it handles a message (T26), and only who
was told of the beginning is told of the end.

A note in the store has those receivers whose journal outlives this program: the next one tells them of the end.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ...actors.errors import HoldfastError, MailboxFull, UnknownMessage, type_name
from ...actors.events import SafeStateEntered, SafeStateLeft, SafeStateMissed, SafeStateOverdue
from ...actors.kernel import mailbox
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.codec import Parcel
from ...actors.kernel.lifecycle import MailboxHome
from ...actors.kernel.node import cell_kind
from ...actors.process.process_host import FlightHome
from ...actors.safe_state import SafeStateChange
from ..home.recorded_home import RecordedHome, switch_of
from ..recovery_settings import SafeState

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from ..group_commit import Commits

KEPT: Final = "safe state"
"""The note of the receivers that the next program has to tell of the end."""
_BEFORE: Final = -1
"""The life in a program that has ended, of somebody who was told there."""
Key = tuple[str, tuple[str, bytes] | None, tuple[str, bytes] | None]
"""A receiver, and the messages it is told with."""


class KeptReceiver(msgspec.Struct, array_like=True, frozen=True):
    """A receiver, as the note has it; the fields are those of Receiver."""

    path: str
    enter: tuple[str, bytes] | None
    leave: tuple[str, bytes] | None
    timeout: float
    holders: tuple[str, ...]


_ENCODE: Final = msgspec.msgpack.Encoder().encode
_DECODE: Final = msgspec.msgpack.Decoder(tuple[KeptReceiver, ...]).decode


class Receiver:
    """One that is safe, or is being told that it is not any more."""

    __slots__ = (
        "because",
        "holders",
        "is_left_behind",
        "is_missed",
        "life",
        "outbox",
        "path",
        "timeout",
        "timer",
        "told",
        "words",
    )

    def __init__(self, key: Key, timeout: float) -> None:
        self.path, self.words = key[0], key[1:]
        self.holders: dict[str, None] = {}  # the recoveries that want it to be safe, oldest first
        self.is_missed = False  # whether telling it makes nobody safe
        self.because = ""
        self.timeout = timeout
        self.life: tuple[Cell, int] | None = None  # that was told; None: it is not told yet
        self.told: tuple[Any, object] = None, None  # what was said to it, and the journal where that stands
        self.timer: asyncio.TimerHandle | None = None
        self.outbox: list[bool] = []  # what could not be put in its mailbox yet
        self.is_left_behind = False  # by a program that has ended; it has not begun in this one yet


class Safety:
    """All receivers of a root.

    Args:
        node: the root.
        journal: where those are noted that outlive this program.
        is_recovering: whether the recovery of an address is under way.
    """

    def __init__(self, node: Node, journal: Commits, is_recovering: Callable[[str], bool]) -> None:
        self._node, self._journal, self._is_recovering = node, journal, is_recovering
        self._receivers: dict[Key, Receiver] = {}
        self._noted = journal.noted(KEPT)
        for one in _DECODE(self._noted) if self._noted is not None else ():
            key = one.path, one.enter, one.leave
            receiver = self._receivers[key] = Receiver(key, one.timeout)
            receiver.holders.update(dict.fromkeys(one.holders))
            receiver.because, receiver.is_left_behind = one.holders[0], True
            receiver.timer = node.loop.call_later(one.timeout, self._overdue, receiver)
            node.on_life = self._begins

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
                self._node.on_life = self._begins
            receiver.holders[path] = None
            if receiver.life is None and not receiver.is_left_behind:
                self._enter(receiver, path)
        self._note()

    def _enter(self, receiver: Receiver, path: str) -> None:
        receiver.because = path
        receiver.timer = self._node.loop.call_later(receiver.timeout, self._overdue, receiver)
        cell = self._node.cell_at(receiver.path)
        problem = self._problem(receiver, cell)
        receiver.is_missed = bool(problem)
        self._say(receiver, cell, entered=True)
        self._node.emit(
            SafeStateMissed(receiver.path, path, problem) if problem else SafeStateEntered(receiver.path, path)
        )

    def _begins(self, cell: Cell) -> None:
        """A life begins: if it has to be safe, nobody has told it so, unless a journal has it or it waits already."""
        path = cell.path
        self._take_up(cell)
        for receiver in self._receivers.values():
            if receiver.path != path or receiver.life == (cell, cell.coming_life) or self._is_kept(receiver, cell):
                continue
            problem, was_missed = self._problem(receiver, cell), receiver.is_missed
            receiver.is_missed = bool(problem)
            if not problem:
                self._say(receiver, cell, entered=True, is_first=True)
                if was_missed:
                    self._node.emit(SafeStateEntered(path, receiver.because))
            elif not was_missed:
                self._node.emit(SafeStateMissed(path, receiver.because, problem))
        self._note()

    def _is_durable(self, receiver: Receiver) -> bool:
        """Whether what it was told outlives this program."""
        switch = switch_of(self._node.cell_at(receiver.path))
        return switch is not None and switch is receiver.told[1] and switch.journal.durable

    def _take_up(self, cell: Cell) -> None:
        """A life begins: the first one of whom a program that has ended left safe, or because of whom it did."""
        path = cell.path
        for receiver in self._receivers.values():
            if receiver.is_left_behind and receiver.path == path:
                receiver.is_left_behind = False
                receiver.told = None, switch_of(cell)
                if self._is_kept(receiver, cell) or not receiver.holders:
                    receiver.life = cell, _BEFORE
        if not self._is_recovering(path):  # It has nothing to come back with.
            self.leave(path)
        else:
            self._let_go("")

    @staticmethod
    def _is_kept(receiver: Receiver, cell: Cell) -> bool:
        """Whether the next life at a cell knows what the receiver was told, for a journal has it."""
        home = cell.host.home
        return (
            isinstance(home, RecordedHome)
            and home.keeps_turns
            and home.switch is not None
            and home.switch is receiver.told[1]
        )

    def _problem(self, receiver: Receiver, cell: Cell) -> str:
        """Why telling this receiver makes nobody safe, as far as it is known here; "" if it does."""
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
        for receiver in self._receivers.values():
            receiver.holders.pop(path, None)
        self._let_go(path)

    def _let_go(self, path: str) -> None:
        """Tell those of the end whom nobody wants to be safe any more."""
        for key, receiver in list(self._receivers.items()):
            if not receiver.holders and not receiver.is_left_behind:  # Else it is told when it begins.
                del self._receivers[key]
                if receiver.timer is not None:
                    receiver.timer.cancel()
                receiver.because = path or receiver.because
                if not receiver.is_missed:
                    self._leave(receiver)
                    self._node.emit(SafeStateLeft(receiver.path, receiver.because))
        if not self._receivers:
            self._node.on_life = None
        self._note()

    def _note(self) -> None:
        """Have the next program know whom to tell of the end."""
        kept = tuple(
            KeptReceiver(receiver.path, *receiver.words, receiver.timeout, tuple(receiver.holders))
            for receiver in self._receivers.values()
            if receiver.is_left_behind or self._is_durable(receiver)
        )
        noted = _ENCODE(kept) if kept else None
        if noted != self._noted:
            self._noted = noted
            self._journal.note(KEPT, noted)

    def _leave(self, receiver: Receiver) -> None:
        """Tell the receiver of the end, unless the life that begins there next has not heard of the beginning."""
        cell = self._node.cell_at(receiver.path)
        if receiver.outbox:
            receiver.outbox.clear()
            return
        is_between = cell.state in (DOWN, GONE) and receiver.life not in ((cell, cell.coming_life), (cell, _BEFORE))
        if is_between and not self._is_kept(receiver, cell) and not mailbox.is_queued(cell, receiver.told[0]):
            return
        self._say(receiver, cell, entered=False)

    def holds(self, path: str) -> tuple[str, ...]:
        """Who is safe because of the recovery of `path`."""
        return tuple(receiver.path for receiver in self._receivers.values() if path in receiver.holders)

    def close(self) -> None:
        """Nobody needs to be told any more."""
        self._node.on_life = None
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

    def _say(self, receiver: Receiver, cell: Cell, *, entered: bool, is_first: bool = False) -> None:
        """Put the word into the mailbox; `is_first`: ahead of what a life that begins finds there, where it can be."""
        if entered:
            if is_first:
                mailbox.take_out(cell, receiver.told[0])  # The life that was to hear it has ended before.
            receiver.outbox.clear()
            receiver.life = (cell, cell.coming_life)
        message = self._message(receiver, cell, entered)
        if message is None:
            return
        if entered:
            receiver.told = message, switch_of(cell)
        if is_first and isinstance(cell.host.home, (MailboxHome, FlightHome)):
            mailbox.put_first(cell, message)  # Ahead of what it was told to do before.
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
            self._say(receiver, self._node.cell_at(receiver.path), entered=entered)

    # -- the dead man's switch --------------------------------------------------------------------------------------

    def _overdue(self, receiver: Receiver) -> None:
        """The receiver's own switch has raised the alarm, if it is told by its hook and has not begun anew since.

        Where nobody could be told, nobody waits for the end.
        """
        receiver.timer = None
        cell = self._node.cell_at(receiver.path)
        has_begun_anew = receiver.life != (cell, cell.life) and not receiver.is_missed
        if receiver.words[0] is not None or has_begun_anew:
            self._node.emit(SafeStateOverdue(receiver.path, receiver.timeout, receiver.because))
