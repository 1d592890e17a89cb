"""The commands that choose a mechanism, and the one that says what diagnosis says now."""

import asyncio
import json
from pathlib import Path

import pytest

import holdfast as hf
from holdfast import diagnosis
from holdfast.actors.events import EventStream
from holdfast.diagnosis.literals import parse
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Manner
from holdfast.diagnosis.repair import Policy, RepairTold
from tests.console.commands import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

DONE, FAILED, UNUSABLE = 0, 1, 2
QUICK = Manner(every=0.1, time_to_live=2.0)


async def test_coverage_is_what_the_mechanisms_declare() -> None:
    status, output, _ = await holdfast("coverage", "--json", "--mechanism", "pbr")
    told = json.loads(output)
    assert (status, told["mechanisms"][0]["tolerates"], "crash" in told["faults"]) == (DONE, ["crash"], True)
    status, output, _ = await holdfast("coverage")
    assert (status, output.count("\n") > 8, "| tmr " in output) == (DONE, True, True)
    status, _, errors = await holdfast("coverage", "--mechanism", "wishes")
    assert (status, "there is no mechanism of that name" in errors) == (UNUSABLE, True)


async def test_select_tells_the_cheapest_or_why_there_is_none() -> None:
    status, output, _ = await holdfast("select", "crash", "--units", "2", "--json")
    told = json.loads(output)
    assert (status, told["best"], told["valid"][0]["units"]) == (DONE, ["pbr"], 2)
    status, output, _ = await holdfast("select", "crash", "--units", "2", "--no-state-access", "--json")
    assert json.loads(output)["best"] == ["lfr"]
    status, output, _ = await holdfast("select", "crash")
    assert (status, "needs 2 processing units, and has 1" in output) == (FAILED, True)
    status, output, _ = await holdfast("select", "crash", "--units", "2", "--actor", "tests.system.trees:Counter")
    assert (status, "pbr" in output) == (DONE, True)
    for wrong, said in (
        (("boom",), "unknown faults boom; there are crash"),
        (("crash", "--actor", "tests.system.trees:NOBODY"), "tests.system.trees has no NOBODY"),
        (("crash", "--actor", "json:loads"), "json:loads is no actor class"),
    ):
        status, _, errors = await holdfast("select", *wrong)
        assert (status, said in errors) == (UNUSABLE, True), errors


async def test_without_diagnosis_it_is_said_how_to_start_one(system: hf.ActorSystem, path: Path) -> None:
    status, _, errors = await holdfast("diagnose", "--socket", path)
    assert (status, errors.startswith("holdfast diagnose: no diagnosis of app runs: start one")) == (FAILED, True)


async def test_diagnose_tells_suspects_with_their_addresses(system: hf.ActorSystem, path: Path) -> None:
    watching = await diagnosis.watch(system, seconds=0.0, trust={"test": 2.0})
    try:
        await watching.diagnosis()
        status, output, errors = await holdfast("diagnose", "--socket", path, "--json")
        [told] = json.loads(output)
        assert (status, errors, told["diagnoser"]) == (DONE, "", "/app/diagnosis/diagnoser")
        component = next(name for name, where in watching.addresses.items() if where == "/app/left/a")
        await system.suspend(system.ref("/app/left/a"))
        now = system._node.loop.time()
        seen = Observation(parse(f"not running({component})"), now, "test", 60.0)
        await system.publish(diagnosis.OBSERVATIONS, seen)
        assert component in (await watching.diagnosis()).suspects
        status, output, _ = await holdfast("diagnose", "/app/left", "--socket", path)
        assert (status, f"faulty: {component} at /app/left/a" in output) == (DONE, True)
        status, output, _ = await holdfast("diagnose", "/app/right", "--socket", path)
        assert (status, "components is suspected" in output) == (DONE, True)
        status, _, errors = await holdfast("diagnose", "/app/nowhere", "--socket", path)
        assert (status, "no component of the diagnosis is at /app/nowhere" in errors) == (FAILED, True)
    finally:
        await system.stop(watching.tree)


