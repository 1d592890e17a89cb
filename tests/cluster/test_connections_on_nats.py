"""Refs to actors of systems on real servers, whose leaders are killed, paused and ended meanwhile."""

from __future__ import annotations

import asyncio
import random
import signal
from pathlib import Path

import msgspec
import pytest
from nats.aio.msg import Msg

import holdfast as hf
from holdfast.actors.process.wire import frames
from holdfast.cluster.lines.far_line import NEW
from holdfast.cluster.lines.line import NOBODY, Boot, LineBatch
from holdfast.cluster.nats.server_file import UserRole
from tests.cluster.bank import Account, Gain, Report
from tests.cluster.fleet import Client, Programs
from tests.cluster.servers import NatsServers
from tests.cluster.till import Clerk, Pay

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = 20261127
PATIENT = 120.0
"""Seconds that an ask may take: far more than a takeover does."""


async def test_what_was_asked_of_a_leader_that_dies_is_done_once(nats1: NatsServers, tmp_path: Path) -> None:
    """Eight askers add 1, again and again; no answer comes twice, and what was answered is what there is."""
    system = nats1.new_system()
    programs = Programs(nats1.store(system), tmp_path)
    pids = Client(programs.socket)
    strikes = [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM]
    random.Random(SEED).shuffle(strikes)
    answers: list[int] = []
    done = asyncio.Event()
    try:
        await programs.leads(await programs.start())
        async with hf.connect(nats1.store(system, UserRole.CLIENT), system="bank") as bank:
            account = bank.ref("/bank/account", Account)

            async def add() -> None:
                while not done.is_set():
                    answers.append(await account.ask(Gain(1), timeout=PATIENT))

            adding = [asyncio.ensure_future(add()) for _ in range(8)]
            standby = await programs.start()
            for strike in strikes:
                await pids.check_pid()
                leader = programs.of(pids.leader)
                known = len(answers)
                while len(answers) < known + 50:
                    await asyncio.wait(adding, timeout=0.05)
                    assert not any(one.done() for one in adding), adding
                if strike == signal.SIGSTOP:
                    leader.send_signal(strike)
                    await programs.leads(standby)
                    leader.send_signal(signal.SIGCONT)  # It wakes with what it had in hand.
                else:
                    await programs.end(leader, strike)
                    await programs.leads(standby)
                    await programs.start()
                standby = next(one for one in programs.processes if one is not standby)
            known = len(answers)
            while len(answers) < known + 50:
                await asyncio.wait(adding, timeout=0.05)
            done.set()
            await asyncio.gather(*adding)
            assert sorted(answers) == [*range(1, len(answers) + 1)], f"seed {SEED}"
            assert (await account.ask(Report()))["balance"] == len(answers)
    finally:
        done.set()
        await pids.close()
        await programs.close()


@pytest.mark.parametrize("how", ["tell", "ask"])
async def test_what_a_recorded_actor_pays_arrives_once_whoever_dies(
    nats1: NatsServers, tmp_path: Path, how: str
) -> None:
    """The bank and the till are killed in turn while the clerk pays."""
    names = [nats1.new_system(), nats1.new_system()]
    for folder in ("bank", "till"):
        (tmp_path / folder).mkdir()
    bank = Programs(nats1.store(names[0]), tmp_path / "bank")
    url = nats1.store(names[0], UserRole.CLIENT)
    command = ("-m", "tests.cluster.till", url, nats1.store(names[1]), how)
    till = Programs(nats1.store(names[1]), tmp_path / "till", command=command)
    try:
        await bank.leads(await bank.start())
        await till.leads(await till.start())
        async with (
            hf.connect(url, system="bank") as to_bank,
            hf.connect(nats1.store(names[1], UserRole.CLIENT), system="till") as to_till,
        ):
            account, clerk = to_bank.ref("/bank/account", Account), to_till.ref("/till/clerk", Clerk)
            paid = 0
            for victim in (till, bank):
                answers = [clerk.ask(Pay(1), timeout=PATIENT) for _ in range(20)]
                paid += 20
                await asyncio.wait(answers, return_when=asyncio.FIRST_COMPLETED)
                await victim.end(victim.processes[0])
                await victim.leads(await victim.start())
                await asyncio.gather(*answers)
            assert await clerk.ask(Pay(0), timeout=PATIENT) == paid
            async with asyncio.timeout(PATIENT):
                while (await account.ask(Report(), timeout=PATIENT))["balance"] < paid:
                    await asyncio.sleep(0.1)
            assert (await account.ask(Report()))["balance"] == paid
    finally:
        await till.close()
        await bank.close()


