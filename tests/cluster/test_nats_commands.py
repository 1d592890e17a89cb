"""`holdfast nats config`, `check` and `remove`, and `holdfast store` with servers, as a user runs them."""

from __future__ import annotations

import asyncio
import json
import subprocess
from pathlib import Path

import pytest
from nats.js.api import StorageType
from typer.testing import CliRunner, Result

import holdfast as hf
from holdfast.cluster.nats.access import access_of
from holdfast.cluster.nats.server_file import UserRole
from holdfast.cluster.nats.system_streams import SubjectNames, stream_settings
from holdfast.console.commands import commands
from tests.cluster.servers import NatsServers, free_ports, server_binary
from tests.cluster.shelves import Put, Shelf

pytestmark = pytest.mark.usefixtures("warm_programs")


def nats(*arguments: str) -> Result:
    return CliRunner().invoke(commands, ["nats", *arguments])


def test_the_files_are_such_that_a_server_takes_them(tmp_path: Path) -> None:
    folder = tmp_path / "servers"
    done = nats("config", str(folder), "--system", "app", *3 * ("--host", "127.0.0.1"), "--store-dir", str(tmp_path))
    assert done.exit_code == 0
    *files, told = done.output.splitlines()
    assert [Path(line).name for line in files] == [
        *("nats-1.conf", "nats-2.conf", "nats-3.conf"),
        *("app-node.nk", "app-client.nk", "app-observer.nk"),
    ]
    servers = "127.0.0.1:4222,127.0.0.1:4223,127.0.0.1:4224"
    assert told == f'app: store="nats://{servers}/app?nkey={folder}/app-node.nk"'
    assert access_of(told.partition('"')[2].rstrip('"')).servers[1] == "nats://127.0.0.1:4223"
    for number in range(3):
        file = folder / f"nats-{number + 1}.conf"
        subprocess.run([server_binary(), "-t", "-c", str(file)], check=True, capture_output=True, timeout=60)
        assert f'listen: "127.0.0.1:{4222 + number}"' in file.read_text()
    again = nats("config", str(folder), "--system", "app")
    assert again.exit_code == 2
    assert "nats-1.conf is there already: give another folder, or --force" in again.output


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--host", "10.0.0.1"], "give it a certificate"),
        (["--host", "10.0.0.1", "--certificate", "/c.pem"], "belong together"),
        (["--host", "127.0.0.1", "--host", "127.0.0.1"], "there are 2 servers"),
    ],
)
def test_a_plan_that_does_not_work_is_refused(tmp_path: Path, arguments: list[str], problem: str) -> None:
    done = nats("config", str(tmp_path), "--system", "app", *arguments)
    assert done.exit_code == 2
    assert problem in done.output
    assert done.output.count("nats config:") == 1


async def _fill(store: str) -> None:
    async with hf.ActorSystem("shop", store=store, log=False) as system:
        await (await system.start(hf.child("shelf", hf.start(Shelf), recovery=hf.hybrid()))).ask(Put("one"))


async def _lines_in(store: str) -> int:
    async with hf.ActorSystem("shop", store=store, log=False) as system:
        return await (await system.start(hf.child("shelf", hf.start(Shelf), recovery=hf.hybrid()))).ask(Put("more"))


def test_a_store_is_removed_when_nobody_leads_and_that_is_confirmed(nats1: NatsServers) -> None:
    store = nats1.store(nats1.new_system())
    asyncio.run(_fill(store))

    async def led() -> Result:
        async with hf.ActorSystem("shop", store=store, log=False):
            return await asyncio.to_thread(nats, "remove", store, "--yes")

    in_use = asyncio.run(led())
    assert (in_use.exit_code, "is in use" in in_use.output) == (2, True), in_use.output
    asked = CliRunner().invoke(commands, ["nats", "remove", store], input="n\n")
    assert (asked.exit_code, "nkey" in asked.output) == (1, False)
    assert asyncio.run(_lines_in(store)) == 2
    removed = nats("remove", store, "--yes")
    assert (removed.exit_code, removed.output.count("removed hf-app")) == (0, 3), removed.output
    assert nats("remove", store, "--yes").output == "there was nothing\n"
    assert asyncio.run(_lines_in(store)) == 1


def test_a_store_is_not_copied_to_the_place_of_another_system(nats1: NatsServers, tmp_path: Path) -> None:
    file, store = f"sqlite:{tmp_path / 'shop.db'}", nats1.store(nats1.new_system())
    asyncio.run(_fill(file))
    refused = CliRunner().invoke(commands, ["store", "copy", file, store])
    assert (refused.exit_code, "that is the place of another system" in refused.output) == (2, True), refused.output
    assert nats("remove", store, "--yes").output == "there was nothing\n"
    assert CliRunner().invoke(commands, ["store", "copy", file, store, "--other-name"]).exit_code == 0
    assert asyncio.run(_lines_in(store)) == 2


@pytest.mark.parametrize("command", ["verify", "stats", "export", "compact", "backup", "restore", "rekey"])
def test_a_command_for_files_says_what_is_for_servers(command: str, tmp_path: Path) -> None:
    dest = [str(tmp_path / "copy.db")] if command in ("backup", "restore", "rekey") else []
    done = CliRunner().invoke(commands, ["store", command, "nats://127.0.0.1/shop?nkey=shop.nk", *dest])
    assert done.exit_code == 2
    assert "this is for a store in a file" in done.output


def test_servers_are_checked(nats1: NatsServers) -> None:
    good = nats("check", nats1.store(nats1.new_system()))
    assert (good.exit_code, good.output) == (0, "ok: what is acknowledged there stays\n")
    system = nats1.new_system()
    asyncio.run(_in_memory(nats1, system))
    bad = nats("check", nats1.store(system))
    assert bad.exit_code == 1
    assert f"PROBLEM: the stream hf-{system}-log: storage is memory" in bad.output
    told = json.loads(nats("check", nats1.store(system), "--json").output)
    assert {one["is_warning"] for one in told} == {False}


async def _in_memory(servers: NatsServers, system: str) -> None:
    client = await servers.connect(system)
    setting = stream_settings(SubjectNames(system), 1)[0]
    setting.storage = StorageType.MEMORY
    await client.jetstream().add_stream(setting)
    await client.close()


def test_who_is_not_let_in_is_told(nats1: NatsServers) -> None:
    stranger = nats("check", nats1.store(nats1.new_system()).partition("?")[0])
    assert stranger.exit_code == 2
    assert "authorization violation" in stranger.output.lower()
    client = nats("check", nats1.store(nats1.new_system(), UserRole.CLIENT))
    assert client.exit_code == 2
    assert "it is the key of a client, or of another system" in client.output
    one, other = nats1.new_system(), nats1.new_system()
    confused = nats("check", nats1.store(one).replace(f"/{one}?", f"/{other}?"))
    assert confused.exit_code == 2
    assert f"may not look at the system {other}" in confused.output
    assert nats("check", nats1.store(one, UserRole.OBSERVER)).exit_code == 0


def test_servers_that_are_not_there_are_told(tmp_path: Path) -> None:
    done = nats("check", f"nats://127.0.0.1:{free_ports(1)[0]}/app", "--seconds", "1")
    assert done.exit_code == 2
    assert "nobody listens there" in done.output
