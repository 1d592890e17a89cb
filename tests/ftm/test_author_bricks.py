"""What a brick of one's own can do with one request: refuse it, answer it; what becomes of one that it lets fall."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import msgspec
import pytest

import holdfast as hf
from holdfast.checkpoint.protocol import Outcome
from holdfast.ftm.alarms import RequestsDropped
from holdfast.ftm.bricks.brick_messages import Done, NoReply, ReplyEvicted, RequestDropped, Work
from holdfast.ftm.bricks.bricks import After, Before, Proceed
from holdfast.ftm.model.mechanism import Mechanism, Role
from tests.ftm.accounts import Account, Add, Counter, Pay, Purse, Tags
from tests.ftm.campaign import whole

REFUSED, ANSWERED, DROPPED, MISANSWERED = -1, -2, -3, -4
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
                case -4:
                    work = self.answer(work, one, "many")
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


async def test_a_brick_that_ends_a_request_with_no_reply_of_its_type_is_named(system: hf.ActorSystem) -> None:
    stack = hf.ftm.compose(Guarding(), hf.ftm.PBR())
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack))
    with pytest.raises(NoReply, match=r"^Guard of \S+ has ended tests.ftm.accounts.Add with what is no reply to it"):
        await ref.ask(Add(1, MISANSWERED))
    assert await ref.ask(Add(2)) == 1
    assert await ref.ask(Tags()) == [2]


def test_a_reply_that_is_not_kept_says_what_not_to_do() -> None:
    assert str(ReplyEvicted("/app/alice", 3)).endswith("is not kept any more: ask for what it has done")


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


class RaisingBefore(Before):
    async def before(self, work: Work) -> Work:
        messages = map(self.message_of, work.requests)
        if amounts := [one.amount for one in messages if isinstance(one, Add) and one.amount == REFUSED]:
            raise TooMuch(amount=amounts[0])
        return work


class RaisingAfter(After):
    async def after(self, done: Done) -> Done:
        requests = [self._standing.inside[end.id] for end in done.ends if end.id in self._standing.inside]
        if any(REFUSED_BODY in one.feed.body for one in requests):
            raise TooMuch(amount=REFUSED)
        return done


REFUSED_BODY = b"\xff"
"""How -1 is encoded; no other amount of these tests has that byte."""


class RaisingHeard(Proceed):
    async def heard(self, outcome: Outcome) -> None:
        raise TooMuch(amount=outcome.k)


@dataclasses.dataclass(frozen=True)
class RaisesBefore(Mechanism):
    name: ClassVar[str] = "raises-before"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=RaisingBefore), "other": Role(before=RaisingBefore)}


@dataclasses.dataclass(frozen=True)
class RaisesAfter(Mechanism):
    name: ClassVar[str] = "raises-after"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(after=RaisingAfter), "other": Role()}


@dataclasses.dataclass(frozen=True)
class RaisesHeard(Mechanism):
    name: ClassVar[str] = "raises-heard"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(proceed=RaisingHeard), "other": Role()}


@pytest.mark.parametrize("outer", [RaisesBefore(), RaisesAfter()], ids=["before", "after"])
async def test_a_refusal_that_a_brick_raises_ends_its_replica_as_any_exception_does(
    system: hf.ActorSystem, outer: Mechanism
) -> None:
    """Nobody is answered by it, so the request comes again, until it has ended too many."""
    stack = hf.ftm.compose(outer, hf.ftm.PBR())
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=stack, recovery=hf.hybrid()))
    assert await ref.ask(Add(1)) == 1
    with system.events() as events:
        with pytest.raises(hf.Quarantined):
            await ref.ask(Add(2, REFUSED), timeout=60)
        crashes = [one for one in events.take() if isinstance(one, hf.events.ActorCrashed)]
    assert crashes
    assert "raised tests.ftm.test_author_bricks.TooMuch: " in str(crashes[0])
    assert await ref.ask(Add(3), timeout=60) == 2
    assert await ref.ask(Tags()) == [1, 3]


async def test_so_it_does_when_it_hears_of_an_ask(system: hf.ActorSystem) -> None:
    account = await system.start(hf.child("account", hf.start(Account, 0)))
    stack = hf.ftm.compose(RaisesHeard(), hf.ftm.PBR())
    spec = hf.child("purse", hf.start(Purse), mechanism=stack, bindings={"account": account.path})
    purse = await system.start(spec)
    with pytest.raises((hf.Quarantined, hf.AskFailed)):
        await purse.ask(Pay(1), timeout=60)


class Consent(hf.Message[bool]):
    """Whether the other replica has nothing against an amount."""

    amount: int


class Consenting(Before):
    peer_messages = (Consent,)

    async def before(self, work: Work) -> Work:
        for one in list(work.requests) if self.leads and self.has_peer else ():
            message = self.message_of(one)
            if isinstance(message, Add):
                try:
                    await self.ask_peer(Consent(message.amount))
                except TooMuch as no:
                    work = self.refuse(work, one, no)
        return work

    async def from_peer(self, message: hf.Message[Any]) -> bool:
        assert isinstance(message, Consent)
        if message.amount == REFUSED:
            raise TooMuch(amount=message.amount)
        return True


@dataclasses.dataclass(frozen=True)
class Consents(Mechanism):
    """Asks the other replica for its consent."""

    name: ClassVar[str] = "consents"
    layer: ClassVar[str] = "assertion"
    roles: ClassVar[dict[str, Role]] = {"leader": Role(before=Consenting), "other": Role(before=Consenting)}


@pytest.mark.parametrize("is_secured", [False, True])
async def test_what_a_brick_refuses_its_peer_is_the_answer(secured: hf.ActorSystem, is_secured: bool) -> None:
    layers = (hf.ftm.SEC("/app/ca"), Consents(), hf.ftm.PBR()) if is_secured else (Consents(), hf.ftm.PBR())
    spec = hf.child("alice", hf.start(Counter), mechanism=hf.ftm.compose(*layers))
    ref = await secured.start(spec)
    await whole(ref)
    assert await ref.ask(Add(1), timeout=60) == 1
    with pytest.raises(TooMuch):
        await ref.ask(Add(2, REFUSED), timeout=60)
    assert await ref.ask(Tags(), timeout=60) == [1]
