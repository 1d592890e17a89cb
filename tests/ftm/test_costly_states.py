"""What it costs to compare runs of an actor with a large state: told from 10 ms on, and only the change with deltas."""

from __future__ import annotations

from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.values import encode_value
from holdfast.ftm.alarms import ProtectionCostly
from holdfast.ftm.bricks.brick_messages import ServerState
from holdfast.ftm.bricks.runs import Digests, digest_of_state
from holdfast.ftm.bricks.state_images import image_from
from tests.ftm.replicated import Add

MEGABYTES = 64


class Archive(hf.Actor):
    """Has a large state, of which it changes a little."""

    def __init__(self, megabytes: int = MEGABYTES) -> None:
        self.pages = {f"{number}": bytes(1000) for number in range(1000 * megabytes)}
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        return self.total


@pytest.mark.parametrize("stack", [hf.ftm.TR(), hf.ftm.TMR()], ids=["tr", "tmr"])
async def test_it_is_told_once_what_a_large_state_costs(system: hf.ActorSystem, stack: Any) -> None:
    with system.events() as events:
        ref = await system.start(hf.child("archive", hf.start(Archive), mechanism=stack))
        for _ in range(3):
            await ref.ask(Add(1), timeout=120)
        told = [one for one in events.take() if isinstance(one, ProtectionCostly) and one.replica.endswith("/r1")]
    (one,) = told
    assert one.seconds > 0.01
    assert one.size > MEGABYTES * 1_000_000


async def test_a_small_state_is_not_worth_a_word(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("archive", hf.start(Archive, 0), mechanism=hf.ftm.TR()))
    with system.events() as events:
        assert await ref.ask(Add(1)) == 1
        assert not [one for one in events.take() if isinstance(one, ProtectionCostly) and one.size < 10_000]


def state(turn: int, data: Any, *deltas: object) -> ServerState:
    return ServerState(turn, data, [encode_value(one) for one in deltas], [], [], True)


def test_of_a_state_that_was_known_only_new_deltas_are_looked_at() -> None:
    """The whole state cannot even be read any more."""
    data = image_from(encode_value((1, "keys", {"total": 0})))
    first, second = state(1, data, {"total": 1}), state(2, data, {"total": 1}, {"total": 2})
    digests = Digests()
    assert digests.of(first) == digest_of_state(first)
    expected = digest_of_state(second)
    data.pieces.clear()
    assert digests.of(second) == expected


def test_other_deltas_or_another_state_below_them_make_another_digest() -> None:
    data, other = (image_from(encode_value((1, "keys", {"total": total}))) for total in (0, 1))
    digests = Digests()
    seen = [
        digests.of(one)
        for one in (
            state(2, data, {"total": 1}, {"total": 2}),
            state(2, data, {"total": 1}, {"total": 3}),
            state(2, data, {"total": 2}),
            state(3, data, {"total": 2}),
            state(2, other, {"total": 2}),
        )
    ]
    assert len(set(seen)) == len(seen)
    assert digests.of(state(2, data, {"total": 2})) == seen[2]
