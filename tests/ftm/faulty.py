"""A mechanism for tests: strikes answers, states or messages in one replica, once or for good. It is loaded by path."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import msgspec

from holdfast.checkpoint.protocol import MESSAGE, OK, REPLY, Answer, TurnEnd
from holdfast.ftm.bricks.brick_messages import Request, Work
from holdfast.ftm.bricks.bricks import Before
from holdfast.ftm.model.mechanism import Mechanism, Role


class Striking(Before):
    """Before of the replica, which also sees the ends of turns."""

    def on_start(self, restored: bool) -> None:
        self.turns = 0
        self._standing.server.hooks.insert(0, self._strike)

    def on_stop(self, reason: object) -> None:
        self._standing.server.hooks.remove(self._strike)

    def _is_hit(self) -> bool:
        mechanism: Any = self.mechanism
        if self._standing.path.rpartition("/")[2] != mechanism.replica:
            return False
        self.turns += 1
        return self.turns > mechanism.skip if mechanism.always else self.turns == mechanism.skip + 1

    def _strike(self, server: Any, end: TurnEnd) -> TurnEnd:
        mechanism: Any = self.mechanism
        life = server.life
        is_message = life.ended is not None and life.ended.kind == MESSAGE and end.status == OK
        if mechanism.what == "message" or not is_message or not self._is_hit():
            return end
        if mechanism.what == "state":
            actor = life.cell.actor
            for name, value in list(vars(actor).items()):
                if name.startswith("_") or name == "ctx":
                    continue
                if type(value) is int:
                    setattr(actor, name, value - 1000)
                elif isinstance(value, list):
                    value.append(-1000)
            return end
        if end.answer.kind != REPLY or not isinstance(msgspec.msgpack.decode(end.answer.body), int):
            return end
        answer = Answer(REPLY, "", msgspec.msgpack.encode(-666))
        return TurnEnd(end.turn, end.id, end.status, end.outs, answer, end.state)

    async def before(self, work: Work) -> Work:
        mechanism: Any = self.mechanism
        if mechanism.what != "message":
            return work
        requests = [self._garbled(one) if self._hits(one) else one for one in work.requests]
        return Work(work.epoch, work.config, work.number, requests, work.go)

    def _hits(self, request: Request) -> bool:
        return request.feed.kind == MESSAGE and request.feed.name.endswith(":Add") and self._is_hit()

    def _garbled(self, request: Request) -> Request:
        """The same request with another last number in its body."""
        fields = msgspec.msgpack.decode(request.feed.body)
        if isinstance(fields, list):
            fields[-1] = -500
        else:
            fields[next(reversed(fields))] = -500
        feed = msgspec.structs.replace(request.feed, body=msgspec.msgpack.encode(fields))
        return Request(request.client, request.incarnation, feed)


@dataclasses.dataclass(frozen=True)
class Faulty(Mechanism):
    """Strikes `what` (answer, state, message) in `replica`, after `skip` chances to: once, or `always` from then on."""

    name: ClassVar[str] = "faulty"
    layer: ClassVar[str] = "repetition"
    roles: ClassVar[dict[str, Role]] = {"single": Role(before=Striking)}

    what: str = "answer"
    always: bool = False
    replica: str = "r1"
    skip: int = 0
