"""A turn that waits for what never comes: its process lives and beats, and yet nobody behind it is kept waiting."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.events import FailedOver, TurnHung
from tests.ftm.accounts import Account, Add, Counter, Put, Tags


class Hang(hf.Message[str]):
    """Pay, and wait for ever; with a path, only whoever comes there first does."""

    path: str = ""


class Hanging(Counter):
    @hf.on(Hang)
    async def hang(self, message: Hang) -> str:
        self.total += 1000  # Must leave no trace.
        if message.path:
            try:
                Path(message.path).touch(exist_ok=False)
            except FileExistsError:
                self.total -= 1000
                return "went on"
        await self.ctx.find("/app/payee", Account).ask(Put(1))
        await asyncio.get_running_loop().create_future()
        return "never"


WATCHED = hf.ftm.Detection(interval=0.02, watch_turns=1.0)


async def begun(system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
    await system.start(hf.child("payee", hf.start(Account, 0)))
    ref = await system.start(hf.child("alice", hf.start(Hanging), mechanism=mechanism))
    assert await ref.ask(Add(0)) == 1
    return ref


async def test_replicas_that_run_are_watched_as_a_change_of_mechanism_says(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    with system.events() as events:
        ref = await begun(system, hf.ftm.PBR())
        async with system.transaction(timeout=30) as change:
            change.protect(ref, hf.ftm.PBR(detection=WATCHED))
        assert await ref.ask(Hang(str(tmp_path / "first")), timeout=60) == "went on"
        assert [one.address for one in events.take() if isinstance(one, hf.events.TurnHung)] == [ref.path]


@pytest.mark.parametrize(
    "mechanism", [hf.ftm.PBR(detection=WATCHED), hf.ftm.LFR(detection=WATCHED)], ids=["pbr", "lfr"]
)
async def test_what_hangs_in_one_replica_only_is_answered_by_the_next(
    system: hf.ActorSystem, mechanism: Any, tmp_path: Path
) -> None:
    with system.events() as events:
        ref = await begun(system, mechanism)
        hung = ref.ask(Hang(str(tmp_path / "first")), timeout=60)
        behind = [ref.ask(Add(tag), timeout=60) for tag in (1, 2)]
        assert await hung == "went on"
        assert await asyncio.gather(*behind) == [2, 3]
        told = [one for one in events.take() if isinstance(one, (TurnHung, FailedOver))]
    if isinstance(mechanism, hf.ftm.PBR):  # Of leader and follower, the one that hangs may be the follower.
        assert [type(one) for one in told] == [TurnHung, FailedOver]
    assert await ref.ask(Tags()) == [0, 1, 2]


@pytest.mark.parametrize(
    "mechanism",
    [hf.ftm.PBR(detection=WATCHED), hf.ftm.LFR(detection=WATCHED), hf.ftm.TR(detection=WATCHED)],
    ids=["pbr", "lfr", "tr"],
)
async def test_a_message_that_hangs_again_is_put_aside(system: hf.ActorSystem, mechanism: Any) -> None:
    """It is not tried in one replica after the other, and the state is not lost with the last of them."""
    with system.events() as events:
        ref = await begun(system, mechanism)
        hung = ref.ask(Hang(), timeout=60)
        behind = [ref.ask(Add(tag), timeout=60) for tag in (1, 2)]
        with pytest.raises(hf.Quarantined):
            await hung
        assert await asyncio.gather(*behind) == [2, 3]
        told = [type(one) for one in events.take() if isinstance(one, (TurnHung, FailedOver))]
    tried = [TurnHung] if mechanism.replicas == 1 else [TurnHung, FailedOver]
    assert told == [*tried, TurnHung]
    assert [one.message for one in system.quarantined(ref)] == [Hang()]
    assert await ref.ask(Tags()) == [0, 1, 2]
    assert await system.ref("/app/payee", Account).ask(Put(0)) == 1  # What it has asked, it has asked once.
    assert ref._cell.life == 1


def test_a_limit_that_is_none_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="watch_turns"):
        hf.ftm.Detection(watch_turns=0)
