"""How lines begin and go on: a gate answers whoever calls this program, and a caller calls another one.

Two programs that call each other have one line, which is there as long as one of them calls.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from typing import Final

import msgspec

from ...actors.errors import SpecError
from ...actors.values.path_parts import check_path_part
from .far_line import FarLine
from .line import NOBODY, LineBatch, Note
from .lines import Lines, Transport

HEAD_BYTES: Final = 4096
"""What a batch may have besides its items, in bytes."""
MOST_CALLERS: Final = 10_000
"""How many programs may have called at a time; further ones are not answered."""
MOST_SYSTEMS: Final = 256
"""How many systems may be known by their names, in all runs of this one; further ones are not answered."""
MOST_NAME: Final = 255
"""The longest name of a program, in characters."""
_DECODER: Final[msgspec.msgpack.Decoder[LineBatch]] = msgspec.msgpack.Decoder(LineBatch)


def _is_sound(batch: LineBatch) -> bool:
    """Whether a program may be called so, and its run has a number."""
    try:
        check_path_part("connect", "the system", batch.sender)
    except SpecError:
        return False
    return len(batch.sender) <= MOST_NAME and re.fullmatch("[0-9a-f]{1,15}", batch.boot.token) is not None


class LineGate:
    """Answers whoever calls this program."""

    def __init__(self, lines: Lines, transport: Transport) -> None:
        self._lines, self._transport = lines, transport
        lines.serve(self)
        self._back: dict[FarLine, str] = {}
        self._strangers: dict[FarLine, None] = {}  # who have greeted, and have not shown that they hear the answer

    def has(self, far: FarLine) -> bool:
        """Whether the other program has called here."""
        return far in self._back

    def reach(self, far: FarLine) -> None:
        """From now on the other program is reached where it has said that answers go."""
        far.post_bytes = lambda data: self._post(far, data)

    def left(self, far: FarLine) -> None:
        """The line is over."""
        self._back.pop(far, None)
        self._strangers.pop(far, None)

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
        is_called = far is not None and lines.caller_of(far) is not None
        if batch.to == NOBODY:
            if batch.note != "bye":  # Else it has given up before anybody answered.
                self._greeted(batch, far, back, is_called=is_called)
        elif batch.to == lines.boot and far is not None and far.is_with(batch):
            self._strangers.pop(far, None)
            self._back[far] = back
            far.hear(batch)
            if batch.note == "bye":  # It has said what has come, too.
                far.take_rest()
                self._ended(far)
        elif batch.to != lines.boot or not is_called:  # Else our own call finds out which run of it there is.
            self._answer(batch, back, 0, "unknown")

    def _answer(self, batch: LineBatch, back: str, number: int, note: Note) -> None:
        lines = self._lines
        answer = LineBatch(lines.name, lines.boot, batch.boot, 0, 1, (), note, number, batch.line)
        self._transport.post(back, msgspec.msgpack.encode(answer), "")

    def _greeted(self, batch: LineBatch, far: FarLine | None, back: str, *, is_called: bool) -> None:
        """Somebody says that it is there, and does not know yet who is here."""
        lines = self._lines
        if far is not None and is_called and far.theirs != batch.boot:
            # Which run of a system that is called from here leads it, the call finds out: anybody may say so here.
            self._answer(batch, back, far.numbers[0], "")
            return
        if far is not None and far.theirs != batch.boot:
            if far.theirs.era > batch.boot.era:
                return  # An earlier run, late.
            lines.forget(far)
            far = None
        if far is None and not self._may_come(batch.sender):
            return  # Whoever greets is not answered, as if nobody were here.
        if far is None:
            far = lines.open(batch.sender, lambda data: None)
            self.reach(far)
            self._strangers[far] = None
            far.most = min(far.most, self._transport.most_bytes - HEAD_BYTES)
        elif far.numbers[1] < batch.line:
            far.end("it has begun anew")
        elif far.numbers[1] > batch.line:
            return  # Of an earlier line, late.
        self._back[far] = back
        if far.line is None:
            far.begin(batch.boot, batch.line)
        far.alive()
        self._answer(batch, back, far.numbers[0], "")

    def _may_come(self, name: str) -> bool:
        """Whether there is room for one more program, perhaps in the place of one that has greeted and said no more."""
        homes = self._lines.homes
        if homes is not None and not homes.far.may_know(name, MOST_SYSTEMS):
            return False
        if len(self._back) >= MOST_CALLERS:
            stranger = next(iter(self._strangers), None)
            if stranger is None:
                return False
            self._lines.forget(stranger)
        return True

    def _ended(self, far: FarLine) -> None:
        """The other program has ended the line in good order."""
        caller = self._lines.caller_of(far)
        if caller is not None:
            self.left(far)
            caller.begin_anew("it has ended")
        else:
            self._lines.forget(far)

    def _post(self, far: FarLine, data: bytes) -> None:
        back = self._back.get(far)
        if back is not None:
            self._transport.post(back, data, "")


class LineCaller:
    """Calls another program, and calls again when that is led by another one.

    Args:
        lines: of this program.
        transport: how the other one is reached.
        to: where it listens.
        name: of the other program.
        begun: called whenever a program that leads it has answered for the first time.

    Raises:
        LineTaken: that program is called already.
    """

    def __init__(
        self, lines: Lines, transport: Transport, to: str, name: str, begun: Callable[[], None] = lambda: None
    ) -> None:
        self._begun = begun
        self._lines, self._transport, self._to = lines, transport, to
        self._own = transport.own_place()
        self._newest = NOBODY
        self.far = lines.call(name, self._post, self)
        self.far.most = min(self.far.most, transport.most_bytes - HEAD_BYTES)
        self._answered: asyncio.Future[None] = lines.node.loop.create_future()

    def _post(self, data: bytes) -> None:
        self._transport.post(self._to, data, self._own)

    async def begin(self, seconds: float) -> None:
        """Greet the other program, and wait until it has answered.

        Raises:
            TimeoutError: it has not. SpecError: it has another name.
        """
        await self._transport.hear(self._own, self.hear)
        lines = self._lines
        async with asyncio.timeout(seconds):
            while not self._answered.done():
                greeting = LineBatch(lines.name, lines.boot, NOBODY, 0, 1, (), "", self.far.numbers[0])
                self._post(msgspec.msgpack.encode(greeting))
                await asyncio.wait((self._answered,), timeout=0.2)
        self._answered.result()

    def begin_anew(self, why: str) -> None:
        """The line has ended: greet whoever leads the other program now."""
        self.far.end(why)
        self.far.say()

    async def end(self, seconds: float) -> None:
        """Call no more; what was sent goes over first, if that takes no longer than so many seconds."""
        line = self.far.line
        emptied = None if line is None or self.far.is_lost else line.emptied()
        if emptied is not None:
            await asyncio.wait((emptied,), timeout=seconds)
        self._lines.hang_up(self.far)

    def hear(self, data: bytes, back: str) -> None:
        """Take what the other program has posted."""
        far, lines = self.far, self._lines
        try:
            batch = _DECODER.decode(data)
        except msgspec.MsgspecError:
            return
        if batch.to != lines.boot or batch.boot.era < self._newest.era or lines.caller_of(far) is not self:
            return  # To an earlier run of this program, or of one that leads no more.
        if batch.to_line != far.numbers[0]:
            return  # To an earlier line.
        if batch.sender != far.name:
            if not self._answered.done():
                problem = f"the system there is called {batch.sender!r}, not {far.name!r}: say system={batch.sender!r}"
                self._answered.set_exception(SpecError("connect", problem))
            return
        self._newest = batch.boot
        if far.line is not None and batch.boot != far.theirs:
            self.begin_anew("another program leads it")
        elif far.line is not None and batch.note in ("unknown", "bye"):
            far.end("it has ended")
            if batch.note != "bye":
                far.say()
        elif far.line is not None:
            if far.is_with(batch):
                self._is_answered()
                far.hear(batch)
        elif not batch.note:
            far.begin(batch.boot, batch.line)
            self._is_answered()
            self._begun()
            far.hear(batch)

    def _is_answered(self) -> None:
        if not self._answered.done():
            self._answered.set_result(None)
