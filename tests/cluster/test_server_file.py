"""Server files: what they refuse to be written with, and what a real server that has one refuses to its users."""

from __future__ import annotations

import asyncio
import contextlib
import stat
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.js.api import StreamConfig

from holdfast.cluster.nats.access import access_of, connect_options
from holdfast.cluster.nats.server_check import check_server
from holdfast.cluster.nats.server_file import (
    VARZ,
    FileExists,
    NatsAccount,
    ServerPlan,
    TlsFiles,
    User,
    UserRole,
    inbox_of,
    new_seed,
    permissions,
    public_key,
    seed_file,
    server_text,
    write_server_files,
)
from holdfast.errors import SpecError
from tests.cluster.certificates import certificates
from tests.cluster.servers import PATIENCE, NatsServers

ONE = ServerPlan(name="n0", host="127.0.0.1", store_dir="/var/lib/nats")
THREE = [
    msgspec.structs.replace(ONE, name=f"n{number}", port=4222 + number, cluster_port=6222 + number)
    for number in range(3)
]
TLS = TlsFiles("/c.pem", "/k.pem", "/ca.pem")


class Tried:
    """A client, and what the server has refused to it."""

    def __init__(self, client: Client, refused: asyncio.Queue[str]) -> None:
        self.client, self._refused = client, refused

    async def may_publish(self, subject: str) -> bool:
        await self.client.publish(subject, b"")
        return await self._allowed(f'violation for publish to "{subject}"')

    async def may_subscribe(self, subject: str) -> bool:
        await self.client.subscribe(subject)
        return await self._allowed(f'violation for subscription to "{subject}"')

    async def _allowed(self, refusal: str) -> bool:
        """Refusals come in order: when that of a subject that nobody may use is there, this one is, if it comes."""
        await self.client.publish("nobody.may", b"")
        told: list[str] = []
        while not told or '"nobody.may"' not in told[-1]:
            told.append(await asyncio.wait_for(self._refused.get(), 30))
        assert all(refusal.lower() in one.lower() for one in told[:-1]), told
        return len(told) == 1


@asynccontextmanager
async def trying(servers: NatsServers, system: str, role: UserRole) -> AsyncGenerator[Tried]:
    refused: asyncio.Queue[str] = asyncio.Queue()

    async def note(error: Exception) -> None:
        refused.put_nowait(str(error))

    client = await servers.connect(system, role, error_cb=note)
    try:
        yield Tried(client, refused)
    finally:
        await client.close()


