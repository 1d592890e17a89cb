"""All lines of one program: who is reached over them, and who is greeted, suspected and forgotten when."""

from __future__ import annotations

import asyncio
import re
import secrets
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from ...actors.errors import HoldfastError, SpecError
from ...actors.values.path_parts import check_path_part
from ...checkpoint.home.ask_recovery import FarId, FarOut
from ...checkpoint.home.pending_asks import SwitchAsk
from ...checkpoint.protocol import Answer
from .far_line import FarLine, run_number
from .line import NOBODY, Boot, LineBatch

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.homes import Homes

BEAT_SECONDS: Final = 1.0
"""How often each end says that it is there."""
SILENT_SECONDS: Final = 5.0
"""After so long without a word the other end is suspected to be gone."""
FORGET_SECONDS: Final = 30.0
"""After so long without a word whoever has called is forgotten."""
STARTING_SECONDS: Final = 5.0
"""How long after its begin a system keeps what comes for actors that it has not started yet."""
HEAD_BYTES: Final = 4096
"""What a batch may have besides its items, in bytes."""
MOST_CALLERS: Final = 10_000
"""How many programs may have called at a time; further ones are not answered."""
MOST_NAME: Final = 255
"""The longest name of a program, in characters."""
_DECODER: Final[msgspec.msgpack.Decoder[LineBatch]] = msgspec.msgpack.Decoder(LineBatch)


