"""The desk of a mapped building: whoever asks twice, since nobody answered the first time, has one answer.

A question is known by its serial number. The desk and all whom it asks are recorded, so that a question that was
accepted is asked once, whatever ends in between; the desk keeps what was answered.
"""

from __future__ import annotations

from typing import Any

import msgspec

from holdfast import Actor, Binding, Message, on

from .actors import FindPath, IsWayFree, LookAt, Mapper, NoWay, Planner, Position, Seen, WayAnswer

ANSWERS: dict[type[Message[Any]], Any] = {LookAt: Seen, IsWayFree: WayAnswer, FindPath: list[Position]}
"""The questions that the desk takes, and what answers each."""
KINDS = {kind.__name__: kind for kind in ANSWERS}
PATIENCE = 600.0  # seconds; a question outlives every outage of this demo
NO_WAY = b""


class Inquiry(Message[bytes]):
    """A question, as bytes of msgpack; the reply is its answer as bytes, NO_WAY if there is no way."""

    serial: int
    kind: str
    question: bytes


class Desk(Actor):
    """Has each question answered once, and says the same whenever it is asked again."""

    mapper: Binding[Mapper]
    planner: Binding[Planner]

    def __init__(self) -> None:
        self.answers: dict[int, bytes] = {}

    @on(Inquiry)
    async def answer(self, inquiry: Inquiry) -> bytes:
        known = self.answers.get(inquiry.serial)
        if known is None:
            question = msgspec.msgpack.decode(inquiry.question, type=KINDS[inquiry.kind])
            asked: Any = self.mapper if isinstance(question, LookAt) else self.planner
            try:
                known = msgspec.msgpack.encode(await asked.ask(question, timeout=PATIENCE))
            except NoWay:
                known = NO_WAY
            self.answers[inquiry.serial] = known
        return known
