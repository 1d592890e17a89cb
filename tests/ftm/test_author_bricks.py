"""What a brick of one's own can do with one request: refuse it, answer it; what becomes of one that it lets fall."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import msgspec
import pytest

import holdfast as hf
from holdfast.ftm.alarms import RequestsDropped
from holdfast.ftm.bricks.brick_messages import Done, ReplyEvicted, RequestDropped, Work
from holdfast.ftm.bricks.bricks import After, Before
from holdfast.ftm.model.mechanism import Mechanism, Role
from tests.ftm.accounts import Add, Counter, Tags

REFUSED, ANSWERED, DROPPED = -1, -2, -3
"""Amounts that the brick does something about."""


class TooMuch(hf.Refusal):
    amount: int


class Guard(Before):
    async def before(self, work: Work) -> Work | None:
        assert isinstance(self.mechanism, Guarding)
        for one in list(work.requests):
            message = self.message_of(one)
            match message.amount if isinstance(message, Add) else 0:
                case -1:
                    work = self.refuse(work, one, TooMuch(amount=message.amount))
                case -2:
                    work = self.answer(work, one, 77)
                case -3 if self.mechanism.whole:
                    return None
                case -3:
                    rest = [other for other in work.requests if other is not one]
                    work = Work(work.epoch, work.config, work.number, rest, work.go)
        return work


@dataclasses.dataclass(frozen=True)
class Guarding(Mechanism):
    """Masks nothing, needs nothing."""

    name: ClassVar[str] = "guarding"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=Guard), "other": Role(before=Guard)}

    whole: bool = False
    """Whether a brick that drops one request drops its whole batch."""


class Loser(After):
    """Keeps the first outcomes of a message, alone or with all of their part."""

    is_over = False

    async def after(self, done: Done) -> Done | None:
        assert isinstance(self.mechanism, Losing)
        if self.is_over or not any(end.id and end.answer.kind for end in done.ends):
            return done
        self.is_over = True
        return None if self.mechanism.whole else msgspec.structs.replace(done, ends=[])


@dataclasses.dataclass(frozen=True)
class Losing(Mechanism):
    """Masks nothing, needs nothing."""

    name: ClassVar[str] = "losing"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(after=Loser), "other": Role()}

    whole: bool = False


@pytest.mark.parametrize("below", ["pbr", "lfr"])
async def test_one_request_is_refused_or_answered_and_leaves_no_trace(system: hf.ActorSystem, below: str) -> None:
    stack = hf.ftm.compose(Guarding(), hf.ftm.PBR() if below == "pbr" else hf.ftm.LFR())
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack))
    assert await ref.ask(Add(1)) == 1
    with pytest.raises(TooMuch):
        await ref.ask(Add(2, REFUSED))
    assert await ref.ask(Add(3, ANSWERED)) == 77
    ref.tell(Add(4, REFUSED))
    assert await ref.ask(Add(5)) == 2
    assert await ref.ask(Tags()) == [1, 5]


@pytest.mark.parametrize("whole", [False, True])
async def test_a_request_that_a_brick_lets_fall_fails_and_is_told(system: hf.ActorSystem, whole: bool) -> None:
    stack = hf.ftm.compose(Guarding(whole=whole), hf.ftm.PBR())
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack))
    with system.events() as events:
        with pytest.raises(RequestDropped, match="has neither passed request 1 on nor ended it"):
            await ref.ask(Add(1, DROPPED), timeout=60)
        (told,) = [one for one in events.take() if isinstance(one, RequestsDropped)]
    assert (told.address, told.numbers.isdecimal()) == (ref.path, True)
    assert await ref.ask(Add(2)) == 1
    assert await ref.ask(Tags()) == [2]


def test_a_reply_that_is_not_kept_says_what_not_to_do() -> None:
    assert str(ReplyEvicted("/app/alice", 3)).endswith("does not keep its reply any more: do not ask again blindly")


@pytest.mark.parametrize("below", [hf.ftm.PBR(), hf.ftm.LFR()], ids=["pbr", "lfr"])
@pytest.mark.parametrize("whole", [False, True])
async def test_an_outcome_that_a_brick_lets_fall_fails_and_may_have_been(
    system: hf.ActorSystem, whole: bool, below: Mechanism
) -> None:
    stack = hf.ftm.compose(Losing(whole=whole), below)
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack))
    with pytest.raises(RequestDropped) as dropped:
        await ref.ask(Add(1), timeout=30)
    assert dropped.value.may_have_run
    assert await ref.ask(Tags(), timeout=30) == [1]
