"""Behind mechanisms an effect is made once for each request, by whoever leads; all other runs get the outcome."""

from __future__ import annotations

import asyncio
import math
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm import AD, LFR, NVP, PBR, RB, TMR, TR
from tests.effects.clerk import IN_TIME, Clerk, Do, Done, deed, lines, words
from tests.effects.patient import Call, Count, Go, Look, Patient
from tests.effects.test_long_waits import waits
from tests.ftm.campaign import injecting
from tests.ftm.injection import Fault
from tests.ftm.test_failover import pid_of


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


async def whole(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
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


async def test_a_turn_that_has_rested_does_not_hang_when_it_goes_on() -> None:
    """What it has rested does not count when its effect takes a while."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        spec = hf.child("late", hf.start(Late), recovery=hf.hybrid(), mechanism=PBR(detection=LONGER))
        ref = await system.start(spec)
        await whole(system, ref)
        with system.events() as stream:
            for _ in range(2):
                await ref.ask(Count(), IN_TIME)
            assert not [event for event in stream.take() if isinstance(event, hf.events.TurnHung)]


LONGER = hf.ftm.Detection(interval=0.02, watch_turns=1.0)


class Late(hf.Actor):
    @hf.on(Count)
    async def rest(self, message: Count) -> int:
        await self.ctx.sleep(1.2)
        await self.ctx.effect(asyncio.sleep, 0.7)
        return 1


class Deaf(Patient):
    """Another version of it, which takes the same."""


ALL: dict[str, tuple[Any, ...]] = {
    **STACKS,
    "rb": (RB(alternates=(Deaf,), test=(is_accepted,)),),
    "nvp": (NVP(versions=(Deaf, Deaf)),),
    "ad + pbr": (AD(assertions=(is_accepted,)), PBR()),
    "ad + lfr": (AD(assertions=(is_accepted,)), LFR()),
}


@pytest.mark.parametrize("recovery", [hf.hybrid(), hf.fresh()], ids=["hybrid", "fresh"])
@pytest.mark.parametrize("name", ALL)
async def test_what_a_turn_waits_for_is_taken_once(name: str, recovery: Any) -> None:
    """Also if it was on its way to the replicas in the same batch, behind the turn that waits for it."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(hf.child("patient", hf.start(Patient), recovery=recovery, mechanism=ALL[name]))
        await whole(system, ref)
        with system.events() as stream:
            for _ in range(3):
                ref.tell(Go(["s0.03"]))  # All that comes meanwhile is in one batch.
                asked = ref.ask(Go(["c", "s0.01", "c"]), IN_TIME)
                counts = [ref.ask(Count(), IN_TIME)]
                ref.tell(Call("a"))
                counts.append(ref.ask(Count(), IN_TIME))
                await ref.ask(Call("b"), IN_TIME)
                assert await asked == "call a, slept, call b"
                first = await counts[0]
                assert await counts[1] == first + 1
            ref.tell(Call("late"))
            said = [*["slept", "call a, slept, call b"] * 3, "no turn has waited for late"]
            assert await ref.ask(Look(), IN_TIME) == said
            bad = (hf.events.ActorCrashed, hf.events.RequestsDropped, hf.events.Diverged, hf.events.Masked)
            assert not [event for event in stream.take() if isinstance(event, bad)]


@pytest.mark.parametrize("name", ["pbr", "lfr", "tmr", "lfr + tr", "ad + lfr"])
@pytest.mark.parametrize("when", ["before", "with it", "behind"])
async def test_whoever_leads_next_waits_for_it_or_has_it(tmp_path: Path, name: str, when: str) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(hf.child("patient", hf.start(Patient), recovery=hf.hybrid(), mechanism=ALL[name]))
        for number in range(3):
            await whole(system, ref)
            asked = ref.ask(Go(["e", "c", "e", "c"], world), IN_TIME)
            calls = [ref.ask(Call(f"a{number}"), IN_TIME)] if when == "with it" else []
            await waits(system)
            if when != "before" and not calls:
                await ref.ask(Call(f"a{number}"), IN_TIME)
                await waits(system)
            await leader_dies(system, ref)
            if when == "before":
                await ref.ask(Call(f"a{number}"), IN_TIME)
            await ref.ask(Call(f"b{number}"), IN_TIME)
            assert (await asked).split(", ")[1::2] == [f"call a{number}", f"call b{number}"]
            await asyncio.gather(*calls)
        seen = await ref.ask(Look(), IN_TIME)
        assert len(seen) == 3
        assert len(lines(world)) == 6


@pytest.mark.parametrize("name", ["lfr", "pbr", "lfr + tr"])
@pytest.mark.parametrize("step", ["protocol", "proceed"])
@pytest.mark.some(3)
async def test_what_was_taken_is_handled_by_nobody_if_the_leader_dies_with_that_news(name: str, step: str) -> None:
    """The follower was given it in the same batch, and hears when it leads that its turn has it already."""
    with injecting() as page:
        async with hf.ActorSystem("app", log=False, intensity=99) as system:
            spec = hf.child("patient", hf.start(Patient), recovery=hf.hybrid(), mechanism=ALL[name])
            ref = await system.start(spec)
            await whole(system, ref)
            page.arm(Fault("crash", step, "Inward", nth=2, leads=True))  # The first one ends the wait before.
            ref.tell(Go(["s0.01"]))  # All of this is in one batch.
            asked, call = ref.ask(Go(["c", "c"]), IN_TIME), ref.ask(Call("a"), IN_TIME)
            count = ref.ask(Count(), IN_TIME)
            await call
            await ref.ask(Call("b"), IN_TIME)
            assert await asked == "call a, call b"
            assert page.has_fired
            assert await count == 1
            assert await ref.ask(Look(), IN_TIME) == ["slept", "call a, call b"]
            await whole(system, ref)
            await leader_dies(system, ref)
            assert await ref.ask(Look(), IN_TIME) == ["slept", "call a, call b"]


class Fail(hf.Message[None]): ...


class Frail(Patient):
    @hf.on(Fail)
    def fail(self, message: Fail) -> None:
        raise RuntimeError("as it was told to")


@pytest.mark.parametrize("late", ["batch", "nothing"])
async def test_a_follower_does_not_handle_what_a_turn_has_waited_for(late: str) -> None:
    """Whichever comes first, the batch or the news; nor does it when its life begins anew, or when it leads."""
    with injecting() as page:
        async with hf.ActorSystem("app", log=False, intensity=99) as system:
            spec = hf.child("patient", hf.start(Frail), recovery=hf.hybrid(), mechanism=LFR(compare_every=math.inf))
            ref = await system.start(spec)
            await whole(system, ref)
            with system.events() as stream:
                if late == "batch":  # The news that it has been waited for overtakes it.
                    page.arm(Fault("delay", "proceed", "Work", leads=False))
                ref.tell(Go(["s0.01" if late == "batch" else "s0.05"]))  # All of this is in one batch.
                asked, call = ref.ask(Go(["c"]), IN_TIME), ref.ask(Call("a"), IN_TIME)
                count = ref.ask(Count(), IN_TIME)
                await asyncio.gather(asked, call, count)
                assert page.has_fired or late == "nothing"
                for number in range(2):
                    with pytest.raises(hf.RemoteCrash, match="as it was told"):
                        await ref.ask(Fail(), IN_TIME)
                    assert await ref.ask(Count(), IN_TIME) == 2 + number
                await leader_dies(system, ref)
                assert await ref.ask(Look(), IN_TIME) == ["slept", "call a"]
                assert await ref.ask(Count(), IN_TIME) == 4
                await whole(system, ref)
                assert not [event for event in stream.take() if isinstance(event, hf.events.Diverged)]


async def leader_dies(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Kill the process of the replica that leads, and wait until another one does."""
    leader = (await system.protection(ref)).leader
    assert leader is not None
    with system.events() as stream:
        os.kill(pid_of(system, ref, leader), signal.SIGKILL)
        async with asyncio.timeout(IN_TIME):
            async for event in stream:
                if isinstance(event, hf.events.FailedOver):
                    return
