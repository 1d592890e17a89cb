"""What a live actor does, seen from outside: status, statistics, trace (otp.md 1.12; W19)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.control.conftest import Starter
from tests.control.players import (
    Account,
    Add,
    Crash,
    No,
    Pass,
    Refuse,
    Total,
    Wait,
    until_there,
)


async def test_a_status_says_what_the_actor_does(system: hf.ActorSystem, start_one: Starter, tmp_path: Path) -> None:
    one, gate = await start_one(hf.start(Account)), tmp_path / "gate"
    status = await system.get_status(one)
    assert (status.address, status.kind, status.state, status.life) == (
        one.path,
        "tests.control.players.Account",
        "running",
        1,
    )
    assert status.parent == one.path.rpartition("/")[0]
    assert (status.queued, status.turn, status.pid) == (0, None, system.pid_of(one))
    waiting = one.ask(Wait(str(gate)))
    await until_there(tmp_path / "gate.begun")
    one.tell(Add(1))
    one.tell(Add(1))
    status = await system.get_status(one)
    assert status.turn == "tests.control.players.Wait"
    assert 0 < status.turn_seconds < 60.0
    assert status.queued == 2
    gate.touch()
    await waiting


async def test_statistics_count_from_when_they_are_switched_on(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    sink = await system.start(hf.child("sink", hf.start(Account)))
    assert await one.ask(Add(1)) == 1
    assert await system.statistics(one) is None
    await system.statistics(one, True)
    assert await one.ask(Add(1)) == 2
    with pytest.raises(No):
        await one.ask(Refuse())
    one.tell(Pass(sink, 7))
    assert await one.ask(Add(1)) == 3
    counts = await system.statistics(one)
    assert counts is not None
    assert (counts.turns, counts.messages_out, counts.restarts) == (4, 1, 0)
    assert 0 < counts.longest_turn <= counts.turn_seconds < 60.0
    assert sum(counts.turn_times) == 4
    assert 0 < counts.turn_quantile(0.5) <= counts.turn_quantile(1.0) == counts.longest_turn
    if "/top/" not in one.path:
        assert counts.messages_in == 4
    assert await system.statistics(one, False) is None
    assert await one.ask(Add(1)) == 4
    assert await system.statistics(one) is None


async def test_statistics_see_restarts(system: hf.ActorSystem, start_one: Starter) -> None:
    one = await start_one(hf.start(Account))
    await system.statistics(one, True)
    with pytest.raises(hf.RemoteCrash):
        await one.ask(Crash())
    assert await one.ask(Add(1), timeout=30.0) == 1
    counts = await system.statistics(one)
    assert counts is not None
    assert counts.restarts == 1


async def test_a_trace_tells_turns_and_messages(system: hf.ActorSystem, start_one: Starter, way: str) -> None:
    one = await start_one(hf.start(Account))
    sink = await system.start(hf.child("sink", hf.start(Account)))
    with await system.trace(one) as stream:
        one.tell(Pass(sink, 7))
        with pytest.raises(No):
            await one.ask(Refuse())
        told = await _until_ended(stream, 2)
    kinds = [type(event).__name__ for event in told if not isinstance(event, hf.events.MessageIn)]
    assert kinds == ["TurnBegan", "MessageOut", "TurnEnded", "TurnBegan", "TurnEnded"]
    assert [event.outcome for event in told if isinstance(event, hf.events.TurnEnded)] == ["done", "refused"]
    assert [event.to for event in told if isinstance(event, hf.events.MessageOut)] == ["/app/sink"]
    assert sum(isinstance(event, hf.events.MessageIn) for event in told) == 2
    assert all(event.address == one.path for event in told)


async def _until_ended(stream: hf.events.EventStream, turns: int) -> list[Any]:
    told: list[Any] = []
    async with asyncio.timeout(30.0):
        async for event in stream:
            told.append(event)
            turns -= isinstance(event, hf.events.TurnEnded)
            if not turns:
                break
    return told


async def test_a_trace_goes_on_over_a_restart_and_ends_with_the_address(
    system: hf.ActorSystem, start_one: Starter
) -> None:
    one = await start_one(hf.start(Account))
    with await system.trace(one) as stream:
        one.tell(Crash())
        (began,) = [event for event in await _until_ended(stream, 1) if isinstance(event, hf.events.TurnEnded)]
        assert began.outcome == "crashed: ValueError"
        await one.ask(Total(), timeout=30.0)
        one.tell(Add(1))
        await _until_ended(stream, 1)
        await system.stop(one)
        async with asyncio.timeout(30.0):
            async for _ in stream:
                pass


async def test_nothing_is_left_in_the_actor_when_nobody_looks_any_more(system: hf.ActorSystem) -> None:
    one = await system.start(hf.child("one", hf.start(Account)))
    cell = one._cell
    assert await one.ask(Add(1)) == 1
    before = cell.admit, cell.table, type(cell.ctx), set(vars(cell.actor))
    with await system.trace(one):
        assert (cell.admit, cell.table, type(cell.ctx)) != before[:3]
    assert (cell.admit, type(cell.ctx), set(vars(cell.actor))) == (before[0], *before[2:])
    assert cell.table is before[1]


class Foreman(hf.Supervisor):
    """One with attributes of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.shift = "late"

    def init(self) -> hf.Plan:
        kids = [hf.child("one", hf.start(Account)), hf.child("idle", hf.start(Account), autostart=False)]
        return hf.Plan(kids, strategy="rest_for_one", intensity=7, period=60.0)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_state_of_a_supervisor_is_what_it_supervises(system: hf.ActorSystem, isolation: Any) -> None:
    """Its flags, how much of its intensity is used, and its children."""
    top = await system.start(hf.child("top", hf.start(Foreman), isolation=isolation))
    one = system.ref("/app/top/one", Account)
    one.tell(Crash())
    assert await one.ask(Total()) == 0
    kid = {"kind": "tests.control.players.Account", "restart": "permanent"}
    expected = {
        "strategy": "rest_for_one",
        "intensity": 7,
        "period": 60.0,
        "auto_shutdown": "never",
        "max_children": None,
        "journal": False,
        "restarts": 1,
        "children": {
            "one": {**kid, "state": "running", "restarts": 1},
            "idle": {**kid, "state": "stopped", "restarts": 0},
        },
        "shift": "late",
    }
    assert await system.get_state(top) == expected
    assert await system.replace_state(top, early) == {**expected, "shift": "early"}


def early(state: dict[str, Any]) -> dict[str, Any]:
    """What can be replaced are its attributes."""
    assert state == {"shift": "late"}
    return {"shift": "early"}


async def test_the_state_of_a_dynamic_supervisor_has_its_children(system: hf.ActorSystem) -> None:
    pool = await system.start(hf.dynamic("pool", max_children=3))
    await pool.ask(hf.StartChild(hf.child("one", hf.start(Account))))
    state = await system.get_state(pool)
    assert (state["max_children"], list(state["children"])) == (3, ["one"])


class End(hf.Message[None]):
    """End in good order behind this turn."""


class Ends(hf.Actor):
    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.stop()


async def test_who_is_looked_at_between_two_lives_is_being_restarted(system: hf.ActorSystem) -> None:
    """Also while its process has ended and the root has not heard of it yet."""
    one = await system.start(hf.child("ends", hf.start(Ends), isolation="process"))
    states: list[str] = []
    for _ in range(3):
        await one.ask(End(), timeout=60.0)
        while not states or states[-1] != "restarting":
            states.append((await system.get_status(one, timeout=60.0)).state)
        states.append("asked again")
    assert set(states) <= {"running", "restarting", "asked again"}
