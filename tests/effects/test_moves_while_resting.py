"""Nobody who holds back what a turn waits for waits for that turn: changes end, and so does the turn, in time."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.checkpoint.home.replay import is_as_before
from holdfast.checkpoint.protocol import LEADS_NOWHERE, Out
from holdfast.ftm import LFR, PBR, TMR, TR
from holdfast.testing import advance
from tests.effects.clerk import lines, note
from tests.effects.patient import IN_TIME, Call, Count, Look, Patient
from tests.effects.test_effects_protected import whole
from tests.effects.test_long_waits import VIRTUAL, waits

OTHER: dict[str, Any] = {"task": "process", "process": "task"}
LONG = 200.0  # seconds
AT = "/app/s/x/patient"


class Rest(hf.Message[str]):
    """Wait in one way: "sleep", "until", "wait" (for a `Call`) or "effect", for so many seconds."""

    how: str
    seconds: float = LONG
    file: str = ""  # where each run of the handler is noted


class Newer(Patient): ...


class Resting(Newer):
    @hf.on(Rest)
    async def rest(self, message: Rest) -> str:
        if message.file:
            note(message.file, "begun")
        match message.how:
            case "sleep":
                await self.ctx.sleep(message.seconds)
            case "until":
                await self.ctx.sleep_until(self.ctx.now() + message.seconds)
            case "wait":
                await self.ctx.wait_for(Call)
            case _:
                await self.ctx.effect(passes, message.seconds)
        self.seen.append(message.how)
        return self.ctx.path


class Other(Resting): ...


async def passes(seconds: float) -> None:
    await asyncio.sleep(seconds)


def family(**options: Any) -> hf.ChildSpec[Any]:
    """A supervisor and the actor whose turns rest."""
    options = {"recovery": hf.hybrid(interval=1000.0), **options}
    return hf.supervisor("x", intensity=99, children=[hf.child("patient", hf.start(Resting), **options)])


async def grown(system: hf.ActorSystem, top: hf.ChildSpec[Any] | None = None) -> hf.ActorRef[Resting]:
    """A tree of two supervisors, below one of which the actor is."""
    await system.start(hf.supervisor("s", intensity=99, children=[family() if top is None else top]))
    await system.start(hf.supervisor("o", intensity=99))
    return system.ref(AT, Resting)


async def rests(system: hf.ActorSystem, how: str) -> None:
    if how == "effect":
        await asyncio.sleep(0.01)
    else:
        await waits(system, AT)


# -- each change, each rest --------------------------------------------------------------------------------------------


async def moved(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=2 * LONG) as change:
        change.move(ref, "/app/o")


async def moved_from_above(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=2 * LONG) as change:
        change.move("/app/s/x", "/app/o")


async def suspended(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.suspend(ref, timeout=2 * LONG)
    await system.resume(ref)


async def replaced(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.suspend(ref, timeout=2 * LONG)
    await system.replace_code(ref, Other, timeout=2 * LONG)
    await system.resume(ref)


async def changed(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    async with system.transaction(timeout=2 * LONG) as change:
        change.replace_state(ref, dict)


async def saved(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.checkpoint(ref, timeout=2 * LONG)


async def cut(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    await system.checkpoint_group([ref], name="cut")


CHANGES: dict[str, Callable[[hf.ActorSystem, hf.ActorRef[Any]], Awaitable[None]]] = {
    one.__name__: one for one in (moved, moved_from_above, suspended, replaced, changed, saved, cut)
}
WAIT = ("moved", "moved_from_above", "saved")
"""They wait for the end of a turn that rests. The others leave it, and it is run again, or pay it no heed."""


@VIRTUAL
@pytest.mark.parametrize("how", ["sleep", "until", "wait", "effect"])
@pytest.mark.parametrize("name", CHANGES)
async def test_a_change_and_the_turn_that_rests_both_end(name: str, how: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await grown(system)
        assert await ref.ask(Count(), IN_TIME) == 1
        await advance(1.0)
        asked = asyncio.ensure_future(ref.ask(Rest(how), 9 * LONG))
        await rests(system, how)
        beside = asyncio.ensure_future(ref.ask(Count(), 9 * LONG))
        with system.events() as stream:
            change = asyncio.ensure_future(CHANGES[name](system, ref))
            await advance(LONG / 2)
            if how != "effect":
                assert change.done() is (name not in WAIT)
            assert not asked.done()
            if how == "wait":
                ref.tell(Call())
            await advance(LONG / 2 + 1.0)
            assert asked.done(), "what the turn waits for has not reached it"
            await change
            assert not [one for one in stream.take() if isinstance(one, hf.events.ActorCrashed)]
        assert await asked == AT, "a turn was repeated under another address"
        assert await beside == 2
        assert await ref.ask(Look(), IN_TIME) == [how]
        assert ref.path == {"moved": "/app/o/patient", "moved_from_above": "/app/o/x/patient"}.get(name, AT)


@VIRTUAL
@pytest.mark.parametrize("how", ["sleep", "until", "wait", "effect"])
async def test_a_turn_that_rests_elsewhere_keeps_nobody_from_being_moved(how: str) -> None:
    """A sleep, a wait and an effect lead to no address."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await grown(system)
        other = await system.start(hf.child("other", hf.start(Resting), recovery=hf.hybrid()))
        asked = asyncio.ensure_future(other.ask(Rest(how), 9 * LONG))
        await asyncio.sleep(0.01)
        async with system.transaction(timeout=5.0) as change:
            change.move(ref, "/app/o")
        assert not asked.done()
        other.tell(Call())
        await advance(LONG)
        assert await asked == "/app/other"


