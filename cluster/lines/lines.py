"""All lines of one program: who is reached over them, and who is greeted, suspected and forgotten when."""

from __future__ import annotations

import asyncio
import itertools
import secrets
import time
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

import msgspec

from ...actors.errors import HoldfastError
from ...actors.events import ConnectionLimited
from ...checkpoint.home.ask_recovery import FarId, FarOut
from ...checkpoint.home.pending_asks import SwitchAsk
from ...checkpoint.protocol import Answer
from .far_line import FarLine, run_number
from .inflow import DEFAULT_LIMITS, ConnectionLimits
from .line import Boot

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.homes import Homes

T = TypeVar("T")

BEAT_SECONDS: Final = 1.0
"""How often each end says that it is there."""
SILENT_SECONDS: Final = 5.0
"""After so long without a word the other end is suspected to be gone."""
FORGET_SECONDS: Final = 30.0
"""After so long without a word whoever has called is forgotten."""
STARTING_SECONDS: Final = 5.0
"""How long after its begin a system keeps what comes for actors that it has not started yet."""
MOST_WAITING: Final = 64 * 1024 * 1024
"""Bytes that wait for a program that has called before its line is ended: it does not take what it wanted."""
STUCK_SECONDS: Final = 10.0
"""After so long in which a program that has called took nothing of what it is to take, its line is ended."""


class LineTaken(HoldfastError, text="there is a connection to a system called {system} already: use that one"):
    """Two systems of one name cannot both be reached: their addresses would be the same."""

    system: str


class PeerLook(msgspec.Struct, frozen=True):
    """Another program that is connected to this system, or was.

    Attributes:
        system: its name, the first part of its addresses.
        is_connected: whether it has answered within the last seconds.
        kept: messages of recorded actors here that it has not accepted yet.
        kept_bytes: of these messages together.
    """

    system: str
    is_connected: bool
    kept: int
    kept_bytes: int


class Transport(Protocol):
    """Carries bytes between programs, each at most once, those from one place to another in order."""

    def post(self, to: str, data: bytes, back: str) -> None:
        """Send bytes to a place; `back` is where answers go. They may get lost."""
        ...

    @property
    def most_bytes(self) -> int:
        """The most that is carried at once, in bytes."""
        ...

    async def hear(self, at: str, take: Callable[[bytes, str], None]) -> None:
        """Have what is sent to a place taken, with where answers go, on the running loop.

        Raises:
            Unanswered: it cannot be listened to there.
        """
        ...

    def own_place(self) -> str:
        """A place at which this program alone may listen."""
        ...

    async def unless_denied(self, work: Coroutine[Any, Any, T]) -> T:
        """Do what waits for an answer, and end it when the servers say that this program may not send there.

        Raises:
            AccessRefused: they say so.
        """
        ...

    async def close(self) -> None:
        """Send what was posted, and end."""
        ...


class Gate(Protocol):
    """Answers whoever calls this program; see `LineGate`."""

    def has(self, far: FarLine) -> bool:
        """Whether the other program has called here."""
        ...

    def reach(self, far: FarLine) -> None:
        """From now on the other program is reached where it has said that answers go."""
        ...

    def left(self, far: FarLine) -> None:
        """The line is over."""
        ...


class Caller(Protocol):
    """Calls another program from here; see `LineCaller`."""

    def begin_anew(self, why: str) -> None:
        """The line has ended: greet whoever leads the other program now."""
        ...


