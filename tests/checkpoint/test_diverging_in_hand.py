"""A turn without an end that the next life runs otherwise: it ends as a replay that goes another way does."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Notes, Sink, start, until
from tests.checkpoint.strikes import NEVER, event, let_through, sink
from tests.checkpoint.wayward_player import Approved, Look, Order, Wayward


def spec(world: Path, how: str, isolation: str = "task", **options: Any) -> hf.ChildSpec:
    options.setdefault("recovery", hf.hybrid(interval=NEVER))
    return hf.child("flow", hf.start(Wayward, str(world), how), isolation=isolation, **options)  # type: ignore[arg-type]


def below(world: Path, how: str, isolation: str, **options: Any) -> hf.ChildSpec:
    """Below a supervisor that may restart it often, and whose end is not that of the system."""
    own, above = ("task", "process") if isolation == "subtree" else (isolation, "task")
    child = spec(world, how, own, **options)
    return hf.supervisor("flows", children=[child], isolation=above, intensity=1000, restart="temporary")  # type: ignore[arg-type]


async def noted(notes: hf.ActorRef[Sink], count: int) -> None:
    """Wait until so much has left the turn in hand."""
    while len(await notes.ask(Notes())) < count:
        await asyncio.sleep(0.005)


async def rests(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Wait until its turn waits for a message."""
    async with asyncio.timeout(20.0):
        while "wait_for" not in (await system.get_status(ref)).turn_at:
            await asyncio.sleep(0.005)


async def given_up(stream: hf.events.EventStream) -> list[hf.events.Event]:
    """What was told until the supervisor gave up."""
    told: list[hf.events.Event] = []
    async with asyncio.timeout(30.0):
        async for one in stream:
            told.append(one)
            if isinstance(one, hf.events.SupervisorGaveUp):
                break
    return told


def kinds(told: Iterable[hf.events.Event], *wanted: type[hf.events.Event]) -> list[str]:
    return [type(one).__name__ for one in told if isinstance(one, wanted)]


@pytest.mark.parametrize("how", ["sleeps", "waits"])
async def test_its_start_fails_and_it_is_not_tried_again(
    system: hf.ActorSystem, isolation: str, how: str, tmp_path: Path
) -> None:
    world, notes = tmp_path / "world", await sink(system)
    world.write_text("as it was")
    await system.start(below(world, how, isolation))
    ref = system.ref("/app/flows/flow", Wayward)
    asked = ref.ask(Order("lamp", notes), timeout=30.0)
    await noted(notes, 1)
    world.write_text("another one")
    with system.events() as stream:
        ref.kill()
        waiting = ref.ask(Look(), timeout=30.0)
        told = await given_up(stream)
    events = hf.events.Recovered, hf.events.RecoveryFailed, hf.events.ChildStartFailed
    assert kinds(told, *events) == ["RecoveryFailed", "ChildStartFailed"]
    assert "nothing that is recorded of it is lost" in str(told[-1])
    with pytest.raises(hf.AskFailed, match="diverged at turn 1, output 1"):
        await asked
    with pytest.raises((hf.ActorStopped, hf.AskFailed), match="diverged at turn 1, output 1"):
        await waiting
    assert any("its turns do not go as they went before" in line for line in await system.why(ref))
    assert await notes.ask(Notes()) == ["as it was"]


async def test_with_a_back_off_it_goes_on_when_the_world_is_as_it_was(
    system: hf.ActorSystem, isolation: str, tmp_path: Path
) -> None:
    world, notes = tmp_path / "world", await sink(system)
    world.write_text("as it was")
    await system.start(below(world, "waits", isolation, backoff=hf.Backoff(0.01, 0.05)))
    ref = system.ref("/app/flows/flow", Wayward)
    asked = ref.ask(Order("lamp", notes), timeout=30.0)
    await noted(notes, 1)
    world.write_text("another one")
    with system.events() as stream:
        ref.kill()
        for _ in range(2):
            assert "diverged at turn 1, output 1" in (await event(stream, hf.events.RecoveryFailed)).reason
        world.write_text("as it was")
        await event(stream, hf.events.Recovered)
    ref.tell(Approved("ann"))
    assert await asked == "approved by ann"
    assert await notes.ask(Notes()) == ["as it was"]


async def test_when_it_is_up_already_its_life_ends_for_that_reason_and_no_other_begins(
    system: hf.ActorSystem, isolation: str, tmp_path: Path
) -> None:
    """Nobody can tell how long a turn waits for something that is in no journal: its start does not wait for that."""
    world, notes = tmp_path / "world", await sink(system)
    world.write_text("as it was")
    await system.start(below(world, "late", isolation))
    ref = system.ref("/app/flows/flow", Wayward)
    asked, gate = ref.ask(Order("lamp", notes), timeout=30.0), tmp_path / "world.gate"
    let_through(gate)
    await noted(notes, 2)
    Path(f"{gate}.open").unlink()
    world.write_text("another one")
    with system.events() as stream:
        ref.kill()
        await event(stream, hf.events.Recovered)
        let_through(gate)
        told = await given_up(stream)
    ends = [one for one in told if isinstance(one, hf.events.ChildTerminated)]
    assert "ReplayDiverged" in str(ends[-1].reason)
    assert kinds(told, hf.events.Recovered, hf.events.RecoveryFailed) == ["RecoveryFailed"]
    with pytest.raises(hf.AskFailed, match="diverged at turn 1, output 2"):
        await asked
    assert await notes.ask(Notes()) == ["begun", "as it was"]


