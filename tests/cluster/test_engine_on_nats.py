"""Real servers keep what every engine promises, and the journal on them what every store does."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from holdfast.cluster.engine_thread import EngineThread
from holdfast.cluster.leadership import lead, leader_name
from holdfast.cluster.log_writer import insist
from holdfast.cluster.nats.access import NatsAccess, access_of
from holdfast.cluster.nats.nats_engine import NatsEngine, open_engine
from holdfast.cluster.nats.system_streams import SubjectNames
from holdfast.cluster.ports import Engine, Unanswered
from holdfast.cluster.replicated_journal import ReplicatedJournal
from holdfast.testing.stores import conformance
from tests.cluster.certificates import certificates
from tests.cluster.engines import PROMISES, Connect
from tests.cluster.machines.slow_links import SlowLinks
from tests.cluster.servers import PATIENCE, NatsServers

SEEDS = 2
"""Sequences of operations that are drawn: each is a few hundred round trips."""


@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
@pytest.mark.some(3)
async def test_a_real_server_keeps_it(nats1: NatsServers, promise: Callable[[Connect], Awaitable[None]]) -> None:
    access = nats1.access(nats1.new_system())
    opened: list[Engine] = []

    async def connect() -> Engine:
        opened.append(await open_engine(access))
        return opened[-1]

    await promise(connect)
    for engine in opened:
        await engine.close()


async def test_a_blob_whose_parts_do_not_come_is_not_taken_for_one_that_is_not_there(nats1: NatsServers) -> None:
    """Parts that are late, since servers choose a leader, are there all the same: whoever reads has to ask again."""
    system = nats1.new_system()
    engine, client = await open_engine(nats1.access(system)), await nats1.connect(system)
    await client.jetstream().publish(f"{SubjectNames(system).blobs}.late.size", b"3")
    with pytest.raises(Unanswered, match="1 parts of late do not come"):
        await engine.blobs.get("late")
    await client.jetstream().publish(f"{SubjectNames(system).blobs}.late.0", b"abc")
    assert await engine.blobs.get("late") == b"abc"
    assert await engine.blobs.get("never") is None
    await client.close()
    await engine.close()


@pytest.mark.asyncio(loop_factories=["asyncio"])
async def test_a_connection_that_is_silent_is_let_go_of_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who would close it in good order would wait for the other end: with TLS half a minute, here for hours."""
    monkeypatch.setattr("asyncio.constants.SSL_SHUTDOWN_TIMEOUT", 24 * 3600.0)
    servers, links = NatsServers(tmp_path, 1, certificates(tmp_path)), SlowLinks(1)
    try:
        await servers.start()
        await links.start([servers.plans[0].port])
        engine = await open_engine(access_of(servers.store(servers.new_system(), ports=links.ports)))
        links.freeze()
        async with asyncio.timeout(PATIENCE):
            assert await insist(engine.log.last) is None
        await engine.close()
    finally:
        await links.close()
        servers.close()


ACCESS: dict[str, NatsAccess] = {}
"""By the digest of a folder: whose store it stands for."""
SERVERS: list[NatsServers] = []


def opened(path: Path) -> ReplicatedJournal:
    """Lead the store that a folder stands for; whoever led it before is deposed."""
    folder = hashlib.sha256(str(path).encode()).hexdigest()
    if folder not in ACCESS:
        ACCESS[folder] = SERVERS[-1].access(SERVERS[-1].new_system())
    thread = EngineThread("test")

    async def take() -> NatsEngine:
        engine = await open_engine(ACCESS[folder])
        await engine.lease.release(1 << 53)  # Whoever has it is not asked.
        return engine

    engine = thread.wait(take())
    return ReplicatedJournal(engine, thread, thread.wait(lead(engine, leader_name(), standby="cold")))


class TestReplicatedOnNats(conformance(opened)):  # type: ignore[misc]
    seeds = SEEDS

    @pytest.fixture(autouse=True)
    def _servers(self, nats1: NatsServers) -> Iterator[None]:
        SERVERS.append(nats1)
        yield
        SERVERS.clear()
        ACCESS.clear()
