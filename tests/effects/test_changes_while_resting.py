"""A change does not wait for days: a turn that rests is left, and run again from its start behind the change."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.ftm import LFR, PBR, TMR, TR
from holdfast.ftm.group.steering import LOOK_AGAIN, past_resting_turns
from tests.effects import test_glances
from tests.effects.clerk import IN_TIME, lines, note
from tests.effects.patient import Call, Count, Go, Look, Patient, patient
from tests.effects.test_effects_protected import leader_dies, whole
from tests.effects.test_glances import sleeper
from tests.effects.test_long_waits import end_of, running, waits
from tests.ftm.test_failover import group_of

OTHER: dict[str, Any] = {"task": "process", "process": "task"}


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_is_moved_while_its_turn_rests(tmp_path: Path, isolation: Any, durability: str) -> None:
    """Nothing is lost, and nothing done twice: there and back, with a kill behind each move."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(patient(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(["e", "c", "e", "s0.01", "c", "e"], world), IN_TIME))
        count = ref.ask(Count(), IN_TIME)
        for word in "ab":
            await waits(system)
            isolation = OTHER[isolation]
            await system.set_isolation(ref, isolation)
            await waits(system)
            await end_of(system, isolation)
            await waits(system)
            await ref.ask(Call(word), IN_TIME)
        assert await asked == "effect 1, call a, effect 2, slept, call b, effect 3"
        assert await count == 1
        await end_of(system, isolation)
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2, slept, call b, effect 3"]
        assert len(lines(world)) == 3


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_comes_while_it_is_moved_is_taken_once(tmp_path: Path, isolation: Any) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        for number in range(3):
            asked = ref.ask(Go(["s0.02", "c", "c"]), IN_TIME)
            await waits(system)
            isolation = OTHER[isolation]
            moved = asyncio.ensure_future(system.set_isolation(ref, isolation))
            for step in range(2):
                ref.tell(Call(f"{number}.{step}"))
                await asyncio.sleep(0.01)
            await moved
            assert await asked == f"slept, call {number}.0, call {number}.1"
        assert len(await ref.ask(Look(), IN_TIME)) == 3


async def change_to(system: hf.ActorSystem, ref: Any, change: str, isolation: Any) -> None:
    match change:
        case "move":
            await system.set_isolation(ref, OTHER[isolation], timeout=IN_TIME)
        case "protect":
            async with system.transaction(timeout=IN_TIME) as changes:
                changes.protect(ref, PBR())
        case "suspend":
            await system.suspend(ref, timeout=IN_TIME)
            await system.resume(ref)


class Whole(Patient):
    """It counts in whole seconds: 600 is what 600.0 is, also where only the number is left."""

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        self.ctx.tell_after(600, Call("late"))
        self.ctx.every(600, Call("each"))
        await self.ctx.effect(note, message.file, "whole", timeout=600)
        await self.ctx.sleep(0)
        return (await self.ctx.wait_for(Call, timeout=600)).word


