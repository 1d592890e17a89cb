"""A copy whose servers or disks fail meanwhile ends with an error, is never taken for whole, and works afterwards."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Journal, NotCopied, StoreFailed, StoreInUse
from holdfast.checkpoint.store_opening import UNFINISHED, check_system
from holdfast.cluster import joining, replicated_journal, store_copy
from holdfast.cluster.joining import open_store
from holdfast.cluster.store_copy import copy_store
from tests.cluster.servers import NatsServers
from tests.cluster.shelves import copied, fill, found_in

pytestmark = pytest.mark.usefixtures("warm_programs")

SHORT = 1.5
"""How long a copy waits for servers in these tests, in seconds."""
LONG = pytest.mark.skipif("HOLDFAST_COPIES" not in os.environ, reason="a campaign: HOLDFAST_COPIES=1 has all of them")


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name in ((joining, "TOOL_SECONDS"), (replicated_journal, "READ_SECONDS")):
        monkeypatch.setattr(module, name, SHORT)
    monkeypatch.setattr(replicated_journal, "CLOSE_SECONDS", 2.0)


def copy(source: str, dest: str, then: Callable[[str], None]) -> None:
    """Copy, and have something done at two points: before the content is written, and before it is compared."""
    with pytest.MonkeyPatch.context() as patch:
        put, compare = store_copy._put, store_copy.differences

        def putting(store: Journal, address: str, kept: store_copy.KeptAddress) -> None:
            then("put")
            put(store, address, kept)  # type: ignore[arg-type]

        def comparing(one: Journal, other: Journal) -> object:
            then("compare")
            return compare(one, other)  # type: ignore[arg-type]

        patch.setattr(store_copy, "_put", putting)
        patch.setattr(store_copy, "differences", comparing)
        with contextlib.ExitStack() as stack:
            first = stack.enter_context(contextlib.closing(open_store(source, is_new=False)))
            second = stack.enter_context(contextlib.closing(open_store(dest)))
            copy_store(first, second, names=("source", "dest"))


@pytest.mark.parametrize(
    ("which", "how", "at"),
    [
        ("source", "killed", "put"),
        pytest.param("source", "paused", "compare", marks=LONG),
        pytest.param("dest", "killed", "compare", marks=LONG),
        ("dest", "paused", "put"),
    ],
)
async def test_servers_fail_while_a_store_is_copied(
    own_nats1: NatsServers, tmp_path: Path, which: str, how: str, at: str
) -> None:
    file, servers = f"sqlite:{tmp_path / 'app.db'}", own_nats1.store(own_nats1.new_system())
    await fill(file if which == "dest" else servers)
    source, dest = (file, servers) if which == "dest" else (servers, file)
    struck: list[str] = []

    def strike(point: str) -> None:
        if point == at and not struck:
            struck.append(point)
            (own_nats1.kill if how == "killed" else own_nats1.stop)(0)

    with pytest.raises((StoreFailed, NotCopied)):
        await asyncio.to_thread(copy, source, dest, strike)
    assert struck == [at]
    if how == "killed":
        await own_nats1.restart(0)
    else:
        own_nats1.cont(0)
    await lease_is_over(servers)
    with pytest.raises(hf.HoldfastError) as refused:  # No system takes what is there, or nothing is there.
        await asyncio.to_thread(is_whole, dest)
    assert isinstance(refused.value, (hf.SpecError, StoreFailed)), refused.value
    await asyncio.to_thread(copy, source, dest, lambda point: None)
    assert await found_in(dest) == (5 << 20, 6)


async def lease_is_over(servers: str) -> None:
    """The copy that was given up could not give its lease back: nobody can open the store for up to three seconds."""
    async with asyncio.timeout(60.0):
        while True:
            try:
                (await asyncio.to_thread(open_store, servers)).close()
                return
            except StoreInUse:
                await asyncio.sleep(0.1)


def is_whole(store: str) -> None:
    """Nothing, if a system would take this store; else the reason why not."""
    with contextlib.closing(open_store(store, is_new=False)) as opened:
        check_system(opened, "app")
        if not opened.addresses():
            raise StoreFailed(store, "there is nothing in it")


async def test_a_full_disk_ends_a_copy(nats1: NatsServers, tmp_path: Path) -> None:
    servers, file = nats1.store(nats1.new_system()), f"sqlite:{tmp_path / 'app.db'}"
    await fill(servers)
    command = [sys.executable, "-m", "holdfast.console.cli", "store", "copy", servers, file]

    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))

    full = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, preexec_fn=small)
    assert full.returncode == 2, full.stderr
    assert full.stderr.startswith("holdfast store copy: "), full.stderr
    assert "Traceback" not in full.stderr
    with pytest.raises(hf.HoldfastError):
        is_whole(file)
    done = copied(servers, file)
    assert done.returncode == 0, done.stderr
    assert await found_in(file) == (5 << 20, 6)


async def test_a_copy_that_was_not_finished_is_no_store(tmp_path: Path) -> None:
    file, dest = f"sqlite:{tmp_path / 'app.db'}", f"sqlite:{tmp_path / 'dest.db'}"
    await fill(file)

    def fails(point: str) -> None:
        if point == "compare":
            raise StoreFailed("dest", "its server is gone")

    with pytest.raises(StoreFailed, match="its server is gone"):
        copy(file, dest, fails)
    with pytest.raises(hf.SpecError, match="it is a copy that was never finished: make it again"):
        await found_in(dest)
    with pytest.raises(NotCopied, match="it is a copy itself that was never finished"):
        copy(dest, f"sqlite:{tmp_path / 'third.db'}", lambda point: None)
    copy(file, dest, lambda point: None)
    with contextlib.closing(open_store(dest)) as opened:
        assert opened.noted(UNFINISHED) is None
    assert await found_in(dest) == (5 << 20, 6)


async def test_a_server_whose_disk_is_full_ends_a_copy(own_nats1: NatsServers, tmp_path: Path) -> None:
    servers, file = own_nats1.store(own_nats1.new_system()), f"sqlite:{tmp_path / 'app.db'}"
    await fill(file)
    whole: list[str] = []

    def small(text: str) -> str:
        whole.append(text)
        return re.sub("max_file_store: .*", "max_file_store: 2097152", text)

    own_nats1.kill(0)
    own_nats1.rewrite(0, small)
    await own_nats1.restart(0)
    with pytest.raises(StoreFailed):
        await asyncio.to_thread(copy, file, servers, lambda point: None)
    own_nats1.kill(0)
    own_nats1.rewrite(0, lambda text: whole[0])
    await own_nats1.restart(0)
    await lease_is_over(servers)
    with pytest.raises(hf.HoldfastError):
        await asyncio.to_thread(is_whole, servers)
    await asyncio.to_thread(copy, file, servers, lambda point: None)
    assert await found_in(servers) == (5 << 20, 6)
