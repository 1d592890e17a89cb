"""Programs that take over from each other on real servers: what a client was answered stays, and is done once."""

from __future__ import annotations

import asyncio
import contextlib
import random
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.cluster.nats.server_file import UserRole, public_key, seed_file
from holdfast.cluster.ports import AccessRefused
from tests.cluster.bank import Account, Gain
from tests.cluster.fleet import Client, Programs
from tests.cluster.servers import NatsServers

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = 4711


@pytest.fixture
async def programs(nats1: NatsServers, tmp_path: Path) -> AsyncIterator[Programs]:
    made = Programs(nats1.store(nats1.new_system()), tmp_path)
    yield made
    await made.close()


@pytest.fixture
async def client(programs: Programs) -> AsyncIterator[Client]:
    made = Client(programs.socket)
    yield made
    await made.close()


async def strike(programs: Programs, client: Client, how: str) -> None:
    """Do something to whoever leads, and have another program lead."""
    leader = programs.of(client.leader)
    if how == "pause":
        leader.send_signal(signal.SIGSTOP)
    else:
        await programs.end(leader, signal.SIGKILL if how == "kill" else signal.SIGTERM)
    while client.leader == leader.pid:
        await client.deposit()
    if how == "pause":
        leader.send_signal(signal.SIGCONT)  # It wakes with what it had in hand, and stands by.
    else:
        await programs.start()


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_was_answered_stays_whoever_leads(programs: Programs, client: Client, isolation: str) -> None:
    """A leader is killed, paused until it was deposed, and ended in good order, in a drawn order."""
    programs.isolation = isolation
    strikes = ["kill", "pause", "end"]
    random.Random(f"{SEED} {isolation}").shuffle(strikes)
    await programs.leads(await programs.start())
    await programs.start()
    for how in strikes:
        for _ in range(20):
            await client.deposit()
        await strike(programs, client, how)
    for _ in range(20):
        await client.deposit()
    await client.check()


async def test_a_server_that_is_killed_stops_nobody(own_nats1: NatsServers, tmp_path: Path) -> None:
    """The tree stays as it is: its leader waits for the server, and goes on."""
    programs = Programs(own_nats1.store(own_nats1.new_system()), tmp_path)
    client = Client(programs.socket)
    try:
        await programs.leads(await programs.start())
        await client.deposit()
        leader = client.leader
        for _ in range(2):
            own_nats1.kill(0)
            working = asyncio.ensure_future(client.deposit())
            await own_nats1.restart(0)
            await working
            await client.deposit()
        assert client.leader == leader
        await client.check()
    finally:
        await client.close()
        await programs.close()


@pytest.mark.parametrize("victim", ["the leader of the log", "another server"])
async def test_one_of_three_servers_may_go(nats3: NatsServers, tmp_path: Path, victim: str) -> None:
    system = nats3.new_system()
    programs = Programs(nats3.store(system), tmp_path)
    client = Client(programs.socket)
    done = asyncio.Event()
    try:
        await programs.leads(await programs.start())
        await client.deposit()
        working = asyncio.ensure_future(client.deposit_for(done))
        leads = await nats3.leader_of(system, f"hf-{system}-log")
        assert leads is not None
        number = leads if victim == "the leader of the log" else (leads + 1) % 3
        nats3.kill(number)
        before = client.count
        while client.count < before + 10:
            await asyncio.wait([working], timeout=0.1)
            assert not working.done(), working
        await nats3.restart(number)
        done.set()
        await working
        await client.check()
    finally:
        done.set()
        await client.close()
        await programs.close()


async def test_a_leader_that_may_not_write_any_more_gives_way(own_nats1: NatsServers) -> None:
    """That is no outage: it says so, gives the lease back, and a program that may write leads."""
    name = own_nats1.new_system()
    store = own_nats1.store(name)
    async with hf.ActorSystem(name, store=store, log=False) as system:
        account = await system.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))
        assert await account.ask(Gain(1)) == 1
        events, whole = system.events(), []

        def denied(text: str) -> str:
            whole.append(text)
            log = f"hf.{name}.root.log"
            key = public_key(seed_file(own_nats1.folder, name, UserRole.NODE).read_text().strip())
            at = text.index(key)
            return text[:at] + text[at:].replace("publish: {", f'publish: {{ deny: ["{log}"], ', 1)

        own_nats1.reload(0, denied)
        refused = False
        while not refused:  # Until the server has taken up its file.
            try:
                await account.ask(Gain(0), timeout=20.0)
            except hf.HoldfastError:
                refused = True
        stopped = await events.until(hf.events.JournalStopped, timeout=20.0)
        assert "permissions violation" in stopped.reason
        own_nats1.reload(0, lambda text: whole[0])
        async with asyncio.timeout(60.0):
            while True:
                try:
                    async with hf.ActorSystem(name, store=store, log=False) as after:
                        account = await after.start(hf.child("account", hf.start(Account), recovery=hf.hybrid()))
                        assert await account.ask(Gain(0)) == 1
                        break
                except (hf.errors.StoreInUse, AccessRefused):  # Or the server has not taken up its file yet.
                    await asyncio.sleep(0.1)
        with contextlib.suppress(hf.errors.StoreError):
            await system.shutdown()