@pytest.mark.parametrize("change", ["move", "protect"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_whole_seconds_are_the_same_behind_a_change(tmp_path: Path, isolation: Any, change: str) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(
            hf.child("patient", hf.start(Whole), isolation=isolation, recovery=hf.hybrid(interval=1000))
        )
        asked = ref.ask(Go([], str(tmp_path / "world")), IN_TIME)
        await waits(system)
        await change_to(system, ref, change, isolation)
        await ref.ask(Call("now"), IN_TIME)
        assert await asked == "now"


@pytest.mark.parametrize("change", ["move", "protect", "suspend"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_snapshot_that_is_due_keeps_no_change_waiting(tmp_path: Path, isolation: Any, change: str) -> None:
    """It is to be taken before anything else, and after the turn that waits: it lapses with that."""
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation, recovery=hf.hybrid(interval=1000)))
        assert await ref.ask(Count(), IN_TIME) == 1
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        home = switch_of(ref._cell)
        assert home is not None
        home.due.want()
        async with asyncio.timeout(IN_TIME):
            while home.due.asked_at < 0:
                await asyncio.sleep(0.001)
        await change_to(system, ref, change, isolation)
        await ref.ask(Call("now"), IN_TIME)
        assert await asked == "call now"
        assert await ref.ask(Count(), IN_TIME) == 2


class Fussy(hf.Actor):
    """It goes on in one process only."""

    def __init__(self, home: int) -> None:
        self.home = home
        self.seen: list[str] = []

    def on_recovered(self) -> None:
        if os.getpid() != self.home:
            raise RuntimeError("not here")

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        self.seen.append("begun")
        word = (await self.ctx.wait_for(Call)).word
        self.seen.append(word)
        return ", ".join(self.seen)

    @hf.on(Call)
    def call(self, message: Call) -> None: ...


async def test_a_move_that_fails_ends_the_life_whose_turn_was_left(tmp_path: Path) -> None:
    """Its state was that of no turn; the next life, at the old place, goes on as after a kill."""
    async with running(tmp_path) as system:
        spec = hf.child("patient", hf.start(Fussy, os.getpid()), recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        asked = ref.ask(Go([]), IN_TIME)
        await waits(system)
        with system.events() as stream:
            with pytest.raises(hf.HoldfastError, match="not here"):
                await system.set_isolation(ref, "process")
            await ref.ask(Call("a"), IN_TIME)
            assert await asked == "begun, a"
            failed = [event for event in stream.take() if isinstance(event, hf.events.RecoveryFailed)]
            assert not failed, "the life whose turn was left has said something"


class Tidies(Patient):
    """When a turn of it is left, that has something to do until the file is there."""

    @hf.on(Go)
    async def go(self, message: Go) -> str | hf.ReplyHandle[str]:
        try:
            return await super().go(message)
        except asyncio.CancelledError:
            while not os.path.exists(message.file):
                await asyncio.sleep(0.001)
            raise


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_move_is_given_up_while_the_turn_is_being_left(tmp_path: Path, isolation: Any) -> None:
    """That life handles nothing more: what stands behind the turn is handled behind it, by the next one."""
    world = tmp_path / "world"
    async with running(tmp_path) as system:
        spec = hf.child("patient", hf.start(Tidies), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        asked, count = ref.ask(Go(["c"], str(world)), IN_TIME), ref.ask(Count(), IN_TIME)
        await waits(system)
        with system.events() as stream:
            with pytest.raises(hf.errors.CannotMove, match="did not"):
                await system.set_isolation(ref, OTHER[isolation], timeout=0.1)
            await system.get_status(ref)  # Its process has heard so, too.
            world.touch()
            await ref.ask(Call("a"), IN_TIME)
            assert await asked == "call a"
            assert await count == 1
            assert not [event for event in stream.take() if isinstance(event, hf.events.RecoveryFailed)]
        assert await ref.ask(Look(), IN_TIME) == ["call a"]


async def test_its_process_dies_while_it_leaves(tmp_path: Path) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient("process"))
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        moved = asyncio.ensure_future(system.set_isolation(ref, "task"))
        await asyncio.sleep(0)
        os.kill(system.pid_of(ref), signal.SIGKILL)
        await asyncio.wait((moved,))
        moved.exception()
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "call a"


STACKS: dict[str, tuple[Any, ...]] = {
    "pbr": (PBR(),),
    "lfr": (LFR(),),
    "tr": (TR(),),
    "pbr + tr": (PBR(), TR()),
    "tmr": (TMR(),),
}


@pytest.mark.parametrize(
    ("first", "then"), [("pbr", "lfr"), ("lfr", "pbr + tr"), ("tr", "pbr"), ("tmr", "tr"), ("lfr", "tmr")]
)
async def test_mechanisms_are_exchanged_while_a_turn_rests(tmp_path: Path, first: str, then: str) -> None:
    """There and back, and whoever leads dies in between."""
    world = str(tmp_path / "world")
    async with running(tmp_path) as system:
        ref = await system.start(patient(isolation="task", mechanism=STACKS[first]))
        await whole(system, ref)
        ref.tell(Count())
        asked = ref.ask(Go(["e", "c", "e", "s0.01", "c", "e"], world), IN_TIME)
        count = ref.ask(Count(), IN_TIME)
        call = ref.ask(Call("a"), IN_TIME)
        await call
        for stack in (then, first):
            await waits(system)
            await whole(system, ref)
            async with system.transaction(timeout=20) as change:
                change.protect(ref, STACKS[stack])
            assert (await system.protection(ref)).stack == tuple(one.name for one in STACKS[stack])
            await waits(system)
        if "tr" not in first:
            await whole(system, ref)
            await leader_dies(system, ref)
            await waits(system)
        await ref.ask(Call("b"), IN_TIME)
        assert await asked == "effect 1, call a, effect 2, slept, call b, effect 3"
        assert await count == 2
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2, slept, call b, effect 3"]
        assert len(lines(world)) == 3


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("stack", ["pbr", "lfr", "tr"])
async def test_an_actor_gets_mechanisms_and_loses_them_while_its_turn_rests(
    tmp_path: Path, isolation: Any, stack: str
) -> None:
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["e", "c", "e", "c"], world), IN_TIME)
        for layers in (STACKS[stack], None):
            await waits(system)
            async with system.transaction(timeout=20) as change:
                change.protect(ref, layers)
            await waits(system)
            await ref.ask(Call("a"), IN_TIME)
        assert await asked == "effect 1, call a, effect 2, call a"
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2, call a"]
        assert len(lines(world)) == 2


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_the_turn_had_changed_so_far_is_not_taken_along(tmp_path: Path, isolation: Any) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper(isolation))
        asked = ref.ask(test_glances.Go(), IN_TIME)
        for _ in range(2):
            await waits(system, ref.path)
            isolation = OTHER[isolation]
            await system.set_isolation(ref, isolation)
        await waits(system, ref.path)
        await ref.ask(test_glances.Word("a"), IN_TIME)
        assert await asked == ["begun", "a"]


