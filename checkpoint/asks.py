"""Asks from inside recorded turns: their outcomes are inputs, and are journaled like one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..actors.cell import Cell
from ..actors.codec import Parcel
from ..actors.errors import BadMessage
from ..actors.mail import ReplyHandle
from ..actors.process.relay import RelayedAsk
from .inputs import Batch
from .records import REPLY, Answer, Out

if TYPE_CHECKING:
    from .switch import Switch


class Over:
    """Stands for the future of an ask that is over."""

    def done(self) -> bool:
        """It is."""
        return True


OVER = Over()


class SwitchAsk(RelayedAsk, eq=False):
    """An ask from inside a recorded turn: its outcome is journaled before the turn hears of it.

    To others it is an ask that was relayed: whoever has an encoded outcome hands that over.
    """

    switch: Any = None
    turn: int = 0
    k: int = 0

    @classmethod
    def made(cls, switch: Switch, turn: int, out: Out, chain: Any, to: Cell) -> SwitchAsk:
        """The ask that was output (turn, k)."""
        deadline = switch.node.loop.time() + out.seconds
        ask = cls(Parcel(out.name, out.body), switch.cell, chain, out.seconds, deadline, None, to)
        ask.future, ask.switch, ask.turn, ask.k = ask, switch, turn, out.k
        return ask

    def done(self) -> bool:
        """As a future has it."""
        return self.is_over

    def answer(self, reply: object) -> None:
        if isinstance(reply, ReplyHandle):
            return
        try:
            body = self.switch.node.codec.encode(reply, self.switch.path)
        except BadMessage as error:
            self.fail(BadMessage("reply", error.message, error.problem))
        else:
            self.give(Answer(REPLY, "", body))

    def answer_raw(self, body: bytes) -> None:
        """An encoded reply."""
        self.give(Answer(REPLY, "", body))

    def fail(self, error: BaseException) -> None:
        self.give(Answer(*self.switch.node.codec.encode_error(error)))

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        """An encoded error."""
        self.give(Answer(kind, name, body))

    def give(self, answer: Answer, batch: Batch | None = None) -> None:
        """The outcome, once."""
        if not self.is_over:
            self.is_over = True
            self.future = OVER  # Not itself any more: a cycle would keep the message until the next collection.
            self.switch.outcome(self.turn, self.k, answer, batch)
