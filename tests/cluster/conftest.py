"""Servers for the tests of this folder; `tests/cluster/servers.py` says what they are.

A process that begins in a test has to end in it. So one server is shared by the tests of a module that do nothing to it
(`nats1`), and who kills or stops servers has some of its own (`own_nats1`, `nats3`).
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from tests.cluster.servers import NatsServers


@pytest.fixture(scope="module")
def nats1(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NatsServers]:
    """One server, shared by a module: a test takes `nats1.new_system()`, and does nothing to the server."""
    servers = NatsServers(tmp_path_factory.mktemp("nats1"))
    asyncio.run(servers.start())
    yield servers
    servers.close()


@pytest.fixture
async def own_nats1(tmp_path: Path) -> AsyncIterator[NatsServers]:
    """One server that a test may kill, stop and start again."""
    servers = NatsServers(tmp_path)
    await servers.start()
    yield servers
    servers.close()


@pytest.fixture
async def nats3(tmp_path: Path) -> AsyncIterator[NatsServers]:
    """Three servers that a test may kill, stop and start again."""
    servers = NatsServers(tmp_path, 3)
    await servers.start()
    yield servers
    servers.close()
