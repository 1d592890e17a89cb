"""A store goes to servers and back: what a system had in it, it finds in the copy."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import NotCopied, StoreFailed
from holdfast.cluster.joining import open_store
from holdfast.cluster.store_copy import copy_store, kept_of
from tests.cluster.servers import NatsServers
from tests.cluster.shelves import copied, fill, found_in


async def test_a_store_goes_to_servers_and_back(nats1: NatsServers, tmp_path: Path) -> None:
    file, back = f"sqlite:{tmp_path / 'app.db'}", f"sqlite:{tmp_path / 'back.db'}"
    servers = nats1.store(nats1.new_system())
    await fill(file)
    for source, dest in ((file, servers), (servers, back)):
        done = copied(source, dest)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("copied "), done.stdout
    assert await found_in(servers) == (5 << 20, 6)
    assert await found_in(back) == (5 << 20, 6)


async def test_nothing_is_copied_into_a_store_that_has_something(nats1: NatsServers, tmp_path: Path) -> None:
    file, servers = f"sqlite:{tmp_path / 'app.db'}", nats1.store(nats1.new_system())
    await fill(file)
    await fill(servers)
    done = copied(file, servers)
    assert (done.returncode, "there is something in it already" in done.stderr) == (2, True), done.stderr
    assert "nkey" not in done.stderr


async def test_a_store_that_is_open_is_not_copied(nats1: NatsServers, tmp_path: Path) -> None:
    servers = nats1.store(nats1.new_system())
    async with hf.ActorSystem("app", store=servers, log=False):
        done = copied(servers, f"sqlite:{tmp_path / 'app.db'}")
    assert (done.returncode, "is in use" in done.stderr) == (2, True), done.stderr


async def test_what_is_not_there_is_not_copied_and_not_made(nats1: NatsServers, tmp_path: Path) -> None:
    typed, dest = tmp_path / "typo.db", tmp_path / "new.db"
    servers = nats1.store(nats1.new_system())
    for source, problem in (
        (f"sqlite:{typed}", "there is no such file"),
        (servers, "there is no system"),
        ("memory", "belongs to one program"),
    ):
        done = copied(source, f"sqlite:{dest}")
        assert (done.returncode, problem in done.stderr) == (2, True), done.stderr
    assert [*tmp_path.glob("*.db*")] == []
    with pytest.raises(StoreFailed, match="there is no system"):
        await asyncio.to_thread(open_store, servers, is_new=False)


def test_a_store_is_not_copied_into_itself(tmp_path: Path) -> None:
    file = tmp_path / "app.db"
    contextlib.closing(open_store(f"sqlite:{file}")).__exit__()
    done = copied(f"sqlite:{file}", f"sqlite:{file.parent}/./app.db")
    assert (done.returncode, "both are one store" in done.stderr) == (2, True), done.stderr


def test_a_copy_that_is_not_the_same_is_told(tmp_path: Path) -> None:
    with contextlib.ExitStack() as stack:
        one, other = (
            stack.enter_context(contextlib.closing(open_store(f"sqlite:{tmp_path / name}"))) for name in ("a", "b")
        )
        one.append([("/app/a", ("in", n)) for n in range(4)])
        keep = other.append

        def forgetful(entries: list[tuple[str, tuple[str, int]]]) -> list[int]:
            return [*keep(entries[:-1]), 0]

        other.append = forgetful  # type: ignore[method-assign, assignment]
        with pytest.raises(NotCopied, match="something else of /app/a"):
            copy_store(one, other, names=("a", "b"))
        assert len(kept_of(other, "/app/a").entries) == 3
