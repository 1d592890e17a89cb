"""Orders that change a stack of mechanisms, over a secured link with an attacker on it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.bricks.replica_orders import Abort, Commit, PrepareStack, Stalled
from holdfast.ftm.bricks.sealed_frames import Opened, Refused, Sealed
from holdfast.ftm.bricks.state_transfer import Assume
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.replica.replica import EndBricks
from tests.ftm.accounts import Add, Counter, Tags
from tests.ftm.test_adaptation_trouble import fails, struck
from tests.ftm.test_sec import CA, Tap, every, flip, group_of, joined


async def begun(secured: hf.ActorSystem) -> Any:
    ref = await secured.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.compose(hf.ftm.SEC(CA), hf.ftm.PBR())))
    await joined(ref)
    assert await ref.ask(Add(0)) == 1
    return ref


def names(ref: Any) -> list[str]:
    return [layer.name for layer in ref._cell.host.place.layers]


async def test_a_change_is_made_though_its_orders_are_held_back_altered_and_replayed(
    secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """T47: each is done once, in the order in which they were given, and none is there to be read."""
    tap = Tap().on_replicas(monkeypatch)
    ref = await begun(secured)
    held: list[tuple[str, bytes]] = []
    arrived: set[bytes] = set()
    harm = every(3, flip)

    def strike(path: str, frame: bytes) -> bytes | None:
        if path.endswith("/protocol") and path not in dict(held):
            held.append((path, frame))
            return None
        struck = harm(path, frame)
        if struck == frame:
            arrived.add(frame)
        return struck

    tap.seen.clear()
    tap.strike = strike
    async with secured.transaction(timeout=60) as change:
        change.protect(ref, hf.ftm.compose(hf.ftm.SEC(CA), LFR(), hf.ftm.TR()))
    tap.strike = lambda path, frame: frame
    assert names(ref) == ["sec", "lfr", "tr"]
    assert {path for path, _ in held} == {"/app/c/ftm/r1/protocol", "/app/c/ftm/r2/protocol"}
    said = list(tap.seen)
    assert not [one for _, one in said if isinstance(one, (PrepareStack, Commit, Abort))]
    sealed = [(path, one.frame) for path, one in said if isinstance(one, Sealed) and "/r" in path]
    again = [*held, *(one for one in sealed if one[1] in arrived)]  # What never came as it was sent is new there.
    assert len(again) > len(held)
    for path, frame in again:
        with pytest.raises(Refused, match=r"replayed|wrong_session|forged|stale"):
            await secured._node.cell_at(path).ref.ask(Sealed(frame))
    assert await ref.ask(Add(1)) == 2
    await joined(ref)
    assert names(ref) == ["sec", "lfr", "tr"]


async def test_the_order_that_ends_a_link_is_answered_over_it(
    secured: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    tap = Tap().on_replicas(monkeypatch)
    ref = await begun(secured)
    tap.seen.clear()
    async with secured.transaction(timeout=60) as change:
        change.protect(ref, "pbr")
    assert not [one for _, one in tap.seen if isinstance(one, Commit)]  # Nobody has to ask in plain words.
    assert names(ref) == ["pbr"]
    assert await ref.ask(Add(1)) == 2


async def test_an_engine_that_dies_before_it_knows_that_the_links_have_ended_learns_it(secured: hf.ActorSystem) -> None:
    ref = await begun(secured)
    seen = struck(ref, "switch", fails)
    async with secured.transaction(timeout=60) as change:
        change.protect(ref, "pbr")
    assert seen.count("switch") == 2
    assert names(ref) == ["pbr"]
    assert await ref.ask(Add(1)) == 2
    assert group_of(ref).failovers == 0


async def test_orders_that_are_forged_change_nothing(secured: hf.ActorSystem) -> None:
    ref = await begun(secured)
    group, node = group_of(ref), secured._node
    replica, protocol = node.cell_at("/app/c/ftm/r1").ref, node.cell_at("/app/c/ftm/r1/protocol").ref
    bricks = sorted(secured.tree())
    with secured.events() as events:
        for order in (PrepareStack(99, [hf.ftm.PBR().describe()]), Commit(99), Abort(group.adaptation.config)):
            with pytest.raises(Refused, match="plain"):
                await protocol.ask(order)
            with pytest.raises(hf.HoldfastError):
                await replica.ask(order)
        own: tuple[Any, ...] = (Assume(False), EndBricks(["before"]))
        for its in own:
            with pytest.raises(hf.HoldfastError):
                await replica.ask(its)
        with pytest.raises(Refused, match="forged"):
            await replica.ask(Opened(0))
        node.cell_at("/app/c/ftm/proxy").ref.tell(Stalled(group.membership.primary, group.membership.epoch, 0))
        places: set[tuple[str, str]] = set()
        async with asyncio.timeout(20):
            while places < {("/app/c/ftm/r1", "plain"), ("/app/c/ftm/proxy", "plain")}:
                places |= {(one.place, one.reason) for one in events.take() if isinstance(one, hf.events.FrameRefused)}
                await asyncio.sleep(0.01)
    assert (
        await protocol.ask(Commit(group.adaptation.config)) == 1
    )  # What was done already can be asked, and is only told.
    assert sorted(secured.tree()) == bricks
    assert await ref.ask(Add(1)) == 2
    assert await ref.ask(Tags()) == [0, 1]
    assert (group.membership.epoch, ref._cell.life) == (1, 1)
