"""The tables of docs/supervision-recovery.md: each cell is a test."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import Do, until
from tests.checkpoint.strikes import let_through
from tests.checkpoint.trees import add, at, back, doing, end_process, escalate, running, seen, snapshot, top, tree
from tests.supervision.test_document import cells

ENDS: dict[str, dict[str, str]] = {}
for parameter in cells("end of a recorded child"):
    row, column, cell = parameter.values
    ENDS.setdefault(row, {})[column] = cell
TIMES = {"once": 1, "again": 2}


async def end(system: hf.ActorSystem, how: str, spec: hf.ChildSpec, gate: Path) -> None:
    """End the child, which is in a turn, and start it again if nobody else does."""
    how = how.replace("`", "")
    call: Any = None
    match how.partition(",")[0]:
        case "crash" | "stops by itself":
            pass  # That is how the turn ends.
        case "kill":
            at(system).kill()
        case "death of its process":
            end_process(system, at(system))
        case "a sibling's crash":
            at(system, "sibling").tell(Do(["raise it"]))
            await until(lambda: at(system, "sibling")._cell.state != "running")
        case "its supervisor is killed and restarted":
            top(system).kill()
        case _:
            cell = at(system)._cell
            call = top(system).ask(hf.TerminateChild("doer"), timeout=20.0)
            await until(lambda: bool(cell.extra().urgent))  # The order to stop stands ahead of what is queued.
    let_through(gate)
    if how.startswith("stops"):
        await until(lambda: "/app/top/doer" not in system.tree())
    if call is not None:
        await call
    if "DeleteChild" in how:
        await top(system).ask(hf.DeleteChild("doer", erase="erase=False" not in how), timeout=20.0)
        await top(system).ask(hf.StartChild(spec), timeout=20.0)
    elif "RestartChild" in how:
        await top(system).ask(hf.RestartChild("doer", fresh="fresh=True" in how), timeout=20.0)


@pytest.mark.parametrize("how", ENDS)
async def test_what_becomes_of_state_and_queue(how: str, store: str | None, gate: Path) -> None:
    isolation = "process" if "process" in how else "task"
    last = "raise it" if how == "crash" else "stop" if how.startswith("stops") else "add turn"
    spec = doing(isolation, restart="transient")
    strategy: Any = "one_for_all" if "one_for_all" in how else "one_for_one"
    async with running(store) as system:
        await system.start(tree(isolation, spec, doing(isolation, "sibling"), strategy=strategy))
        await add(system, "state")
        with system.events() as stream:
            at(system).tell(Do([f"gate {gate}", last]))
            await until(gate.exists)
            at(system).tell(Do(["add queued"]))
            await end(system, how, spec, gate)
            if "Child" not in how:
                await back(stream, hf.events.Recovered)
        told = [one for one in await seen(system) if one != "turn"]
        expected = ENDS[how]
        assert ("state" in told) is (expected["its state"] == "kept")
        assert ("queued" in told) is (expected["what waits"] == "kept")
        assert (system.dead_letters > 0) is (expected["what waits"] == "dropped")


@pytest.mark.parametrize(("time", "method", "expected"), cells("escalation comes back"))
async def test_what_comes_back_after_an_escalation(time: str, method: str, expected: str) -> None:
    options = {} if method == "left out" else {"on_escalate": method.strip('`"')}
    async with running(None) as system:
        await system.start(tree("task", doing("task", **options), intensity=0))
        before: list[str] = []
        after: list[str] = []
        for number in range(TIMES[time]):
            for letter in "ab":
                await add(system, f"{letter}{number}")
                await snapshot(system)
            await add(system, f"c{number}")
            before = await seen(system)
            with contextlib.suppress(hf.HoldfastError):
                await escalate(system, "task")
            after = await seen(system)
    assert after == {"as it was": before, "older snapshot": before[:-2], "fresh": []}[expected]
