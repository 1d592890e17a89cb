"""A leader whose servers are away says so, and a log that was deleted is never taken for a new store."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest
from nats.js import JetStreamContext

import holdfast as hf
from holdfast.cluster.nats.server_check import check_store
from holdfast.cluster.nats.system_streams import SubjectNames, stream_settings
from holdfast.console.service.health import Service
from tests.cluster.bank import Account, Gain
from tests.cluster.servers import PATIENCE, NatsServers


def account() -> hf.ChildSpec:
    return hf.child("account", hf.start(Account), recovery=hf.hybrid())


def system_on(servers: NatsServers, name: str) -> hf.ActorSystem:
    return hf.ActorSystem(name, store=servers.store(name), log=False)


async def with_streams(servers: NatsServers, name: str, work: Callable[[JetStreamContext], Awaitable[object]]) -> None:
    client = await servers.connect(name)
    try:
        await work(client.jetstream())
    finally:
        await client.close()


async def filled(servers: NatsServers) -> str:
    """A system in which something is recorded, and which does not run."""
    name = servers.new_system()
    async with system_on(servers, name) as system:
        assert await (await system.start(account())).ask(Gain(1)) == 1
    return name


async def test_a_leader_whose_servers_are_away_says_so_until_they_answer(own_nats1: NatsServers) -> None:
    name = own_nats1.new_system()
    async with Service(system_on(own_nats1, name)) as service, asyncio.timeout(2 * PATIENCE):
        system, events = service.system, service.system.events()
        gains = await system.start(account())
        service.up()
        assert (await service.ready()).is_good
        own_nats1.kill(0)
        silent = await events.until(hf.events.ServersSilent)
        assert f"127.0.0.1:{own_nats1.plans[0].port} (nobody listens there)" in silent.reason
        assert f"the store takes nothing: its servers do not answer: {silent.reason}" in (await service.ready()).text
        assert (await service.live()).is_good
        assert "The servers of the store have not answered" in "\n".join(await system.why(f"/{name}"))
        await own_nats1.restart(0)
        assert (await events.until(hf.events.ServersAnswer)).seconds > 0
        assert await gains.ask(Gain(1)) == 1
        assert (await service.ready()).is_good
        assert "servers" not in "\n".join(await system.why(f"/{name}"))


@pytest.mark.parametrize("how", ["deleted", "emptied", "made anew"])
async def test_a_leader_whose_log_is_gone_ends_and_says_what_has_happened(nats1: NatsServers, how: str) -> None:
    name = nats1.new_system()
    stream = SubjectNames(name).log_stream

    async def strike(streams: JetStreamContext) -> None:
        if how == "emptied":
            await streams.purge_stream(stream)
            return
        await streams.delete_stream(stream)
        if how == "made anew":
            await streams.add_stream(stream_settings(SubjectNames(name), 1)[0])

    async def led() -> None:
        async with asyncio.timeout(PATIENCE), system_on(nats1, name) as system:
            await (await system.start(account())).ask(Gain(1))
            await with_streams(nats1, name, strike)
            await asyncio.Event().wait()

    with pytest.raises(hf.errors.StoreFailed, match="is gone from the servers: somebody has deleted or emptied it"):
        await led()


@pytest.mark.parametrize("how", ["deleted", "emptied"])
async def test_what_is_left_of_a_system_is_no_new_one(nats1: NatsServers, how: str) -> None:
    name = await filled(nats1)
    stream = SubjectNames(name).log_stream
    await with_streams(nats1, name, lambda s: s.delete_stream(stream) if how == "deleted" else s.purge_stream(stream))
    with pytest.raises(hf.errors.ForeignStore, match=f"the stream {stream}: it is .*holdfast nats remove"):
        async with system_on(nats1, name):
            raise AssertionError("it has begun with nothing")
    (problem,) = await check_store(nats1.store(name))
    assert (problem.where, problem.is_warning) == (f"the stream {stream}", False)


@pytest.mark.parametrize("made", [0, 1, 2, 3])
async def test_a_first_start_that_was_cut_off_comes_up(nats1: NatsServers, made: int) -> None:
    """It was killed when it had made some of the streams, or had taken the lease, too."""
    name = nats1.new_system()

    async def begin(streams: JetStreamContext) -> None:
        for settings in stream_settings(SubjectNames(name), 1)[:made]:
            await streams.add_stream(settings)
        if made == 3:
            await streams.publish(SubjectNames(name).lease, b"somebody", msg_ttl=1.0)

    await with_streams(nats1, name, begin)
    async with hf.ActorSystem(name, store=nats1.store(name), standby="cold", log=False) as system:
        assert await (await system.start(account())).ask(Gain(1)) == 1