def mode_of(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


@pytest.mark.parametrize(
    ("role", "publishes", "subscribes", "no_publishing", "no_subscribing"),
    [
        (
            UserRole.NODE,
            ["hf.{s}.root.log", "hf.{s}.beat.n1", "$JS.API.STREAM.CREATE.x", "_INBOX.somebody.1", VARZ],
            ["hf.{s}.>", "{inbox}.*"],
            ["hf.other.root.in", "elsewhere", "$SYS.REQ.SERVER.PING.CONNZ"],
            ["hf.>", "_INBOX.>", ">", "$SYS.>", "$JS.API.>"],
        ),
        (
            UserRole.CLIENT,
            ["hf.{s}.root.in", "hf.{s}.node.n1.b1.x"],
            ["{inbox}.*"],
            ["hf.{s}.root.log", "hf.{s}.root.lease", "hf.{s}.beat.n1", "$JS.API.STREAM.MSG.GET.x", "_INBOX.x.1", VARZ],
            ["hf.{s}.>", "hf.{s}.root.in", "hf.{s}.root.log", "_INBOX.>", ">"],
        ),
        (
            UserRole.OBSERVER,
            ["$JS.API.INFO", "$JS.API.STREAM.INFO.x", VARZ],
            ["hf.{s}.beat.*", "hf.{s}.*.lease", "{inbox}.*"],
            ["hf.{s}.root.in", "hf.{s}.root.lease", "_INBOX.x.1", "$JS.API.STREAM.PURGE.x", "$JS.API.STREAM.MSG.GET.x"],
            ["hf.{s}.root.log", "hf.{s}.>", "_INBOX.>", "$JS.EVENT.>"],
        ),
    ],
)
async def test_a_role_may_do_what_it_is_for_and_nothing_else(
    nats1: NatsServers,
    role: UserRole,
    publishes: list[str],
    subscribes: list[str],
    no_publishing: list[str],
    no_subscribing: list[str],
) -> None:
    system = nats1.new_system()
    words = {"s": system, "inbox": inbox_of(public_key(seed_file(nats1.folder, system, role).read_text()))}
    async with trying(nats1, system, role) as tried:
        assert [one for one in publishes if not await tried.may_publish(one.format(**words))] == []
        assert [one for one in subscribes if not await tried.may_subscribe(one.format(**words))] == []
        assert [one for one in no_publishing if await tried.may_publish(one.format(**words))] == []
        assert [one for one in no_subscribing if await tried.may_subscribe(one.format(**words))] == []


async def test_a_node_answers_a_client_and_nobody_else_hears_it(nats1: NatsServers) -> None:
    system = nats1.new_system()
    node = await nats1.connect(system)
    client = await nats1.connect(system, UserRole.CLIENT)

    async def answer(question: Msg) -> None:
        await question.respond(question.data + b" answered")

    try:
        await node.subscribe(f"hf.{system}.root.in", cb=answer)
        await node.flush()
        async with asyncio.timeout(PATIENCE):
            while True:  # A request is sent at most once: whoever asks sends it again.
                with contextlib.suppress(NatsError):
                    reply = await client.request(f"hf.{system}.root.in", b"question", timeout=2)
                    break
                await asyncio.sleep(0.02)  # "Nobody is there" comes at once, while a client connects anew.
        assert reply.data == b"question answered"
    finally:
        await client.close()
        await node.close()


async def test_another_system_sees_nothing(nats1: NatsServers) -> None:
    one, other = nats1.new_system(), nats1.new_system()
    node, stranger = await nats1.connect(one), await nats1.connect(other)
    await node.jetstream().add_stream(StreamConfig(name="log", subjects=[f"hf.{one}.root.log"]))
    assert [info.config.name for info in await node.jetstream().streams_info()] == ["log"]
    assert await stranger.jetstream().streams_info() == []
    await stranger.close()
    async with trying(nats1, other, UserRole.NODE) as tried:
        assert not await tried.may_publish(f"hf.{one}.root.log")
        assert not await tried.may_subscribe(f"hf.{one}.>")
    assert (await node.jetstream().stream_info("log")).state.messages == 0
    await node.close()


async def test_who_has_no_key_is_not_let_in(nats1: NatsServers) -> None:
    system = nats1.new_system()
    options = connect_options(access_of(nats1.store(system).partition("?")[0]))
    options["max_reconnect_attempts"] = 1
    options["allow_reconnect"] = False
    client, told = Client(), list[str]()

    async def note(error: Exception) -> None:
        told.append(str(error).lower())

    with pytest.raises((NatsError, OSError)):
        await client.connect(**options, error_cb=note)
    await client.close()
    assert [one for one in told if "authorization violation" in one], told


async def test_servers_with_certificates_are_used_with_one_only(tmp_path: Path) -> None:
    files = certificates(tmp_path)
    servers = NatsServers(tmp_path / "servers", tls=files)
    (tmp_path / "servers").mkdir()
    await servers.start()
    system = servers.new_system()
    access = servers.access(system)
    assert access.is_encrypted
    client = await servers.connect(system)
    assert await check_server(client, access) == []
    await client.close()
    bare = connect_options(msgspec.structs.replace(access, certificate=None, key=None))
    bare["allow_reconnect"] = False
    stranger = Client()
    with pytest.raises((NatsError, OSError)):
        await stranger.connect(**bare, error_cb=_unheard)
    await stranger.close()
    servers.close()


async def _unheard(error: Exception) -> None:
    """What the client reports is raised, too."""


def test_all_files_are_for_their_owner_alone_and_keys_stay(tmp_path: Path) -> None:
    folder = tmp_path / "servers"
    files = write_server_files(folder, THREE, ["app"])
    assert [file.name for file in files] == [
        *("n0.conf", "n1.conf", "n2.conf"),
        *("app-node.nk", "app-client.nk", "app-observer.nk"),
    ]
    assert {mode_of(file) for file in folder.iterdir()} == {0o600}
    assert mode_of(folder) == 0o700
    before = {file.name: file.read_text() for file in folder.iterdir()}
    write_server_files(folder, THREE, ["app", "billing"], force=True)
    after = {file.name: file.read_text() for file in folder.iterdir()}
    assert {name for name in before if before[name] != after[name]} == {"n0.conf", "n1.conf", "n2.conf"}
    assert after.keys() - before.keys() == {"billing-node.nk", "billing-client.nk", "billing-observer.nk"}
    seeds = [text.strip() for name, text in after.items() if name.endswith(".nk")]
    assert not [seed for seed in seeds for name, text in after.items() if name.endswith(".conf") and seed in text]


def test_a_file_that_may_have_been_changed_by_hand_is_kept(tmp_path: Path) -> None:
    write_server_files(tmp_path, [ONE], ["app"])
    (tmp_path / "n0.conf").write_text("mine")
    with pytest.raises(FileExists, match=r"n0\.conf is there already"):
        write_server_files(tmp_path, [ONE], ["app"])
    assert (tmp_path / "n0.conf").read_text() == "mine"


def test_a_key_that_others_may_read_is_not_used_again(tmp_path: Path) -> None:
    write_server_files(tmp_path, [ONE], ["app"])
    seed_file(tmp_path, "app", UserRole.NODE).chmod(0o644)
    with pytest.raises(SpecError, match=r"others may use .*app-node"):
        write_server_files(tmp_path, [ONE], ["app"], force=True)


def replaced(number: int, **more: object) -> list[ServerPlan]:
    return [msgspec.structs.replace(one, **more) if one.name == f"n{number}" else one for one in THREE]


@pytest.mark.parametrize(
    ("servers", "systems", "problem"),
    [
        (THREE[:2], ["app"], "there are 2 servers: give 1, or 3"),
        ([], ["app"], "there are 0 servers"),
        (replaced(1, name="n0"), ["app"], "two servers have one name"),
        (replaced(1, port=4222), ["app"], "two servers have one client address"),
        (replaced(1, cluster_port=6222), ["app"], "two servers have one cluster address"),
        (replaced(1, host="10.0.0.2"), ["app"], "n1 listens on 10.0.0.2, which others reach"),
        (replaced(1, host="0.0.0.0"), ["app"], "which others reach"),
        (replaced(1, name="n 1"), ["app"], "must be at most 64 letters"),
        (replaced(1, store_dir="/var\n}"), ["app"], "cannot be printed"),
        ([ONE], [], "there is no system"),
        ([ONE], ["app", "app"], "different names"),
        ([ONE], ["SYS"], "none of them SYS"),
        ([ONE], ["app.>"], "must be at most 64 letters"),
    ],
)
def test_a_plan_that_does_not_work_is_refused(
    tmp_path: Path, servers: list[ServerPlan], systems: list[str], problem: str
) -> None:
    with pytest.raises(SpecError, match="nats config: ") as refused:
        write_server_files(tmp_path / "servers", servers, systems)
    assert problem in str(refused.value)
    assert not [*tmp_path.glob("servers/*.conf")]


def test_no_text_of_a_plan_ends_its_quotes() -> None:
    strange = msgspec.structs.replace(ONE, store_dir='/var/"}\\')
    assert 'store_dir: "/var/\\"}\\\\"' in server_text(strange, [strange], [NatsAccount("app", ())], "")


def test_a_server_that_others_reach_asks_for_certificates_everywhere() -> None:
    far = [msgspec.structs.replace(one, host=f"10.0.0.{one.name[1]}", tls=TLS) for one in THREE]
    text = server_text(far[0], far, [NatsAccount("app", ())], "secret")
    assert text.count("verify: true") == text.count("tls {") == 2
    assert "nats-route://holdfast:secret@10.0.0.2:6224" in text
    assert 'http: "127.0.0.1:8222"' in text


def test_each_user_has_answers_of_its_own() -> None:
    keys = [public_key(new_seed()) for _ in range(2)]
    inboxes = {f"{inbox_of(key)}.>" for key in keys}
    for key in keys:
        heard = permissions("app", User(UserRole.CLIENT, key)).subscribe
        assert inboxes & {*heard} == {f"{inbox_of(key)}.>"}
