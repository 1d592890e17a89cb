"""An operator need not wait for days: a turn that rests is left for an order, and run again behind it."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.effects import test_glances
from tests.effects.clerk import IN_TIME, lines
from tests.effects.patient import Call, Count, Go, Look, Patient, patient
from tests.effects.test_glances import sleeper
from tests.effects.test_long_waits import end_of, running, waits


class Newer(Patient):
    """Says so in what its turns come to."""

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        return f"newer: {await super().go(message)}"


def one_more(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "count": state["count"] + 10}


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_is_suspended_while_its_turn_rests(tmp_path: Path, isolation: Any, durability: str) -> None:
    """What it waits for may come meanwhile: it goes on after `resume`, and has done nothing twice."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(patient(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(["e", "c", "e", "s0.01", "e", "c"], world), IN_TIME))
        await waits(system)
        with system.events() as stream:
            await system.suspend(ref, timeout=IN_TIME)
            assert (await system.get_status(ref)).state == "suspended"
            call = ref.ask(Call("a"), IN_TIME)
            count = ref.ask(Count(), IN_TIME)
            await asyncio.sleep(0.05)
            assert not asked.done()
            assert len(lines(world)) == 1
            await system.suspend(ref)  # Twice is once.
            await system.resume(ref)
            await call
            ended = (hf.events.ActorCrashed, hf.events.ChildRestarted)
            assert not [event for event in stream.take() if isinstance(event, ended)], "somebody has heard of an end"
        await waits(system)
        await ref.ask(Call("b"), IN_TIME)
        assert await asked == "effect 1, call a, effect 2, slept, effect 3, call b"
        assert await count == 1
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2, slept, effect 3, call b"]
        assert len(lines(world)) == 3


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_sleep_that_is_over_while_it_is_suspended_is_over_behind_that(tmp_path: Path, isolation: Any) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(["s0.2", "c0.1"]), IN_TIME))
        await waits(system)
        await system.suspend(ref, timeout=IN_TIME)
        await asyncio.sleep(0.3)
        assert not asked.done()
        await system.resume(ref)
        assert (await asked).startswith("slept, ")


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_ends_while_it_is_suspended_in_a_turn_that_was_left(tmp_path: Path, isolation: Any) -> None:
    """A suspension ends with the life; the turn goes on in the next one."""
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["e", "c", "e"], world), IN_TIME)
        await waits(system)
        await system.suspend(ref, timeout=IN_TIME)
        await end_of(system, isolation)
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "effect 1, call a, effect 2"
        assert len(lines(world)) == 2


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_gets_other_code_while_its_turn_rests(tmp_path: Path, isolation: Any, durability: str) -> None:
    """The turn is run again from its start by the new code, on the outcomes that it had; so it is after a kill."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["e", "c", "e", "c"], world), IN_TIME)
        await waits(system)
        await system.suspend(ref, timeout=IN_TIME)
        await system.replace_code(ref, Newer, timeout=IN_TIME)
        await system.resume(ref)
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        await waits(system)
        await end_of(system, isolation)
        await waits(system)
        await ref.ask(Call("b"), IN_TIME)
        assert await asked == "newer: effect 1, call a, effect 2, call b"
        assert len(lines(world)) == 2


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_transaction_changes_an_actor_while_its_turn_rests(tmp_path: Path, isolation: Any) -> None:
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["e", "c", "e"], world), IN_TIME)
        await waits(system)
        async with system.transaction(timeout=20) as change:
            change.replace_code(ref, Newer)
            change.replace_state(ref, one_more)
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "newer: effect 1, call a, effect 2"
        assert await ref.ask(Count(), IN_TIME) == 11
        assert len(lines(world)) == 2


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_actor_gets_another_state_while_its_turn_rests(tmp_path: Path, isolation: Any) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        state = await system.replace_state(ref, one_more, timeout=IN_TIME)
        assert state["seen"] == []
        await waits(system)
        await end_of(system, isolation)
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "call a"
        assert await ref.ask(Count(), IN_TIME) == 11


@pytest.mark.parametrize("step", [0, 1, 2, 3, 5, 8, 13, 21])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_it_is_killed_on_the_way(tmp_path: Path, isolation: Any, step: int) -> None:
    """After so many ticks of the loop: nothing is lost, and nothing done twice, whether or not it was suspended."""
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["e", "c", "e"], world), IN_TIME)
        await waits(system)
        with system.events() as stream:
            ordered = asyncio.ensure_future(system.suspend(ref, timeout=IN_TIME))
            for _ in range(step):
                await asyncio.sleep(0)
            pid = system.pid_of(ref) if isolation == "process" else None
            ref.kill() if pid is None else os.kill(pid, signal.SIGKILL)
            await asyncio.wait((ordered,))
            if not isinstance(ordered.exception(), hf.HoldfastError):
                ordered.result()
            async with asyncio.timeout(IN_TIME):  # Killed when it was another life already, no life has ended.
                while not [one for one in stream.take() if isinstance(one, hf.events.Recovered)] and pid is None:
                    await asyncio.sleep(0.01)
        await system.resume(ref, timeout=IN_TIME)
        call = ref.ask(Call("a"), IN_TIME)
        assert await asked == "effect 1, call a, effect 2"
        await call
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2"]
        assert len(lines(world)) == 2


async def test_the_program_ends_while_an_actor_is_suspended_in_a_turn_that_was_left(tmp_path: Path) -> None:
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient())
        ref.tell(Go(["e", "c", "e"], world))
        await waits(system)
        await system.suspend(ref, timeout=IN_TIME)
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient())
        await waits(system)
        await ref.ask(Call("a"), IN_TIME)
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2"]
        assert len(lines(world)) == 2


async def test_who_is_not_suspended_is_resumed_at_once(tmp_path: Path) -> None:
    """Twice is once, also while its turn rests."""
    async with running(tmp_path) as system:
        ref = await system.start(patient())
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        life = system._node.cell_at(ref.path).actor
        await system.resume(ref, timeout=IN_TIME)
        assert system._node.cell_at(ref.path).actor is life, "its turn was left for nothing"
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "call a"


def the_same(state: dict[str, Any]) -> dict[str, Any]:
    return state


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_the_turn_had_changed_so_far_is_not_kept(tmp_path: Path, isolation: Any) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(sleeper(isolation))
        asked = ref.ask(test_glances.Go(), IN_TIME)
        await waits(system, ref.path)
        await system.replace_state(ref, the_same, timeout=IN_TIME)
        await waits(system, ref.path)
        await ref.ask(test_glances.Word("a"), IN_TIME)
        assert await asked == ["begun", "a"]


class Wins(hf.Message):
    """Race an effect, which takes so many seconds, with a Call; what comes first is published."""

    seconds: float


class Won(hf.Message):
    by: str


class Who(hf.Message[str]): ...


async def worked(seconds: float) -> float:
    await asyncio.sleep(seconds)
    return seconds


class Racing(hf.Actor):
    name = "old"

    def __init__(self) -> None:
        self.won = 0

    @hf.on(Wins)
    async def race(self, message: Wins) -> None:
        both: list[asyncio.Future[Any]] = [self.ctx.effect(worked, message.seconds), self.ctx.wait_for(Call)]
        _, rest = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        for one in rest:
            one.cancel()
        self.won += 1
        await self.ctx.publish("/won", Won(self.name))

    @hf.on(Count)
    def count(self, message: Count) -> int:
        return self.won

    @hf.on(Who)
    def who(self, message: Who) -> str:
        return self.name


class RacingOn(Racing):
    name = "new"


def ten_more(state: dict[str, Any]) -> dict[str, Any]:
    return {**state, "won": state["won"] + 10}


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_turn_that_ends_by_itself_while_it_is_to_be_left_ends_once(tmp_path: Path, isolation: Any) -> None:
    """The life that has obeyed is the one that goes on, at whatever moment the effect comes."""
    async with running(tmp_path, "os") as system:
        stream = system.events()
        for number, seconds in enumerate((0.02, 0.05, 0.1, 0.2)):
            name = f"racing{number}"
            spec = hf.child(name, hf.start(Racing), isolation=isolation, recovery=hf.hybrid(interval=60.0))
            ref = await system.start(spec)
            ref.tell(Wins(seconds))
            await waits(system, ref.path)
            async with system.transaction(timeout=20) as change:
                change.replace_code(ref, RacingOn)
                change.replace_state(ref, ten_more)
            committed = [one for one in stream.take() if isinstance(one, hf.events.TransactionCommitted)]
            assert [one.problems for one in committed] == [()]
            for is_next in (False, True):
                if is_next:
                    await end_of(system, isolation, ref.path)
                assert await ref.ask(Who(), IN_TIME) == "new"
                assert await ref.ask(Count(), IN_TIME) == 11


async def test_what_helps_where_a_turn_is_not_left_is_said_and_helps(tmp_path: Path) -> None:
    async with running(tmp_path, "os") as system:
        await system.start(hf.supervisor("team", isolation="process", children=[patient("task")]))
        ref = system.ref("/app/team/patient", Patient)
        asked = asyncio.ensure_future(ref.ask(Go(["c"]), IN_TIME))
        await waits(system, ref.path)
        helps = "/app/team has a process, below which a turn that waits is not left: have it live as a task"
        with pytest.raises(hf.TransactionFailed, match=helps):
            async with system.transaction(timeout=0.1) as change:
                change.replace_code(ref, Newer)
        with pytest.raises(hf.AskTimeout, match=helps):
            await system.suspend(ref, timeout=0.1)
        for isolation in ("task", "process"):
            async with system.transaction(timeout=IN_TIME) as change:
                change.isolation("/app/team", isolation)
            if isolation == "task":
                async with system.transaction(timeout=IN_TIME) as change:
                    change.replace_code(ref, Newer)
        assert system.pid_of(ref) != os.getpid()
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "newer: call a"


class Parent(Patient):
    """Has a child, which ends before it does."""

    def on_start(self, restored: bool) -> None:
        self.ctx.spawn(hf.start(Idle), "child")


class Idle(hf.Actor): ...


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_has_children_is_stopped_while_its_turn_rests(tmp_path: Path, isolation: Any) -> None:
    """It waits for them in a step of its own. In that of the turn that is left no actor of the loop had another one."""
    async with running(tmp_path) as system:
        other = await system.start(hf.child("other", hf.start(Patient), recovery=hf.hybrid()))
        spec = hf.child("patient", hf.start(Parent), recovery=hf.hybrid(), isolation=isolation, restart="temporary")
        ref = await system.start(spec)
        asked = asyncio.ensure_future(ref.ask(Go(["c"]), IN_TIME))
        await waits(system)
        async with asyncio.timeout(IN_TIME):
            await system.stop(ref)
        with pytest.raises(hf.HoldfastError):
            await asked
        assert await other.ask(Count(), IN_TIME) == 1


async def test_an_order_that_waits_for_a_change_of_place_obeys_the_new_one(tmp_path: Path) -> None:
    """Its turn was to be left where it is not any more."""
    async with running(tmp_path) as system:
        ref = await system.start(patient())
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)

        async def protect() -> None:
            async with system.transaction(timeout=IN_TIME) as change:
                change.protect(ref, hf.ftm.PBR())

        protected = asyncio.ensure_future(protect())
        async with asyncio.timeout(IN_TIME):
            while not any("/ftm/" in path for path in system.tree()):
                await asyncio.sleep(0.001)
        with pytest.raises(hf.errors.ControlFailed, match="it is protected"):
            await system.replace_state(ref, the_same, timeout=IN_TIME)
        await protected
        await ref.ask(Call("a"), IN_TIME)
        assert await asked == "call a"