@pytest.mark.parametrize("mechanism", [hf.ftm.PBR(), hf.ftm.LFR()], ids=["pbr", "lfr"])
async def test_behind_a_mechanism_its_life_ends_too(system: hf.ActorSystem, mechanism: Any, tmp_path: Path) -> None:
    world, notes = tmp_path / "world", await sink(system)
    world.write_text("as it was")
    await system.start(below(world, "waits", "task", mechanism=mechanism))
    ref = system.ref("/app/flows/flow", Wayward)
    asked = ref.ask(Order("lamp", notes), timeout=30.0)
    await noted(notes, 1)
    world.write_text("another one")
    with system.events() as stream:
        ref.kill()
        told = await given_up(stream)
    assert kinds(told, hf.events.RecoveryFailed) == ["RecoveryFailed"]
    with pytest.raises(hf.AskFailed, match="diverged at turn 1, output 1"):
        await asked
    assert await notes.ask(Notes()) == ["as it was"]


HOWS = ["one more effect", "no effect", "another effect", "a timer", "nothing"]


@pytest.mark.parametrize("how", HOWS)
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_other_code_is_refused_and_the_old_one_goes_on(isolation: str, how: str, tmp_path: Path) -> None:
    world, store = tmp_path / "world", f"sqlite:{tmp_path / 'app.db'}"
    world.write_text("as it was")
    async with hf.ActorSystem("app", log=False, store=store) as system:
        notes = await sink(system)
        ref = await system.start(spec(world, "waits", isolation))
        ref.tell(Order("lamp", notes))
        await rests(system, ref)
        ref.tell(Order("chair", notes))
    async with hf.ActorSystem("app", log=False, store=store) as system:
        notes = await sink(system)
        with pytest.raises(hf.StartFailed, match="diverged at turn 1, output"):
            await system.start(spec(world, how, isolation))
        assert not await notes.ask(Notes())
    async with hf.ActorSystem("app", log=False, store=store) as system:
        notes = await sink(system)
        ref = await system.start(spec(world, "waits", isolation))
        for count in (1, 2):
            await rests(system, ref)
            ref.tell(Approved("ann"))
            while len(await ref.ask(Look(), timeout=30.0)) < 2 * count:
                await asyncio.sleep(0.005)
        assert await ref.ask(Look(), timeout=30.0) == [
            "reserved lamp", "approved by ann", "reserved chair", "approved by ann"
        ]  # fmt: skip


async def test_a_start_does_not_wait_for_what_no_journal_has(
    system: hf.ActorSystem, isolation: str, tmp_path: Path
) -> None:
    first, second, notes = tmp_path / "first", tmp_path / "second", await sink(system)
    ref = await start(system, isolation, "doer", hf.start(Doer), recovery=hf.hybrid(interval=NEVER))
    steps = ["tell a", "flush", f"gate {first}", "tell b", "flush", f"gate {second}"]
    asked = ref.ask(Do(steps, notes), timeout=30.0)
    let_through(first)
    await until(second.exists)
    Path(f"{first}.open").unlink()
    with system.events() as stream:
        ref.kill()
        await event(stream, hf.events.Recovered)
    let_through(first)
    let_through(second)
    assert await asked == "0"
    assert await notes.ask(Notes()) == ["a", "b"]


def as_it_was(state: dict[str, Any]) -> dict[str, Any]:
    return state


async def test_a_start_does_not_wait_for_an_actor_that_is_suspended(system: hf.ActorSystem, gate: Path) -> None:
    """The order comes between two lives, and is obeyed before the turn in hand is run again."""
    notes = await sink(system)
    ref = await start(system, "task", "doer", hf.start(Doer), recovery=hf.hybrid(interval=NEVER))
    asked = ref.ask(Do(["tell a", "flush", f"gate {gate}"], notes), timeout=30.0)
    await until(gate.exists)
    gate.unlink()
    with system.events() as stream:
        suspended = asyncio.ensure_future(system.suspend(ref, timeout=30.0))
        await asyncio.sleep(0)
        ref.kill()
        await event(stream, hf.events.Recovered)
    await suspended
    assert not gate.exists()
    await system.replace_state(ref, as_it_was, timeout=30.0)  # It waits for no turn that is not run before `resume`.
    let_through(gate)
    await system.resume(ref)
    assert await asked == "0"
    assert await notes.ask(Notes()) == ["a"]
