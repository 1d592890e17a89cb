"""What recovery refuses, gives up, or brings back only when asked (DESIGN 4 and 6, T9-T28)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.supervision.admin import RestartChild, TerminateChild
from tests.checkpoint.players import Dice, Do, Doer, Honest, Note, Notes, Seen, until
from tests.checkpoint.strikes import NEVER, doer, event, sink, strike, struck


def below(isolation: Any) -> tuple[Any, Any]:
    """Where the actor lives, and where its supervisor does."""
    return ("task", "process") if isolation == "subtree" else (isolation, "task")


async def test_replay_of_an_actor_that_is_not_deterministic_diverges(system: hf.ActorSystem, isolation: Any) -> None:
    notes = await sink(system)
    own, above = below(isolation)
    spec = hf.child("dice", hf.start(Dice), isolation=own, recovery=hf.hybrid(interval=NEVER))
    nested = hf.supervisor("games", intensity=1000, children=[spec], restart="temporary", isolation=above)
    await system.start(nested)
    ref = system.ref("/app/games/dice", Dice)
    await ref.ask(Do([], notes))
    with system.events() as stream:
        ref.kill()
        waiting = ref.ask(Do([], notes), timeout=30.0)
        told: list[hf.events.Event] = []
        why = ""
        async for one in stream:
            told.append(one)
            if isinstance(one, hf.events.SupervisorGaveUp):
                why = str(one.reason)
                break
        assert "diverged at turn 1" in why
        assert "nothing that is recorded of it is lost: start it with the code that has" in why
    [failed] = [one for one in told if isinstance(one, hf.events.RecoveryFailed)]
    assert "diverged at turn 1, output 1" in failed.reason
    assert sum(isinstance(one, hf.events.ChildStartFailed) for one in told) == 1, "it would diverge again"
    with pytest.raises(hf.ActorStopped, match="diverged at turn 1"):
        await waiting
    noted = await notes.ask(Notes())
    assert len(noted) == 1


def test_a_class_that_says_it_is_not_deterministic_is_refused() -> None:
    with pytest.raises(hf.SpecError, match="Honest is not deterministic"):
        hf.child("honest", hf.start(Honest), recovery=hf.hybrid())


@pytest.mark.parametrize("deep", [0, 1, 2])
async def test_a_message_is_quarantined_before_anybody_else_falls(
    system: hf.ActorSystem, deep: int, tmp_path: Path
) -> None:
    """With the defaults: the root allows three restarts in five seconds, other supervisors one, and they escalate."""
    spec: hf.ChildSpec = hf.child("doer", hf.start(Doer), isolation="process", recovery=hf.hybrid())
    path = "/app"
    for number in range(deep):
        spec = hf.supervisor(f"s{number}", children=[spec])
    await system.start(spec)
    path += "".join(f"/s{number}" for number in reversed(range(deep))) + "/doer"
    ref, notes = system.ref(path, Doer), await sink(system)
    await ref.ask(Note("before"))
    bad = Do([f"die {tmp_path}/deaths"], notes)
    with system.events() as events:
        if deep:
            ref.tell(bad)  # An ask ends with the supervisor that gives up.
        else:
            with pytest.raises(hf.Quarantined):
                await ref.ask(bad, timeout=30.0)
        assert (await event(events, hf.events.MessageQuarantined)).deliveries == 3
    assert (tmp_path / "deaths").read_text() == "xxx"
    assert len(system.quarantined()) == 1
    assert await system.ref(path, Doer).ask(Seen(), timeout=30.0)


async def test_a_message_that_kills_its_process_again_and_again_is_quarantined(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """T16: and the next turn does not inherit what that one has sent or asked."""
    ref, notes = await doer(system, "process", max_deliveries=3), await sink(system)
    await ref.ask(Note("before"))
    with system.events() as stream:
        bad = ref.ask(Do(["ask bad", f"die {tmp_path}/deaths"], notes), timeout=30.0)
        after = ref.ask(Do(["tell 1", "ask good", "tell 2"], notes), timeout=30.0)
        with pytest.raises(hf.Quarantined):
            await bad
        assert (await event(stream, hf.events.MessageQuarantined)).deliveries == 3
    await after
    await struck(system, ref)
    assert (tmp_path / "deaths").read_text() == "xxx"
    assert await ref.ask(Seen()) == ["before", "good:3"]
    assert await notes.ask(Notes()) == ["bad", "1", "good", "2"]


async def test_stopped_and_started_again_the_state_comes_back(system: hf.ActorSystem, isolation: Any) -> None:
    own, above = below(isolation)
    spec = hf.child("doer", hf.start(Doer), isolation=own, recovery=hf.hybrid(interval=NEVER))
    await system.start(hf.supervisor("house", children=[spec], isolation=above))
    house = system.ref("/app/house", hf.Supervisor)
    ref = system.ref("/app/house/doer", Doer)
    await ref.ask(Do(["add kept", "subscribe /news", "after 0.05"]))
    await house.ask(TerminateChild("doer"))
    with pytest.raises(hf.ActorStopped):
        await ref.ask(Seen())
    again = await house.ask(RestartChild("doer"))
    await system.publish("/news", Note("news"))
    while len(await again.ask(Seen())) < 3:
        await asyncio.sleep(0.005)
    assert sorted(await again.ask(Seen())) == ["kept", "news", "tick"]


async def test_a_tick_that_had_come_when_the_actor_was_stopped_is_handled_by_the_next_life(
    system: hf.ActorSystem, isolation: Any
) -> None:
    """As its timer would go on if it had not run out yet."""
    own, above = below(isolation)
    spec = hf.child("doer", hf.start(Doer), isolation=own, recovery=hf.hybrid(interval=NEVER))
    await system.start(hf.supervisor("house", children=[spec], isolation=above))
    house, ref = system.ref("/app/house", hf.Supervisor), system.ref("/app/house/doer", Doer)
    await ref.ask(Do(["add kept", "after 0.05"]))
    await system.suspend(ref)
    cell: Any = ref._cell
    await until(lambda: any(source.kind == "tick" for source in cell.host.home.switch.open.values()))
    for _ in range(2):
        await house.ask(TerminateChild("doer"))
        again = await house.ask(RestartChild("doer"))
        await until_seen(again, ["kept", "tick"])


async def until_seen(ref: Any, texts: list[str]) -> None:
    while await ref.ask(Seen()) != texts:
        await asyncio.sleep(0.005)


async def test_an_actor_that_stopped_itself_comes_back_as_it_was(system: hf.ActorSystem, isolation: str) -> None:
    ref = await doer(system, isolation)
    ref.tell(Do(["add kept", "stop"]))
    ref.tell(Note("queued"))
    assert await ref.ask(Note("last"), timeout=30.0) == 3
    assert await ref.ask(Seen()) == ["kept", "queued", "last"]


@pytest.mark.parametrize("isolation", ["task", "process"])  # Below another process its queue is there, too.
async def test_fresh_loses_the_state_and_keeps_the_queue(system: hf.ActorSystem, isolation: Any, gate: Path) -> None:
    ref = await system.start(hf.child("doer", hf.start(Doer), isolation=isolation, recovery=hf.fresh()))
    await ref.ask(Note("lost"))
    hold = ref.ask(Do([f"gate {gate}"]), timeout=30.0)
    queued = ref.ask(Note("queued"), timeout=30.0)
    await until(gate.exists)
    strike(system, ref)
    with pytest.raises(hf.AskFailed):
        await hold
    assert await queued == 1


async def test_a_replay_is_followed_by_a_snapshot_so_that_the_next_need_not_repeat_it(
    system: hf.ActorSystem, isolation: Any
) -> None:
    """T17: a crash loop makes progress; the interval alone would start anew with each life."""
    ref = await doer(system, isolation)
    await ref.ask(Note("one"))
    with system.events() as stream:
        strike(system, ref)
        assert (await event(stream, hf.events.SnapshotTaken)).turn == 1
        strike(system, ref)
        back = await event(stream, hf.events.Recovered)
        if back.life == 2:  # In one process the snapshot is told of before the recovery that led to it.
            back = await event(stream, hf.events.Recovered)
    assert (back.life, back.replayed) == (3, 0)