class Both(hf.Actor):
    """It waits for a message while an effect is out that is made at most once."""

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        effect = self.ctx.effect(slow, message.file, at_most_once=True)
        said, call = await asyncio.gather(effect, self.ctx.wait_for(Call))
        return f"{said}, {call.word}"

    @hf.on(Call)
    def call(self, message: Call) -> None: ...


async def slow(file: str) -> int:
    await asyncio.sleep(1.5)
    return note(file, "slow")


@pytest.mark.parametrize("stack", [None, "pbr", "lfr"])
async def test_an_effect_that_is_out_beside_the_wait_is_waited_for(tmp_path: Path, stack: str | None) -> None:
    """It would be in doubt, and for no reason."""
    world = str(tmp_path / "world")
    async with running(tmp_path) as system:
        mechanism = None if stack is None else STACKS[stack]
        ref = await system.start(hf.child("patient", hf.start(Both), recovery=hf.hybrid(), mechanism=mechanism))
        asked = ref.ask(Go([], world), IN_TIME)
        await waits(system)
        if stack is None:
            await system.set_isolation(ref, "process")
        else:
            async with system.transaction(timeout=20) as change:
                change.protect(ref, STACKS["tr"])
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "1, a"


@pytest.mark.parametrize("later", [0.0, 0.001, 0.002, 0.004, 0.008, 0.016])
async def test_who_gives_up_waiting_for_a_turn_that_rests_leaves_it_to_go_on(later: float) -> None:
    """So many seconds behind the moment at which the replicas are told to leave it: it is sent again all the same."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        spec = hf.child("patient", hf.start(Patient), recovery=hf.hybrid(), mechanism=LFR())
        ref = await system.start(spec)
        await whole(system, ref)
        asked = ref.ask(Go(["c"]), IN_TIME)
        for _ in range(3):
            await waits(system)
            group = group_of(ref)
            leaving = asyncio.ensure_future(past_resting_turns(group, group.quiet()))
            await asyncio.wait((leaving,), timeout=LOOK_AGAIN + later)
            leaving.cancel()
            await asyncio.gather(leaving, return_exceptions=True)
            await asyncio.sleep(LOOK_AGAIN)  # Whoever has left it has done so.
        await waits(system)
        ref.tell(Call("a"))
        assert await asked == "call a"
