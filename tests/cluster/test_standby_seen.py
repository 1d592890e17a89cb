"""A program that stands by is seen by its role, and commands take the program that runs the tree, or that is named."""

from __future__ import annotations

import asyncio
import json
import socket
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.console.endpoint import served
from holdfast.console.operate.reaching import NODE, NoSystem, chosen
from holdfast.console.remote import RemoteSystem
from holdfast.console.runtime_folder import found_sockets
from holdfast.console.wire import NotRunningHere
from tests.cluster.fleet import Programs
from tests.cluster.servers import NatsServers
from tests.console.commands import holdfast

pytestmark = pytest.mark.usefixtures("warm_programs")

WAITS = """
import asyncio, sys
import holdfast as hf
from holdfast.console.endpoint import served


async def main():
    async with served(hf.ActorSystem("bank", store=sys.argv[1], standby="warm", log=False)):
        print("leads", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.fixture(autouse=True)
def own_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder for sockets that no other test has; its path is short, as that of a socket must be."""
    for name in ("HOLDFAST_SYSTEM", "HOLDFAST_NODE"):
        monkeypatch.delenv(name, raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


@pytest.fixture
async def store(nats1: NatsServers) -> str:
    return nats1.store(nats1.new_system())


@pytest.fixture
async def programs(store: str, tmp_path: Path) -> AsyncIterator[Programs]:
    """A leader, and a program that stands by."""
    made = Programs(store, tmp_path, command=("-c", WAITS, store))
    try:
        await made.leads(await made.start())
        await until_role((await made.start()).pid, "standby")
        yield made
    finally:
        await made.close()


def about(pid: int) -> dict[str, Any] | None:
    """What a program says of itself; None if it has no endpoint yet."""
    for found in found_sockets():
        if found.pid == pid:
            with RemoteSystem(found.path) as remote:
                return remote.about()
    return None


async def until_role(pid: int, role: str) -> None:
    async with asyncio.timeout(60.0):
        while (await asyncio.to_thread(about, pid) or {}).get("role") != role:
            await asyncio.sleep(0.05)


async def test_programs_are_listed_by_role_and_the_one_that_runs_the_tree_is_taken(
    programs: Programs, store: str
) -> None:
    leader, standby = (process.pid for process in programs.processes)
    status, output, _ = await holdfast("ls")
    lines = {int(line.split()[2]): line for line in output.splitlines()[1:]}
    assert (status, len(lines)) == (0, 2)
    assert f"  standby of {socket.gethostname()}, process {leader}  " in lines[standby]
    assert "  leader  " in lines[leader]
    assert lines[leader].endswith(f"  {store.partition('?')[0]}")
    status, output, _ = await holdfast("tree", "--json")
    assert (status, json.loads(output)["pid"]) == (0, leader)
    status, output, errors = await holdfast("--node", "standby", "tree")
    assert (status, output) == (2, "")
    assert f"process {standby} does not run bank: it stands by, and " in errors
    assert f"process {leader} " in errors


async def test_a_program_is_chosen_by_pid_machine_and_role(programs: Programs) -> None:
    leader, standby = (process.pid for process in programs.processes)

    def pid_of(node: str) -> int:
        """Whose endpoint is chosen, in the thread of a command."""
        NODE.set(node)
        where = chosen("bank", None)
        return next(one.pid for one in found_sockets() if one.path == where)

    chosen_by = {node: await asyncio.to_thread(pid_of, node) for node in ("", "standby", "leader", str(standby))}
    assert chosen_by == {"": leader, "standby": standby, "leader": leader, str(standby): standby}
    assert await asyncio.to_thread(pid_of, socket.gethostname()) == leader
    with pytest.raises(NoSystem, match="no program is 'nobody', by its pid, machine or role; there are bank") as none:
        await asyncio.to_thread(pid_of, "nobody")
    assert f"bank (pid {leader}, leader)" in str(none.value)
    await programs.end(programs.of(leader))
    await programs.leads(programs.of(standby))
    assert await asyncio.to_thread(pid_of, "") == standby


async def test_a_system_that_is_not_up_tells_its_role_alone_and_its_endpoint_goes_with_it(store: str) -> None:
    leading, standby = (hf.ActorSystem(name, store=store, standby="warm", log=False) for name in ("bank", "bank"))
    assert (leading.role, leading.leader) == ("waiting", "")
    async with leading:
        assert (leading.role, leading.leader) == ("leader", "")
        came = asyncio.create_task(run(standby))
        await asyncio.sleep(0)
        standing = await standby.events().until(hf.events.StandingBy)
        assert (standby.role, standby.leader) == ("standby", standing.leader)
        [found] = found_sockets()

        def asks() -> None:
            with RemoteSystem(found.path) as remote:
                remote.tree()

        with pytest.raises(NotRunningHere, match=r"it stands by, and .* leads"):
            await asyncio.to_thread(asks)
    assert await came == "leader"
    assert found_sockets() == []


async def run(system: hf.ActorSystem) -> str:
    """What the system is when it is up."""
    async with served(system):
        return system.role