# -- some for others ---------------------------------------------------------------------------------------------------


class Answer(hf.Message): ...


class Need(hf.Message[str]):
    """Rest, and then ask another actor, or wait for what it tells."""

    peer: hf.ActorRef[Any]
    how: str


class Pair(Patient):
    """Its turn needs another one below the same supervisor."""

    @hf.on(Need)
    async def need(self, message: Need) -> str:
        await asyncio.sleep(5.0)  # A turn that nobody knows to wait: all others are at rest when it goes on.
        if message.how == "ask":
            return f"{await message.peer.ask(Count(), 9 * LONG)}"
        message.peer.tell(Answer())
        await self.ctx.wait_for(Call)
        return "called"

    @hf.on(Answer)
    def answer(self, message: Answer) -> None:
        assert self.ctx.sender is not None
        self.ctx.sender.tell(Call())


@VIRTUAL
@pytest.mark.parametrize("how", ["ask", "wait"])
@pytest.mark.parametrize("order", ["ab", "ba"])
async def test_who_is_at_rest_lets_another_turn_have_what_that_waits_for(order: str, how: str) -> None:
    """All below a supervisor come to rest for its move, and one of them needs another one before it can."""
    specs = {name: hf.child(name, hf.start(Pair), recovery=hf.hybrid()) for name in order}
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        top = hf.supervisor("x", intensity=99, children=[specs[name] for name in order])
        await system.start(hf.supervisor("s", intensity=99, children=[top]))
        await system.start(hf.supervisor("o", intensity=99))
        one, peer = system.ref("/app/s/x/a", Pair), system.ref("/app/s/x/b", Pair)
        asked = asyncio.ensure_future(one.ask(Need(peer, how), 9 * LONG))
        await asyncio.sleep(0.01)
        async with system.transaction(timeout=60.0) as change:
            change.move("/app/s/x", "/app/o")
        assert await asked == ("1" if how == "ask" else "called")


@VIRTUAL
async def test_the_others_answer_until_the_turn_that_rests_is_over() -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        children = [hf.child(name, hf.start(Resting), recovery=hf.hybrid()) for name in ("other", "patient", "last")]
        ref = await grown(system, hf.supervisor("x", intensity=99, children=children))
        asked = asyncio.ensure_future(ref.ask(Rest("sleep"), 9 * LONG))
        await rests(system, "sleep")
        change = asyncio.ensure_future(moved_from_above(system, ref))
        for step in range(1, 4):
            await advance(1.0)
            now = asyncio.get_running_loop().time()
            for name in ("other", "last"):
                assert await system.ref(f"/app/s/x/{name}", Resting).ask(Count(), IN_TIME) == step
            assert asyncio.get_running_loop().time() - now < 0.01, "they stand still"
        await change
        assert await asked == AT


async def test_an_output_that_leads_nowhere_is_known_by_the_digest_that_a_store_of_before_has() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("patient", hf.start(Patient), recovery=hf.hybrid()))
        home = switch_of(ref._cell)
        assert home is not None
        out = Out(1, "sleep", "since then", seconds=3.0)
        assert out.digest() > LEADS_NOWHERE
        assert is_as_before(home, out, out.digest() - LEADS_NOWHERE)
        assert not is_as_before(home, Out(1, "sleep", "since then", seconds=4.0), out.digest())


# -- mechanisms --------------------------------------------------------------------------------------------------------