async def test_repair_waits_for_an_approval_from_the_command_line_and_tells_its_case(
    system: hf.ActorSystem, path: Path, tmp_path: Path
) -> None:
    watching = await diagnosis.watch(
        system, seconds=0.0, repair="ask", policy=Policy(look=0.0, settle=0.1, verify=1.0), manner=QUICK
    )
    with system.events() as events:
        component = next(name for name, where in watching.addresses.items() if where == "/app/left/a")
        await watching.diagnosis()
        await system.ref("/app/left", hf.Supervisor).ask(hf.TerminateChild("a", parks=False))
        await told_of(events, "ApprovalWanted")
        status, output, _ = await holdfast("diagnose", "--socket", path)
        assert (status, "holdfast repair approve 1" in output) == (DONE, True)
        assert f"{component} is suspected" in output
        assert "`/app/left/a` does not run" in output
        status, output, errors = await holdfast("repair", "approve", "1", "--socket", path, "--json")
        assert (status, errors, json.loads(output)[0]["stance"]) == (DONE, "", "ask")
        await told_of(events, "Repaired")
    picture = tmp_path / "case.png"
    status, output, errors = await holdfast("diagnose", "--socket", path, "--png", picture)
    assert (status, errors, picture.read_bytes()[:4]) == (DONE, "", b"\x89PNG")
    status, output, _ = await holdfast("repair", "set", "advise", "--socket", path)
    assert (status, "repair is advise" in output) == (DONE, True)
    assert (await watching.repair_status()).stance == "advise"
    await system.stop(watching.tree)
    status, _, errors = await holdfast("repair", "status", "--socket", path)
    assert (status, "no repair of app runs" in errors) == (FAILED, True)


class Wait(hf.Message[int]):
    behind: tuple[str, ...] = ()


class Link(hf.Actor):
    """Asks the next one, who asks the next one; the last one does not answer."""

    @hf.on(Wait)
    async def wait(self, message: Wait) -> int:
        if not message.behind:
            await asyncio.Event().wait()
        return await self.ctx.find(message.behind[0], Link).ask(Wait(message.behind[1:]), timeout=600.0)


async def test_diagnose_says_who_waits_since_when_and_what_was_denied(system: hf.ActorSystem, path: Path) -> None:
    pipe = [hf.child(name, hf.start(Link)) for name in ("reader", "parser", "writer", "cache")]
    await system.start(hf.supervisor("pipe", children=pipe))
    watching = await diagnosis.watch(
        system, seconds=0.0, repair="ask", policy=Policy(look=0.0), manner=QUICK, approve=lambda wanted: "not today",
        trust={"test": 2.0},
    )  # fmt: skip
    with system.events() as events:
        reader = system.ref("/app/pipe/reader", Link)
        writer = system.ref("/app/pipe/writer", Link)
        asking = asyncio.gather(
            reader.ask(Wait(("/app/pipe/parser", "/app/pipe/cache")), timeout=600.0),
            writer.ask(Wait(("/app/pipe/cache",)), timeout=600.0),
            return_exceptions=True,
        )
        seen = Observation(parse("not progress(pipe/cache)"), system._node.loop.time(), "test", 60.0)
        await system.publish(diagnosis.OBSERVATIONS, seen)
        await told_of(events, "GaveUp")
    status, output, errors = await holdfast("diagnose", "/app/pipe/cache", "--socket", path)
    assert (status, errors) == (DONE, "")
    assert "`/app/pipe/cache` has not answered for " in output
    [waits] = [line for line in output.splitlines() if "three actors wait for it: " in line]
    assert all(f"/app/pipe/{name}" in waits for name in ("parser", "writer", "reader"))
    assert "suspected since " in output
    assert "plan: For pipe/cache repair will do restart_child(pipe/cache)." in output
    assert "denied: not today (`holdfast repair retry pipe/cache` takes that back)" in output
    _, output, _ = await holdfast("diagnose", "--socket", path, "--json")
    [suspect] = json.loads(output)[0]["suspects"]
    assert (suspect["waiting_count"], suspect["unanswered_seconds"] > 0) == (3, True)
    await system.stop(watching.tree)
    system.ref("/app/pipe/cache", Link).kill()
    assert len(await asking) == 2


async def told_of(events: EventStream, what: str) -> None:
    """Wait until repair has told something of this kind."""
    async with asyncio.timeout(60.0):
        async for event in events:
            if isinstance(event, RepairTold) and event.what == what:
                return