async def test_others_are_served_while_programs_attack(nats1: NatsServers, tmp_path: Path) -> None:
    """One floods the leader with tells, one never takes its outcomes, one subscribes to everything, one only greets."""
    name = nats1.new_system()
    programs = Programs(nats1.store(name), tmp_path)
    url, subject = nats1.store(name, UserRole.CLIENT), f"hf.{name}.root.in"
    try:
        leader = await programs.start()
        await programs.leads(leader)
        async with hf.connect(url, system="bank") as honest, hf.connect(url, system="bank") as greedy:
            account = honest.ref("/bank/account", Account)
            assert await account.ask(Gain(1), timeout=PATIENT) == 1
            before = memory_of(leader.pid)
            evil = await nats1.connect(name, UserRole.CLIENT)
            answers: list[LineBatch] = []

            async def hear(message: Msg) -> None:
                answers.append(msgspec.msgpack.decode(message.data, type=LineBatch))

            inbox = evil.new_inbox()
            await evil.subscribe(inbox, cb=hear)

            async def post(sender: str, to: Boot, first: int, *made: frames.Frame) -> None:
                items = tuple(NEW + msgspec.msgpack.encode(one) for one in made)
                batch = LineBatch(sender, Boot(1, "ff"), to, 0, first, items, "", 0, answers[0].line if answers else 0)
                await evil.publish(subject, msgspec.msgpack.encode(batch), reply=inbox)

            await post("evil", NOBODY, 1)
            async with asyncio.timeout(PATIENT):
                while not answers:
                    await asyncio.sleep(0.01)
            add, report = f"{Gain.__module__}:Gain", f"{Report.__module__}:Report"
            body, none = msgspec.Raw(msgspec.msgpack.encode(Gain(0))), msgspec.Raw(msgspec.msgpack.encode(Report()))
            first = 1
            for round_ in range(40):
                for _ in range(500):
                    greedy.ref("/bank/account", Account).tell(Gain(0))
                asks = [frames.Ask(first + n, "/bank/account", report, none, 60.0) for n in range(500)]
                tells = [frames.Tell("/bank/audit", add, body) for _ in range(500)]
                topics = [frames.Command("/evil/ear", "subscribe", {"topic": f"/{first + n}"}) for n in range(500)]
                ties = [frames.Command("/bank/audit", "monitor", {"watcher": "/evil/eye"}) for _ in range(500)]
                for made in (asks, tells, topics, ties):
                    await post("evil", answers[0].boot, first, *made)
                    first += len(made)
                for number in range(50):
                    await post(f"client~{50 * round_ + number:x}", NOBODY, 1)
                assert await account.ask(Gain(1), timeout=PATIENT) == round_ + 2
            await evil.close()
            assert memory_of(leader.pid) - before < 150 << 20
            async with hf.connect(url, system="bank", timeout=PATIENT) as late:
                assert await late.ref("/bank/account", Account).ask(Gain(1), timeout=PATIENT) == 42
    finally:
        await programs.close()


def memory_of(pid: int) -> int:
    """The memory of a process, in bytes."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


async def test_nobody_has_a_leader_write_into_its_own_log(nats1: NatsServers) -> None:
    """A client may not write there. Whoever says that answers go there is not answered."""
    name = nats1.new_system()
    async with hf.ActorSystem(name, store=nats1.store(name), log=False) as system:
        account = await system.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))
        client = await nats1.connect(name, UserRole.CLIENT)
        greeting = msgspec.msgpack.encode(LineBatch("evil", Boot(1, "ff"), NOBODY, 0, 1, ()))
        for reply in (f"hf.{name}.root.log", f"hf.{name}.root.lease", "$JS.API.INFO"):
            await client.publish(f"hf.{name}.root.in", greeting, reply=reply)
        await client.flush()
        await client.close()
        async with hf.connect(nats1.store(name, UserRole.CLIENT)) as bank:  # What came before is handled by now.
            assert await bank.ref(account.path, Account).ask(Gain(1)) == 1
        async with asyncio.timeout(20):
            while system.lines._lines:  # That of the bank, which says good-bye.
                await asyncio.sleep(0.01)