STACKS: dict[str, Any] = {"tr": TR(detection=None), "pbr": PBR(), "lfr": LFR(), "tmr": TMR()}


@pytest.mark.parametrize(
    ("stack", "how"), [("tr", "sleep"), ("tr", "wait"), ("pbr", "sleep"), ("lfr", "wait"), ("tmr", "effect")]
)
@pytest.mark.some(3)
async def test_who_is_protected_is_moved_when_its_turn_is_over(tmp_path: Path, stack: str, how: str) -> None:
    world = str(tmp_path / "world")
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await grown(system, family(mechanism=STACKS[stack]))
        await whole(system, ref)
        asked = asyncio.ensure_future(ref.ask(Rest(how, 1.0, world), IN_TIME))
        await rests(system, how)
        beside = asyncio.ensure_future(ref.ask(Count(), IN_TIME))
        change = asyncio.ensure_future(moved(system, ref))
        await asyncio.sleep(0.1)
        assert not change.done()
        ref.tell(Call())
        assert await asked == AT, "a turn was repeated under another address"
        await asyncio.wait_for(change, IN_TIME)
        assert ref.path == "/app/o/patient"
        assert await beside == 1
        if stack == "pbr":  # Elsewhere others run it, too.
            assert lines(world) == ["begun"], "it was left, and run again"
        assert [line for line in await ref.ask(Look(), IN_TIME) if not line.startswith("no turn")] == [how]


# -- supervisors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "how"), [("list", "wait"), ("dynamic", "wait"), ("dynamic", "sleep")])
async def test_a_supervisor_is_given_a_process_while_a_turn_below_it_rests(tmp_path: Path, kind: str, how: str) -> None:
    """There and back: the turn is left, as for a move of the actor alone, and snapshots that are wanted keep nobody."""
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{tmp_path / 'app.db'}", intensity=99) as system:
        often = hf.hybrid(interval=0.05)
        ref = await grown(system, family(recovery=often))
        if kind == "dynamic":
            above = await system.start(hf.dynamic("d", template=hf.child(None, hf.start(Resting), recovery=often)))
            ref = await above.ask(hf.StartChild(id="patient"))
        path, top = ref.path, "/app/d" if kind == "dynamic" else "/app/s/x"
        assert await ref.ask(Count(), IN_TIME) == 1
        asked = asyncio.ensure_future(ref.ask(Rest(how, 1.0), IN_TIME))
        await waits(system, path)
        beside = asyncio.ensure_future(ref.ask(Count(), IN_TIME))
        for place in OTHER.values():
            await system.set_isolation(system.ref(top, hf.Supervisor), place, timeout=IN_TIME)
        if how == "wait":
            await waits(system, path)
            assert not asked.done()
            ref.tell(Call())
        assert await asked == path
        assert await beside == 2
        assert await ref.ask(Look(), IN_TIME) == [how]


async def test_what_a_turn_waits_for_reaches_it_while_its_supervisor_leaves_a_process() -> None:
    """The actor is lent a process, where it may be brought to rest before it is in its turn again."""
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        await system.start(hf.supervisor("s", isolation="process", intensity=99, children=[family()]))
        await system.start(hf.supervisor("o", intensity=99))
        ref = system.ref(AT, Resting)
        asked = asyncio.ensure_future(ref.ask(Rest("wait"), IN_TIME))
        await waits(system, AT)
        change = asyncio.ensure_future(moved_from_above(system, ref))
        async with asyncio.timeout(IN_TIME):
            while not system.pid_of(ref) or system.pid_of(ref) == system.pid_of(system.ref("/app/s", hf.Supervisor)):
                await asyncio.sleep(0.001)
        ref.tell(Call())
        assert await asyncio.wait_for(asked, IN_TIME) == AT
        await asyncio.wait_for(change, IN_TIME)
        assert ref.path == "/app/o/x/patient"


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_move_that_is_given_up_says_what_it_has_waited_for_and_is_in_nobodys_way(isolation: Any) -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await grown(system, family(isolation=isolation))
        asked = asyncio.ensure_future(ref.ask(Rest("wait"), IN_TIME))
        await waits(system, AT)
        with pytest.raises(hf.errors.TransactionFailed, match=rf"a turn of {AT} has waited for 0.\d s for \S+Call"):
            async with system.transaction(timeout=0.3) as change:
                change.move(ref, "/app/o")
        await system.set_isolation(ref, OTHER[isolation], timeout=IN_TIME)
        assert not asked.done()
        await waits(system, AT)
        ref.tell(Call())
        assert await asked == AT
