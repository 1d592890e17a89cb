"""Whether an actor is protected now, by what, who leads, and since when."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

import holdfast as hf
from holdfast.console.commands import commands
from holdfast.console.endpoint import control_endpoint
from holdfast.ftm.mechanisms.lfr import LFR
from holdfast.ftm.mechanisms.pbr import PBR
from holdfast.ftm.mechanisms.tr import TR
from tests.ftm.accounts import Counter, Total
from tests.ftm.test_failover import pid_of, two_again

# Processes do not care which event loop the root has.
pytestmark = [pytest.mark.asyncio(loop_factories=["uvloop"]), pytest.mark.usefixtures("warm_programs")]


async def whole(system: hf.ActorSystem, ref: hf.ActorRef[Counter], wanted: bool) -> hf.ftm.ProtectionStatus:
    """How it is protected when it is whole, or is not."""
    async with asyncio.timeout(30):
        while (found := await system.protection(ref)).is_whole is not wanted:
            await asyncio.sleep(0.001)
    return found


async def test_it_says_who_leads_and_whether_a_replica_may_die(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=(PBR(), TR())))
    first = await whole(system, ref, True)
    assert (first.stack, first.leader, first.epoch, first.config) == (("pbr", "tr"), "r1", 1, 1)
    assert first.replicas == {"r1": "leads", "r2": "follows"}
    os.kill(pid_of(system, ref, "r1"), signal.SIGSTOP)
    broken = await whole(system, ref, False)
    assert broken.since >= first.since
    await two_again(ref)
    again = await whole(system, ref, True)
    assert (again.leader, again.epoch) == ("r2", 2)
    assert again.since >= broken.since


async def test_an_actor_without_a_mechanism_is_not_protected(system: hf.ActorSystem) -> None:
    found = await system.protection(await system.start(hf.child("bob", hf.start(Counter))))
    assert (found.is_protected, found.stack, found.leader, found.is_whole) == (False, (), None, False)


@pytest.mark.parametrize("ticks", [0, 1, 2, 5])
async def test_a_kill_of_a_life_that_is_ending_already_is_no_reason_to_end_it_never(
    system: hf.ActorSystem, ticks: int
) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    ref.kill()
    for _ in range(ticks):
        await asyncio.sleep(0)
    ref.kill()
    async with asyncio.timeout(20.0):
        while (await system.get_status(ref)).life == 1:
            await asyncio.sleep(0.005)
    assert await ref.ask(Total(), 20.0) == 0


async def test_a_new_stack_is_on_probation(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    async with system.transaction(timeout=60) as change:
        change.protect(ref, LFR())
    found = await system.protection(ref)
    assert (found.stack, found.config, found.is_on_probation) == (("lfr",), 2, True)


@pytest.mark.parametrize("mechanism", [LFR(), (LFR(),)], ids=["alone", "tuple of one"])
async def test_a_tuple_of_one_means_that_one(system: hf.ActorSystem, mechanism: LFR | tuple[LFR]) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=(PBR(), TR())))
    async with system.transaction(timeout=60) as change:
        change.protect(ref, mechanism)
    assert (await system.protection(ref)).stack == ("lfr",)


async def test_the_command_line_shows_it(system: hf.ActorSystem, tmp_path: Path) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=PBR()))
    await two_again(ref)
    async with control_endpoint(system, tmp_path / "app.sock") as socket:
        command = ["inspect", ref.path, "--socket", str(socket)]
        shown = await asyncio.to_thread(lambda: CliRunner().invoke(commands, command))
    assert "protection: pbr, whole since" in shown.output, shown.output
    assert "epoch 1 (r1 leads, r2 follows)" in shown.output


async def test_a_protected_actor_lives_in_the_process_of_the_one_that_leads(system: hf.ActorSystem) -> None:
    """Whoever kills that by its pid does not kill the whole program."""
    ref = await system.start(hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR(), recovery=hf.hybrid()))
    leader = (await system.protection(ref)).leader
    assert leader is not None
    assert system.pid_of(ref) == system.pid_of(system.ref(f"{ref.path}/ftm/{leader}", hf.Actor)) != os.getpid()
    async with system.transaction() as change:
        change.protect(ref, None)
    assert system.pid_of(ref) == os.getpid()