class LineTaken(HoldfastError, text="there is a connection to a system called {system} already: use that one"):
    """Two systems of one name cannot both be reached: their addresses would be the same."""

    system: str


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

    async def close(self) -> None:
        """Send what was posted, and end."""
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
    """

    def __init__(self, node: Node, name: str, boot: Boot, homes: Homes | None = None) -> None:
        self.node, self.name, self.boot, self.homes = node, name, boot, homes
        self._lines: dict[str, FarLine] = {}
        self._gates: list[LineGate] = []
        self._began = node.loop.time()
        self._waiting: dict[str, list[Callable[[FarLine], None]]] = {}
        self._beat: asyncio.TimerHandle | None = None
        if homes is not None:
            homes.far.deliver, homes.far.sender = self._deliver, self

    def find(self, path: str) -> Cell | None:
        """The stand-in for an actor of another program, if there is a line to that."""
        far = self._lines.get(_system(path))
        return None if far is None else far.stand_in(path)

    def open(self, name: str, post: Callable[[bytes], None]) -> FarLine:
        """A line to another program, which has not answered yet.

        Raises:
            LineTaken: there is one to a program of that name, or this one is called so.
        """
        if name in self._lines or name == self.name:
            raise LineTaken(name)
        far = self._lines[name] = FarLine(self.node, (self.name, self.boot), name, post, self.homes)
        far.await_actor = self._await_actor
        far.is_closing = self.homes is not None and self.homes.far.is_closing
        far.hand_back = lambda ask: self.ask(ask, again=True)
        self._send_kept(far)
        if self._beat is None:
            self._beat = self.node.loop.call_later(BEAT_SECONDS, self._look)
        return far

    def at(self, name: str) -> FarLine | None:
        """The line to the program of that name."""
        return self._lines.get(name)

    def drop(self, far: FarLine) -> None:
        """End a line, whose name is free again."""
        if self._lines.get(far.name) is far:
            del self._lines[far.name]
        far.close()

    def serve(self, transport: Transport) -> LineGate:
        """Answer whoever calls by this transport."""
        gate = LineGate(self, transport)
        self._gates.append(gate)
        return gate

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
            for out in self.homes.far.outs(far.name):
                far.tell_lasting(out, again=True)
        for send in self._waiting.pop(far.name, ()):
            send(far)

    def _deliver(self, which: FarId, answer: Answer) -> None:
        far = self._lines.get(_system(which.asker))
        if far is not None:
            far.deliver(which, answer)

    def _await_actor(self, path: str, then: Callable[[], None]) -> bool:
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
            if quiet > FORGET_SECONDS and any(gate.has(far) for gate in self._gates):
                self.drop(far)
                continue
            if quiet > SILENT_SECONDS:
                far.lose()
            far.say()


def _is_sound(batch: LineBatch) -> bool:
    """Whether a program may be called so, and its run has a number."""
    try:
        check_path_part("connect", "the system", batch.sender)
    except SpecError:
        return False
    return len(batch.sender) <= MOST_NAME and re.fullmatch("[0-9a-f]{1,15}", batch.boot.token) is not None


def _system(path: str) -> str:
    """The first part of an address: the program that it is of."""
    return path[1:].partition("/")[0]


def _ask(far: FarLine, path: str, ask: SwitchAsk, *, again: bool) -> None:
    if not ask.is_over:
        ask.to = far.stand_in(path)
        far.ask_lasting(ask, again=again)


class LineGate:
    """Answers whoever calls this program."""

    def __init__(self, lines: Lines, transport: Transport) -> None:
        self._lines, self._transport = lines, transport
        self._back: dict[FarLine, str] = {}

    def has(self, far: FarLine) -> bool:
        """Whether a line was made because somebody has called here."""
        return far in self._back

    def hear(self, data: bytes, back: str) -> None:
        """Take what was posted to this program."""
        lines = self._lines
        try:
            batch = _DECODER.decode(data)
        except msgspec.MsgspecError:
            return  # It comes from no program of ours.
        if not back or not _is_sound(batch) or batch.sender == lines.name:
            return
        far = lines.at(batch.sender)
        if far is not None and far not in self._back:
            return  # Its name is that of a system that this one has called.
        if batch.to == NOBODY:
            if batch.note == "bye":
                return  # It has given up before anybody answered.
            if far is not None and far.theirs != batch.boot:
                if far.theirs.era > batch.boot.era:
                    return  # An earlier run, late.
                self._forget(far)
                far = None
            if far is None and len(self._back) >= MOST_CALLERS:
                return  # Whoever greets is not answered, as if nobody were here.
            if far is None:
                far = lines.open(batch.sender, lambda data: self._post(batch.sender, data))
                self._back[far] = back
                far.most = min(far.most, self._transport.most_bytes - HEAD_BYTES)
                far.begin(batch.boot)
            self._back[far] = back
            far.alive()
            far.say()
        elif batch.to != lines.boot or far is None or far.theirs != batch.boot:
            answer = LineBatch(lines.name, lines.boot, batch.boot, 0, 1, (), "unknown")
            self._transport.post(back, msgspec.msgpack.encode(answer), "")
        elif batch.note == "bye":
            far.hear(batch)  # It says what has come, too.
            self._forget(far)
        else:
            self._back[far] = back
            far.hear(batch)

    def _forget(self, far: FarLine) -> None:
        """That run of the other program is over: nobody asks again what it has asked."""
        theirs = far.theirs
        self._drop(far)
        if self._lines.homes is not None:
            self._lines.homes.far.forget_run(far.name, run_number(theirs))

    def _drop(self, far: FarLine) -> None:
        self._lines.drop(far)
        self._back.pop(far, None)

    def _post(self, name: str, data: bytes) -> None:
        far = self._lines.at(name)
        if far is not None:
            self._transport.post(self._back[far], data, "")


class LineCaller:
    """Calls another program, and calls again when that is led by another one.

    Args:
        lines: of this program.
        transport: how the other one is reached.
        to: where it listens.
        name: of the other program.
        begun: called whenever a program that leads it has answered for the first time.

    Raises:
        LineTaken: there is a line to a program of that name.
    """

    def __init__(
        self, lines: Lines, transport: Transport, to: str, name: str, begun: Callable[[], None] = lambda: None
    ) -> None:
        self._begun = begun
        self._lines, self._transport, self._to = lines, transport, to
        self._own = transport.own_place()
        self._newest = NOBODY
        self.far = lines.open(name, lambda data: transport.post(to, data, self._own))
        self.far.most = min(self.far.most, transport.most_bytes - HEAD_BYTES)
        self._answered: asyncio.Future[None] = lines.node.loop.create_future()

    async def begin(self, seconds: float) -> None:
        """Greet the other program, and wait until it has answered.

        Raises:
            TimeoutError: it has not. SpecError: it has another name.
        """
        await self._transport.hear(self._own, self.hear)
        async with asyncio.timeout(seconds):
            while not self._answered.done():
                self.far.say()
                await asyncio.wait((self._answered,), timeout=0.2)
        self._answered.result()

    def hear(self, data: bytes, back: str) -> None:
        """Take what the other program has posted."""
        far, lines = self.far, self._lines
        try:
            batch = _DECODER.decode(data)
        except msgspec.MsgspecError:
            return
        if batch.to != lines.boot or batch.boot.era < self._newest.era or far.is_closed:
            return  # To an earlier run of this program, or of one that leads no more.
        self._newest = batch.boot
        if far.line is not None and (batch.boot != far.theirs or batch.note in ("unknown", "bye")):
            far.end("another program leads it" if batch.boot != far.theirs else "it has ended")
            if batch.note != "bye":
                far.say()
        elif far.line is None and not batch.note:
            if batch.sender != far.name:
                if not self._answered.done():
                    problem = (
                        f"the system there is called {batch.sender!r}, not {far.name!r}: say system={batch.sender!r}"
                    )
                    self._answered.set_exception(SpecError("connect", problem))
                return
            far.begin(batch.boot)
            if not self._answered.done():
                self._answered.set_result(None)
            self._begun()
            far.hear(batch)
        elif far.line is not None:
            far.hear(batch)