def new_boot(era: int | None = None) -> Boot:
    """An incarnation; `era` is a number that rises with each one of this system, the clock's if left out."""
    return Boot(time.time_ns() // 1_000_000 if era is None else era, secrets.token_hex(6))


class Lines:
    """The lines of one node.

    Args:
        node: whose actors use them.
        name: of this program, as others know it.
        boot: the incarnation of this program.
        homes: the recorded actors here, if there can be any.
        limits: how much each other program may have outstanding here.
    """

    def __init__(
        self, node: Node, name: str, boot: Boot, homes: Homes | None = None, limits: ConnectionLimits = DEFAULT_LIMITS
    ) -> None:
        self.node, self.name, self.boot, self.homes = node, name, boot, homes
        self.limits = limits
        self._lines: dict[str, FarLine] = {}
        self._gates: list[Gate] = []
        self._began = node.loop.time()
        self._waiting: dict[str, list[Callable[[FarLine], None]]] = {}
        self._beat: asyncio.TimerHandle | None = None
        self._numbers = itertools.count()
        self._callers: dict[FarLine, Caller] = {}
        if homes is not None:
            homes.far.deliver, homes.far.sender, homes.far.limits = self._deliver, self, self.limits

    def find(self, path: str) -> Cell | None:
        """The stand-in for an actor of another program, if there is a line to that."""
        far = self._lines.get(_system(path))
        return None if far is None else far.stand_in(path)

    def open(self, name: str, post: Callable[[bytes], None]) -> FarLine:
        """A line to another program, which has not answered yet."""
        far = self._lines[name] = FarLine(self, name, post)
        self._send_kept(far)
        if self._beat is None:
            self._beat = self.node.loop.call_later(BEAT_SECONDS, self._look)
        return far

    def call(self, name: str, post: Callable[[bytes], None], caller: Caller) -> FarLine:
        """A line to another program, which is called from here; if that has called already, both use the same line.

        Raises:
            LineTaken: that program is called already, or this one has its name.
        """
        far = self._lines.get(name)
        if name == self.name or (far is not None and far in self._callers):
            raise LineTaken(name)
        if far is None:
            far = self.open(name, post)
        self._callers[far] = caller
        far.post_bytes = post
        return far

    def hang_up(self, far: FarLine) -> None:
        """A program is called no more; if it has called, too, it keeps its line."""
        self._callers.pop(far, None)
        gate = next((gate for gate in self._gates if gate.has(far)), None)
        if gate is not None and far.line is not None:
            gate.reach(far)
        else:
            self.drop(far)

    def caller_of(self, far: FarLine) -> Caller | None:
        """Who calls the other program from here, if anybody does."""
        return self._callers.get(far)

    def peers(self) -> list[PeerLook]:
        """All programs that are connected, and systems for which something may be kept, by name."""
        kept = {} if self.homes is None else self.homes.far.kept()
        found = {name: PeerLook(name, False, *kept[name]) for name in kept}
        for name, far in self._lines.items():
            there = far.line is not None and not far.is_lost
            found[name] = PeerLook(name, there, *kept.get(name, (0, 0)))
        return [found[name] for name in sorted(found)]

    def forget_system(self, name: str) -> int:
        """Drop what recorded actors have told a system that has not accepted it; return how many messages that were.

        Raises:
            StoreError: the store does not take it.
        """
        dropped = 0 if self.homes is None else self.homes.far.drop(name)
        if self.homes is not None and name in self._lines:
            self.homes.far.connected(name)
        return dropped

    def overrun(self, far: FarLine, problem: str) -> None:
        """End the line of a program that wants more than it may: what it has out is lost, and it may call anew."""
        self.node.emit(ConnectionLimited(f"/{far.name}", "line", problem))
        self.node.loop.call_soon(self._end, far)

    def _end(self, far: FarLine) -> None:
        caller = self._callers.get(far)
        if caller is not None:
            caller.begin_anew("it wants more than it may")
        elif self._lines.get(far.name) is far:
            self.forget(far)

    def forget(self, far: FarLine) -> None:
        """The run of the other program is over: nobody asks again what it has asked."""
        theirs = far.theirs
        self.drop(far)
        if self.homes is not None:
            self.homes.far.forget_run(far.name, run_number(theirs))

    def at(self, name: str) -> FarLine | None:
        """The line to the program of that name."""
        return self._lines.get(name)

    def drop(self, far: FarLine) -> None:
        """End a line, whose name is free again."""
        if self._lines.get(far.name) is far:
            del self._lines[far.name]
            if self.homes is not None:
                self.homes.far.leaves(far.name)
        self._callers.pop(far, None)
        for gate in self._gates:
            gate.left(far)
        far.close()

    def serve(self, gate: Gate) -> None:
        """Have whoever calls answered by this gate."""
        self._gates.append(gate)

    def closing(self) -> None:
        """This program ends: what comes is for whoever follows it; what was asked before is still answered."""
        if self.homes is not None:
            self.homes.far.is_closing = True
        for far in self._lines.values():
            far.is_closing = True

    def close(self) -> None:
        """End all lines to other programs, and look after none."""
        for far in list(self._lines.values()):
            self.drop(far)
        if self._beat is not None:
            self._beat.cancel()

    def ask(self, ask: SwitchAsk, *, again: bool) -> None:
        """Send an ask of a recorded actor, now or when there is a line to whom it asks."""
        assert ask.to is not None
        path = ask.to.path
        self._to(path, lambda far: _ask(far, path, ask, again=again))

    def next_number(self) -> int:
        """A number for a line that begins: it rises, over all lines of this run."""
        return next(self._numbers)

    def hand_back(self, ask: SwitchAsk) -> None:
        """Have an ask whose line was closed wait for the next one, as long as its turn does."""
        self.ask(ask, again=True)

    def tell(self, out: FarOut, *, again: bool) -> None:
        """Send a message of a recorded actor, now or when there is a line to whom it is for."""
        far = self._lines.get(_system(out.to))
        if far is not None:  # Else it is sent with all that is kept when there is a line.
            far.tell_lasting(out, again=again)

    def _to(self, path: str, send: Callable[[FarLine], None]) -> None:
        far = self._lines.get(_system(path))
        if far is not None:
            send(far)
        else:
            self._waiting.setdefault(_system(path), []).append(send)

    def _send_kept(self, far: FarLine) -> None:
        """Send what has waited for a line."""
        if self.homes is not None:
            self.homes.far.connected(far.name)
            self.homes.far.connects(far.name)
            for out in self.homes.far.outs(far.name):
                far.tell_lasting(out, again=True)
        for send in self._waiting.pop(far.name, ()):
            send(far)

    def _deliver(self, which: FarId, answer: Answer) -> None:
        far = self._lines.get(_system(which.asker))
        if far is not None:
            far.deliver(which, answer)

    def await_actor(self, path: str, then: Callable[[], None]) -> bool:
        """Have something done when an actor is started at an address, or cannot be hoped for any more."""
        loop = self.node.loop
        left = self._began + STARTING_SECONDS - loop.time()
        if self.node.root is None or left <= 0.0:
            return False
        timer: asyncio.TimerHandle | None = None
        come = self.node.awaited.setdefault(path, [])

        def soon() -> None:
            if timer is not None:
                timer.cancel()
            loop.call_soon(then)

        def over() -> None:
            if soon in come:
                come.remove(soon)
            then()

        come.append(soon)
        timer = loop.call_later(left, over)
        return True

    def _look(self) -> None:
        """Say that we are here, and see who has not said so for long."""
        loop = self.node.loop
        self._beat = loop.call_later(BEAT_SECONDS, self._look) if self._lines else None
        for far in list(self._lines.values()):
            quiet = loop.time() - far.heard
            if far not in self._callers:
                if quiet > FORGET_SECONDS:
                    self.drop(far)
                    continue
                if problem := _stuck(far):
                    if quiet > SILENT_SECONDS:  # It cannot be reached, which is not more than it may.
                        loop.call_soon(self._end, far)
                    else:
                        self.overrun(far, problem)
                    continue
            if quiet > SILENT_SECONDS:
                far.lose()
            far.say()


def _stuck(far: FarLine) -> str:
    """Why what another program is sent does not go on; an empty text if it does."""
    if far.line is not None and (waits := far.line.stuck_for(STUCK_SECONDS, MOST_WAITING)):
        return f"it does not take what it is sent: {waits} bytes wait for it"
    if far.unaccepted_for() > STUCK_SECONDS:  # Whoever has published it waits for that.
        return "it neither accepts nor refuses what it is sent"
    return ""


def _system(path: str) -> str:
    """The first part of an address: the program that it is of."""
    return path[1:].partition("/")[0]


def _ask(far: FarLine, path: str, ask: SwitchAsk, *, again: bool) -> None:
    if not ask.is_over:
        ask.to = far.stand_in(path)
        far.ask_lasting(ask, again=again)
