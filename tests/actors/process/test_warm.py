"""A fork server of the tests, which is forked from a warm process, is as one that is started by exec."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import signal
from pathlib import Path
from typing import Any

import pytest

from holdfast.actors.process.fork import fork_server, launch
from holdfast.actors.process.fork.fork_server import ForkServer
from tests.actors.process.facts import descriptors
from tests.actors.process.waiting import until
from tests.warm import Forked, WarmServers, own_children

ENTRY = "tests.actors.process.facts:main"


async def facts_of(start: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(fork_server, "exec_server", start)
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lambda: None)
    await server.start()
    try:
        child = await server.fork()
        with contextlib.closing(child):
            # The last descriptor that it closes in the server.
            await until(lambda: not any("page" in one for one in descriptors(server.pid)))
            loop = asyncio.get_running_loop()
            await loop.sock_sendall(child.sock, b"?")
            said = b""
            while not said.endswith(b"\n"):
                more = await loop.sock_recv(child.sock, 1 << 16)
                assert more, "it has ended"
                said += more
    finally:
        await server.stop()
    found: dict[str, Any] = json.loads(said)
    return found


async def test_it_has_all_that_one_started_by_exec_has(
    warm_servers: WarmServers | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "America/New_York")
    monkeypatch.setenv("SAID_BY_A_TEST", "half a pair: \udc80")
    monkeypatch.delenv("HOME", raising=False)
    files = resource.getrlimit(resource.RLIMIT_NOFILE)
    umask = os.umask(0o027)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (files[1] // 2, files[1]))
        warm = await facts_of(warm_servers.exec_server, monkeypatch)
        cold = await facts_of(launch.exec_server, monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, files)
        os.umask(umask)
    assert warm == cold
    assert warm["started by"] == os.getpid()


async def test_its_end_is_known_as_that_of_any_child(warm_servers: WarmServers | None) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    lost = asyncio.Event()
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lost.set)
    await server.start()
    assert isinstance(server._process, Forked)
    os.kill(server.pid, signal.SIGKILL)
    async with asyncio.timeout(30):
        await lost.wait()
    assert server._process.returncode == -signal.SIGKILL
    await server.stop()
    assert not own_children()


@pytest.mark.parametrize("name", ["PYTHONHASHSEED", "MALLOC_TRIM_THRESHOLD_", "OMP_NUM_THREADS"])
async def test_what_a_program_reads_as_it_begins_means_exec(
    warm_servers: WarmServers | None, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    if warm_servers is None:
        pytest.skip("HOLDFAST_COLD=1: there is no warm process")
    monkeypatch.setenv(name, "3")
    server = ForkServer(ENTRY, (), on_exit=lambda pid, status: None, on_lost=lambda: None)
    await server.start()
    assert not isinstance(server._process, Forked)
    await server.stop()
