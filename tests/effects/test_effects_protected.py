"""Behind mechanisms an effect is made once for each request, by whoever leads; all other runs get the outcome."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import LFR, NVP, PBR, RB, TMR, TR
from tests.effects.clerk import IN_TIME, Clerk, Do, Done, deed, lines, words
from tests.effects.patient import Go, Patient


class Second(Clerk):
    """Another version of it, which says so."""

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        said = [await self.attempted(message.file, word) for word in message.words]
        self.done.append(f"second: {' '.join(said)}")
        return self.done[-1]


class Third(Clerk):
    """A version that is no different."""


class Failing(Clerk):
    """It has an effect, and raises."""

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        await self.effect(message.file, message.words[0])
        raise RuntimeError("after the effect")


class Otherwise(Failing):
    """It wants another effect than the one that was made."""

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        return await self.ctx.effect(deed, message.file, "other", self.ctx.message_id, key="other")


class Likewise(Failing):
    """It wants the same effect, and does not raise."""

    @hf.on(Do)
    async def do(self, message: Do) -> str:
        return await self.effect(message.file, message.words[0])


def is_second(reply: object) -> bool:
    """A test that the class itself never passes."""
    return not isinstance(reply, str) or reply.startswith("second")


STACKS: dict[str, tuple[Any, ...]] = {
    "pbr": (PBR(),),
    "lfr": (LFR(),),
    "tmr": (TMR(),),
    "tr": (TR(),),
    "pbr + tr": (PBR(), TR()),
    "lfr + tr": (LFR(), TR()),
}
WITH_VERSIONS: dict[str, tuple[Any, ...]] = {
    "rb": (RB(alternates=(Second,), test=(is_second,)),),
    "nvp": (NVP(versions=(Third, Second)),),
}


def protected(stack: tuple[Any, ...]) -> hf.ChildSpec[Clerk]:
    return hf.child("clerk", hf.start(Clerk), recovery=hf.hybrid(), mechanism=stack)


@pytest.mark.parametrize("name", [*STACKS, *WITH_VERSIONS])
async def test_each_is_made_once_for_each_request(tmp_path: Path, name: str) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(protected((STACKS | WITH_VERSIONS)[name]))
        asked = [Do(world, [f"a{number}", f"thread{number}", f"b{number}:no"]) for number in range(8)]
        said = await asyncio.gather(*(ref.ask(one, IN_TIME) for one in asked))
        plain = [f"a{number}! thread{number}! (No(why='b{number}'))" for number in range(8)]
        assert said == ([f"second: {one}" for one in plain] if name == "rb" else plain)
        if name != "rb":
            assert await ref.ask(Done(), IN_TIME) == plain
    assert words(world) == [f"{word}{number}" for number in range(8) for word in ("a", "thread", "b")]
    assert len({line.split()[1] for line in lines(world)}) == 8


@pytest.mark.parametrize("name", ["pbr", "lfr", "tmr", "lfr + tr"])
@pytest.mark.parametrize("word", ["b", "once"])
async def test_whoever_leads_next_goes_on_where_the_last_one_has_died(tmp_path: Path, name: str, word: str) -> None:
    """It dies in the middle of the effect: that is made again with the same key, or is in doubt."""
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(protected(STACKS[name]))
        await whole(system, ref)
        said = await ref.ask(Do(world, ["a", f"{word}:die", "c"]), IN_TIME)
        again = await ref.ask(Done(), IN_TIME)
        await whole(system, ref)
        assert await ref.ask(Done(), IN_TIME) == again == [said]
    if word == "b":
        assert said == "a! b! c!"
        assert words(world) == ["a", "b", "b", "c"]
    else:
        assert said.startswith("a! (/app/clerk has ended while its effect deed was out")
        assert said.endswith(" c!")
        assert words(world) == ["a", "once", "c"]
    assert len({line.split()[1] for line in lines(world)}) == 1


@pytest.mark.parametrize("recovery", [hf.hybrid(), hf.fresh()])
async def test_an_alternate_gets_the_outcome_of_its_own_effect_only(tmp_path: Path, recovery: Any) -> None:
    """One that wants another effect than was made is no run; one that wants the same gets its outcome."""
    world = str(tmp_path / "world")
    for alternates, says in (((Likewise,), "a!"), ((Otherwise,), None), ((Otherwise, Likewise), "a!")):
        async with hf.ActorSystem("app", log=False, intensity=99) as system:
            stack = RB(alternates=alternates, test=(is_accepted,))
            ref = await system.start(hf.child("clerk", hf.start(Failing), recovery=recovery, mechanism=stack))
            for _ in range(2):
                if says is None:
                    with pytest.raises(hf.HoldfastError, match="has asked what the first run has not asked"):
                        await ref.ask(Do(world, ["a"]), IN_TIME)
                else:
                    assert await ref.ask(Do(world, ["a"]), IN_TIME) == says
            assert await ref.ask(Done(), IN_TIME) == []
    assert words(world) == ["a"] * 6


def is_accepted(reply: object) -> bool:
    return reply is not None


async def whole(system: hf.ActorSystem, ref: hf.ActorRef[Clerk]) -> None:
    """Wait until all replicas count."""
    async with asyncio.timeout(IN_TIME):
        while not (await system.protection(ref)).is_whole:
            await asyncio.sleep(0.01)


WATCHED = hf.ftm.Detection(interval=0.02, watch_turns=0.2)


@pytest.mark.parametrize("mechanism", [PBR(detection=WATCHED), TR(detection=WATCHED)])
async def test_a_turn_that_rests_is_not_taken_for_one_that_hangs(mechanism: Any) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        spec = hf.child("patient", hf.start(Patient), recovery=hf.hybrid(), mechanism=mechanism)
        ref = await system.start(spec)
        with system.events() as stream:
            assert await ref.ask(Go(["s1.5"]), IN_TIME) == "slept"
            assert not [event for event in stream.take() if isinstance(event, hf.events.TurnHung)]
